"""Atomic writing of files, and reading of JSON with errors in one sentence.

A rename alone is not enough: after a power failure the disk may have the new name without the contents, or the contents
without the name. So the contents are synced before the rename, and the name is synced before the caller continues.
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
import sys
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
_TRIES, _AGAIN_S = 100, 0.01
T = TypeVar("T")


@contextlib.contextmanager
def writing(place: Path) -> Iterator[None]:
    """Turn errors of the disk into `CannotWrite`."""
    try:
        yield
    except OSError as error:
        raise CannotWrite(place, error.strerror or str(error)) from error


def sync(path: Path) -> None:
    """Wait until a file's contents are on the disk, or a folder's list of names if the system supports that."""
    try:
        descriptor = os.open(path, os.O_RDWR if sys.platform == "win32" else os.O_RDONLY)  # as Windows wants it
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
    """Wait until a file, or a folder with everything in it, is on the disk."""
    for folder, _, names in os.walk(made):
        for name in names:
            sync(Path(folder, name))
        sync(Path(folder))
    if made.is_file():
        sync(made)


def put_in_place(made: Path, place: Path) -> None:
    """Rename a file or folder to its final name. On return, it survives a power failure.

    Raises:
        OSError: if the disk refuses. The file may then not be in place.
    """
    _rename(made, place)
    sync(place.parent.parent)  # the folder itself may be new


@contextlib.contextmanager
def file_at_once(path: Path) -> Iterator[Path]:
    """Yield a new file beside `path` to write to. It gets that name once it is complete and on the disk.

    Several threads and processes may write to the same path: each has its own file, and the last one stays.

    Raises:
        CannotWrite: if the folder does not exist, or the disk refuses. An older file is then unchanged.
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
    """Write bytes with `file_at_once`. The folder is created if it does not exist.

    Raises:
        CannotWrite: if the disk refuses. An older file is then unchanged.
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
        InvalidInput: if the path exists and is not an empty folder.
    """
    out = Path(out).absolute()
    if out.exists() and (not out.is_dir() or any(out.iterdir())):
        raise InvalidInput("output folder", out, "new or empty")
    return out


@contextlib.contextmanager
def folder_at_once(out: Path) -> Iterator[Path]:
    """Yield a folder beside `out` to fill. It gets that name once it is complete and on the disk.

    `out` may be an empty folder. Errors of the caller pass unchanged.

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
    """Yield a folder inside `parent` that is deleted afterwards.

    Args:
        parent: folder, which is created if it does not exist.
        prefix: prefix of the folder's name.
        life_s: age of the last change from which other folders with this prefix are deleted as well, because a killed
            process left them [s].
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
    """Put a folder in place of an older one, if there is one. On return, it survives a power failure.

    Several processes may do this at the same time; the last folder stays. The older folder is moved beside `made`, for
    the caller to delete.

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
    """Delete a folder atomically. On return, it is gone even after a power failure.

    Raises:
        OSError: if the disk refuses. The folder may then still be in place.
    """
    aside = _beside(folder)
    folder.rename(aside)
    sync(folder.parent)
    shutil.rmtree(aside, ignore_errors=True)


def _make_folder(folder: Path, wanted: Path) -> None:
    """Create a folder and its parents."""
    if not folder.is_dir():
        with writing(wanted):
            folder.mkdir(parents=True, exist_ok=True)
            sync(folder.parent)


def _rename(made: Path, place: Path) -> None:
    """Rename a file or folder once its contents are on the disk; then sync the name."""
    sync_tree(made)
    if sys.platform == "win32":
        _replace_on_windows(made, place)
    else:
        made.replace(place)
    sync(place.parent)


def _replace_on_windows(made: Path, place: Path) -> None:
    """Rename where an empty folder is in the way, and files cannot be replaced while another process reads them."""
    if made.is_dir() and place.is_dir():
        place.rmdir()
    for _ in range(_TRIES):
        with contextlib.suppress(PermissionError):
            made.replace(place)
            return
        time.sleep(_AGAIN_S)
    made.replace(place)


def _beside(path: Path) -> Path:
    """Return a unique name in the same folder."""
    return path.parent / f".{path.name}.{secrets.token_hex(6)}"


def read_json(path: Path, parse: Callable[[object], T]) -> T:
    """Return the result of `parse` for the contents of a JSON file.

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
    """Check that parsed JSON is an object, and return it.

    Raises:
        InvalidInput: if it is not.
    """
    if not isinstance(data, dict):
        raise InvalidInput("content", shown(repr(data)), "a JSON object")
    return data


def is_text(name: str) -> bool:
    """Return whether a name can be encoded: JSON may hold lone surrogates."""
    try:
        name.encode()
    except UnicodeEncodeError:
        return False
    return True


def is_file_name(name: object) -> TypeGuard[str]:
    """Return whether a value of a file can be a file name."""
    return isinstance(name, str) and bool(name) and "\0" not in name and is_text(name)


def leads_out(folder: Path, path: Path) -> bool:
    """Return whether a path is a link that leads out of a folder."""
    try:
        return not path.resolve().is_relative_to(folder.resolve())
    except (OSError, RuntimeError):  # loops of links and names that are too long lead nowhere
        return False


@contextlib.contextmanager
def reading_png(path: Path, reason: str) -> Iterator[None]:
    """Turn errors of an image library about a damaged PNG into `CorruptFile`.

    Raises:
        CorruptFile: with the reason, for every error.
    """
    try:
        yield
    except OsfError:
        raise
    except _PNG_ERRORS as error:
        raise CorruptFile(path, reason) from error
