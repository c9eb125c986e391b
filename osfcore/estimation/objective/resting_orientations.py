"""How an object can lie on a table, from its field alone.

The height of the centre of mass over the table is a function of the direction that points down. Where it has a minimum
the object lies stably; where it hardly changes from one direction to the next, as for a can on its side, every one of
them is kept.
"""

from __future__ import annotations

from dataclasses import dataclass
from typing import Protocol

import numpy as np
from jaxtyping import Float, Float32
from scipy.spatial import ConvexHull

from osfcore.geometry.poses import Pose, quaternion_exp, quaternion_multiply

_OPAQUE_G = 2.0  # density feature above which a corner counts as solid
_DIRECTIONS = 3000
_NEIGHBOURHOOD_DEG = 20.0
_SLACK_M = 1.5e-3  # above the lowest direction nearby
_SPACING_DEG = 15.0
_YAWS = 24


class DensityGrid(Protocol):
    """A field's density features on a grid: `osfcore.fields.kiloosf.KiloOSF`, or the paper's."""

    @property
    def origin(self) -> Float32[np.ndarray, "3"]:
        """Corner (0, 0, 0) of the grid [m]."""
        ...

    @property
    def voxel(self) -> float:
        """Side of a voxel [m]."""
        ...

    @property
    def density(self) -> Float32[np.ndarray, "nx ny nz"]:
        """Density features on all corners."""
        ...


@dataclass(frozen=True, eq=False, slots=True)
class RestingOrientations:
    """Orientations in which an object may lie on a table, each turned about the vertical in equal steps.

    Attributes:
        quaternions: rotations from the object's frame to the world.
        heights: of the centre of mass above the table [m].
        centre: the centre of mass of a solid body of that shape, in the object's frame [m].
        radius: of the sphere around that centre that holds the object [m].
        hull: vertices of the convex hull, in the object's frame [m].
    """

    quaternions: Float[np.ndarray, "K 4"]
    heights: Float[np.ndarray, "K"]
    centre: Float[np.ndarray, "3"]
    radius: float
    hull: Float[np.ndarray, "H 3"]

    def lowest(self, pose: Pose) -> float:
        """Height of the lowest point of the object in a pose [m]."""
        return float(pose.apply(self.hull)[:, 2].min())


def resting_orientations(field: DensityGrid, *, yaws: int = _YAWS) -> RestingOrientations:
    """Find them for a field; `yaws` steps about the vertical."""
    vertices, centre = _solid(field)
    directions = fibonacci_sphere(_DIRECTIONS)
    heights = ((vertices - centre) @ directions.T).max(axis=0)
    down = _stable(directions, heights)
    lying = np.array([_rotation_downwards(directions[k]) for k in down])
    turns = yaw_quaternions(np.arange(yaws) * 2 * np.pi / yaws)
    quaternions = quaternion_multiply(turns[None], lying[:, None]).reshape(-1, 4)
    radius = float(np.linalg.norm(vertices - centre, axis=1).max())
    return RestingOrientations(quaternions, np.repeat(heights[down], yaws), centre, radius, vertices)


def fibonacci_sphere(count: int) -> Float[np.ndarray, "count 3"]:
    """Unit vectors spread evenly over the sphere (a Fibonacci lattice)."""
    k = np.arange(count) + 0.5
    z = 1 - 2 * k / count
    azimuth = np.pi * (1 + 5**0.5) * k
    radius = np.sqrt(1 - z * z)
    return np.stack([radius * np.cos(azimuth), radius * np.sin(azimuth), z], axis=1)


def yaw_quaternions(angles: Float[np.ndarray, "K"]) -> Float[np.ndarray, "K 4"]:
    """Turns about the vertical by angles [rad]."""
    return quaternion_exp(np.stack([np.zeros_like(angles), np.zeros_like(angles), angles], axis=1))


def _solid(field: DensityGrid) -> tuple[np.ndarray, np.ndarray]:
    """Vertices of the convex hull of what is opaque, and the hull's centre of mass."""
    solid = np.argwhere(field.density > min(_OPAQUE_G, float(field.density.max()) - 1))
    points = field.origin + field.voxel * solid
    hull = ConvexHull(points, qhull_options="QJ")  # joggled: a flat or degenerate field still has a hull
    corners = points[hull.simplices]
    inside = points[hull.vertices].mean(axis=0)
    sides = corners - inside
    volumes = np.abs(np.einsum("ij,ij->i", sides[:, 0], np.cross(sides[:, 1], sides[:, 2])))
    centres = (corners.sum(axis=1) + inside) / 4
    return points[hull.vertices], (centres * volumes[:, None]).sum(axis=0) / volumes.sum()


def _stable(directions: np.ndarray, heights: np.ndarray) -> list[int]:
    """Directions that are (almost) the lowest around them, thinned out, the lowest first."""
    cosines = directions @ directions.T
    lowest = np.where(cosines > np.cos(np.deg2rad(_NEIGHBOURHOOD_DEG)), heights, np.inf).min(axis=1)
    candidates = np.flatnonzero(heights <= lowest + _SLACK_M)
    kept: list[int] = []
    for k in candidates[np.argsort(heights[candidates])]:
        if all(cosines[k, other] < np.cos(np.deg2rad(_SPACING_DEG)) for other in kept):
            kept.append(int(k))
    return kept


def _rotation_downwards(direction: np.ndarray) -> np.ndarray:
    """A rotation that takes a unit vector to (0, 0, -1)."""
    axis = np.cross(direction, (0.0, 0.0, -1.0))
    sine = np.linalg.norm(axis)
    if sine < 1e-9:  # along the vertical already
        return np.array([1.0, 0.0, 0.0, 0.0] if direction[2] < 0 else [0.0, 1.0, 0.0, 0.0])
    return quaternion_exp(axis / sine * np.arctan2(sine, -direction[2]))
