"""Images as 8-bit values and as PNG files."""

from __future__ import annotations

from pathlib import Path

import cv2
import numpy as np
from jaxtyping import Float, UInt8

from osfcore.io.files import write_atomically


def to_uint8(image: Float[np.ndarray, "*shape"]) -> UInt8[np.ndarray, "*shape"]:
    """Values in [0, 1] as 8 bit."""
    return np.round(np.clip(image, 0, 1) * 255).astype(np.uint8)


def encode_png(image: UInt8[np.ndarray, "h w *channels"]) -> bytes:
    """An RGB or grey image as PNG."""
    return _encoded(image, ".png", [cv2.IMWRITE_PNG_COMPRESSION, 3])


def encode_jpeg(image: UInt8[np.ndarray, "h w 3"]) -> bytes:
    """An RGB image as JPEG of quality 85."""
    return _encoded(image, ".jpg", [cv2.IMWRITE_JPEG_QUALITY, 85])


def write_png(path: Path, image: UInt8[np.ndarray, "h w *channels"]) -> None:
    """Write an RGB or grey image; the file appears only when it is whole.

    Raises:
        CannotWrite: if the disk refuses.
    """
    write_atomically(path, encode_png(image))


def _encoded(image: UInt8[np.ndarray, "h w *channels"], suffix: str, options: list[int]) -> bytes:
    _, data = cv2.imencode(suffix, np.ascontiguousarray(image[..., ::-1] if image.ndim == 3 else image), options)
    return data.tobytes()
