"""A Dask cluster of this machine, and pieces of work and trainings for it."""

import os
import signal
from collections.abc import Iterator
from contextlib import contextmanager
from pathlib import Path

import numpy as np
from distributed import LocalCluster

from osfcore.experiments.harness import TaskResult
from osfcore.fields.train_kiloosf import TrainField, train_field
from osfcore.fields.train_osf import FieldStep
from osfcore.inspection.contact_sheet import Comparison
from tests.support.rendered_sets import QUICK


@contextmanager
def local_cluster(folder: Path):
    """The address of a scheduler with two workers, each one process with one thread."""
    with LocalCluster(
        n_workers=2, threads_per_worker=1, dashboard_address=None, local_directory=str(folder), scheduler_port=0
    ) as cluster:
        yield cluster.scheduler_address


def number_of(n: int) -> TaskResult:
    """A result that tells its number and who made it."""
    shown = Comparison(str(n), *(np.full((4, 4, 3), n, np.uint8) for _ in range(2)))
    return TaskResult({"number": n, "process": os.getpid()}, (shown,))


def number_that_kills(n: int, mark: Path) -> TaskResult:
    """The same, but its worker dies of it the first time."""
    if not mark.exists():
        mark.touch()
        os.kill(os.getpid(), signal.SIGKILL)
    return number_of(n)


def deadly(_: int) -> TaskResult:
    """Every worker dies of it."""
    os.kill(os.getpid(), signal.SIGKILL)
    raise AssertionError("dead")


def training_that_dies(settings: TrainField, name: str, mark: Path) -> Iterator[FieldStep]:
    """A quick training whose process dies of one object the first time, when it has begun."""
    steps = train_field(settings, QUICK)
    yield next(steps)
    if settings.out.stem == name and not mark.exists():
        mark.touch()
        os.kill(os.getpid(), signal.SIGKILL)
    yield from steps
