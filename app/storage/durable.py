"""Putting files in place so that they are there after a loss of power, whole.

A rename is atomic but not durable: what was renamed may come back empty, or not at all, unless files and folders were
written through to the disk before and after.
"""

from __future__ import annotations

import os
from pathlib import Path


def sync(path: Path) -> None:
    """Write a file's content, or a folder's names, through to the disk.

    Raises:
        OSError: if the disk refuses.
    """
    descriptor = os.open(path, os.O_RDONLY)
    try:
        os.fsync(descriptor)
    finally:
        os.close(descriptor)


def sync_tree(folder: Path) -> None:
    """The same for a folder and all that is in it."""
    for place, _, files in os.walk(folder):
        for name in files:
            sync(Path(place) / name)
        sync(Path(place))


def put_in_place(folder: Path, place: Path) -> None:
    """Give a folder its final name, for good.

    Args:
        folder: made elsewhere on the same disk, complete.
        place: does not exist, or is an empty folder.

    Raises:
        OSError: if that is not possible; then `folder` is left as it is.
    """
    sync_tree(folder)
    folder.rename(place)
    sync(place.parent)
