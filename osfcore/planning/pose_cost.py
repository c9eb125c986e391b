"""Pose goals, and the running and terminal cost of rollouts by distances of poses."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass
from typing import Protocol

import numpy as np
from jaxtyping import Float

from osfcore.errors import InvalidInput
from osfcore.geometry.poses import Pose, rotation_angle
from osfcore.geometry.rollouts import Rollouts
from osfcore.geometry.states import SceneState

ARM_M = 0.06  # a rotation counts as its angle times this
TERMINAL_WEIGHT = 2.0  # of the last state, against the mean over the horizon


class Cost(Protocol):
    """What futures cost."""

    def __call__(self, rollouts: Rollouts) -> Float[np.ndarray, "K"]:
        """The cost of each sequence; less is better."""
        ...


@dataclass(frozen=True, eq=False, slots=True)
class PoseGoal:
    """Where each object should be.

    Attributes:
        names: of the N objects.
        poses: theirs.
    """

    names: tuple[str, ...]
    poses: Pose

    @staticmethod
    def of(state: SceneState, moved: Mapping[str, Pose]) -> PoseGoal:
        """Some objects elsewhere, the others where they are.

        Raises:
            InvalidInput: if an object is not in the scene.
        """
        for name in moved:
            if name not in state.names:
                raise InvalidInput("object of the goal", name, f"one of {', '.join(state.names)}")
        return PoseGoal(state.names, state.poses).replaced(moved)

    def pose(self, name: str) -> Pose:
        """Where one object should be."""
        return self.poses[self.names.index(name)]

    def replaced(self, poses: Mapping[str, Pose]) -> PoseGoal:
        """The goal with some objects elsewhere."""
        every = [poses.get(name) or self.pose(name) for name in self.names]
        positions, quaternions = ([getattr(pose, part) for pose in every] for part in ("position", "quaternion"))
        return PoseGoal(self.names, Pose(np.array(positions), np.array(quaternions)))

    def poses_of(self, names: tuple[str, ...]) -> Pose:
        """The poses of objects in another order."""
        return self.poses[[self.names.index(name) for name in names]]

    def offsets_m(self, state: SceneState) -> Float[np.ndarray, "N 2"]:
        """How far each object has to go, horizontally, in the order of the state [m]."""
        return self.poses_of(state.names).position[:, :2] - state.poses.position[:, :2]


@dataclass(frozen=True, eq=False, slots=True)
class PoseCost:
    """S = mean_t c(t) + 2 c(T) with c(t) = sum_n |p_n(t) - p_n*| + arm * angle(q_n(t), q_n*), p horizontally [m].

    Attributes:
        goal: where that is.
        arm_m: what a rotation counts [m/rad]; 0 to leave rotations out.
    """

    goal: PoseGoal
    arm_m: float = ARM_M

    def __call__(self, rollouts: Rollouts) -> Float[np.ndarray, "K"]:
        """Running cost averaged over the horizon, plus the weighted terminal cost."""
        running_cost = object_costs(rollouts, self.goal, self.arm_m)[:, 1:].sum(axis=2)
        return running_cost.mean(axis=1) + TERMINAL_WEIGHT * running_cost[:, -1]


def object_costs(rollouts: Rollouts, goal: PoseGoal, arm_m: float = ARM_M) -> Float[np.ndarray, "K T1 N"]:
    """|p_n(t) - p_n*| + arm * angle(q_n(t), q_n*) of each object, before the first and after each action [m].

    Args:
        rollouts: the futures.
        goal: where everything should be.
        arm_m: what a rotation counts [m/rad]; 0 to leave rotations out.
    """
    order = [goal.names.index(name) for name in rollouts.names]
    cost = np.linalg.norm(rollouts.positions[..., :2] - goal.poses.position[order, :2], axis=-1)
    if arm_m > 0:
        target = np.broadcast_to(goal.poses.quaternion[order], rollouts.quaternions.shape)
        cost = cost + arm_m * rotation_angle(rollouts.quaternions, target)
    return cost
