"""What strangers send: written to disk bit by bit, then looked at in a process of its own.

Decoding takes much memory and may crash; neither must hurt the service. What is done with a sound upload is up to
`image_sets` and `estimates`.
"""

from __future__ import annotations

import asyncio
import contextlib
import logging
import signal
import threading
from collections.abc import AsyncIterator, Callable
from multiprocessing.connection import Connection
from multiprocessing.context import SpawnProcess
from pathlib import Path
from typing import Generic, TypeVar

from starlette.concurrency import run_in_threadpool

from app.processes.child_process import end, launch, own_group, silence_stdout
from app.processes.messages import Failure
from app.storage.database import CannotStore
from osfcore.errors import OsfError

_WRITE_BYTES = 1 << 20
_PATIENCE_S = 600.0
_log = logging.getLogger(__name__)
Found = TypeVar("Found")


class UploadRefused(OsfError):
    """An upload that cannot be used, told by the process that looked at it; `kind` is the class of its error."""

    def __init__(self, kind: str, text: str) -> None:
        super().__init__(text)
        self.kind = "CannotStore" if kind == "CannotWrite" else "UploadRefused"


async def save(chunks: AsyncIterator[bytes], file: Path) -> None:
    """Write what comes in to a file, whose folder is made.

    Raises:
        CannotStore: if the disk is full.
    """
    try:
        await run_in_threadpool(file.parent.mkdir, parents=True)
        with file.open("wb") as sink:
            waiting = bytearray()
            async for chunk in chunks:
                waiting += chunk
                if len(waiting) >= _WRITE_BYTES:
                    await run_in_threadpool(sink.write, bytes(waiting))
                    waiting.clear()
            await run_in_threadpool(sink.write, bytes(waiting))
    except OSError as error:
        raise CannotStore(file.parent.parent, error.strerror or str(error)) from error


class Examiner(Generic[Found]):
    """Runs a look at an upload's folder in a process of its own, one at a time.

    Args:
        look: a function of a module; unpacks and judges, raises OsfError, returns what crosses to the service.
        what: that is uploaded, for people, such as "set".
        names: what the look's sentences call places on disk, in words that the uploader knows; asked for a folder.
    """

    def __init__(self, look: Callable[[Path], Found], what: str, names: Callable[[Path], dict[str, str]]) -> None:
        self._look = look
        self._what = what
        self._names = names
        self._one_at_a_time = asyncio.Lock()  # decoding takes much memory
        self._worker: SpawnProcess | None = None
        self._worker_lock = threading.Lock()
        self._is_stopped = False

    def stop(self) -> None:
        """End the process that looks at an upload, if there is one. Calling it again does nothing."""
        with self._worker_lock:
            self._is_stopped = True
            if self._worker is not None:
                end(self._worker)

    async def examine(self, folder: Path) -> Found:
        """What was found in the upload in a folder.

        Raises:
            UploadRefused: if it cannot be used.
        """
        async with self._one_at_a_time:
            return await run_in_threadpool(self._examine, folder)

    def _examine(self, folder: Path) -> Found:
        with self._worker_lock:
            if self._is_stopped:
                raise UploadRefused("Stopped", f"The service is stopping; upload the {self._what} again later.")
            process, connection = launch(examine_main, "osf-upload", self._look, self._what, folder)
            self._worker = process
        try:
            if not connection.poll(_PATIENCE_S):
                late = f"Looking at the {self._what} took more than {_PATIENCE_S / 60:.0f} minutes."
                raise UploadRefused("TooSlow", late)
            outcome = connection.recv()
        except (EOFError, OSError):
            died = f"The process that looked at the {self._what} ended unexpectedly; it may have run out of memory."
            raise UploadRefused("Died", died) from None
        finally:
            end(process)
            connection.close()
            self._worker = None
        if isinstance(outcome, Failure):
            raise UploadRefused(outcome.kind, self._plain(outcome.text, folder))
        return outcome

    def _plain(self, text: str, folder: Path) -> str:
        """An error's sentence without the names of places that the uploader does not know."""
        for place, name in self._names(folder).items():
            text = text.replace(place, name)
        return text


def examine_main(connection: Connection, look: Callable[[Path], object], what: str, folder: Path) -> None:
    """Look at what was uploaded to a folder and tell what was found, or a Failure."""
    signal.signal(signal.SIGINT, signal.SIG_IGN)
    own_group()
    silence_stdout()
    outcome: object
    try:
        outcome = look(folder)
    except OsfError as error:
        outcome = Failure.of(error)
    except MemoryError:
        text = f"The {what} needs more memory than there is; take fewer or smaller images."
        outcome = Failure(0, "OutOfMemory", text)
    except Exception as error:
        _log.exception("looking at an upload failed")
        text = f"The {what} could not be looked at ({type(error).__name__}); the service's log tells more."
        outcome = Failure(0, "Internal", text)
    with contextlib.suppress(OSError):  # the web process has gone
        connection.send(outcome)
