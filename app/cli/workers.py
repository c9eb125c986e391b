"""Worker processes for commands that take `--workers`."""

from __future__ import annotations

import multiprocessing
import os
import signal
import threading
from collections.abc import Iterator
from concurrent.futures import Executor, ProcessPoolExecutor
from contextlib import contextmanager
from multiprocessing.connection import wait

from osfcore.errors import InvalidInput

MAX_WORKERS = 256


@contextmanager
def worker_pool(workers: int) -> Iterator[Executor | None]:
    """Processes that share the work; None, which means this process alone, for one.

    Raises:
        InvalidInput: if the number is out of range.
    """
    if not 1 <= workers <= MAX_WORKERS:
        raise InvalidInput("number of workers", workers, f"between 1 and {MAX_WORKERS}")
    executor = _processes(workers) if workers > 1 else None
    try:
        yield executor
    finally:
        if executor is not None:
            executor.shutdown(wait=True, cancel_futures=True)


def _processes(workers: int) -> Executor | None:
    try:
        context = multiprocessing.get_context("spawn")
        return ProcessPoolExecutor(workers, mp_context=context, initializer=_end_with_parent)
    except OSError:  # no shared memory, as in some sandboxes: slower, but it works
        return None


def _end_with_parent() -> None:
    """Let Ctrl-C or the parent's death end a worker at once and silently: what it writes is whole or not there."""
    signal.signal(signal.SIGINT, signal.SIG_DFL)
    parent = multiprocessing.parent_process()
    assert parent is not None
    threading.Thread(target=_leave_after, args=(parent.sentinel,), daemon=True).start()


def _leave_after(sentinel: int) -> None:
    wait([sentinel])
    os._exit(1)
