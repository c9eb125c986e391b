"""Cast shadows of known objects: their surfels, drawn from the lamp, tell what it sees (Williams 1978).

A point is lit as far as nothing nearer to the lamp was drawn where it would be seen; between the four pixels around it
the answer is interpolated, so that it changes gradually as the lamp moves. Distant lamps stand a hundred times
the objects' extent away.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np
from jaxtyping import Float, Float32

from osfcore.geometry.cameras import Camera
from osfcore.geometry.poses import Pose, quaternion_to_matrix
from osfcore.photo.poses.pose_kernels import draw_surfels
from osfcore.photo.poses.surfels import Surfels

SIDE = 224  # of the picture that the lamp sees [px]
_FAR = 100.0  # radii of all objects together, at which a distant lamp stands
_SURFELS = 6000  # of an object, about
_HALF_SIDE = 0.75  # of a surfel, in spacings
_LIFT = 1.5  # spacings
_TOLERANCE_M = 1e-3  # by which what hides a point must be nearer
_WIDEST_RAD = 1.2  # half the lamp's field of view


@dataclass(frozen=True, eq=False, slots=True)
class _Caster:
    """Surfels in the world, and the distance between neighbours [m]."""

    points: Float32[np.ndarray, "S 3"]
    normals: Float32[np.ndarray, "S 3"]
    spacing: float


class Shadows:
    """What objects hide from lamps.

    Args:
        surfels: of each object.
        poses: of each, in the world.
    """

    def __init__(self, surfels: Sequence[Surfels], poses: Sequence[Pose]) -> None:
        thinned = [_thinned(s) for s in surfels]
        self._casters = [
            _Caster(*_placed(points, normals, pose), spacing)
            for (points, normals, spacing), pose in zip(thinned, poses, strict=True)
        ]
        everything = np.concatenate([np.zeros((0, 3), np.float32), *(c.points for c in self._casters)])
        low, high = (everything.min(axis=0), everything.max(axis=0)) if len(everything) else np.zeros((2, 3))
        self.centre: Float[np.ndarray, "3"] = ((low + high) / 2).astype(float)
        """Of all objects [m]."""
        self.radius = float(np.linalg.norm(everything - self.centre, axis=1).max(initial=0.0))
        """Of the sphere around it that holds them [m]."""
        self._lift_m = _LIFT * max((c.spacing for c in self._casters), default=0.0)

    def lifted(self, points: Float[np.ndarray, "P 3"], normals: Float[np.ndarray, "P 3"]) -> Float[np.ndarray, "P 3"]:
        """Points of the objects' own surfaces, lifted so that these do not shade themselves [m]."""
        return points + self._lift_m * normals

    def from_direction(
        self, direction: Float[np.ndarray, "3"], points: Float[np.ndarray, "P 3"]
    ) -> Float[np.ndarray, "P"]:
        """Shares of a distant lamp's light from a unit direction that reach points [m]."""
        return self.from_place(self.centre + _FAR * max(self.radius, 1e-3) * direction, points)

    def from_place(self, place: Float[np.ndarray, "3"], points: Float[np.ndarray, "P 3"]) -> Float[np.ndarray, "P"]:
        """Shares of the light of a lamp at a place [m] that reach points [m]."""
        distance = float(np.linalg.norm(self.centre - place))
        if not self._casters or distance < 1e-6:
            return np.ones(len(points))
        half = min(float(np.arcsin(min(1.05 * self.radius / distance, 1.0))), _WIDEST_RAD)
        camera = Camera.look_at("lamp", place, self.centre, size=SIDE, fov_y_deg=float(np.rad2deg(2 * half)))
        to_lamp = camera.T_world_camera.inverse()
        return _lit(self._drawn(to_lamp, camera.intrinsics), to_lamp.apply(points), camera.intrinsics)

    def _drawn(self, to_lamp: Pose, intrinsics: np.ndarray) -> Float32[np.ndarray, "side side"]:
        """Depth of what the lamp sees first, along its axis [m]; huge where it sees nothing."""
        rotation = np.ascontiguousarray(quaternion_to_matrix(to_lamp.quaternion), np.float32)
        position = np.ascontiguousarray(to_lamp.position, np.float32)
        lens = intrinsics[[0, 1, 0, 1], [0, 1, 2, 2]].astype(np.float32)
        nearest = np.full((SIDE, SIDE), 1e9, np.float32)
        depth, index = np.empty((SIDE, SIDE), np.float32), np.empty((SIDE, SIDE), np.int32)
        for caster in self._casters:
            half = np.float32(_HALF_SIDE * caster.spacing)
            draw_surfels(caster.points, caster.normals, half, rotation, position, lens, depth, index)
            np.minimum(nearest, depth, out=nearest)
        return nearest


def _lit(
    nearest: Float32[np.ndarray, "side side"], local: Float[np.ndarray, "P 3"], K: np.ndarray
) -> Float[np.ndarray, "P"]:
    """Shares of the four pixels around each point, in the lamp's frame, that show nothing nearer than it."""
    depth = np.maximum(local[:, 2], 1e-6)
    x, y = (K[axis, axis] * local[:, axis] / depth + K[axis, 2] - 0.5 for axis in range(2))
    seen = (local[:, 2] > 1e-6) & (x > 0) & (y > 0) & (x < SIDE - 1) & (y < SIDE - 1)
    x, y = np.where(seen, x, 0), np.where(seen, y, 0)
    column, row = np.minimum(x.astype(np.int64), SIDE - 2), np.minimum(y.astype(np.int64), SIDE - 2)
    right, below = x - column, y - row
    lit = np.zeros(len(local))
    flat, first, level = nearest.ravel(), row * SIDE + column, (depth - _TOLERANCE_M).astype(np.float32)
    shares = (1 - right) * (1 - below), right * (1 - below), (1 - right) * below, right * below
    for step, share in zip((0, 1, SIDE, SIDE + 1), shares, strict=True):
        lit += share * (flat[first + step] >= level)
    return np.where(seen, lit, 1.0)


def _thinned(surfels: Surfels) -> tuple[np.ndarray, np.ndarray, float]:
    """Points, normals and spacing of about 6000 of an object's surfels: shadows need no more."""
    coarser = max(np.sqrt(len(surfels.points) / _SURFELS), 1.0)
    spacing = float(coarser * surfels.spacing)
    if coarser == 1:
        return surfels.points, surfels.normals, spacing
    cells = np.floor(surfels.points / spacing).astype(np.int64)
    _, kept = np.unique(cells, axis=0, return_index=True)
    return surfels.points[kept], surfels.normals[kept], spacing


def _placed(points: np.ndarray, normals: np.ndarray, pose: Pose) -> tuple[np.ndarray, np.ndarray]:
    rotation = quaternion_to_matrix(pose.quaternion)
    moved, turned = points @ rotation.T + pose.position, normals @ rotation.T
    return np.ascontiguousarray(moved, np.float32), np.ascontiguousarray(turned, np.float32)
