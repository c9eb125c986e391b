"""Thumbnails of objects: drawn once in a process of their own, which leaves when it is idle, and kept on disk."""

from __future__ import annotations

import contextlib
import threading
from pathlib import Path

from app.processes.client import ProcessClient, ProcessUnavailable
from app.processes.thumbnail_process import thumbnails_main
from osfcore.errors import CannotWrite
from osfcore.io.files import write_atomically
from osfcore.objects.asset_library import AssetLibrary

VERSION = 1  # of the picture; another one makes all anew
_NAME = "drawer of thumbnails"
_IDLE_S = 20.0
_ANSWER_S = 60.0


class Thumbnails:
    """Draws thumbnails, one at a time. Any thread may call.

    Args:
        library: the objects.
        cache: folder of what was drawn; made when needed.
        idle_s: after which the process ends [s].
    """

    def __init__(self, library: AssetLibrary, cache: Path, idle_s: float = _IDLE_S) -> None:
        self._library, self._cache, self._idle_s = library, cache, idle_s
        self._drawing = threading.Lock()
        self._lock = threading.Lock()
        self._process: ProcessClient | None = None
        self._timer: threading.Timer | None = None
        self._is_stopped = False

    def stop(self) -> None:
        """End the process, if there is one. Calling it again does nothing."""
        with self._lock:
            self._is_stopped = True
        self._end()

    def png(self, name: str) -> bytes:
        """The object from all around, as `osfcore.inspection.contact_sheet` draws it. Blocks.

        Raises:
            UnknownName, MissingAssets, CorruptFile: if there is no such object here, or it is damaged.
            ProcessUnavailable: if it could not be drawn.
        """
        file = self._cache / f"{self._library.digest(name)}-{VERSION}.png"
        with contextlib.suppress(OSError):
            return file.read_bytes()
        with self._drawing:
            with contextlib.suppress(OSError):  # another request may have drawn it meanwhile
                return file.read_bytes()
            png = self._draw(name)
        with contextlib.suppress(CannotWrite):  # on a full disk it is drawn again the next time
            write_atomically(file, png)
        return png

    def _draw(self, name: str) -> bytes:
        with self._lock:
            if self._is_stopped:  # requests that wait must not begin another process each
                raise ProcessUnavailable(_NAME, "has been stopped")
            if self._timer is not None:
                self._timer.cancel()
            if self._process is None:
                root = self._library.root
                self._process = ProcessClient(thumbnails_main, (root,), _NAME, answer_s=_ANSWER_S)
            process = self._process
        try:
            return process.call(name)
        finally:
            with self._lock:
                self._timer = threading.Timer(self._idle_s, self._end)
                self._timer.daemon = True
                self._timer.start()
                is_stopped = self._is_stopped
            if is_stopped:
                self._end()

    def _end(self) -> None:
        with self._lock:
            process, self._process = self._process, None
            if self._timer is not None:
                self._timer.cancel()
        if process is not None:
            process.stop()
