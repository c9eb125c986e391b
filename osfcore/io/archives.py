"""Safe unpacking of zip archives from others, such as image sets and observations."""

from __future__ import annotations

import contextlib
import lzma
import os
import stat
import struct
import zipfile
import zlib
from collections.abc import Iterator, Mapping
from dataclasses import dataclass
from pathlib import Path, PurePosixPath, PureWindowsPath
from typing import BinaryIO

from osfcore.errors import CorruptFile, OsfError
from osfcore.io.files import folder_at_once, new_folder, writing
from osfcore.io.image_set import FROM_NERF

# The files that a zip lists are counted before the list is parsed: parsing takes memory and time for each.

_END, _END64, _LOCATOR64, _ENTRY = b"PK\5\6", b"PK\6\6", b"PK\6\7", b"PK\1\2"
_END_BYTES, _END64_BYTES, _LOCATOR64_BYTES, _ENTRY_BYTES = 22, 56, 20, 46
_COMMENT_BYTES = 1 << 16  # at most, behind the end record
_BYTES_PER_FILE = 512  # that a list may have: a long path and what zip tools note beside it
_SMALL_DIRECTORY_BYTES = 1 << 16  # below this no list hurts


def _check_directory(archive: BinaryIO, max_files: int) -> None:
    """Check the size of a zip's list of files, without trusting the sizes that the archive states.

    The list is read where `zipfile` reads it. A damaged list passes here, because `zipfile` refuses it.

    Args:
        archive: the complete file, open for reading.
        max_files: largest number of files in the list.

    Raises:
        CorruptFile: if the list is too large or too long, or if there are two lists.
    """
    start, size = _find_directory(archive)
    if start < 0:
        return
    most = max(max_files * _BYTES_PER_FILE, _SMALL_DIRECTORY_BYTES)
    if size > most:
        raise CorruptFile(archive.name, f"its list of files has {size} bytes; at most {most} are read")
    archive.seek(start)
    data, count, place = archive.read(size), 0, 0
    while len(data) - place >= _ENTRY_BYTES and data.startswith(_ENTRY, place):
        place += _ENTRY_BYTES + sum(struct.unpack_from("<28xHHH", data, place))
        count += 1
    if count > max_files:
        raise CorruptFile(archive.name, f"it holds {count} files; at most {max_files} are unpacked")


def _find_directory(archive: BinaryIO) -> tuple[int, int]:
    """Return start and length of the list of files [bytes]. The start is negative if there is no list."""
    size = archive.seek(0, os.SEEK_END)
    archive.seek(max(size - _COMMENT_BYTES - _END_BYTES, 0))
    tail = archive.read()
    has_comment = tail[-_END_BYTES:][:4] != _END or tail[-2:] != b"\0\0"
    place = tail.rfind(_END) if has_comment else len(tail) - _END_BYTES
    record = tail[place : place + _END_BYTES]
    if place < 0 or len(record) < _END_BYTES:
        return -1, 0
    end = size - len(tail) + place
    length = struct.unpack_from("<12xL", record)[0]
    return _find_large_directory(archive, end) or (end - length, length)


def _find_large_directory(archive: BinaryIO, end: int) -> tuple[int, int] | None:
    """Return start and length [bytes] by the records for large archives, if there are any before the end record."""
    place = end - _LOCATOR64_BYTES - _END64_BYTES
    if place < 0:
        return None
    archive.seek(place)
    record, locator = archive.read(_END64_BYTES), archive.read(_LOCATOR64_BYTES)
    if locator[:4] != _LOCATOR64:
        return None
    claimed = struct.unpack_from("<8xQ", locator)[0]
    if claimed < place:  # versions of `zipfile` differ in which of two records they believe
        archive.seek(claimed)
        if archive.read(4) == _END64:
            raise CorruptFile(archive.name, "it holds two lists of its files")
    if record[:4] != _END64:
        return None
    length = struct.unpack_from("<40xQ", record)[0]
    return place - length, length


MAX_BYTES = 2 << 30
MAX_FILES = 20_000
MAX_RATIO = 100  # unpacked to packed: PNGs do not shrink, and lists of numbers shrink to a fifth
_SMALL_BYTES = 10_000_000  # below this no ratio hurts
_MAX_NAME_BYTES = 200
_CHUNK_BYTES = 1 << 20
_DAMAGE = (zipfile.BadZipFile, zlib.error, lzma.LZMAError, EOFError, OSError, struct.error, ValueError, OverflowError)


