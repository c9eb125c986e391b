"""Conversions between the values of an image file and linear radiance."""

from __future__ import annotations

from dataclasses import dataclass, replace
from typing import Literal

import numpy as np
from jaxtyping import Float

from osfcore.geometry.light import AMBIENT, DIFFUSE
from osfcore.geometry.states import Observation

Encoding = Literal["srgb", "linear"]
_SLOPE, _OFFSET, _GAMMA = 12.92, 0.055, 2.4  # of IEC 61966-2-1
_KNEE_LINEAR, _KNEE_SRGB = 0.0031308, 0.04045  # below it the curve is a straight line


def srgb_of_linear(linear: Float[np.ndarray, "*shape"]) -> Float[np.ndarray, "*shape"]:
    """Encode linear radiance l in [0, 1] as sRGB values v in [0, 1] (IEC 61966-2-1).

    v = 12.92 l  if l <= 0.0031308,  else  1.055 l^(1 / 2.4) - 0.055

    Example:
        >>> srgb_of_linear(np.array([0.0, 0.5, 1.0])).round(3)
        array([0.   , 0.735, 1.   ])
    """
    curve = (1 + _OFFSET) * np.maximum(linear, _KNEE_LINEAR) ** (1 / _GAMMA) - _OFFSET
    return np.where(linear <= _KNEE_LINEAR, _SLOPE * linear, curve)


def linear_of_srgb(encoded: Float[np.ndarray, "*shape"]) -> Float[np.ndarray, "*shape"]:
    """Decode sRGB values v in [0, 1] to linear radiance l: the inverse of `srgb_of_linear`.

    l = v / 12.92  if v <= 0.04045,  else  ((v + 0.055) / 1.055)^2.4
    """
    curve = ((np.maximum(encoded, _KNEE_SRGB) + _OFFSET) / (1 + _OFFSET)) ** _GAMMA
    return np.where(encoded <= _KNEE_SRGB, encoded / _SLOPE, curve)


def linear_from_encoded(values: Float[np.ndarray, "*shape"], encoding: Encoding) -> Float[np.ndarray, "*shape"]:
    """Return the linear radiance of the values of an image file.

    Args:
        values: values of the file, divided by the largest one that it can hold.
        encoding: "srgb", which nearly all cameras write, or "linear" for files that hold radiance.

    Returns:
        Values of the same range and type.
    """
    return linear_of_srgb(values) if encoding == "srgb" else values


# The image model of images whose exposure, ambient light and table are not known. Fields and images are adapted until
# they fit each other.
#
# Fields are trained with ambient 0.25 and diffuse 0.75 on a table of one known colour. Images obey, for each colour c,
#
#     I_c = G_c * albedo_c * (r * ambient + direct(l)) * (T_c on the table),          ideal: G = r = T = 1
#
# where G is exposure and white balance, r the ambient light relative to the direct one, T the table's albedo
# relative to the known one. Images are divided by G, and r and T go into the fields. Both are then scaled such that a
# white surface that faces the lamp has radiance 1 again, because errors are judged in radiance.


_USUAL = 0.12  # of the logarithm of each factor


@dataclass(frozen=True, eq=False, slots=True)
class ImageModel:
    """How images differ from those that the fields were trained for.

    Attributes:
        gain: G, exposure and white balance, per colour.
        ambient: r, ambient light relative to the direct light.
        table: T, factors on the table's albedo, per colour.
        encoding: encoding of the images' values.
        surroundings: linear radiance of the background beyond the table in the images; None if it is as in the
            fields. It is a value of its own, because nobody knows what lights the background.
    """

    gain: Float[np.ndarray, "3"]
    ambient: float
    table: Float[np.ndarray, "3"]
    encoding: Encoding = "linear"
    surroundings: Float[np.ndarray, "3"] | None = None

    @property
    def scale(self) -> float:
        """Factor that brings the radiance of a white surface facing the lamp back to 1."""
        return 1 / (AMBIENT * self.ambient + DIFFUSE)

    @property
    def is_usual(self) -> bool:
        """Whether the fields suit such images, within the error of a fit at the right poses."""
        factors = np.array([*self.gain, self.ambient, *self.table])
        return self.encoding == "linear" and bool(np.all(np.abs(np.log(factors)) < _USUAL))

    @property
    def oddities(self) -> str:
        """What is unusual about the images, in words; "" if nothing is."""
        parts = ["sRGB values"] if self.encoding == "srgb" else []
        for what, factor in (("exposure", self.gain), ("ambient light", self.ambient), ("table", self.table)):
            if np.abs(np.log(factor)).max() > _USUAL:
                parts.append(f"{what} {' '.join(f'{each:.2f}' for each in np.atleast_1d(factor))} times the usual")
        return ", ".join(parts)

    def normalized(self, observation: Observation) -> Observation:
        """Return the observation as linear radiance at the usual exposure."""
        images = linear_from_encoded(observation.images, self.encoding) * (self.scale / self.gain)
        return replace(observation, images=images.astype(np.float32))
