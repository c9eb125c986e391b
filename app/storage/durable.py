"""Putting files in place so that they are there after a power failure, too.

A rename alone is not enough: the disk may keep the new name and lose what was written under it, or the other way round.
"""

from __future__ import annotations

import os
from pathlib import Path


def sync(path: Path) -> None:
    """Wait until a file's contents, or a folder's list of names, are on the disk."""
    descriptor = os.open(path, os.O_RDONLY)
    try:
        os.fsync(descriptor)
    finally:
        os.close(descriptor)


def sync_tree(made: Path) -> None:
    """The same for a file, or for a folder with all that is in it."""
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
    sync_tree(made)
    made.rename(place)
    sync(place.parent)
    sync(place.parent.parent)  # the folder itself may be new
