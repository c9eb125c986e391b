"""Starting and ending child processes so that none outlives the service, and Ctrl-C reaches only the service."""

from __future__ import annotations

import contextlib
import importlib
import multiprocessing
import os
import signal
import sys
import time
from collections.abc import Callable, Iterator
from multiprocessing import resource_tracker
from multiprocessing.connection import Connection
from multiprocessing.context import SpawnProcess
from multiprocessing.process import BaseProcess
from typing import cast

import psutil

_NICENESS = 5
_SPAWN = multiprocessing.get_context("spawn")
_NOTING_TRIES, _NOTING_S = 200, 0.005
_UNKNOWN = (psutil.Error, OSError)  # a process that has just left, or no file descriptor left to read of it


def launch(target: Callable[..., None], name: str, *arguments: object) -> tuple[SpawnProcess, Connection]:
    """Start `target(connection, *arguments)` in a new process; returns it and the other end of its pipe."""
    ours, theirs = _SPAWN.Pipe(duplex=True)
    process = _SPAWN.Process(target=target, name=name, args=(theirs, *arguments), daemon=True)
    if sys.platform != "win32":
        resource_tracker.ensure_running()  # its own start would unblock the signal again
    try:
        with interrupts_held_back():  # children never see one
            process.start()
    except BaseException:
        ours.close()
        raise
    finally:
        theirs.close()  # or its end would never be seen
    return process, cast(Connection, ours)  # on Windows, it is another class with the same methods


@contextlib.contextmanager
def interrupts_held_back() -> Iterator[None]:
    """Hold back Ctrl-C, which reaches everything that runs in a terminal, from this thread and what it starts.

    Windows has no such thing: a process that starts there can be interrupted until it ignores the signal.
    """
    if sys.platform == "win32":
        yield
        return
    before = signal.pthread_sigmask(signal.SIG_BLOCK, {signal.SIGINT})
    try:
        yield
    finally:
        signal.pthread_sigmask(signal.SIG_SETMASK, before)


def leave_it_to_the_service() -> None:
    """Ignore Ctrl-C, and a terminal that closes: the service decides when this process stops."""
    signal.signal(signal.SIGINT, signal.SIG_IGN)
    if sys.platform != "win32":
        signal.signal(signal.SIGHUP, signal.SIG_IGN)


def give_way() -> None:
    """Let other processes have the processor first."""
    this = psutil.Process()
    if sys.platform == "win32":
        this.nice(psutil.BELOW_NORMAL_PRIORITY_CLASS)
    else:
        this.nice(this.nice() + _NICENESS)


def silence_stdout() -> None:
    """Send what libraries write to standard output nowhere: the service's own output is one line that people read."""
    nowhere = os.open(os.devnull, os.O_WRONLY)
    os.dup2(nowhere, 1)
    os.close(nowhere)


def import_quietly(module: str) -> None:
    """Import a module whose libraries greet on standard error; real errors still raise."""
    kept, nowhere = os.dup(2), os.open(os.devnull, os.O_WRONLY)
    os.dup2(nowhere, 2)
    try:
        importlib.import_module(module)
    finally:
        os.dup2(kept, 2)
        os.close(kept)
        os.close(nowhere)


def limit_memory(more_bytes: int) -> None:
    """Let this process take no more memory than this beside what it has now; asking for more is a MemoryError.

    Only Linux holds a process to it; elsewhere there is no limit.
    """
    if sys.platform == "linux":
        most, _ = _limits(psutil.RLIMIT_AS, psutil.Process().memory_info().vms + more_bytes)
        psutil.Process().rlimit(psutil.RLIMIT_AS, (most, most))


def limit_cpu(more_s: int) -> None:
    """End this process once it has computed for so long from now on [s]; only on Linux, as `limit_memory`."""
    if sys.platform == "linux":
        used = psutil.Process().cpu_times()
        limits = _limits(psutil.RLIMIT_CPU, int(used.user + used.system) + more_s)
        psutil.Process().rlimit(psutil.RLIMIT_CPU, limits)


if sys.platform == "linux":

    def _limits(which: int, most: int) -> tuple[int, int]:
        """A limit, lowered to what the system lets this process have; and that."""
        hard = psutil.Process().rlimit(which)[1]
        return most if hard == psutil.RLIM_INFINITY else min(most, hard), hard


def is_stopped(pid: int) -> bool:
    """Whether the system has stopped a process; False where that is not known."""
    try:
        return psutil.Process(pid).status() == psutil.STATUS_STOPPED
    except _UNKNOWN:
        return False


def end_with_children() -> None:
    """End this process and what it has started at once."""
    _kill_started_by(os.getpid())
    os._exit(1)


def end_children() -> None:
    """End all children of this process and theirs at once, without waiting for them; for signal handlers."""
    for process in multiprocessing.active_children():
        _kill_tree(process)


def end(process: SpawnProcess, grace_s: float = 0.0) -> None:
    """Wait `grace_s` for a process to leave by itself, then end it and its children. Calling it again does nothing."""
    process.join(grace_s)
    if process.is_alive():
        _kill_tree(process)
    process.join()
    for _ in range(_NOTING_TRIES):  # another thread may have taken the exit code, and be about to note it
        if not process.is_alive():
            return
        time.sleep(_NOTING_S)


def _kill_tree(process: BaseProcess) -> None:
    if process.pid is not None:
        with contextlib.suppress(*_UNKNOWN):
            psutil.Process(process.pid).suspend()  # so that it starts nothing more
            _kill_started_by(process.pid)
    process.kill()


def _kill_started_by(pid: int) -> None:
    with contextlib.suppress(*_UNKNOWN):
        for process in psutil.Process(pid).children(recursive=True):
            with contextlib.suppress(psutil.Error):
                process.kill()
