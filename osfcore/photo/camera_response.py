"""The camera's response: sRGB's transfer function (IEC 61966-2-1) and its inverse."""

from __future__ import annotations

from typing import Literal

import numpy as np
from jaxtyping import Float, Float32

Encoding = Literal["srgb", "linear"]


def linear_from_encoded(
    values: Float[np.ndarray, "*shape"], encoding: Encoding = "srgb"
) -> Float32[np.ndarray, "*shape"]:
    """Linear radiance of encoded values, both in [0, 1]."""
    if encoding == "linear":
        return np.asarray(values, np.float32)
    curve = ((np.maximum(values, 0) + 0.055) / 1.055) ** 2.4
    return np.where(values <= 0.04045, values / 12.92, curve).astype(np.float32)


def encoded_from_linear(radiance: Float[np.ndarray, "*shape"]) -> Float32[np.ndarray, "*shape"]:
    """SRGB values of linear radiance, both in [0, 1]."""
    curve = 1.055 * np.maximum(radiance, 0) ** (1 / 2.4) - 0.055
    return np.where(radiance <= 0.0031308, radiance * 12.92, curve).astype(np.float32)
