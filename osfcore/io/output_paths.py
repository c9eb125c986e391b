"""Refuse output places that cannot or must not be written, before long work begins."""

from __future__ import annotations

import os
import sys
import tempfile
from collections.abc import Collection
from pathlib import Path

from osfcore.errors import CannotWrite, InvalidInput, OsfError
from osfcore.io.files import as_mapping, read_json, writing

SUFFIX = ".safetensors"
_MARGIN_BYTES = 16  # temporary names are longer


def check_weights_place(out: Path, metrics: Collection[str]) -> None:
    """Refuse a place for weights with their metrics beside them that cannot take them; nothing is left there.

    Args:
        out: FILE.safetensors to be written, with FILE.json beside it.
        metrics: keys by which an older FILE.json is known to be ours, so that it may be replaced.

    Raises:
        InvalidInput: if the name has another suffix, or FILE.json is something else than metrics.
        CannotWrite: if the place cannot be written.
    """
    if out.suffix != SUFFIX:
        raise InvalidInput("output file", out, f"a path that ends in {SUFFIX}")
    check_place(out)
    beside = out.with_suffix(".json")
    if os.path.lexists(beside) and not _has_keys(beside, metrics):
        allowed = f"another one: {beside.name} beside it is no metrics file and would be lost"
        raise InvalidInput("output file", out, allowed)


def check_place(path: Path) -> None:
    """Refuse a place where no file can be written; nothing is left there.

    Raises:
        CannotWrite: if it is a folder, lies inside a file, has too long a name or may not be written.
    """
    try:
        with writing(path):
            if path.is_dir():
                raise CannotWrite(path, "it is a folder; the name of a file is expected")
            ground = path.parent
            while not ground.exists() and ground != ground.parent:
                ground = ground.parent
            longest = max((len(os.fsencode(part)) for part in path.parts), default=0)
            if longest + _MARGIN_BYTES > _longest_name(ground):
                raise CannotWrite(path, "its name is too long")
            tempfile.TemporaryFile(prefix=".trial-", dir=ground).close()
    except UnicodeEncodeError as error:
        raise CannotWrite(path, "its name cannot be written") from error


def _longest_name(folder: Path) -> int:
    return 255 if sys.platform == "win32" else os.pathconf(folder, "PC_NAME_MAX")


def _has_keys(path: Path, keys: Collection[str]) -> bool:
    try:
        return set(keys) <= set(read_json(path, as_mapping))
    except OsfError:
        return False
