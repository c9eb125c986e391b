"""Write files that are whole or not there, and read JSON with its errors as one sentence.

A rename alone is not enough: after a power failure the disk may have kept the new name and lost what was written under
it, or the other way round. So contents are synced before they take their name, and the name is synced before the
caller goes on.
"""

from __future__ import annotations

import contextlib
import errno
import itertools
import json
import os
import secrets
import shutil
import struct
import tempfile
import time
import zlib
from collections.abc import Callable, Iterator, Mapping
from pathlib import Path
from typing import Any, TypeGuard, TypeVar

from PIL import Image

from osfcore.errors import CannotWrite, CorruptFile, InvalidInput, OsfError, shown

MAX_JSON_BYTES = 16_000_000
_PNG_ERRORS = (OSError, SyntaxError, ValueError, EOFError, struct.error, zlib.error, Image.DecompressionBombError)
T = TypeVar("T")


@contextlib.contextmanager
def writing(place: Path) -> Iterator[None]:
    """Raise what the disk refuses as `CannotWrite` of a place."""
    try:
        yield
    except OSError as error:
        raise CannotWrite(place, error.strerror or str(error)) from error


def sync(path: Path) -> None:
    """Wait until a file's contents, or a folder's list of names where the system allows that, are on the disk."""
    try:
        descriptor = os.open(path, os.O_RDONLY)
    except PermissionError:
        if path.is_dir():  # it may be open for writing alone
            return
        raise
    try:
        os.fsync(descriptor)
    except OSError as error:
        if error.errno != errno.EINVAL or not path.is_dir():  # folders of some network disks cannot
            raise
    finally:
        os.close(descriptor)


def sync_tree(made: Path) -> None:
    """Wait until a file, or a folder with all that is in it, is on the disk."""
    for folder, _, names in os.walk(made):
        for name in names:
            sync(Path(folder, name))
        sync(Path(folder))
    if made.is_file():
        sync(made)


def put_in_place(made: Path, place: Path) -> None:
    """Rename a file or folder to where it counts as there; on return it outlives a power failure.

    Raises:
        OSError: if the disk refuses; then it is not in place, or not for certain.
    """
    _rename(made, place)
    sync(place.parent.parent)  # the folder itself may be new


@contextlib.contextmanager
def file_at_once(path: Path) -> Iterator[Path]:
    """Give a new file beside `path` to fill, which takes that name only when it is whole and on the disk.

    Any number of threads and processes may write to the same path: each has a file of its own, and the last one stays.

    Raises:
        CannotWrite: if there is no such folder, or the disk refuses, here or while the file is filled; what was there
            before is untouched.
    """
    partial = _beside(path)
    try:
        with writing(path):
            partial.open("xb").close()  # with the rights that any new file has
            yield partial
            _rename(partial, path)
    finally:
        with contextlib.suppress(OSError):  # where nothing could be written, there may be no folder either
            partial.unlink(missing_ok=True)


def write_atomically(path: Path, data: bytes) -> None:
    """Write bytes by `file_at_once`, and make the folder if there is none.

    Raises:
        CannotWrite: if the disk refuses; what was there before is untouched.
    """
    _make_folder(path.parent, path)
    with file_at_once(path) as partial:
        partial.write_bytes(data)


def write_json(path: Path, content: Mapping[str, Any]) -> None:
    """Write a JSON file by `write_atomically`.

    Raises:
        CannotWrite: if the disk refuses.
    """
    write_atomically(path, (json.dumps(content, indent=1) + "\n").encode())


def new_folder(out: Path) -> Path:
    """Return the absolute path of an output folder.

    Raises:
        InvalidInput: if there is something in its place other than an empty folder.
    """
    out = Path(out).absolute()
    if out.exists() and (not out.is_dir() or any(out.iterdir())):
        raise InvalidInput("output folder", out, "new or empty")
    return out


@contextlib.contextmanager
def folder_at_once(out: Path) -> Iterator[Path]:
    """Give a folder beside `out` to fill, which takes that name only when everything is there and on the disk.

    `out` may be an empty folder. Errors of whoever fills it pass as they are.

    Raises:
        CannotWrite: if the disk refuses the folder.
    """
    partial = _beside(out)
    _make_folder(out.parent, out)
    _make_folder(partial, out)
    try:
        yield partial
        with writing(out):
            _rename(partial, out)
    finally:
        shutil.rmtree(partial, ignore_errors=True)


