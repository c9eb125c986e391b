"""What strangers send: written to disk bit by bit, then looked at in a process of its own.

Decoding takes much memory and may crash; neither must hurt the service. What is done with a sound upload is up to
`image_sets` and `estimates`.
"""

from __future__ import annotations

import asyncio
import threading
from collections.abc import AsyncIterator, Callable
from pathlib import Path
from typing import Generic, TypeVar

from starlette.concurrency import run_in_threadpool

from osfcore.errors import CannotWrite, CorruptFile, OsfError
from osfcore.io.archives import check_zip

from ..processes.child_process import limit_memory
from ..processes.client import ProcessClient, ProcessHangs, ProcessUnavailable
from ..processes.server import ProcessServer
from .database import storing

_WRITE_BYTES = 1 << 20
_PATIENCE_S = 600.0
_MEMORY_BYTES = 4 << 30  # the largest set that is read takes 3.4 GB
Found = TypeVar("Found")


class UploadRefused(OsfError):
    """An upload that cannot be used."""


class UploadNotStored(UploadRefused):
    """An upload for which there is no room on the disk."""


async def save(chunks: AsyncIterator[bytes], file: Path) -> None:
    """Write what comes in to a file, whose folder is made.

    Raises:
        CannotStore: if the disk is full.
    """
    with storing(Path(file.parent.parent.name)):
        await run_in_threadpool(file.parent.mkdir, parents=True)
        with file.open("wb") as sink:
            waiting = bytearray()
            async for chunk in chunks:
                waiting += chunk
                if len(waiting) >= _WRITE_BYTES:
                    await run_in_threadpool(sink.write, bytes(waiting))
                    waiting.clear()
            await run_in_threadpool(sink.write, bytes(waiting))


class Examiner(Generic[Found]):
    """Runs a look at an upload's folder in a process of its own, one at a time.

    Args:
        look: a function of a module; unpacks and judges, raises OsfError, returns what crosses to the service.
        what: that is uploaded, for people, such as "set".
        names: what the look's sentences call places on disk, in words that the uploader knows; asked for a folder.
        archive: name of the zip in the folder, if one was uploaded.
    """

    def __init__(
        self,
        look: Callable[[Path], Found],
        what: str,
        names: Callable[[Path], dict[str, str]],
        archive: str | None = None,
    ) -> None:
        self._look = look
        self._archive = archive
        self._what = what
        self._names = names
        self._one_at_a_time = asyncio.Lock()  # decoding takes much memory
        self._lock = threading.Lock()
        self._process: ProcessClient | None = None
        self._is_stopped = False

    def stop(self) -> None:
        """End the process that looks at an upload, if there is one. Calling it again does nothing."""
        with self._lock:
            self._is_stopped = True
            process = self._process
        if process is not None:
            process.stop()

    async def examine(self, folder: Path) -> Found:
        """What was found in the upload in a folder.

        Raises:
            UploadRefused: if it cannot be used.
            UploadNotStored: if the disk is full.
        """
        if self._archive is not None:  # what is no zip at all need not wait for a process
            try:
                await run_in_threadpool(check_zip, folder / self._archive)
            except CorruptFile as error:
                raise UploadRefused(self._plain(str(error), folder)) from error
        async with self._one_at_a_time:
            return await run_in_threadpool(self._examine, folder)

    def _examine(self, folder: Path) -> Found:
        with self._lock:
            if self._is_stopped:
                raise UploadRefused(f"The service is stopping; upload the {self._what} again later.")
            self._process = ProcessClient(
                examiner_main, (self._look,), f"process that looked at the {self._what}", answer_s=_PATIENCE_S
            )
        try:
            return self._process.call(folder)
        except CannotWrite as error:
            raise UploadNotStored(self._plain(str(error), folder)) from error
        except ProcessHangs:
            late = f"Looking at the {self._what} took more than {_PATIENCE_S / 60:.0f} minutes."
            raise UploadRefused(late) from None
        except ProcessUnavailable:
            died = f"The process that looked at the {self._what} ended unexpectedly; it may have run out of memory."
            raise UploadRefused(died) from None
        except OsfError as error:
            raise UploadRefused(self._plain(str(error), folder)) from error
        finally:
            self._process.stop()

    def _plain(self, text: str, folder: Path) -> str:
        """An error's sentence without the names of places that the uploader does not know."""
        for place, name in self._names(folder).items():
            text = text.replace(place, name)
        return text


def examiner_main(server: ProcessServer, look: Callable[[Path], object]) -> None:
    """Look at the folder that is asked for."""
    limit_memory(_MEMORY_BYTES)
    server.serve(lambda folder, _: look(folder))
