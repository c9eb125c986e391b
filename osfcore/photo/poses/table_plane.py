"""The table's plane in a camera's frame, from points on it."""

from __future__ import annotations

import numpy as np
from jaxtyping import Float

from osfcore.errors import InvalidInput
from osfcore.geometry.poses import Pose, orthogonal_basis

_TRIES = 400
_TOLERANCE_M = 6e-3
_LEAST_SHARE = 0.3  # of the points on the plane
_FEWEST = 50


def table_from_points(points_camera: Float[np.ndarray, "P 3"], rng: np.random.Generator) -> Pose:
    """`T_world_camera` such that most points lie at z = 0, by RANSAC and a least-squares plane through its inliers.

    The world's origin is the inliers' mean; z points from the plane to the camera's side.

    Args:
        points_camera: most of them on the table, in the camera's frame [m].
        rng: of the draws.

    Raises:
        InvalidInput: if there are fewer than 50 points, or less than 30 % lie on one plane.
    """
    if len(points_camera) < _FEWEST:
        raise InvalidInput("number of points on the table", len(points_camera), f"{_FEWEST} or more")
    best = np.zeros(len(points_camera), bool)
    for _ in range(_TRIES):
        a, b, c = points_camera[rng.choice(len(points_camera), 3, replace=False)]
        normal = np.cross(b - a, c - a)
        length = np.linalg.norm(normal)
        if length > 0:
            near = np.abs((points_camera - a) @ normal) < _TOLERANCE_M * length
            best = near if near.sum() > best.sum() else best
    if best.mean() < _LEAST_SHARE:
        raise InvalidInput("points on one plane", f"{100 * best.mean():.0f} %", f"{100 * _LEAST_SHARE:.0f} % or more")
    inliers = points_camera[best]
    centre = inliers.mean(axis=0)
    normal = np.linalg.svd(inliers - centre, full_matrices=False)[2][2]
    normal = -normal if normal @ centre > 0 else normal
    right, ahead = orthogonal_basis(normal)
    if np.cross(right, ahead) @ normal < 0:
        ahead = -ahead
    matrix = np.eye(4)
    matrix[:3, :3], matrix[:3, 3] = np.stack([right, ahead, normal], axis=1), centre
    return Pose.from_matrix(matrix).inverse()
