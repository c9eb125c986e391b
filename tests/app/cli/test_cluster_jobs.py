"""`--cluster slurm`, with jobs that are processes of this machine; a real SLURM is not at hand."""

import signal
import time
from functools import partial
from pathlib import Path

import numpy as np
import pytest

from app.cli.cluster_jobs import FOLDER
from app.cli.workers import worker_pool
from osfcore.errors import InvalidInput, WorkerDied
from osfcore.io.push_file import read_pushes
from osfcore.world.collect_pushes import CollectPushes, collect_pushes
from tests.app.cli.test_workers import pieces_of, results
from tests.clusters import deadly, number_of
from tests.support.errors import about


@pytest.fixture(autouse=True)
def place(tmp_path, monkeypatch):
    """Jobs leave their logs in the present folder; they find the tests where these were started."""
    monkeypatch.setenv("PYTHONPATH", str(Path.cwd()))
    monkeypatch.chdir(tmp_path)


@pytest.mark.slow
def test_jobs_give_the_same_numbers_and_leave_logs(tmp_path):
    works = [partial(number_of, n) for n in range(3)]
    assert results(worker_pool(2, "local-jobs"), pieces_of(tmp_path / "jobs", works)) == [0, 1, 2]
    assert any(FOLDER.iterdir())


@pytest.mark.slow
def test_pushes_from_jobs_are_the_same_to_the_last_bit(library, tmp_path):
    for name, pool in (("alone", worker_pool(1)), ("jobs", worker_pool(1, "local-jobs:jobs=2"))):
        config = CollectPushes(tmp_path / f"{name}.h5", episodes=2, steps=3, objects=2, policy="directed")
        with pool as executor:
            for _ in collect_pushes(config, library, executor):
                pass
    alone, shared = (list(read_pushes(tmp_path / f"{name}.h5")) for name in ("alone", "jobs"))
    for one, other in zip(alone, shared, strict=True):
        np.testing.assert_array_equal(one.positions, other.positions)


@pytest.mark.slow
def test_errors_of_a_job_arrive_as_they_are_and_a_dead_one_is_told(tmp_path):
    with worker_pool(2, "local-jobs") as executor:
        refused = executor.submit(check_number, 3)
        with pytest.raises(InvalidInput, check=about("number")):
            refused.result()
        with pytest.raises(WorkerDied):
            results(worker_pool(1, "local-jobs"), pieces_of(tmp_path, [partial(deadly, 0)]))


def check_number(n):
    raise InvalidInput("number", n, "another")


@pytest.mark.slow
def test_jobs_that_are_left_are_cancelled(tmp_path):
    mark = tmp_path / "mark"
    with worker_pool(1, "local-jobs") as executor:
        left = [executor.submit(begin_and_sleep, mark) for _ in range(2)]
        while not mark.exists():
            time.sleep(0.05)
    running, waiting = left
    assert waiting.cancelled()
    with pytest.raises(WorkerDied):
        running.result(timeout=60)


def begin_and_sleep(mark):
    signal.signal(signal.SIGINT, signal.default_int_handler)  # as where the tests run in the background
    mark.touch()
    time.sleep(600)


@pytest.mark.parametrize("cluster", ["slurm:gpu", "local-jobs:jobs=0", "local-jobs:jobs=many", "local-jobs:colour=red"])
def test_what_no_cluster_takes_is_refused(cluster):
    with pytest.raises(InvalidInput, check=about("cluster")), worker_pool(2, cluster):
        pass


def test_slurm_where_there_is_none_is_refused(monkeypatch):
    monkeypatch.setenv("PATH", "")
    with pytest.raises(InvalidInput, check=about("cluster")), worker_pool(2, "slurm"):
        pass
