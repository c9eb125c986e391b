"""How many files a zip lists, counted before anybody parses the list: that takes memory and time for each."""

from __future__ import annotations

import os
import struct
from dataclasses import dataclass
from typing import BinaryIO

from osfcore.errors import CorruptFile

_END, _END64, _LOCATOR64, _ENTRY = b"PK\5\6", b"PK\6\6", b"PK\6\7", b"PK\1\2"
_END_BYTES, _END64_BYTES, _LOCATOR64_BYTES, _ENTRY_BYTES = 22, 56, 20, 46
_COMMENT_BYTES = 1 << 16  # at most, behind the end record
_BYTES_PER_FILE = 512  # that a list may have: a long path and what zip tools note beside it
_SMALL_BYTES = 1 << 16  # below this no list hurts


@dataclass(frozen=True, slots=True)
class _Directory:
    """Where the list of files lies in an archive, in bytes."""

    start: int
    size: int


def check_directory(archive: BinaryIO, max_files: int) -> None:
    """Judge the list of files of a zip by its size and its length, whatever the archive says of them.

    The list is sought where `zipfile` seeks it. What is damaged passes: `zipfile` refuses it.

    Args:
        archive: a whole file, open for reading.
        max_files: that the list may hold.

    Raises:
        CorruptFile: if it is larger or longer, or if there are two.
    """
    directory = _find(archive)
    if directory is None or directory.start < 0:
        return
    most = max(max_files * _BYTES_PER_FILE, _SMALL_BYTES)
    if directory.size > most:
        raise CorruptFile(archive.name, f"its list of files has {directory.size} bytes; at most {most} are read")
    archive.seek(directory.start)
    count = _entries(archive.read(directory.size))
    if count > max_files:
        raise CorruptFile(archive.name, f"it holds {count} files; at most {max_files} are unpacked")


def _find(archive: BinaryIO) -> _Directory | None:
    size = archive.seek(0, os.SEEK_END)
    archive.seek(max(size - _COMMENT_BYTES - _END_BYTES, 0))
    tail = archive.read()
    has_comment = tail[-_END_BYTES:][:4] != _END or tail[-2:] != b"\0\0"
    place = tail.rfind(_END) if has_comment else len(tail) - _END_BYTES
    record = tail[place : place + _END_BYTES]
    if place < 0 or len(record) < _END_BYTES:
        return None
    end = size - len(tail) + place
    return _find64(archive, end) or _before(end, struct.unpack_from("<12xL", record)[0])


def _find64(archive: BinaryIO, end: int) -> _Directory | None:
    """The list that the records for large archives tell of, if there are any before the end record."""
    place = end - _LOCATOR64_BYTES - _END64_BYTES
    if place < 0:
        return None
    archive.seek(place)
    record, locator = archive.read(_END64_BYTES), archive.read(_LOCATOR64_BYTES)
    if locator[:4] != _LOCATOR64:
        return None
    told = struct.unpack_from("<8xQ", locator)[0]
    if told < place:  # versions of `zipfile` differ in which of two records they believe
        archive.seek(told)
        if archive.read(4) == _END64:
            raise CorruptFile(archive.name, "it holds two lists of its files")
    return _before(place, struct.unpack_from("<40xQ", record)[0]) if record[:4] == _END64 else None


def _before(end: int, size: int) -> _Directory:
    return _Directory(end - size, size)


def _entries(data: bytes) -> int:
    """How many entries stand one behind the other."""
    count = place = 0
    while len(data) - place >= _ENTRY_BYTES and data.startswith(_ENTRY, place):
        place += _ENTRY_BYTES + sum(struct.unpack_from("<28xHHH", data, place))
        count += 1
    return count
