"""Trying an output place before long work begins: what cannot be written, or must not be, is told at once."""

from __future__ import annotations

import json
import os
import tempfile
from collections.abc import Collection
from pathlib import Path

from osfcore.errors import CannotWrite, InvalidInput

SUFFIX = ".safetensors"
_MARGIN_BYTES = 16  # what files are called while they are written is longer
_MAX_METRICS_BYTES = 1_000_000


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
        raise InvalidInput(
            "output file", out, f"another one: {beside.name} beside it is no metrics file and would be lost"
        )


def check_place(path: Path) -> None:
    """Refuse a place where no file can be written; nothing is left there.

    Raises:
        CannotWrite: if it is a folder, lies inside a file, has too long a name or may not be written.
    """
    try:
        if path.is_dir():
            raise CannotWrite(path, "it is a folder; the name of a file is expected")
        ground = path.parent
        while not ground.exists() and ground != ground.parent:
            ground = ground.parent
        longest = max(len(os.fsencode(part)) for part in path.parts) if path.parts else 0
        if longest + _MARGIN_BYTES > os.pathconf(ground, "PC_NAME_MAX"):
            raise CannotWrite(path, "its name is too long")
        descriptor, trial = tempfile.mkstemp(prefix=".trial-", dir=ground)
        os.close(descriptor)
        os.unlink(trial)
    except OSError as error:
        raise CannotWrite(path, error.strerror or str(error)) from error
    except UnicodeEncodeError as error:
        raise CannotWrite(path, "its name cannot be written") from error


def _has_keys(path: Path, keys: Collection[str]) -> bool:
    try:
        if path.stat().st_size > _MAX_METRICS_BYTES:
            return False
        content = json.loads(path.read_text(encoding="utf-8"))
    except (OSError, ValueError, RecursionError):
        return False
    return isinstance(content, dict) and set(keys) <= set(content)
