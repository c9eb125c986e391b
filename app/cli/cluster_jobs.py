"""SLURM as a `concurrent.futures.Executor`: each piece of work is a job of submitit."""

from __future__ import annotations

import threading
import time
from collections.abc import Callable, Iterator
from concurrent.futures import Executor, Future, ThreadPoolExecutor
from contextlib import contextmanager
from pathlib import Path
from typing import Any

from osfcore.errors import InvalidInput, OsfError, WorkerDied
from osfcore.extras import need

KINDS = {"slurm": "slurm", "local-jobs": "local"}  # what --cluster says, and what submitit calls it
FOLDER = Path("osf-jobs")  # of the orders, answers and logs of jobs; all machines must see it
_FORM = "slurm, or slurm:KEY=VALUE,..., such as slurm:partition=gpu,time=60,jobs=100"
_MOST_JOBS = 64  # of SLURM at a time
_MINUTES = 60  # that a job may take; submitit would give it five
_POLL_S, _ENDS_WITHIN_S = 1.0, 5.0


def names_jobs(cluster: str) -> bool:
    """Whether a cluster is one of jobs, and not the address of a scheduler."""
    return cluster.partition(":")[0] in KINDS


@contextmanager
def job_executor(cluster: str, workers: int) -> Iterator[Executor]:
    """An executor that makes a job of each piece of work; those that are left are cancelled at the end.

    Args:
        cluster: "slurm" or "local-jobs", which are processes of this machine; after a colon, options of sbatch, and
            jobs=N, the most at a time.
        workers: the most jobs at a time on this machine, where the cluster does not say.

    Raises:
        InvalidInput: if an option is unknown, or this is no machine of a cluster.
        MissingExtra: if submitit is not installed.
    """
    need("slurm", "This cluster")
    from submitit import AutoExecutor

    kind, _, rest = cluster.partition(":")
    try:
        pairs = (pair.split("=") for pair in rest.split(",") if pair)
        asked: dict[str, Any] = {f"slurm_{key}": int(value) if value.isdecimal() else value for key, value in pairs}
        jobs = int(asked.pop("slurm_jobs", _MOST_JOBS if kind == "slurm" else workers))
        makes_jobs = AutoExecutor(FOLDER, cluster=KINDS[kind])
        makes_jobs.update_parameters(name="osf", timeout_min=_MINUTES, **asked)
        executor = _JobExecutor(makes_jobs, jobs)
    except ValueError:  # no pair, no number, or no job at all
        raise InvalidInput("cluster", cluster, _FORM) from None
    except (NameError, RuntimeError) as error:
        raise InvalidInput("cluster", cluster, f"{_FORM} ({str(error).splitlines()[0]})") from None
    try:
        yield executor
    finally:
        executor.is_over.set()
        executor.shutdown(cancel_futures=True)


class _JobExecutor(ThreadPoolExecutor):
    """A thread waits for each job, because jobs are no futures."""

    def __init__(self, makes_jobs: Any, jobs: int) -> None:  # noqa: ANN401  submitit is an extra
        super().__init__(jobs)
        self.is_over = threading.Event()
        self._makes_jobs, self._submitting = makes_jobs, threading.Lock()

    def submit(self, fn: Callable[..., Any], /, *args: Any, **kwargs: Any) -> Future[Any]:  # noqa: ANN401
        return super().submit(self._result_of_job, fn, args, kwargs)

    def _result_of_job(self, fn: Callable[..., Any], args: tuple[Any, ...], kwargs: dict[str, Any]) -> object:
        from submitit.core.utils import FailedJobError, UncompletedJobError

        with self._submitting:
            job = self._makes_jobs.submit(_told, fn, args, kwargs)
        while not job.done():
            if self.is_over.wait(_POLL_S):
                job.cancel(check=False)
                ends = time.monotonic() + _ENDS_WITHIN_S
                while not job.done() and time.monotonic() < ends:  # a process of this machine shall not be left
                    time.sleep(_POLL_S / 10)
                raise WorkerDied("sharing the work of the cluster")
        try:
            result, error = job.result()
        except FailedJobError:
            raise  # a mistake of ours: its text has the traceback of the job
        except UncompletedJobError:
            raise WorkerDied(f"working on a job, whose log is in {FOLDER}") from None
        if error is not None:
            raise error
        return result


def _told(fn: Callable[..., Any], args: tuple[Any, ...], kwargs: dict[str, Any]) -> tuple[object, OsfError | None]:
    """Return the result or an error of ours, of which submitit would keep the text alone."""
    try:
        return fn(*args, **kwargs), None
    except OsfError as error:
        return None, error
