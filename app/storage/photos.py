"""Photos that strangers send: looked at by their header first, then decoded to 8-bit RGB of a moderate size.

Decoders have defects, so the service leaves them to a process of its own, which may take too long, die, or ask for too
much memory without hurting anybody.
"""

from __future__ import annotations

import io
import threading
import warnings
from collections.abc import Callable

import numpy as np
from jaxtyping import UInt8
from PIL import ExifTags, Image

from app.processes.child_process import limit_memory
from app.processes.process_client import ProcessClient, ProcessHangs
from app.processes.process_server import ProcessServer
from osfcore.errors import OsfError

FORMATS = ("PNG", "JPEG")
MAX_SIDE, MAX_PIXELS = 4096, 4096 * 4096
MIN_SIDE, MAX_RATIO = 32, 4
KEPT_SIDE = 512  # larger photos are scaled down to this: estimators look at less
_SIGNATURES = (b"\x89PNG", b"\xff\xd8")
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
_PATIENCE_S = 20.0  # sound photos take two, and a busy machine some to start the process
_MEMORY_BYTES = 1 << 30  # sound photos take half of it


class PhotoRefused(OsfError):
    """A photo that cannot be used."""


def read_photo(data: bytes) -> UInt8[np.ndarray, "h w 3"]:
    """The pixels of a PNG or JPEG, upright, no side longer than 512 px.

    Grey, palettes, CMYK, transparency (which is dropped) and 16 bits a channel are understood.

    Raises:
        PhotoRefused: if it is no such image, is broken or animated, or has too many or too few pixels.
    """
    try:
        with warnings.catch_warnings():
            warnings.simplefilter("error", Image.DecompressionBombWarning)
            warnings.simplefilter("ignore", UserWarning)  # about odd metadata, which nobody needs
            with Image.open(io.BytesIO(data), formats=FORMATS) as image:
                _check_header(image)
                return _pixels(image)
    except PhotoRefused:  # a ValueError itself
        raise
    except MemoryError:
        raise PhotoRefused("The photo needs too much memory to be decoded; send a smaller one.") from None
    except (Image.DecompressionBombError, Image.DecompressionBombWarning):
        raise PhotoRefused(f"The photo has far too many pixels; {MAX_SIDE} a side are allowed.") from None
    except Exception:  # decoders raise whatever their own code stumbles over
        if not data.startswith(_SIGNATURES):
            raise PhotoRefused("The photo is neither a PNG nor a JPEG image.") from None
        raise PhotoRefused("The photo is damaged or incomplete; it cannot be decoded.") from None


def _check_header(image: Image.Image) -> None:
    width, height = image.size
    if max(width, height) > MAX_SIDE or width * height > MAX_PIXELS:
        raise PhotoRefused(f"The photo has {width} x {height} pixels; {MAX_SIDE} a side are allowed.")
    if min(width, height) < MIN_SIDE:
        raise PhotoRefused(f"The photo has {width} x {height} pixels; at least {MIN_SIDE} a side are needed.")
    if max(width, height) > MAX_RATIO * min(width, height):
        raise PhotoRefused(f"The photo has {width} x {height} pixels; one side may be {MAX_RATIO} times the other.")
    if image.format == "PNG" and getattr(image, "is_animated", False):  # JPEGs of telephones may bring further views
        raise PhotoRefused("The photo is animated; a single image is expected.")


def _pixels(image: Image.Image) -> UInt8[np.ndarray, "h w 3"]:
    image.draft("RGB", (KEPT_SIDE, KEPT_SIDE))  # lets a JPEG be decoded small at once
    if image.mode in _WIDE_MODES:
        plain = Image.fromarray(_EIGHT_BITS[np.asarray(image)]).convert("RGB")
    else:
        plain = image.convert("RGB")
    plain.thumbnail((KEPT_SIDE, KEPT_SIDE), Image.Resampling.BOX)
    turn = _turn(image)
    return np.asarray(plain if turn is None else plain.transpose(turn))


def _turn(image: Image.Image) -> Image.Transpose | None:
    """What makes a decoded image stand upright; None if it does, or if its metadata cannot be understood."""
    try:
        return _UPRIGHT.get(image.getexif().get(ExifTags.Base.Orientation, 1))
    except Exception:  # there are too many kinds of mistakes in metadata to name them
        return None


class PhotoReader:
    """Decodes photos in a process of its own, one at a time; it starts at the first photo, and again if it dies.

    Args:
        read: a function of a module that takes a photo and returns its pixels.
        answer_s: how long it may take, the start of the process included [s].
    """

    def __init__(self, read: Callable[[bytes], np.ndarray] = read_photo, answer_s: float = _PATIENCE_S) -> None:
        self._answer_s = answer_s
        self._process = ProcessClient(reader_main, (read,), "decoder of photos", answer_s=answer_s)
        self._one_at_a_time = threading.Lock()  # so that none waits for another's time

    def read(self, data: bytes) -> UInt8[np.ndarray, "h w 3"]:
        """The pixels of a photo, see `read_photo`. Blocks.

        Raises:
            PhotoRefused: if it cannot be used, or takes too long.
            ProcessUnavailable: if the process died.
        """
        try:
            with self._one_at_a_time:
                return self._process.call(data)
        except ProcessHangs:
            late = f"The photo could not be decoded within {self._answer_s:g} s; save it anew as a plain PNG or JPEG."
            raise PhotoRefused(late) from None

    def stop(self) -> None:
        """End the process, if there is one. Calling it again does nothing."""
        self._process.stop()


def reader_main(server: ProcessServer, read: Callable[[bytes], np.ndarray]) -> None:
    """Decode the photos that are sent."""
    limit_memory(_MEMORY_BYTES)
    server.serve(lambda data, _: read(data))
