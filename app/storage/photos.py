"""Photos that strangers send: looked at by their header first, then decoded to 8-bit RGB of a moderate size.

Decoders have defects, so the service leaves them to a process of its own, which may take too long, die, or ask for too
much memory without hurting anybody.
"""

from __future__ import annotations

import io
import threading
import warnings
from collections.abc import Callable
from dataclasses import dataclass

import numpy as np
from jaxtyping import UInt8
from PIL import ExifTags, Image, UnidentifiedImageError
from pillow_heif import register_heif_opener

from app.processes.child_process import limit_memory
from app.processes.process_client import ProcessClient, ProcessHangs
from app.processes.process_server import ProcessServer
from osfcore.errors import OsfError

FORMATS = ("PNG", "JPEG", "WEBP", "HEIF", "AVIF", "TIFF", "GIF", "BMP")
MAX_PIXELS = 150_000_000
MIN_SIDE = 32
KEPT_SIDE = 2048  # larger photos are scaled down to this: enough to cut the table out of a wide one
_WIDE_MODES = ("I;16", "I;16B", "I;16L", "I;16N")
_EIGHT_BITS = ((np.arange(1 << 16) + 128) // 257).astype(np.uint8)  # of sixteen, rounded
_UPRIGHT = {  # how to turn a picture that its EXIF orientation says is turned
    2: Image.Transpose.FLIP_LEFT_RIGHT,
    3: Image.Transpose.ROTATE_180,
    4: Image.Transpose.FLIP_TOP_BOTTOM,
    5: Image.Transpose.TRANSPOSE,
    6: Image.Transpose.ROTATE_270,
    7: Image.Transpose.TRANSVERSE,
    8: Image.Transpose.ROTATE_90,
}
_ON_ITS_SIDE = (5, 6, 7, 8)
_PATIENCE_S = 20.0  # sound photos take two, and a busy machine some to start the process
_MEMORY_BYTES = 3 << 29  # sound photos take two thirds of it


class PhotoRefused(OsfError):
    """A photo that cannot be used."""


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
    """The pixels of a photo in any usual format, upright, no side longer than 2048 px.

    Grey, palettes, CMYK, transparency (which is dropped) and 16 bits a channel are understood; of an animation the
    first image counts.

    Raises:
        PhotoRefused: if it is no such image, is broken, or has too many or too few pixels.
    """
    register_heif_opener()
    try:
        with warnings.catch_warnings():
            warnings.simplefilter("ignore")  # about odd metadata, which nobody needs, and sizes, which are checked here
            with Image.open(io.BytesIO(data), formats=FORMATS) as image:
                _check_size(*image.size)
                return _decoded(image)
    except PhotoRefused:  # a ValueError itself
        raise
    except MemoryError:
        raise PhotoRefused("The photo needs too much memory to be decoded; send a smaller one.") from None
    except UnidentifiedImageError:
        kinds = "a JPEG, PNG, WebP, HEIC, AVIF, TIFF, GIF or BMP file"
        raise PhotoRefused(f"The file is no picture that can be read here; send {kinds}.") from None
    except Image.DecompressionBombError:
        raise PhotoRefused(f"The photo has far too many pixels; {_millions(MAX_PIXELS)} are allowed.") from None
    except Exception:  # decoders raise whatever their own code stumbles over
        raise PhotoRefused("The photo is damaged or incomplete; it cannot be decoded.") from None


def _check_size(width: int, height: int) -> None:
    size = f"The photo has {width} x {height} pixels"
    if width * height > MAX_PIXELS:
        raise PhotoRefused(f"{size}; {_millions(MAX_PIXELS)} are allowed.")
    if min(width, height) < MIN_SIDE:
        raise PhotoRefused(f"{size}; at least {MIN_SIDE} a side are needed.")


def _millions(pixels: int) -> str:
    return f"{pixels // 1_000_000} million"


def _decoded(image: Image.Image) -> Photo:
    size = image.size
    image.draft("RGB", (KEPT_SIDE, KEPT_SIDE))  # lets a JPEG be decoded small at once
    if image.mode in _WIDE_MODES:
        plain = Image.fromarray(_EIGHT_BITS[np.asarray(image)]).convert("RGB")
    else:
        plain = image if image.mode == "RGB" else image.convert("RGB")
    plain.thumbnail((KEPT_SIDE, KEPT_SIDE), Image.Resampling.BOX)
    orientation = _orientation(image)
    upright = plain.transpose(_UPRIGHT[orientation]) if orientation in _UPRIGHT else plain
    width, height = size[::-1] if orientation in _ON_ITS_SIDE else size
    return Photo(np.asarray(upright), width, height)


def _orientation(image: Image.Image) -> int | None:
    """What EXIF says; None if its metadata cannot be understood (ImageOps gives up)."""
    try:
        orientation = image.getexif().get(ExifTags.Base.Orientation, 1)
        return orientation if orientation in _UPRIGHT else None
    except Exception:  # there are too many kinds of mistakes in metadata to name them
        return None


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
