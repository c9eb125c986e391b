"""Masks of objects, drawn over an image."""

from __future__ import annotations

import numpy as np
from jaxtyping import Bool, UInt8

MASK_COLOURS = np.array(
    [
        [230, 85, 60],
        [60, 140, 230],
        [70, 180, 90],
        [235, 180, 50],
        [160, 95, 210],
        [40, 190, 190],
        [235, 110, 170],
        [140, 120, 90],
    ],
    np.uint8,
)


def tint_masks(pixels: UInt8[np.ndarray, "h w 3"], masks: Bool[np.ndarray, "N h w"]) -> UInt8[np.ndarray, "h w 3"]:
    """An image with the masks of N objects laid over it, half transparent, one colour each."""
    drawn = pixels.copy()
    for number, mask in enumerate(masks):
        colour = MASK_COLOURS[number % len(MASK_COLOURS)]
        drawn[mask] = (pixels[mask].astype(np.uint16) + colour) // 2
    return drawn
