"""The image model's materials and lamp: what every picture of this project is made of.

Lambert shading without specular part, as stated in the README's conventions:
radiance = albedo * (ambient + diffuse * max(0, n . l) * visible), visible in {0, 1}. Values are linear, no gamma.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from jaxtyping import Float

from osfcore.geometry.light import AMBIENT, DIFFUSE

TABLE_ALBEDO = (0.66, 0.62, 0.56)  # pale wood, uniform, so that only light and shadow change it
BACKGROUND_RADIANCE = (0.10, 0.11, 0.12)  # beyond the table's edge; no lamp reaches it


@dataclass(frozen=True, slots=True)
class Lamp:
    """How strongly the scene is lit.

    Attributes:
        ambient: radiance of a white surface in shadow.
        diffuse: what the light adds when it falls in along the normal.
    """

    ambient: float = AMBIENT
    diffuse: float = DIFFUSE


def lambert(
    albedo: Float[np.ndarray, "S 3"], cosine: Float[np.ndarray, "S"], visible: Float[np.ndarray, "S"], lamp: Lamp
) -> Float[np.ndarray, "S 3"]:
    """Radiance of matte surfaces.

    Args:
        albedo: linear, in [0, 1].
        cosine: n . l.
        visible: 1 where the light arrives, 0 in shadow.
        lamp: strengths of ambient and diffuse light.
    """
    irradiance = lamp.ambient + lamp.diffuse * np.maximum(cosine, 0) * visible
    return albedo * irradiance[:, None]