@contextlib.contextmanager
def scratch_folder(parent: Path, prefix: str, life_s: float) -> Iterator[Path]:
    """Give a folder inside `parent` that is gone afterwards.

    Args:
        parent: made if it is not there.
        prefix: prefix of the folder's name.
        life_s: folders of this prefix that have not changed for so long were left by a killed process, and go too [s].
    """
    parent.mkdir(parents=True, exist_ok=True)
    for path in parent.glob(f"{prefix}*"):
        with contextlib.suppress(OSError):  # another process may be removing it, too
            if time.time() - path.stat().st_mtime > life_s:
                shutil.rmtree(path, ignore_errors=True)
    folder = Path(tempfile.mkdtemp(prefix=prefix, dir=parent))
    try:
        yield folder
    finally:
        shutil.rmtree(folder, ignore_errors=True)


def replace_folder(made: Path, place: Path) -> None:
    """Put a folder in place of an older one, if there is one; on return it outlives a power failure.

    Several processes may put a folder there at the same time; the last one stays. What was there is moved beside
    `made`, for the caller to delete.

    Raises:
        OSError: if the disk refuses.
    """
    sync_tree(made)
    for attempt in itertools.count():
        try:
            made.rename(place)
            break
        except OSError as error:
            if error.errno not in (errno.ENOTEMPTY, errno.EEXIST, errno.ENOTDIR):
                raise
        with contextlib.suppress(FileNotFoundError):
            place.rename(made.with_name(f"old{attempt}"))
    sync(place.parent)


def remove_folder(folder: Path) -> None:
    """Delete a folder in one piece; on return it is gone for good, also after a power failure.

    Raises:
        OSError: if the disk refuses; then it is in place, or not for certain.
    """
    aside = _beside(folder)
    folder.rename(aside)
    sync(folder.parent)
    shutil.rmtree(aside, ignore_errors=True)


def _make_folder(folder: Path, wanted: Path) -> None:
    """Make a folder, and those around it, for what is wanted."""
    if not folder.is_dir():
        with writing(wanted):
            folder.mkdir(parents=True, exist_ok=True)
            sync(folder.parent)


def _rename(made: Path, place: Path) -> None:
    """Give what is made its name, once all of it is on the disk; then put the name there, too."""
    sync_tree(made)
    made.replace(place)
    sync(place.parent)


def _beside(path: Path) -> Path:
    """Return a name that nobody else takes, in the same folder."""
    return path.parent / f".{path.name}.{secrets.token_hex(6)}"


def read_json(path: Path, parse: Callable[[object], T]) -> T:
    """Return what `parse` makes of a JSON file.

    Raises:
        CorruptFile: if it cannot be read, is not JSON, or `parse` raises an OsfError; the message says why.
    """
    try:
        if path.stat().st_size > MAX_JSON_BYTES:
            raise CorruptFile(path, f"it is larger than {MAX_JSON_BYTES // 1_000_000} MB")
        text = path.read_text(encoding="utf-8")
    except OSError as error:
        raise CorruptFile(path, error.strerror or str(error)) from error
    except UnicodeDecodeError as error:
        raise CorruptFile(path, "it is not a text file") from error
    try:
        return parse(json.loads(text))
    except json.JSONDecodeError as error:
        raise CorruptFile(path, f"it is not valid JSON (line {error.lineno}: {error.msg})") from error
    except RecursionError as error:
        raise CorruptFile(path, "it is nested too deeply") from error
    except CorruptFile:  # of a file that this one names
        raise
    except OsfError as error:
        raise CorruptFile(path, str(error).rstrip(".")) from error
    except ValueError as error:  # a number with thousands of digits
        raise CorruptFile(path, f"it is not valid JSON ({error})") from error


def as_mapping(data: object) -> dict[str, Any]:
    """Return parsed JSON that is an object.

    Raises:
        InvalidInput: if it is something else.
    """
    if not isinstance(data, dict):
        raise InvalidInput("content", shown(repr(data)), "a JSON object")
    return data


def is_text(name: str) -> bool:
    """Whether a name can be written at all: JSON may hold halves of characters."""
    try:
        name.encode()
    except UnicodeEncodeError:
        return False
    return True


def is_file_name(name: object) -> TypeGuard[str]:
    """Whether a value of a file can be the name of a file at all."""
    return isinstance(name, str) and bool(name) and "\0" not in name and is_text(name)


def leads_out(folder: Path, path: Path) -> bool:
    """Whether a path is a link that leads out of a folder."""
    try:
        return not path.resolve().is_relative_to(folder.resolve())
    except (OSError, RuntimeError):  # loops of links and names that are too long lead nowhere
        return False


@contextlib.contextmanager
def reading_png(path: Path, reason: str) -> Iterator[None]:
    """Raise whatever an image library makes of a damaged PNG as `CorruptFile`.

    Raises:
        CorruptFile: with the reason, for all that reading raises, other than a `CorruptFile` itself.
    """
    try:
        yield
    except OsfError:
        raise
    except _PNG_ERRORS as error:
        raise CorruptFile(path, reason) from error
