"""What share of a lamp's light falls on each pixel: n . l, visibility, falloff and cone, by few numbers.

The lamp stands at centre + direction / q: q = 1 / distance is searched rather than the distance, since it is bounded,
and small for a distant lamp. The direction is a step in the tangent plane of a base direction. The cone looks at a
point of the plane z = centre_z; its size is the radius rho of the pool of light around that point, which says less of
the distance than an angle would.
"""

from __future__ import annotations

from dataclasses import dataclass, replace

import numpy as np
from jaxtyping import Float

from osfcore.geometry.poses import orthogonal_basis
from osfcore.photo.light.lit_pixels import LitPixels

STEPS = np.array([0.012, 0.012, 0.05, 0.01, 0.01, 0.03, 0.03])
"""Of the numbers x of `LampShape.moved`, at which the light changes noticeably, but still linearly."""
PLACE_NUMBERS = 3  # of those, that say where the lamp is
NEAREST_M, FARTHEST_M = 0.2, 25.0
_SHARES = 0.2, 0.98  # inner over outer half-angle
_RADII_M = 0.03, 3.0
_LEAST_HEIGHT = 0.08  # of the direction above the table


@dataclass(frozen=True, eq=False, slots=True)
class LampShape:
    """A lamp.

    Attributes:
        centre: what its direction and distance are told from [m].
        direction: unit vector from there toward the lamp.
        inverse: of the distance [1/m].
        aim: x and y of the point that it looks at, from the centre [m].
        radius: of the pool of light around that point, where it ends [m]; None without a cone.
        inner_share: the inner half-angle of the cone over the outer one.
    """

    centre: Float[np.ndarray, "3"]
    direction: Float[np.ndarray, "3"]
    inverse: float
    aim: Float[np.ndarray, "2"]
    radius: float | None = None
    inner_share: float = 0.7

    @property
    def place(self) -> Float[np.ndarray, "3"]:
        """Of the lamp [m]."""
        return self.centre + self.direction / self.inverse

    @property
    def aim_point(self) -> Float[np.ndarray, "3"]:
        """What it looks at [m]."""
        return self.centre + np.array([*self.aim, 0.0])

    @property
    def cone_rad(self) -> tuple[float, float] | None:
        """Inner and outer half-angle; None without a cone."""
        if self.radius is None:
            return None
        outer = float(np.arctan2(self.radius, np.linalg.norm(self.place - self.aim_point)))
        return self.inner_share * outer, outer

    @property
    def count(self) -> int:
        """Of the numbers that it has."""
        return PLACE_NUMBERS if self.radius is None else len(STEPS)

    def moved(self, x: Float[np.ndarray, "count"], *, above_table: bool) -> LampShape:
        """Another lamp nearby.

        Args:
            x: two steps of the direction [rad], of the inverse distance [1/m], of the aim [m], of the radius's
                logarithm and of the inner share; the first three alone without a cone.
            above_table: keep it above the plane.
        """
        right, up = orthogonal_basis(self.direction)
        direction = self.direction + x[0] * right + x[1] * up
        direction /= np.linalg.norm(direction)
        if above_table and direction[2] < _LEAST_HEIGHT:
            flat = direction[:2] / max(float(np.linalg.norm(direction[:2])), 1e-9)
            direction = np.array([*flat * np.sqrt(1 - _LEAST_HEIGHT**2), _LEAST_HEIGHT])
        inverse = float(np.clip(self.inverse + x[2], 1 / FARTHEST_M, 1 / NEAREST_M))
        if self.radius is None:
            return replace(self, direction=direction, inverse=inverse)
        radius = float(np.clip(self.radius * np.exp(np.clip(x[5], -1, 1)), *_RADII_M))
        share = float(np.clip(self.inner_share + x[6], *_SHARES))
        return LampShape(self.centre, direction, inverse, self.aim + x[3:5], radius, share)

    def unshaded(self, pixels: LitPixels) -> Float[np.ndarray, "P"]:
        """Share of the light that falls on each pixel past no object; 1 on one at the centre that faces the lamp."""
        way = self.place - pixels.points
        squared = np.einsum("ij,ij->i", way, way)
        along = np.einsum("ij,ij->i", way, pixels.normals)
        share = np.maximum(along, 0) / np.sqrt(squared) / (squared * self.inverse**2)
        cone = self.cone_rad
        if cone is None:
            return share
        axis = self.aim_point - self.place
        cosine = -(way @ axis) / (np.sqrt(squared) * np.linalg.norm(axis))
        s = np.clip((cone[1] - np.arccos(np.clip(cosine, -1, 1))) / (cone[1] - cone[0]), 0, 1)
        return share * s**2 * (3 - 2 * s)
