"""Files that are whole or not there, and JSON that is told apart from what it should be.

A rename alone is not enough: after a power failure the disk may have kept the new name and lost what was written under
it, or the other way round. So contents are on the disk before they take their name, and the name is before anybody is
told that they are there.
"""

from __future__ import annotations

import contextlib
import errno
import json
import os
import secrets
import shutil
import struct
import zlib
from collections.abc import Callable, Iterator, Mapping
from pathlib import Path
from typing import Any, TypeVar

from PIL import Image

from osfcore.errors import CannotWrite, CorruptFile, InvalidInput, OsfError, shown

MAX_JSON_BYTES = 16_000_000
_PNG_ERRORS = (OSError, SyntaxError, ValueError, EOFError, struct.error, zlib.error, Image.DecompressionBombError)
T = TypeVar("T")


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
    """Wait likewise for a file, or for a folder with all that is in it."""
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
    """A new file beside `path` to fill, which takes that name only when it is whole; then it outlives a power failure.

    Any number of threads and processes may write to the same path: each has a file of its own, and the last one stays.

    Raises:
        CannotWrite: if there is no such folder, or the disk refuses, here or while the file is filled; what was there
            before is untouched.
    """
    partial = _beside(path)
    try:
        partial.open("xb").close()  # with the rights that any new file has
        yield partial
        _rename(partial, path)
    except OSError as error:
        raise CannotWrite(path, error.strerror or str(error)) from error
    finally:
        with contextlib.suppress(OSError):  # where nothing could be written, there may be no folder either
            partial.unlink(missing_ok=True)


def write_atomically(path: Path, data: bytes) -> None:
    """Write bytes to a file in the same way, and make its folder if there is none.

    Raises:
        CannotWrite: if the disk refuses; what was there before is untouched.
    """
    _make_folder(path.parent, path)
    with file_at_once(path) as partial:
        partial.write_bytes(data)


def write_json(path: Path, content: Mapping[str, Any]) -> None:
    """Write a JSON file in the same way.

    Raises:
        CannotWrite: if the disk refuses.
    """
    write_atomically(path, (json.dumps(content, indent=1) + "\n").encode())


@contextlib.contextmanager
def folder_at_once(out: Path) -> Iterator[Path]:
    """A folder beside `out` to fill, which takes that name (an empty folder's too) only when everything is there.

    Then it outlives a power failure. Errors of whoever fills it pass as they are.

    Raises:
        CannotWrite: if the disk refuses the folder.
    """
    partial = _beside(out)
    _make_folder(out.parent, out)
    _make_folder(partial, out)
    try:
        yield partial
        try:
            _rename(partial, out)
        except OSError as error:
            raise CannotWrite(out, error.strerror or str(error)) from error
    finally:
        shutil.rmtree(partial, ignore_errors=True)


def _make_folder(folder: Path, wanted: Path) -> None:
    """Make a folder, and those around it, for what is wanted."""
    if folder.is_dir():
        return
    try:
        folder.mkdir(parents=True, exist_ok=True)
        sync(folder.parent)
    except OSError as error:
        raise CannotWrite(wanted, error.strerror or str(error)) from error


def _rename(made: Path, place: Path) -> None:
    """Give what is made its name, once all of it is on the disk; then put the name there, too."""
    sync_tree(made)
    made.replace(place)
    sync(place.parent)


def _beside(path: Path) -> Path:
    """A name that nobody else takes, in the same folder."""
    return path.parent / f".{path.name}.{secrets.token_hex(6)}"


def read_json(path: Path, parse: Callable[[object], T]) -> T:
    """What `parse` makes of a JSON file.

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
    """Parsed JSON that is an object.

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


@contextlib.contextmanager
def reading_png(path: Path, reason: str) -> Iterator[None]:
    """Whatever an image library makes of a damaged PNG becomes one sentence.

    Raises:
        CorruptFile: with the reason, for all that reading raises, other than a `CorruptFile` itself.
    """
    try:
        yield
    except OsfError:
        raise
    except (
        OSError,
        SyntaxError,
        ValueError,
        EOFError,
        struct.error,
        zlib.error,
        Image.DecompressionBombError,
    ) as error:
        raise CorruptFile(path, reason) from error
