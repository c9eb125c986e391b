"""Images of scenes, made once for everybody who asks for the same one."""

from __future__ import annotations

import asyncio
import threading
from collections import OrderedDict
from collections.abc import Awaitable, Callable

from app.processes.messages.scene_messages import TakeImage, TakeMask

ImageKey = tuple[int, TakeImage | TakeMask]  # revision of the scene, and what is asked for


class SceneImages:
    """Asks for images and keeps them until their scene changes. Belongs to one event loop.

    Args:
        max_bytes: of the images that are kept.
        revision_of: tells the revision of a scene; raises UnknownName if there is none.
        take: makes an image of a scene as it is now.
    """

    def __init__(
        self,
        max_bytes: int,
        revision_of: Callable[[str], int],
        take: Callable[[TakeImage | TakeMask], Awaitable[bytes]],
    ) -> None:
        self._revision_of = revision_of
        self._take = take
        self._kept = ImageCache(max_bytes)
        self._in_the_making: dict[ImageKey, asyncio.Future[bytes]] = {}

    async def image(self, command: TakeImage | TakeMask) -> bytes:
        """A PNG of a scene as it is now.

        Raises:
            UnknownName: if there is no such scene.
            OsfError: if the image cannot be made.
        """
        key = (self._revision_of(command.id), command)
        images = self._kept.get(key)
        if images is not None:
            return images
        making = self._in_the_making.get(key)
        if making is None:
            making = asyncio.ensure_future(self._make(key))
            self._in_the_making[key] = making
            making.add_done_callback(lambda done: self._made(key, done))
        return await asyncio.shield(making)  # whoever asked first may leave, others still wait

    async def _make(self, key: ImageKey) -> bytes:
        revision, command = key
        image = await self._take(command)
        # After a change in between, what was made shows the later state, so it is not kept.
        if revision == self._revision_of(command.id):
            self._kept.put(key, image)
        return image

    def _made(self, key: ImageKey, done: asyncio.Future[bytes]) -> None:
        del self._in_the_making[key]
        if not done.cancelled():
            done.exception()  # taken note of, in case that everybody has left


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
