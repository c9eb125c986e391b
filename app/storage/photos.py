"""Photos that strangers send: looked at by their header first, then decoded to 8-bit RGB of a moderate size."""

from __future__ import annotations

import io
import struct
import warnings
import zlib

import numpy as np
from jaxtyping import UInt8
from PIL import Image, ImageOps

from osfcore.errors import OsfError

FORMATS = ("PNG", "JPEG")
MAX_SIDE, MAX_PIXELS = 4096, 4096 * 4096
MIN_SIDE, MAX_RATIO = 32, 4
KEPT_SIDE = 512  # larger photos are scaled down to this: estimators look at less
_DEFECTS = (OSError, SyntaxError, ValueError, EOFError, OverflowError, MemoryError, struct.error, zlib.error)
_WIDE_MODES = ("I;16", "I;16B", "I;16L", "I;16N", "I", "F")


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
    except (Image.DecompressionBombError, Image.DecompressionBombWarning):
        raise PhotoRefused(f"The photo has far too many pixels; {MAX_SIDE} a side are allowed.") from None
    except _DEFECTS as error:
        if isinstance(error, Image.UnidentifiedImageError):
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
    upright = ImageOps.exif_transpose(image)
    if upright.mode in _WIDE_MODES:
        wide = np.asarray(upright, np.float64)
        upright = Image.fromarray(np.clip(np.round(wide / 257), 0, 255).astype(np.uint8))
    upright = upright.convert("RGB")
    upright.thumbnail((KEPT_SIDE, KEPT_SIDE), Image.Resampling.BOX)
    return np.asarray(upright)
