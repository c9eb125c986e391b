"""Image sets that people upload: stored under DATA_DIR/sets/ID once they were unpacked and found sound.

A folder holds `images` (train and test), `overlay.png`, which shows how cameras, light and silhouettes were understood,
and `set.json`. It is made under another name beside its place, so that a set is there whole or not at all.
"""

from __future__ import annotations

import shutil
import uuid
from collections.abc import AsyncIterator, Callable
from dataclasses import dataclass
from pathlib import Path
from typing import Annotated

from pydantic import Field, StrictInt
from starlette.concurrency import run_in_threadpool

from osfcore.errors import CorruptFile, OsfError
from osfcore.io.json_codec import Text

from ..storage.database import now_utc
from ..storage.records import RecordFolders
from ..storage.uploads import Examiner, save

_ARCHIVE, _IMAGES, _OVERLAY, _FACTS = "set.zip", "images", "overlay.png", "set.json"
_TEMPORARY_PREFIX = ".new-"
_Count = Annotated[StrictInt, Field(ge=0, lt=1 << 31)]


class TooManySets(OsfError):
    """No more sets are kept."""

    def __init__(self, limit: int) -> None:
        super().__init__(f"There are {limit} image sets already, which is the most; delete one first.")


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
        number: orders the sets; the store gives it.
    """

    id: Text
    file_name: Text
    created_at: Text
    train: _Count
    test: _Count
    summary: Text
    number: int = 0


class ImageSets(RecordFolders[SetRecord]):
    """The uploaded sets of one data directory. Any thread may call; uploads belong to the event loop.

    Args:
        root: the folder, DATA_DIR/sets; made at the first upload.
        max_sets: kept at once.
        check_room: raises an OsfError if nothing more may be written.
    """

    def __init__(self, root: Path, max_sets: int = 20, check_room: Callable[[], None] = lambda: None) -> None:
        super().__init__(root, SetRecord, "image set", _FACTS, _OVERLAY, max_sets, TooManySets)
        self._check_storage = check_room
        self._examiner = Examiner(examine, "set", _names, _ARCHIVE)

    def stop(self) -> None:
        """End the process that looks at a set, if there is one. Calling it again does nothing."""
        self._examiner.stop()

    def folder(self, set_id: str) -> Path:
        """The folder with train and test of a set that exists."""
        return self._root / set_id / _IMAGES

    def overlay(self, set_id: str) -> Path:
        """The picture of how a set was understood."""
        return self._root / set_id / _OVERLAY

    async def receive(self, chunks: AsyncIterator[bytes], file_name: str) -> SetRecord:
        """Take in an uploaded zip, bit by bit, and keep the set in it if it is sound.

        Raises:
            TooManySets: if there are too many.
            StorageFull: if nothing more may be written.
            UploadRefused: if it is no sound set of an object; nothing is kept.
            CannotStore: if the disk is full.
        """
        await run_in_threadpool(self.check_room)
        await run_in_threadpool(self._check_storage)
        set_id = uuid.uuid4().hex[:12]
        folder = self._root / f"{_TEMPORARY_PREFIX}{set_id}"
        try:
            await save(chunks, folder / _ARCHIVE)
            examined = await self._examiner.examine(folder)
            record = SetRecord(set_id, file_name, now_utc(), examined.train, examined.test, examined.summary)
            return await run_in_threadpool(self._keep, record, {}, folder)
        finally:
            await run_in_threadpool(shutil.rmtree, folder, True)


def examine(folder: Path) -> Examined:
    """Unpack `set.zip` of a folder to `images` beside it, judge it as `osf check` does, and draw `overlay.png`.

    Raises:
        OsfError: if it is no sound image set of an object.
    """
    from osfcore.inspection.check import check_path, draw_overlay
    from osfcore.io.archives import unpack_set
    from osfcore.io.image_set import read_image_set

    images = unpack_set(folder / _ARCHIVE, folder / _IMAGES)
    (folder / _ARCHIVE).unlink()
    report = check_path(images)
    if read_image_set(images, "test").is_opaque:
        raise CorruptFile(images, "its images are opaque all over; an object on transparent background is expected")
    draw_overlay(images, folder / _OVERLAY)
    return Examined(report.facts["train"], report.facts["test"], report.summary)


def _names(folder: Path) -> dict[str, str]:
    """What the uploader calls the places in a folder."""
    return {
        f"{folder / _ARCHIVE}": "The uploaded file",
        f"{folder / _IMAGES}/": "",
        f"{folder / _IMAGES}": "The uploaded set",
    }
