"""Monitoring of a closed loop: distance to the goal, stalled progress, changes that no push explains."""

from __future__ import annotations

import numpy as np
from jaxtyping import Bool, Float

from osfcore.geometry.light import Light
from osfcore.geometry.poses import planar_turn, rotation_angle
from osfcore.geometry.states import SceneState
from osfcore.geometry.workspace import PUSHER_RADIUS_M
from osfcore.planning.pose_cost import PoseGoal

_MAX_STALLED = 16  # actions without progress
_PROGRESS_M = 0.003
_LAMP_RAD = np.deg2rad(4.0)
_MOVED_M = 0.03  # an object this far from where it was expected, and out of the pusher's reach, was carried
_REACH_M = 0.2  # from the pusher to the middle of what it may have pushed, perhaps by way of another object


def offsets(goal: PoseGoal, state: SceneState) -> tuple[Float[np.ndarray, "N"], Float[np.ndarray, "N"]]:
    """How far each object is from where it should be: on the table's plane [m], and turned [rad]."""
    target = np.array([goal.pose(name).quaternion for name in state.names]).reshape(-1, 4)
    turned = rotation_angle(state.poses.quaternion, target)
    return np.linalg.norm(goal.offsets_m(state), axis=1), np.asarray(turned)


def lies_otherwise(goal: PoseGoal, state: SceneState) -> Bool[np.ndarray, "N"]:
    """Which objects lie on another side than in the goal: turning them about the vertical would not do."""
    turns = (planar_turn(state.pose(name).quaternion, goal.pose(name).quaternion) for name in state.names)
    return np.array([turn is None for turn in turns], bool)


class ProgressMonitor:
    """Detects that the distance to the goal no longer shrinks."""

    def __init__(self) -> None:
        self._least, self._since = np.inf, 0

    def is_stalled(self, distance_m: float) -> bool:
        """Take the distance after each action; true once it has not shrunk for 16 actions, and counting restarts."""
        if distance_m < self._least - _PROGRESS_M:
            self._least, self._since = distance_m, 0
            return False
        self._since += 1
        if self._since < _MAX_STALLED:
            return False
        self._least, self._since = distance_m, 0
        return True


def lamp_moved(before: Light, now: Light) -> float | None:
    """By which angle the lamp was moved [rad]; None if it was not."""
    angle = before.angle_to(now)
    return angle if angle > _LAMP_RAD else None


def moved_by_hand(expected: SceneState, now: SceneState) -> tuple[str, ...]:
    """Objects that are not where they were expected, too far from the pusher for a push to be the cause."""
    assert now.pusher is not None
    shift = np.linalg.norm(now.poses.position - expected.poses.position, axis=1)
    ends = [now.pusher] if expected.pusher is None else [now.pusher, expected.pusher]
    away = np.min(
        [np.linalg.norm(expected.poses.position[:, :2] - end[:2], axis=1) for end in ends], axis=0
    )  # fmt: skip
    is_moved = (shift > _MOVED_M) & (away > _REACH_M + PUSHER_RADIUS_M)
    return tuple(name for name, flag in zip(now.names, is_moved, strict=True) if flag)
