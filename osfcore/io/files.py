"""Files that are whole or not there, and JSON that is told apart from what it should be."""

from __future__ import annotations

import contextlib
import json
import os
import shutil
import struct
import tempfile
import zlib
from collections.abc import Callable, Iterator, Mapping
from pathlib import Path
from typing import Any, TypeVar

from PIL import Image

from osfcore.errors import CannotWrite, CorruptFile, InvalidInput, OsfError, shown

MAX_JSON_BYTES = 16_000_000
_PNG_ERRORS = (OSError, SyntaxError, ValueError, EOFError, struct.error, zlib.error, Image.DecompressionBombError)
T = TypeVar("T")


def write_atomically(path: Path, data: bytes) -> None:
    """Write bytes to a file that takes its name only when it is whole.

    Raises:
        CannotWrite: if the disk refuses.
    """
    partial = path.with_name(f".{path.name}.{os.getpid()}")
    try:
        path.parent.mkdir(parents=True, exist_ok=True)
        partial.write_bytes(data)
        partial.replace(path)
    except OSError as error:
        raise CannotWrite(path, error.strerror or str(error)) from error
    finally:
        with contextlib.suppress(OSError):  # where nothing could be written, there may be no folder either
            partial.unlink(missing_ok=True)


def write_json(path: Path, content: Mapping[str, Any]) -> None:
    """Write a JSON file in the same way.

    Raises:
        CannotWrite: if the disk refuses.
    """
    write_atomically(path, (json.dumps(content, indent=1) + "\n").encode())


@contextlib.contextmanager
def folder_at_once(out: Path) -> Iterator[Path]:
    """A folder beside `out` to fill, which takes that name (an empty folder's too) only when everything is there.

    Raises:
        CannotWrite: if the disk refuses.
    """
    try:
        out.parent.mkdir(parents=True, exist_ok=True)
        partial = Path(tempfile.mkdtemp(prefix=f".{out.name}-", dir=out.parent))
    except OSError as error:
        raise CannotWrite(out, error.strerror or str(error)) from error
    try:
        yield partial
        try:
            partial.chmod(0o755)  # temporary folders are private
            partial.rename(out)
        except OSError as error:
            raise CannotWrite(out, error.strerror or str(error)) from error
    finally:
        shutil.rmtree(partial, ignore_errors=True)


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
