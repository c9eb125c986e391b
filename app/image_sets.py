"""Image sets that people upload: stored under DATA_DIR/sets/ID once they were unpacked and found sound.

A folder holds `images` (train and test), `overlay.png`, which shows how cameras, light and silhouettes were understood,
and `set.json`. It is made under another name beside its place, so that a set is there whole or not at all.
"""

from __future__ import annotations

import asyncio
import contextlib
import json
import logging
import shutil
import signal
import threading
import uuid
from collections.abc import AsyncIterator
from dataclasses import asdict, dataclass
from multiprocessing.connection import Connection
from multiprocessing.context import SpawnProcess
from pathlib import Path

from starlette.concurrency import run_in_threadpool

from app.messages import Failure
from app.processes import end, launch, own_group, silence_stdout
from app.store import CannotStore, now_utc
from osfcore.errors import CorruptFile, OsfError, UnknownName

_ARCHIVE, _IMAGES, _OVERLAY, _FACTS = "set.zip", "images", "overlay.png", "set.json"
_TEMPORARY_PREFIX = ".new-"
_WRITE_BYTES = 1 << 20
_PATIENCE_S = 600.0
_log = logging.getLogger(__name__)


class TooManySets(OsfError):
    """No more sets are kept."""

    def __init__(self, limit: int) -> None:
        super().__init__(f"There are {limit} image sets already, which is the most; delete one first.")


class SetRefused(OsfError):
    """An upload that is no usable set, told by the process that looked at it; `kind` is the class of its error."""

    def __init__(self, kind: str, text: str) -> None:
        super().__init__(text)
        self.kind = "CannotStore" if kind == "CannotWrite" else "SetRefused"


@dataclass(frozen=True, slots=True)
class Examined:
    """What was found in a set.

    Attributes:
        train: number of images to learn from.
        test: number of images that only measure.
        summary: the same in words.
    """

    train: int
    test: int
    summary: str


@dataclass(frozen=True, slots=True)
class SetRecord:
    """A stored set.

    Attributes:
        id: identifier.
        file_name: of the zip that was uploaded.
        created_at: UTC, ISO 8601.
        train: number of images to learn from.
        test: number of images that only measure.
        summary: the same in words.
    """

    id: str
    file_name: str
    created_at: str
    train: int
    test: int
    summary: str


class ImageSets:
    """The uploaded sets of one data directory. Any thread may call; uploads belong to the event loop.

    Args:
        root: the folder, DATA_DIR/sets; made at the first upload.
        max_sets: kept at once.
    """

    def __init__(self, root: Path, max_sets: int = 20) -> None:
        self._root = root
        self._max_sets = max_sets
        self._one_at_a_time = asyncio.Lock()  # decoding takes much memory
        self._keeping = threading.Lock()
        self._worker: SpawnProcess | None = None
        self._worker_lock = threading.Lock()
        self._is_stopped = False

    def start(self) -> None:
        """Remove what an earlier service left half done."""
        for folder in self._root.glob(f"{_TEMPORARY_PREFIX}*"):
            shutil.rmtree(folder, ignore_errors=True)

    def stop(self) -> None:
        """End the process that looks at a set, if there is one. Calling it again does nothing."""
        with self._worker_lock:
            self._is_stopped = True
            if self._worker is not None:
                end(self._worker)

    def all(self) -> tuple[SetRecord, ...]:
        """All sets, oldest first."""
        if not self._root.is_dir():
            return ()
        records = []
        for path in self._root.glob(f"[!.]*/{_FACTS}"):
            with contextlib.suppress(CorruptFile, OSError):  # a damaged one must not hide the others
                records.append(_read(path))
        return tuple(sorted(records, key=lambda record: record.created_at))

    def get(self, set_id: str) -> SetRecord:
        """One set.

        Raises:
            UnknownName: if there is none.
        """
        for record in self.all():
            if record.id == set_id:
                return record
        raise UnknownName("image set", set_id[:80], [record.id for record in self.all()])

    def folder(self, set_id: str) -> Path:
        """The folder with train and test of a set that exists."""
        return self._root / set_id / _IMAGES

    def overlay(self, set_id: str) -> Path:
        """The picture of how a set was understood."""
        return self._root / set_id / _OVERLAY

    def remove(self, set_id: str) -> None:
        """Delete a set.

        Raises:
            UnknownName: if there is none.
        """
        self.get(set_id)
        trash = self._root / f"{_TEMPORARY_PREFIX}{uuid.uuid4().hex[:12]}"
        try:
            (self._root / set_id).rename(trash)
        except OSError as error:
            raise CannotStore(self._root, error.strerror or str(error)) from error
        shutil.rmtree(trash, ignore_errors=True)

    async def receive(self, chunks: AsyncIterator[bytes], file_name: str) -> SetRecord:
        """Take in an uploaded zip, bit by bit, and keep the set in it if it is sound.

        Raises:
            TooManySets: if there are too many.
            SetRefused: if it is no sound set of an object; nothing is kept.
            CannotStore: if the disk is full.
        """
        await run_in_threadpool(self._check_room)
        set_id = uuid.uuid4().hex[:12]
        folder = self._root / f"{_TEMPORARY_PREFIX}{set_id}"
        try:
            await self._save(chunks, folder)
            async with self._one_at_a_time:
                found = await run_in_threadpool(self._examine, folder)
            record = SetRecord(set_id, file_name, now_utc(), found.train, found.test, found.summary)
            await run_in_threadpool(self._keep, folder, record)
        finally:
            await run_in_threadpool(shutil.rmtree, folder, True)
        return record

    async def _save(self, chunks: AsyncIterator[bytes], folder: Path) -> None:
        try:
            await run_in_threadpool(folder.mkdir, parents=True)
            with (folder / _ARCHIVE).open("wb") as file:
                waiting = bytearray()
                async for chunk in chunks:
                    waiting += chunk
                    if len(waiting) >= _WRITE_BYTES:
                        await run_in_threadpool(file.write, bytes(waiting))
                        waiting.clear()
                await run_in_threadpool(file.write, bytes(waiting))
        except OSError as error:
            raise CannotStore(self._root, error.strerror or str(error)) from error

    def _examine(self, folder: Path) -> Examined:
        with self._worker_lock:
            if self._is_stopped:
                raise SetRefused("Stopped", "The service is stopping; upload the set again later.")
            process, connection = launch(examine_main, "osf-set", folder)
            self._worker = process
        try:
            if not connection.poll(_PATIENCE_S):
                raise SetRefused("TooSlow", f"Looking at the set took more than {_PATIENCE_S / 60:.0f} minutes.")
            outcome = connection.recv()
        except (EOFError, OSError):
            died = "The process that looked at the set ended unexpectedly; it may have run out of memory."
            raise SetRefused("Died", died) from None
        finally:
            end(process)
            connection.close()
            self._worker = None
        if isinstance(outcome, Failure):
            raise SetRefused(outcome.kind, outcome.text)
        return outcome

    def _check_room(self) -> None:
        if len(self.all()) >= self._max_sets:
            raise TooManySets(self._max_sets)

    def _keep(self, folder: Path, record: SetRecord) -> None:
        try:
            (folder / _FACTS).write_text(json.dumps(asdict(record), indent=1) + "\n", encoding="utf-8")
            with self._keeping:  # others may have come in since the upload began
                self._check_room()
                folder.rename(self._root / record.id)
        except OSError as error:
            raise CannotStore(self._root, error.strerror or str(error)) from error


