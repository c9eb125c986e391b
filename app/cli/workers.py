"""Worker processes for commands that take `--workers`, and Dask or SLURM for those that take `--cluster`."""

from __future__ import annotations

import asyncio
import multiprocessing
import os
import signal
import sys
import threading
from collections.abc import Iterator
from concurrent.futures import Executor, ProcessPoolExecutor
from contextlib import contextmanager, suppress
from multiprocessing.connection import wait
from multiprocessing.context import SpawnContext, SpawnProcess

from osfcore.errors import InvalidInput, OsfError, WorkerDied

from ..processes.child_process import interrupts_held_back
from .cluster_jobs import job_executor, names_jobs

MAX_WORKERS = 256


@contextmanager
def worker_pool(
    workers: int, cluster: str | None = None, *, answers_within_s: float = 10.0
) -> Iterator[Executor | None]:
    """Processes that share the work; None, which means this process alone, for one.

    Args:
        workers: processes of this machine.
        cluster: address of a Dask scheduler whose workers share the work instead, or how `job_executor` names jobs.
        answers_within_s: how long the scheduler may take to answer.

    Raises:
        InvalidInput: if the number is out of range, or nothing answers at the address.
        OsfError: if Dask or submitit is not installed.
        WorkerDied: if a piece of work has ended several workers of the cluster.
    """
    if cluster is not None:
        jobs = job_executor(cluster, workers) if names_jobs(cluster) else _cluster(cluster, answers_within_s)
        with jobs as executor:
            yield executor
        return
    if not 1 <= workers <= MAX_WORKERS:
        raise InvalidInput("number of workers", workers, f"between 1 and {MAX_WORKERS}")
    executor, others = None, set(multiprocessing.active_children())
    if workers > 1:
        with suppress(OSError):  # no shared memory, as in some sandboxes: slower, but it works
            executor = ProcessPoolExecutor(workers, mp_context=_Workers(), initializer=_end_with_parent)
    try:
        yield executor
    except (KeyboardInterrupt, OsfError):  # a piece of work may take minutes
        for worker in set(multiprocessing.active_children()) - others:
            worker.terminate()
        raise
    finally:
        if executor is not None:
            executor.shutdown(wait=True, cancel_futures=True)


@contextmanager
def _cluster(address: str, answers_within_s: float) -> Iterator[Executor]:
    try:
        from distributed import Client
        from distributed.comm.core import connect
        from distributed.scheduler import KilledWorker
    except ImportError:
        raise OsfError("--cluster needs Dask; 'pip install osf-manipulation[cluster]' brings it.") from None

    async def check() -> None:
        (await connect(address, timeout=answers_within_s)).abort()

    try:
        # Before there is a client: one that cannot connect waits for the collector, which closes it. Where that happens
        # while another one starts, both wait for Dask's lock for ever.
        asyncio.run(check())
    except (OSError, ValueError):
        allowed = "that of a running Dask scheduler, such as tcp://127.0.0.1:8786 ('dask scheduler' prints its own)"
        raise InvalidInput("address of the cluster", address, allowed) from None
    with Client(address, timeout=answers_within_s, set_as_default=False) as client:
        try:
            yield client.get_executor()
        except KilledWorker as error:
            raise WorkerDied("sharing the work of the cluster") from error


class _Worker(SpawnProcess):
    """A worker that begins with Ctrl-C held back: until `_end_with_parent` has run, its answer would be a traceback."""

    def start(self) -> None:
        with interrupts_held_back():
            super().start()


class _Workers(SpawnContext):
    Process = _Worker


def _end_with_parent() -> None:
    """Let Ctrl-C or the parent's death end a worker at once and silently: what it writes is whole or not there."""
    signal.signal(signal.SIGINT, signal.SIG_DFL)
    if sys.platform != "win32":
        signal.pthread_sigmask(signal.SIG_UNBLOCK, {signal.SIGINT})
    parent = multiprocessing.parent_process()
    assert parent is not None
    threading.Thread(target=_leave_after, args=(parent.sentinel,), daemon=True).start()


def _leave_after(sentinel: int) -> None:
    wait([sentinel])
    os._exit(1)
