"""Photos that strangers send: looked at by their header first, then decoded to 8-bit RGB of a moderate size.

Decoders have defects, so the service leaves them to a process of its own, which may take too long, die, or ask for too
much memory without hurting anybody.
"""

from __future__ import annotations

import threading
from collections.abc import Callable
from dataclasses import dataclass

import numpy as np
from jaxtyping import UInt8

from app.processes.child_process import limit_memory
from app.processes.pictures.photo_process import PhotoRefused
from app.processes.process_client import ProcessClient, ProcessHangs
from app.processes.process_server import ProcessServer
from osfcore.errors import CorruptFile
from osfcore.photo.read_photograph import read_photograph

_PATIENCE_S = 20.0  # sound photos take two, and a busy machine some to start the process
_MEMORY_BYTES = 3 << 29  # sound photos take two thirds of it


@dataclass(frozen=True, eq=False, slots=True)
class Photo:
    """A decoded photo, upright.

    Attributes:
        pixels: perhaps scaled down.
        width: as it was sent [px].
        height: as it was sent [px].
    """

    pixels: UInt8[np.ndarray, "h w 3"]
    width: int
    height: int


def read_photo(data: bytes) -> Photo:
    """The pixels of a photo in any usual format, see `read_photograph`, in 8 bit.

    Raises:
        PhotoRefused: if it is no such image, is broken, or has too many or too few pixels.
    """
    try:
        raw = read_photograph(data)
    except CorruptFile as error:
        raise PhotoRefused(str(error)) from None
    return Photo(raw.eight_bit, *raw.sent_size)


class PhotoReader:
    """Decodes photos in a process of its own, one at a time; it starts at the first photo, and again if it dies.

    Args:
        read: a function of a module that takes a photo and returns it decoded.
        answer_s: how long it may take, the start of the process included [s].
    """

    def __init__(self, read: Callable[[bytes], Photo] = read_photo, answer_s: float = _PATIENCE_S) -> None:
        self._answer_s = answer_s
        self._process = ProcessClient(reader_main, (read,), "decoder of photos", answer_s=answer_s)
        self._one_at_a_time = threading.Lock()  # so that none waits for another's time

    def read(self, data: bytes) -> Photo:
        """A photo, see `read_photo`. Blocks.

        Raises:
            PhotoRefused: if it cannot be used, or takes too long.
            ProcessUnavailable: if the process died.
        """
        try:
            with self._one_at_a_time:
                return self._process.call(data)
        except ProcessHangs:
            late = f"The photo could not be decoded within {self._answer_s:g} s; save it anew as a plain JPEG."
            raise PhotoRefused(late) from None

    def stop(self) -> None:
        """End the process, if there is one. Calling it again does nothing."""
        self._process.stop()


def reader_main(server: ProcessServer, read: Callable[[bytes], Photo]) -> None:
    """Decode the photos that are sent."""
    limit_memory(_MEMORY_BYTES)
    server.serve(lambda data, _: read(data))