def examine_main(connection: Connection, folder: Path) -> None:
    """Unpack and judge the archive in a folder, in a process of its own; tells an Examined or a Failure."""
    signal.signal(signal.SIGINT, signal.SIG_IGN)
    own_group()
    silence_stdout()
    outcome: object
    try:
        outcome = examine(folder)
    except OsfError as error:
        outcome = Failure(0, type(error).__name__, _plain(str(error), folder))
    except MemoryError:
        outcome = Failure(0, "OutOfMemory", "The set needs more memory than there is; take fewer or smaller images.")
    except Exception as error:
        _log.exception("looking at a set failed")
        text = f"The set could not be looked at ({type(error).__name__}); the service's log tells more."
        outcome = Failure(0, "Internal", text)
    with contextlib.suppress(OSError):  # the web process has gone
        connection.send(outcome)


def examine(folder: Path) -> Examined:
    """Unpack `set.zip` of a folder to `images` beside it, judge it as `osf check` does, and draw `overlay.png`.

    Raises:
        OsfError: if it is no sound image set of an object.
    """
    from osfcore.check import check_path, draw_overlay
    from osfcore.fields.image_set import read_image_set
    from osfcore.fields.set_archive import unpack_set

    images = unpack_set(folder / _ARCHIVE, folder / _IMAGES)
    (folder / _ARCHIVE).unlink()
    report = check_path(images)
    if read_image_set(images, "test").is_opaque:
        raise CorruptFile(images, "its images are opaque all over; an object on transparent background is expected")
    draw_overlay(images, folder / _OVERLAY)
    return Examined(report.facts["train"], report.facts["test"], report.summary)


def _plain(text: str, folder: Path) -> str:
    """An error's sentence without the names of places that the uploader does not know."""
    for place, name in (
        (f"{folder / _ARCHIVE}", "The uploaded file"),
        (f"{folder / _IMAGES}/", ""),
        (f"{folder / _IMAGES}", "The uploaded set"),
    ):
        text = text.replace(place, name)
    return text


def _read(path: Path) -> SetRecord:
    try:
        record = SetRecord(**json.loads(path.read_text(encoding="utf-8")))
        "".join((record.id, record.file_name, record.created_at, record.summary)).encode()  # text, and whole characters
        counts = (record.train, record.test)
        if record.id != path.parent.name or not all(type(n) is int and 0 <= n < 1 << 31 for n in counts):
            raise ValueError("of another place or kind")
    except (ValueError, TypeError, RecursionError) as error:
        raise CorruptFile(path, "it does not describe an image set") from error
    return record
