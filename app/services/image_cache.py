"""Images that were made already, so that asking twice costs nothing."""

from __future__ import annotations

import threading
from collections import OrderedDict


class ImageCache:
    """The latest images, up to a number of bytes."""

    def __init__(self, max_bytes: int) -> None:
        self._max_bytes = max_bytes
        self._bytes = 0
        self._images: OrderedDict[object, bytes] = OrderedDict()
        self._lock = threading.Lock()

    def get(self, key: object) -> bytes | None:
        """An image, which then counts as new again; None if it is not kept."""
        with self._lock:
            if key in self._images:
                self._images.move_to_end(key)
            return self._images.get(key)

    def put(self, key: object, image: bytes) -> None:
        """Keep an image, in place of those that were asked for the longest time ago."""
        with self._lock:
            self._bytes += len(image) - len(self._images.get(key, b""))
            self._images[key] = image
            while self._bytes > self._max_bytes:
                _, dropped = self._images.popitem(last=False)
                self._bytes -= len(dropped)
