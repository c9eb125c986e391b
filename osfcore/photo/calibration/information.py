"""How well photographs of the board tell a camera, and what that means in millimetres on the table.

The normal matrix J^T J of a photograph is over (theta, pose); with corners that scatter by s, J^T J / s^2 is the
information that it brings. Poses of other photographs are eliminated (Schur complement), so that any number of them
adds a 4 x 4 matrix over theta.
"""

from __future__ import annotations

from collections.abc import Iterable
from dataclasses import dataclass

import cv2
import numpy as np
from jaxtyping import Bool, Float

from osfcore.geometry.workspace import WORKSPACE_HALF_M
from osfcore.photo.calibration.camera_fit import INTRINSICS, POSE, PoseVector, Theta, on_board, pose_of, seen

GRID_SIDE = 9  # points
_SINGULAR = 1e-13  # of the normal matrix with a diagonal of 1: below, rounding decides

Information = Float[np.ndarray, "P P"]


@dataclass(frozen=True, slots=True)
class TableError:
    """How far from its place a table point may be located by its pixel: sqrt(E |error|^2), over the workspace's grid.

    Attributes:
        mean_m: of the points that the camera sees [m].
        worst_m: of these [m].
        seen_share: of the grid's points that the camera sees.
    """

    mean_m: float
    worst_m: float
    seen_share: float


def normal_matrix(theta: Theta, pose: PoseVector, points_m: Float[np.ndarray, "N 2"]) -> Float[np.ndarray, "10 10"]:
    """J^T J of one photograph, over theta and the pose."""
    rows = seen(theta, pose, on_board(points_m))[1].reshape(-1, INTRINSICS + POSE)
    return rows.T @ rows


def about_camera(normal: Float[np.ndarray, "10 10"]) -> Float[np.ndarray, "4 4"]:
    """What a photograph tells of theta, whatever the board's pose: the Schur complement of the pose's block."""
    across = normal[:INTRINSICS, INTRINSICS:]
    return normal[:INTRINSICS, :INTRINSICS] - across @ np.linalg.solve(normal[INTRINSICS:, INTRINSICS:], across.T)


def total(parts: Iterable[Float[np.ndarray, "4 4"]]) -> Float[np.ndarray, "4 4"]:
    """What several photographs tell of theta; nothing if there are none."""
    return sum(parts, np.zeros((INTRINSICS, INTRINSICS)))


def covariance(information: Information) -> Information:
    """The inverse; very large, but finite, along what is not told."""
    scale = np.sqrt(np.maximum(np.diag(information), np.finfo(float).tiny))
    values, vectors = np.linalg.eigh(information / np.outer(scale, scale))
    return (vectors / np.maximum(values, _SINGULAR)) @ vectors.T / np.outer(scale, scale)


def workspace_grid() -> Float[np.ndarray, "G 3"]:
    """Points of the table where objects lie [m]."""
    line = np.linspace(-WORKSPACE_HALF_M, WORKSPACE_HALF_M, GRID_SIDE)
    return np.stack(np.meshgrid(line, line, [0.0]), axis=-1).reshape(-1, 3)


def in_picture(
    theta: Theta, pose: PoseVector, points: Float[np.ndarray, "G 3"], size: tuple[int, int]
) -> Bool[np.ndarray, "G"]:
    """Which points of the board's frame a camera sees."""
    pixels = seen(theta, pose, points)[0]
    is_before = pose_of(pose).apply(points)[:, 2] > 0
    return is_before & np.all((pixels > 0) & (pixels < size), axis=1)


def table_error(
    theta: Theta,
    pose: PoseVector,
    spread: Float[np.ndarray, "10 10"],
    points: Float[np.ndarray, "G 3"],
    size: tuple[int, int],
) -> TableError:
    """Errors of table points that are located by their pixels u = pi(theta, pose, X), to first order.

        d X = -(d pi / d X)^-1 (d pi / d (theta, pose)) d (theta, pose),   X in the table's plane

    Args:
        theta: of the camera.
        pose: of the board on the table, in the camera's frame.
        spread: covariance of theta and pose.
        points: of the table, in the board's frame [m].
        size: width and height of the picture [px].

    Returns:
        The errors of the points in the picture; infinite if there are none.
    """
    inside = in_picture(theta, pose, points, size)
    if not inside.any():
        return TableError(float("inf"), float("inf"), 0.0)
    by = seen(theta, pose, points[inside])[1]
    by_place = by[:, :, INTRINSICS + 3 :] @ cv2.Rodrigues(pose[:3])[0][:, :2]
    moves = np.linalg.solve(by_place, by)
    errors = np.sqrt(np.einsum("gip,pq,giq->g", moves, spread, moves))
    return TableError(float(errors.mean()), float(errors.max()), float(inside.mean()))


def with_later_pose(
    spread: Float[np.ndarray, "4 4"], normal: Float[np.ndarray, "10 10"], noise_px: float
) -> Float[np.ndarray, "10 10"]:
    """Covariance of theta and of a pose that is found with theta held fixed, in a photograph taken afterwards.

        d pose = -A_pp^-1 A_pt d theta + e,   Cov e = noise^2 A_pp^-1

    Args:
        spread: covariance of theta.
        normal: A, J^T J of that photograph.
        noise_px: of its corners along each axis [px].
    """
    own = np.linalg.inv(normal[INTRINSICS:, INTRINSICS:])
    follows = np.vstack([np.eye(INTRINSICS), -own @ normal[INTRINSICS:, :INTRINSICS]])
    whole = follows @ spread @ follows.T
    whole[INTRINSICS:, INTRINSICS:] += noise_px**2 * own
    return whole


def padded(information: Float[np.ndarray, "4 4"]) -> Float[np.ndarray, "10 10"]:
    """What is known of theta, over theta and a pose of which nothing is known."""
    return np.pad(information, (0, POSE))
