"""What a known table tells of an object's pose: it probably stands on it, in one of its stable orientations."""

from __future__ import annotations

import numpy as np
from jaxtyping import Float

from osfcore.estimation.objective.resting_orientations import RestingOrientations
from osfcore.geometry.poses import Pose, quaternion_conjugate, rotate

_HEIGHT_STD_M = 2e-3
_TILT_STD_RAD = np.deg2rad(1.5)
_FARTHEST = 20.0  # deviations, beyond which a refined object may as well lean or lie on another one
_MOST_PENALTY = 10.0  # deviations that count at most while orientations are compared
_DOWN = np.array([0.0, 0.0, -1.0])


class TablePrior:
    """Height of the lowest point above z = 0 and tilt from the nearest stable orientation, both normally distributed.

    Beyond ten standard deviations the penalty is constant: objects may lie on objects.

    Args:
        resting: how the object can lie.
    """

    def __init__(self, resting: RestingOrientations) -> None:
        self._hull = resting.hull
        self._stable = np.unique(np.round(rotate(quaternion_conjugate(resting.quaternions), _DOWN), 6), axis=0)

    def downs(self, pose: Pose) -> Float[np.ndarray, "K 3"]:
        """Directions, in the pose's outer frame, one of which is down if the object stands in a stable orientation."""
        return rotate(pose.quaternion, self._stable)

    def extent(self, pose: Pose, direction: Float[np.ndarray, "3"]) -> float:
        """How far the object reaches along a direction, from the outer frame's origin [m]."""
        return float((pose.apply(self._hull) @ direction).max())

    def penalties(self, poses: Pose) -> Float[np.ndarray, "B"]:
        """Squared deviations of B poses, each of the two at most 100."""
        lowest = rotate(poses.quaternion[:, None], self._hull)[..., 2].min(axis=1) + poses.position[:, 2]
        cosines = (rotate(poses.quaternion[:, None], self._stable) @ _DOWN).max(axis=1)
        heights = np.abs(lowest) / _HEIGHT_STD_M
        tilts = np.arccos(np.clip(cosines, -1, 1)) / _TILT_STD_RAD
        return np.minimum(heights, _MOST_PENALTY) ** 2 + np.minimum(tilts, _MOST_PENALTY) ** 2

    def normal_equations(self, pose: Pose) -> tuple[Float[np.ndarray, "6 6"], Float[np.ndarray, "6"]]:
        """J^T J and -J^T r of one pose's deviations, for a shift [m] and a turn about its origin [rad] in the world."""
        points = rotate(pose.quaternion, self._hull)
        low = points[np.argmin(points[:, 2])]
        height = low[2] + pose.position[2]
        rows, residuals = [], []
        if abs(height) < _FARTHEST * _HEIGHT_STD_M:
            rows.append(np.concatenate([[0.0, 0.0, 1.0], np.cross(low, [0.0, 0.0, 1.0])]) / _HEIGHT_STD_M)
            residuals.append(height / _HEIGHT_STD_M)
        down = self.downs(pose)
        nearest = down[np.argmax(down @ _DOWN)]
        if np.arccos(np.clip(nearest @ _DOWN, -1, 1)) < _FARTHEST * _TILT_STD_RAD:
            for axis in range(2):  # a turn by nearest x down brings it there
                row = np.zeros(6)
                row[3 + axis] = 1 / _TILT_STD_RAD
                rows.append(row)
                residuals.append(-np.cross(nearest, _DOWN)[axis] / _TILT_STD_RAD)
        if not rows:
            return np.zeros((6, 6)), np.zeros(6)
        jacobian = np.array(rows)
        return jacobian.T @ jacobian, -jacobian.T @ np.array(residuals)
