"""How much the data directory holds, measured in the background, and whether there is room for more."""

from __future__ import annotations

import os
import shutil
import threading
import time
from concurrent.futures import Future, ThreadPoolExecutor
from contextlib import suppress
from dataclasses import dataclass
from pathlib import Path

from osfcore.errors import OsfError

from .database import PUT_BACK, CannotStore, identities

FRESH_S = 30.0  # a figure that is older is measured anew with the next request
_PATIENCE_S = 1.0  # longer than that, no request waits for a new figure
FOLDERS = {  # kinds by their folder in the data directory; "other" is what else is there
    "objects": "objects",
    "fields": "fields",
    "paper_fields": "fields",
    "goals": "goals",
    "photos": "photos",
    "sets": "sets",
    "collections": "jobs",
    "training": "training",
    "downloads": "downloads",
}
_DELETABLE = {
    "jobs": "finished jobs",
    "sets": "image sets",
    "training": "leftovers of training",
    "goals": "goals",
    "photos": "photos of tables",
    "fields": "trained fields",
}


class StorageFull(OsfError):
    """Nothing more may be written, by what the operator has set."""


@dataclass(frozen=True, slots=True)
class Usage:
    """What the data directory holds.

    Attributes:
        bytes: by kind, see `FOLDERS`.
        seconds_ago: when that was measured [s].
    """

    bytes: dict[str, int]
    seconds_ago: float

    @property
    def total(self) -> int:
        """Of all kinds [bytes]."""
        return sum(self.bytes.values())


class StorageMeter:
    """Measures one data directory, one walk at a time. Any thread may call.

    Args:
        data_dir: of the service.
        max_bytes: that it may hold; 0 for any.
        min_free_bytes: that must stay free on its disk.
    """

    def __init__(self, data_dir: Path, max_bytes: int = 0, min_free_bytes: int = 0) -> None:
        self._data_dir = data_dir
        self._identity = identities(data_dir)
        self.max_bytes = max_bytes
        self.min_free_bytes = min_free_bytes
        self._lock = threading.Lock()
        self._pool = ThreadPoolExecutor(1, "storage")
        self._walk: Future[None] | None = None
        self._bytes: dict[str, int] | None = None
        self._measured_at = 0.0
        self._is_outdated = True
        self._is_stopping = threading.Event()

    def stop(self) -> None:
        """Measure no more. Calling it again does nothing."""
        with self._lock:
            self._is_stopping.set()
        self._pool.shutdown(cancel_futures=True)

    def outdate(self) -> None:
        """Something large was deleted: the next figure shall know."""
        self._is_outdated = True

    @property
    def free_bytes(self) -> int:
        """Free on the disk now; 0 if the directory is gone."""
        try:
            return shutil.disk_usage(self._data_dir).free
        except OSError:
            return 0

    def usage(self, wait_s: float = _PATIENCE_S) -> Usage | None:
        """The latest figures, measured anew if they are old.

        Args:
            wait_s: for new figures; then the old ones must do, None if there are none yet.
        """
        for _ in range(2):  # the walk under way may have begun before something was deleted
            walk = self._begin()
            if walk is None:
                break
            with suppress(TimeoutError):
                walk.result(wait_s)
        with self._lock:
            if self._bytes is None:
                return None
            return Usage(self._bytes, time.monotonic() - self._measured_at)

    @property
    def problem(self) -> str | None:
        """Why nothing more may be written, by the latest figures; None if it may."""
        try:
            self.check_room(wait_s=0)
        except (StorageFull, CannotStore) as error:
            return str(error)
        return None

    def check_room(self, wait_s: float = _PATIENCE_S) -> None:
        """Refuse what would write more.

        Args:
            wait_s: for new figures, if the latest are old.

        Raises:
            StorageFull: if the directory holds too much, or too little is free on its disk.
            CannotStore: if another directory, or none, has its name now.
        """
        if identities(self._data_dir) != self._identity:
            reason = "it was moved, deleted or replaced while the service runs"
            raise CannotStore(Path("The data directory"), reason, PUT_BACK)
        free = self.free_bytes
        if free < self.min_free_bytes:
            limit = f"{_size(self.min_free_bytes)} must stay free (OSF_MIN_FREE_BYTES)"
            raise StorageFull(f"{_size(free)} are free on the disk of the data directory, but {limit}; {_advice({})}.")
        usage = self.usage(wait_s) if self.max_bytes else None
        if usage is not None and usage.total >= self.max_bytes:
            limit = f"it may hold {_size(self.max_bytes)} (OSF_MAX_DATA_BYTES)"
            raise StorageFull(f"The data directory holds {_size(usage.total)}, but {limit}; {_advice(usage.bytes)}.")

    def _begin(self) -> Future[None] | None:
        """The walk that is under way, begun now if the figures are old."""
        with self._lock:
            if self._walk is not None and not self._walk.done():
                return self._walk
            is_fresh = not self._is_outdated and time.monotonic() - self._measured_at < FRESH_S
            if is_fresh or self._is_stopping.is_set():
                return None
            self._is_outdated = False
            self._walk = self._pool.submit(self._measure)
            return self._walk

    def _measure(self) -> None:
        found = dict.fromkeys((*FOLDERS.values(), "other"), 0)
        with suppress(OSError), os.scandir(self._data_dir) as entries:
            for entry in entries:
                if entry.is_dir(follow_symlinks=False):
                    found[FOLDERS.get(entry.name, "other")] += folder_bytes(Path(entry.path), self._is_stopping)
                else:
                    found["other"] += entry.stat(follow_symlinks=False).st_size
        with self._lock:
            self._bytes, self._measured_at = found, time.monotonic()


def folder_bytes(path: Path, is_stopping: threading.Event | None = None) -> int:
    """What the files in a folder hold; links count themselves, what vanishes meanwhile counts nothing.

    Args:
        path: of the folder.
        is_stopping: ends the walk early once it is set.
    """
    total, waiting = 0, [os.fspath(path)]
    while waiting and not (is_stopping and is_stopping.is_set()):
        with suppress(OSError), os.scandir(waiting.pop()) as entries:
            for entry in entries:
                with suppress(OSError):
                    if entry.is_dir(follow_symlinks=False):
                        waiting.append(entry.path)
                    else:
                        total += entry.stat(follow_symlinks=False).st_size
    return total


def _advice(found: dict[str, int]) -> str:
    """What to delete, the largest first."""
    names = sorted(_DELETABLE, key=lambda kind: -found.get(kind, 0))
    parts = [f"{_DELETABLE[kind]}{f' ({_size(found[kind])})' if found.get(kind) else ''}" for kind in names]
    return f"delete some {', '.join(parts[:-1])} or {parts[-1]}"


def _size(count: int) -> str:
    for unit, name in ((1 << 30, "GiB"), (1 << 20, "MiB"), (1 << 10, "KiB")):
        if count >= unit:
            return f"{count / unit:.1f} {name}"
    return f"{count} bytes"