@dataclass(frozen=True, slots=True)
class ArchiveKind:
    """What an archive may hold.

    Attributes:
        what: name of the kind in messages.
        marker: file that marks the right folder in the archive.
        kept: folders that are unpacked; everything beside the marker if empty.
        expected: description of a right archive, for messages.
        max_depth: largest depth of folders in it.
    """

    what: str
    marker: PurePosixPath
    kept: tuple[str, ...]
    expected: str
    max_depth: int = 8


_IMAGE_SET = ArchiveKind(
    "image set", PurePosixPath("train/anno.json"), ("train", "test"), "a zipped image set with train and test"
)
_OBSERVATION = ArchiveKind(
    "observation", PurePosixPath("observation.json"), (), "a zipped observation folder with the images that it names"
)


def unpack_set(archive: Path, out: Path, *, max_bytes: int = MAX_BYTES, max_files: int = MAX_FILES) -> Path:
    """Unpack the train and test folders of an image set to `out`/train and `out`/test. In the zip they may lie deeper.

    Everything is checked before anything is written, and `out` appears only once it is complete. `read_splits` checks
    the image set itself.

    Args:
        archive: a .zip file.
        out: folder to write; must not exist or be empty.
        max_bytes: largest size of the unpacked archive.
        max_files: largest number of entries in the archive, including folders.

    Returns:
        `out`, the folder that holds train/anno.json.

    Raises:
        CorruptFile: if it is no zip, is damaged, locked or a zip bomb, holds no image set, or has links or names that
            lead out of it.
        InvalidInput: if `out` exists and is not empty.
        CannotWrite: if the disk is full or cannot be written.
    """
    return unpack(archive, out, _IMAGE_SET, max_bytes, max_files)


def unpack_observation(archive: Path, out: Path, *, max_bytes: int = MAX_BYTES, max_files: int = MAX_FILES) -> Path:
    """Unpack an observation folder, as `unpack_set` does a set; `osfcore.io.observation_file` checks it."""
    return unpack(archive, out, _OBSERVATION, max_bytes, max_files)


def check_zip(archive: Path, max_files: int = MAX_FILES) -> list[PurePosixPath]:
    """Return the paths in a zip within milliseconds, without unpacking, if it has few enough files.

    Raises:
        CorruptFile: if it is no zip archive, or holds more than `max_files` files.
    """
    with _opened(Path(archive), max_files) as file:
        return [_plain_path(info) for info in file.infolist() if not info.is_dir()]


def _plain_path(info: zipfile.ZipInfo) -> PurePosixPath:
    return PurePosixPath(info.filename.replace("\\", "/"))  # some Windows tools write backslashes


@contextlib.contextmanager
def _opened(archive: Path, max_files: int) -> Iterator[zipfile.ZipFile]:
    """Open a zip whose list of files is not too long; raise damage in it as `CorruptFile`."""
    try:
        with archive.open("rb") as raw:
            _check_directory(raw, max_files)
            with _with_names(raw) as file:
                yield file
    except OsfError:  # these are ValueErrors, too
        raise
    except FileNotFoundError as error:
        raise CorruptFile(archive, "there is no such file") from error
    except _DAMAGE as error:
        raise CorruptFile(archive, "it is no zip archive or a damaged one") from error
    except RuntimeError as error:
        raise CorruptFile(archive, "it is packed in a way that cannot be read; a plain zip is expected") from error


def _with_names(raw: BinaryIO) -> zipfile.ZipFile:
    """Open a zip and decode its names: macOS, and `zip` without a locale, write UTF-8 and do not say so."""
    try:
        return zipfile.ZipFile(raw, metadata_encoding="utf-8")
    except UnicodeDecodeError:
        return zipfile.ZipFile(raw)


def unpack(archive: Path, out: Path, kind: ArchiveKind, max_bytes: int = MAX_BYTES, max_files: int = MAX_FILES) -> Path:
    """Unpack the contents of one kind of archive, with the same checks.

    Args:
        archive: a .zip file.
        out: folder to write; must not exist or be empty.
        kind: kind of archive.
        max_bytes: largest size of the unpacked archive.
        max_files: largest number of files in the archive.

    Returns:
        `out`, the folder that holds the marker.

    Raises:
        CorruptFile: if it is no zip, is damaged, locked or a zip bomb, of another kind, or has names that lead out of
            it.
        InvalidInput: if `out` exists and is not empty.
        CannotWrite: if the disk is full or cannot be written.
    """
    archive, out = Path(archive), new_folder(out)
    with _opened(archive, max_files) as file:
        wanted = _wanted(archive, _members(archive, file, kind, max_bytes), kind)
        with folder_at_once(out) as partial:
            for path, info in wanted.items():
                _extract(archive, file, info, partial / path, out)
    return out


