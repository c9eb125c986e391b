"""Errors of estimated poses, in the measures of the field (BOP; ADD-S after Hinterstoisser)."""

from __future__ import annotations

import numpy as np
from jaxtyping import Float
from scipy.spatial import KDTree

from osfcore.geometry.poses import (
    Pose,
    orthogonal_basis,
    quaternion_conjugate,
    quaternion_log,
    quaternion_multiply,
    rotate,
    rotation_angle,
)
from osfcore.objects.asset import Symmetry

_PARALLEL = 1e-9


def rotation_error(symmetry: Symmetry, estimated: Float[np.ndarray, "4"], true: Float[np.ndarray, "4"]) -> float:
    """Return the least angle [rad] to any orientation that looks like the true one.

    Args:
        symmetry: symmetry of the object; for a body of revolution only the tilt of its axis counts.
        estimated: rotation from the object's frame to the world, unit.
        true: the same.
    """
    return float(np.linalg.norm(rotation_components(symmetry, estimated, true)))


def pose_error(symmetry: Symmetry, estimated: Pose, true: Pose) -> tuple[float, float]:
    """Return the distance [mm] and the angle [deg] between two poses of an object, symmetries considered."""
    mm = 1000 * float(np.linalg.norm(estimated.position - true.position))
    return mm, float(np.rad2deg(rotation_error(symmetry, estimated.quaternion, true.quaternion)))


def rotation_components(
    symmetry: Symmetry, estimated: Float[np.ndarray, "4"], true: Float[np.ndarray, "4"]
) -> Float[np.ndarray, "C"]:
    """Return the rotation from the nearest orientation that looks like the true one to the estimated one [rad].

    Args:
        symmetry: symmetry of the object.
        estimated: rotation from the object's frame to the world, unit.
        true: the same.

    Returns:
        A rotation vector along the world's axes (C = 3); for a body of revolution its two components across the axis,
        since a turn about it is no error.
    """
    if symmetry.kind == "continuous":
        axis = np.asarray(symmetry.axis)
        return direction_components(rotate(estimated, axis), rotate(true, axis))
    alike = [np.asarray(true), *(quaternion_multiply(true, np.asarray(turn)) for turn in symmetry.rotations)]
    nearest = min(alike, key=lambda other: float(rotation_angle(np.asarray(estimated), other)))
    return quaternion_log(quaternion_multiply(estimated, quaternion_conjugate(nearest)))


def direction_components(estimated: Float[np.ndarray, "3"], true: Float[np.ndarray, "3"]) -> Float[np.ndarray, "2"]:
    """Return the shortest rotation between two unit vectors [rad], along two directions across the true one."""
    basis = np.stack(orthogonal_basis(np.asarray(true, float)))
    turn = basis @ np.cross(true, estimated)
    sine, cosine = float(np.linalg.norm(turn)), float(np.dot(true, estimated))
    if sine < _PARALLEL:  # so near that the sine is the angle, or opposite, where any direction serves
        return turn if cosine > 0 else np.array([np.pi, 0.0])
    return turn * (np.arctan2(sine, cosine) / sine)


def adds(points: Float[np.ndarray, "P 3"], estimated: Pose, true: Pose) -> float:
    """Return ADD-S [m]: the mean distance from the object's points in the true pose to the nearest in the estimated.

    Args:
        points: on the object's surface, in its frame [m].
        estimated: `T_world_object`.
        true: the same.
    """
    distances, _ = KDTree(estimated.apply(points)).query(true.apply(points))
    return float(np.mean(distances))
