"""Images as 8-bit values and as PNG files."""

from __future__ import annotations

from pathlib import Path

import cv2
import numpy as np
from jaxtyping import Float, UInt8

from osfcore.errors import CannotWrite
from osfcore.io.files import write_atomically


def to_uint8(image: Float[np.ndarray, "*shape"]) -> UInt8[np.ndarray, "*shape"]:
    """Values in [0, 1] as 8 bit."""
    return np.round(np.clip(image, 0, 1) * 255).astype(np.uint8)


def write_png(path: Path, image: UInt8[np.ndarray, "h w 3"]) -> None:
    """Write an RGB image; the file appears only when it is whole.

    Raises:
        CannotWrite: if the disk refuses.
    """
    done, data = cv2.imencode(".png", image[..., ::-1])
    if not done:
        raise CannotWrite(path, "the image could not be encoded")
    write_atomically(path, data.tobytes())