def _members(
    archive: Path, file: zipfile.ZipFile, kind: ArchiveKind, max_bytes: int
) -> dict[PurePosixPath, zipfile.ZipInfo]:
    """Return the plain files of an archive by their paths, none of which leads out of it."""
    infos = file.infolist()
    size = sum(info.file_size for info in infos)
    if size > max_bytes:
        raise CorruptFile(archive, f"it unpacks to {size / 1e6:.0f} MB; at most {max_bytes / 1e6:.0f} MB are unpacked")
    packed = archive.stat().st_size
    if size > _SMALL_BYTES and size > MAX_RATIO * packed:
        expected = f"more than {MAX_RATIO} times its size, which no images do"
        raise CorruptFile(archive, f"{packed / 1e6:.1f} MB unpack to {size / 1e6:.0f} MB, {expected}")
    members: dict[PurePosixPath, zipfile.ZipInfo] = {}
    for info in infos:
        path = _safe_path(archive, info, kind.max_depth)
        if info.is_dir():
            continue
        if path in members:
            raise CorruptFile(archive, f"it holds {info.filename[:100]!r} twice")
        members[path] = info
    if any(parent in members for path in members for parent in path.parents):
        raise CorruptFile(archive, "it holds a file and a folder of the same name")
    return members


def _safe_path(archive: Path, info: zipfile.ZipInfo, max_depth: int) -> PurePosixPath:
    path, place = _plain_path(info), f"it holds {info.filename[:100]!r}"
    windows = PureWindowsPath(str(path))
    if path.is_absolute() or windows.drive or windows.root or ".." in path.parts:
        raise CorruptFile(archive, f"{place}, a name that leads out of the archive")
    is_long = any(len(part.encode(errors="replace")) > _MAX_NAME_BYTES for part in path.parts)
    if is_long or not 1 <= len(path.parts) <= max_depth or not str(path).isprintable():
        raise CorruptFile(archive, f"{place}, a name that is too long, too deep or not printable")
    kind = stat.S_IFMT(info.external_attr >> 16)
    if kind not in (0, stat.S_IFREG, stat.S_IFDIR):
        raise CorruptFile(archive, f"{place}, a link or device; plain files and folders are expected")
    if info.flag_bits & 1:
        raise CorruptFile(archive, f"{place}, which is locked with a password")
    return path


def _wanted(
    archive: Path, members: Mapping[PurePosixPath, zipfile.ZipInfo], kind: ArchiveKind
) -> dict[PurePosixPath, zipfile.ZipInfo]:
    """Return the files to keep, by their paths from the marker's folder."""
    depth = len(kind.marker.parts)
    roots = [p.parents[depth - 1] for p in members if PurePosixPath(*p.parts[-depth:]) == kind.marker]
    if not roots:
        if kind is _IMAGE_SET and any(p.name.startswith("transforms") and p.suffix == ".json" for p in members):
            raise CorruptFile(archive, FROM_NERF)
        raise CorruptFile(archive, f"it holds no {kind.marker}; {kind.expected} is expected")
    roots.sort(key=lambda root: len(root.parts))
    if len(roots) > 1 and len(roots[0].parts) == len(roots[1].parts):
        raise CorruptFile(archive, f"it holds several {kind.what}s, {roots[0]} and {roots[1]}; one is expected")
    root = roots[0]
    inside = {path.relative_to(root): info for path, info in members.items() if path.is_relative_to(root)}
    return {path: info for path, info in inside.items() if not kind.kept or path.parts[0] in kind.kept}


def _extract(archive: Path, file: zipfile.ZipFile, info: zipfile.ZipInfo, target: Path, out: Path) -> None:
    size = 0
    with file.open(info) as source:
        with writing(out):
            target.parent.mkdir(parents=True, exist_ok=True)
            sink = target.open("xb")
        with sink:
            while chunk := source.read(_CHUNK_BYTES):
                size += len(chunk)
                if size > info.file_size:  # sizes in the directory of an archive are mere claims
                    raise CorruptFile(archive, f"{info.filename[:100]!r} is larger than it claims to be")
                with writing(out):
                    sink.write(chunk)
