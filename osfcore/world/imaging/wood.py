"""A wooden table: boards side by side, with grain, year rings and dark joints, drawn at random."""

from __future__ import annotations

from itertools import pairwise

import cv2
import numpy as np
from jaxtyping import Float

from osfcore.world.imaging.optics import TABLE_ALBEDO

_ROWS = 10  # of boards across the table
_TONE = 0.07  # by which boards differ (standard deviation), as a share of their brightness
_RING, _GRAIN = 0.10, 0.05  # amplitude of year rings and standard deviation of grain, as shares
_JOINT = 0.45  # brightness of the gap between boards
_DARKER = (0.85, 1.0, 1.2)  # dark wood is redder: blue loses more than red


def wooden_texture(rng: np.random.Generator, side: int = 1024) -> Float[np.ndarray, "side side 3"]:
    """An albedo for a `TableSurface`, as bright and of the same colour as the usual table in the mean.

    Args:
        rng: draws the boards.
        side: of the texture [texels].
    """
    edges = np.round(np.linspace(0, side, _ROWS + 1)).astype(int)
    shade = np.empty((side, side), np.float32)
    for top, bottom in pairwise(edges):
        end = int(rng.integers(side // 5, side - side // 5))  # where one board of the row ends and the next begins
        shade[top:bottom, :end] = _board(rng, bottom - top, end, side)
        shade[top:bottom, end:] = _board(rng, bottom - top, side - end, side)
    texture = np.array(TABLE_ALBEDO, np.float32) * (
        1 + (shade - shade.mean())[..., None] * np.array(_DARKER, np.float32)
    )
    return np.clip(texture, 0, 1).astype(np.float32)


def _board(rng: np.random.Generator, height: int, width: int, side: int) -> Float[np.ndarray, "height width"]:
    """Relative brightness of one board along x, less 1, with a joint at its top and left."""
    texel = 1024 / side  # sizes below are in texels of a texture of 1024
    y = np.arange(height)[:, None] * texel
    bent = y + 9 * _noise(rng, height, width, 40 / texel, 250 / texel)  # rings meander along the board
    rings = np.sin(2 * np.pi * bent / rng.uniform(12, 26) + rng.uniform(0, 2 * np.pi))
    grain = _noise(rng, height, width, 2 / texel, 90 / texel)
    shade = _TONE * rng.standard_normal() + _RING * rings * np.abs(rings) + _GRAIN * grain
    gap = max(round(2 / texel), 1)
    shade[:gap], shade[:, :gap] = _JOINT - 1, _JOINT - 1
    return shade.astype(np.float32)


def _noise(rng: np.random.Generator, height: int, width: int, across: float, along: float) -> np.ndarray:
    """Smooth noise of standard deviation 1 that changes within these distances across and along the board [texels]."""
    coarse = rng.standard_normal((round(height / across) + 2, round(width / along) + 2))
    smooth = cv2.resize(coarse, (width, height), interpolation=cv2.INTER_CUBIC)
    return smooth / max(smooth.std(), 1e-9)
