"""From the values that a picture file holds to linear radiance, and back."""

from __future__ import annotations

from typing import Literal

import numpy as np
from jaxtyping import Float

Encoding = Literal["srgb", "linear"]
_SLOPE, _OFFSET, _GAMMA = 12.92, 0.055, 2.4  # of IEC 61966-2-1
_KNEE_LINEAR, _KNEE_SRGB = 0.0031308, 0.04045  # below it the curve is a straight line


def srgb_of_linear(linear: Float[np.ndarray, "*shape"]) -> Float[np.ndarray, "*shape"]:
    """Values in [0, 1] as sRGB encodes them (IEC 61966-2-1).

    v = 12.92 l  if l <= 0.0031308,  else  1.055 l^(1 / 2.4) - 0.055
    """
    curve = (1 + _OFFSET) * np.maximum(linear, _KNEE_LINEAR) ** (1 / _GAMMA) - _OFFSET
    return np.where(linear <= _KNEE_LINEAR, _SLOPE * linear, curve)


def linear_of_srgb(encoded: Float[np.ndarray, "*shape"]) -> Float[np.ndarray, "*shape"]:
    """The inverse of `srgb_of_linear`.

    l = v / 12.92  if v <= 0.04045,  else  ((v + 0.055) / 1.055)^2.4
    """
    curve = ((np.maximum(encoded, _KNEE_SRGB) + _OFFSET) / (1 + _OFFSET)) ** _GAMMA
    return np.where(encoded <= _KNEE_SRGB, encoded / _SLOPE, curve)


def linear_from_encoded(values: Float[np.ndarray, "*shape"], encoding: Encoding) -> Float[np.ndarray, "*shape"]:
    """Linear radiance of the values of a picture file.

    Args:
        values: 1 stands for the largest number that the file can hold.
        encoding: "srgb", as nearly all cameras write; "linear" for files that hold radiance as it is.

    Returns:
        Values of the same range and type.
    """
    return linear_of_srgb(values) if encoding == "srgb" else values
