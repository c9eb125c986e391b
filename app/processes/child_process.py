"""Starting and ending child processes so that none outlives the service, and Ctrl-C reaches only the service."""

from __future__ import annotations

import contextlib
import importlib
import multiprocessing
import os
import resource
import signal
import time
from collections.abc import Callable
from multiprocessing import resource_tracker
from multiprocessing.connection import Connection
from multiprocessing.context import SpawnProcess
from pathlib import Path

_SPAWN = multiprocessing.get_context("spawn")
_NOTING_TRIES, _NOTING_S = 200, 0.005


def launch(target: Callable[..., None], name: str, *arguments: object) -> tuple[SpawnProcess, Connection]:
    """Start `target(connection, *arguments)` in a new process; returns it and the other end of its pipe."""
    ours, theirs = _SPAWN.Pipe(duplex=True)
    process = _SPAWN.Process(target=target, name=name, args=(theirs, *arguments), daemon=True)
    resource_tracker.ensure_running()  # its own start would unblock the signal again
    # A Ctrl-C goes to the whole terminal group; children inherit the mask and thus never see one.
    before = signal.pthread_sigmask(signal.SIG_BLOCK, {signal.SIGINT})
    try:
        process.start()
    except BaseException:
        ours.close()
        raise
    finally:
        signal.pthread_sigmask(signal.SIG_SETMASK, before)
        theirs.close()  # or its end would never be seen
    return process, ours


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
    """Let this process take no more memory than this beside what it has now; asking for more is a MemoryError."""
    pages = int(Path("/proc/self/statm").read_text(encoding="ascii").split()[0])
    most, hard = pages * resource.getpagesize() + more_bytes, resource.getrlimit(resource.RLIMIT_AS)[1]
    most = most if hard == resource.RLIM_INFINITY else min(most, hard)
    resource.setrlimit(resource.RLIMIT_AS, (most, most))


def own_group() -> None:
    """Make this process the head of a group, so that its own children end with it (see `end`)."""
    os.setpgid(0, 0)


def end_own_group() -> None:
    """End this process and its children at once; only for a process that called `own_group`."""
    if os.getpgid(0) == os.getpid():
        os.killpg(0, signal.SIGKILL)
    os._exit(1)


def end_children() -> None:
    """End all children of this process and their groups at once, without waiting for them; for signal handlers."""
    for process in multiprocessing.active_children():
        if process.pid is not None:
            with contextlib.suppress(ProcessLookupError):
                if os.getpgid(process.pid) == process.pid:
                    os.killpg(process.pid, signal.SIGKILL)
                os.kill(process.pid, signal.SIGKILL)


def end(process: SpawnProcess, grace_s: float = 0.0) -> None:
    """Wait `grace_s` for a process to leave by itself, then end it and its group. Calling it again does nothing."""
    process.join(grace_s)
    if process.is_alive() and process.pid is not None:
        with contextlib.suppress(ProcessLookupError):  # it has just left
            if os.getpgid(process.pid) == process.pid:
                os.killpg(process.pid, signal.SIGKILL)
        process.kill()
    process.join()
    for _ in range(_NOTING_TRIES):  # another thread may have taken the exit code, and be about to note it
        if not process.is_alive():
            return
        time.sleep(_NOTING_S)
