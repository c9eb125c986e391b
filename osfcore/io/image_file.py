"""Images as 8-bit values and as PNG files."""

from __future__ import annotations

import struct
from pathlib import Path

import cv2
import numpy as np
from jaxtyping import Float, UInt8

from osfcore.io.files import write_atomically


def to_uint8(image: Float[np.ndarray, "*shape"]) -> UInt8[np.ndarray, "*shape"]:
    """Return values in [0, 1] as 8-bit values, 0 to 255. Values outside [0, 1] are clipped.

    Example:
        >>> to_uint8(np.array([-0.1, 0.2, 1.0]))
        array([  0,  51, 255], dtype=uint8)
    """
    return np.round(np.clip(image, 0, 1) * 255).astype(np.uint8)


def encode_png(image: UInt8[np.ndarray, "h w *channels"]) -> bytes:
    """Return an RGB or grey image as PNG."""
    return _encoded(image, ".png", [cv2.IMWRITE_PNG_COMPRESSION, 3])


def encode_jpeg(image: UInt8[np.ndarray, "h w 3"]) -> bytes:
    """Return an RGB image as JPEG of quality 85."""
    return _encoded(image, ".jpg", [cv2.IMWRITE_JPEG_QUALITY, 85])


def png_header(path: Path) -> tuple[int, int, int, int] | None:
    """Return width and height [px], bits of a channel and colour type of a PNG, or None for another file."""
    with path.open("rb") as file:
        head = file.read(26)
    is_png = len(head) == 26 and head.startswith(b"\x89PNG\r\n\x1a\n") and head[12:16] == b"IHDR"
    return struct.unpack(">IIBB", head[16:]) if is_png else None


def write_png(path: Path, image: UInt8[np.ndarray, "h w *channels"]) -> None:
    """Write an image as a PNG file. The file appears only once it is complete.

    Args:
        path: the file to write.
        image: RGB, shape (h, w, 3), or grey, shape (h, w).

    Raises:
        CannotWrite: if the file cannot be written.

    Example:
        >>> from pathlib import Path
        >>> write_png(Path("view.png"), to_uint8(rendered.rgb[0, 0]))
    """
    write_atomically(path, encode_png(image))


def _encoded(image: UInt8[np.ndarray, "h w *channels"], suffix: str, options: list[int]) -> bytes:
    _, data = cv2.imencode(suffix, np.ascontiguousarray(image[..., ::-1] if image.ndim == 3 else image), options)
    return data.tobytes()
