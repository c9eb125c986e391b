"""Where training a field for the service leaves its files, and how a finished field is put in place.

The workshop DATA_DIR/training/NAME holds images and checkpoint while NAME is being trained; it outlives a service or a
job that was killed, so that the same order goes on from there. A finished field moves to DATA_DIR/fields/NAME,
one as published to DATA_DIR/paper_fields/NAME.safetensors.
"""

from __future__ import annotations

import contextlib
import json
import shutil
import tempfile
from dataclasses import dataclass
from pathlib import Path
from typing import Any

from osfcore.fields.field_library import FIELD_FILE, METRICS_FILE
from osfcore.io.files import remove_folder, scratch_folder, sync, sync_tree, write_atomically, writing

from .database import utc_of
from .usage import folder_bytes

_ORDER = "order.json"
_TEMPORARY_PREFIX = ".writing-"
_TEMPORARY_LIFE_S = 3600.0
_ASIDE_PREFIX = ".replaced-"  # its folder holds an older field under its name, until the new one is in place


def workshop(data_dir: Path, name: str) -> Path:
    """The folder in which a field of this name is trained."""
    return data_dir / "training" / name


def open_workshop(data_dir: Path, name: str, order: dict[str, Any]) -> Path:
    """The workshop, emptied if it was left by another order than this one.

    Args:
        data_dir: of the service.
        name: of the field.
        order: plain JSON of everything the field will depend on.

    Raises:
        CannotWrite: if it cannot be made.
    """
    place = workshop(data_dir, name)
    text = json.dumps(order, sort_keys=True)
    with writing(place):
        if not (place / _ORDER).is_file() or (place / _ORDER).read_bytes() != text.encode():
            clear_workshop(data_dir, name)
            write_atomically(place / _ORDER, text.encode())
    return place


@dataclass(frozen=True, slots=True)
class Leftover:
    """A workshop that is there.

    Attributes:
        name: of the field.
        bytes: of all its files.
        changed_at: when files last came or went, UTC, ISO 8601.
    """

    name: str
    bytes: int
    changed_at: str


def workshops(data_dir: Path) -> tuple[Leftover, ...]:
    """All that are there, sorted by name."""
    found = []
    for place in sorted((data_dir / "training").glob("[!.]*")):
        with contextlib.suppress(OSError):  # one that is being removed must not hide the others
            if place.is_dir():
                changed_at = utc_of(place.stat().st_mtime, "seconds")
                found.append(Leftover(place.name, folder_bytes(place), changed_at))
    return tuple(found)


def clear_workshop(data_dir: Path, name: str) -> None:
    """Forget what was made for a field that is not finished."""
    shutil.rmtree(workshop(data_dir, name), ignore_errors=True)


def remove_workshop(data_dir: Path, name: str) -> None:
    """Delete a workshop that is there, in one piece; needs no room on the disk.

    Raises:
        CannotWrite: if that is not allowed.
    """
    with writing(Path("training") / name):
        remove_folder(workshop(data_dir, name))


def install(made: Path, place: Path) -> None:
    """Copy weights and metrics from `made` to the folder `place`, in one piece, over an older field if there is one.

    Raises:
        CannotWrite: if the disk is full or the folder cannot be written; then nothing is changed.
    """
    with writing(place):
        place.parent.mkdir(parents=True, exist_ok=True)
        with _temporary(place) as temporary:
            folder = temporary / "new"
            folder.mkdir(mode=0o755)
            for name in (FIELD_FILE, METRICS_FILE):
                shutil.copyfile(made / name, folder / name)
            sync_tree(folder)
            _swap(folder, place)


def install_published(made: Path, weights: Path) -> None:
    """Copy a field as published from `made` to the file `weights`, and its metrics beside it as JSON.

    Raises:
        CannotWrite: if the disk is full or the folder cannot be written.
    """
    with writing(weights):
        for name in (METRICS_FILE, FIELD_FILE):  # what is looked for comes last
            write_atomically(weights.with_suffix(Path(name).suffix), (made / name).read_bytes())


def uninstall_published(weights: Path) -> None:
    """Delete a field as published and its metrics.

    Raises:
        CannotWrite: if that is not allowed.
    """
    with writing(weights):
        for name in (FIELD_FILE, METRICS_FILE):
            weights.with_suffix(Path(name).suffix).unlink(missing_ok=True)
        sync(weights.parent)


def uninstall(place: Path) -> None:
    """Delete a field's folder, in one piece.

    Raises:
        CannotWrite: if that is not allowed.
    """
    with writing(place), _temporary(place) as folder:
        place.rename(folder / "old")
        sync(place.parent)


def sweep(fields: Path) -> None:
    """Remove what a killed service left half done in a folder; what was put aside and has no successor returns."""
    for aside in fields.glob(f"{_ASIDE_PREFIX}*"):
        for older in aside.glob("*"):
            if not (fields / older.name).exists():
                with contextlib.suppress(OSError):  # then it stays aside, and the next start tries again
                    older.rename(fields / older.name)
        if all((fields / older.name).exists() for older in aside.glob("*")):
            shutil.rmtree(aside, ignore_errors=True)
    for folder in fields.glob(".*"):
        if not folder.name.startswith(_ASIDE_PREFIX):
            shutil.rmtree(folder, ignore_errors=True)


def _temporary(place: Path) -> contextlib.AbstractContextManager[Path]:
    """A hidden folder beside a field's; what is in it lies one level too deep to be taken for a field."""
    return scratch_folder(place.parent, f"{_TEMPORARY_PREFIX}{place.name}-", _TEMPORARY_LIFE_S)


def _swap(folder: Path, place: Path) -> None:
    """Rename a folder to its place; the older one is put aside first, and returns if that fails."""
    if not place.exists():
        folder.rename(place)
        sync(place.parent)
        return
    aside = Path(tempfile.mkdtemp(prefix=_ASIDE_PREFIX, dir=place.parent))
    older = aside / place.name
    try:
        place.rename(older)
        try:
            folder.rename(place)
        except OSError:
            older.rename(place)
            raise
        sync(place.parent)
    finally:
        if place.exists():  # else the older one is all there is, and the next start puts it back
            shutil.rmtree(aside, ignore_errors=True)
