"""Costs of rollouts: distances of poses, and squared difference from the goal image (line 15 of Algorithm 1)."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass
from typing import Protocol

import cv2
import numpy as np
from jaxtyping import Float

from osfcore.errors import InvalidInput
from osfcore.geometry.cameras import MIN_IMAGE_SIDE, Camera
from osfcore.geometry.light import Light
from osfcore.geometry.poses import Pose, rotation_angle
from osfcore.geometry.rollouts import Rollouts
from osfcore.geometry.states import SceneState
from osfcore.render.types import PLANNING, Renderer, SceneBatch

# Image cost of rollouts: squared difference from the goal image (line 15 of the paper's Algorithm 1).


SIDE = 64  # longest side of the images that are compared [px]
EVERY = 3  # actions between rendered states
_SAME = 5  # decimals of metres and quaternions up to which states count as one


class ImageCost:
    """S = sum over t of |I(t) - I_goal|^2 with I(t) rendered from the goal camera, as a mean over pixels.

    Deviations: futures are rendered in 64 pixels a side, at every third state and the last; states that are the same in
    several sequences, as the beginnings mostly are, once. The pusher is left out, for the goal image shows none.

    Args:
        renderer: of the objects on the table.
        camera: of the goal image.
        image: that camera's, linear RGB.
        light: under which futures are rendered: that of the goal image.
        every: actions between rendered states; 1 for the paper's sum over all of them.

    Raises:
        InvalidInput: if the image has another size than its camera's.
    """

    def __init__(
        self, renderer: Renderer, camera: Camera, image: Float[np.ndarray, "h w 3"], light: Light, *, every: int = EVERY
    ) -> None:
        if image.shape != (camera.height, camera.width, 3):
            raise InvalidInput("shape of the goal image", image.shape, f"{(camera.height, camera.width, 3)}")
        scale = min(1.0, SIDE / max(camera.width, camera.height))
        size = max(round(camera.width * scale), MIN_IMAGE_SIDE), max(round(camera.height * scale), MIN_IMAGE_SIDE)
        self._renderer, self._light, self._every = renderer, light, every
        self._camera = camera.resized(*size)
        self._image = cv2.resize(np.asarray(image, np.float32), size, interpolation=cv2.INTER_AREA)

    def __call__(self, rollouts: Rollouts) -> Float[np.ndarray, "K"]:
        """The cost of each sequence."""
        horizon = rollouts.positions.shape[1] - 1
        times = np.arange(horizon, 0, -self._every)
        states = np.concatenate([rollouts.positions[:, times], rollouts.quaternions[:, times]], axis=-1)
        count = states.shape[0] * states.shape[1]
        shown, which = np.unique(states.round(_SAME).reshape(count, -1), axis=0, return_inverse=True)
        costs = self._costs(rollouts.names, shown.reshape(len(shown), -1, 7))[which.reshape(-1)]
        return horizon * costs.reshape(states.shape[:2]).mean(axis=1)

    def _costs(self, names: tuple[str, ...], states: Float[np.ndarray, "B N 7"]) -> Float[np.ndarray, "B"]:
        """Mean squared differences of single states."""
        quaternions = states[..., 3:] / np.linalg.norm(states[..., 3:], axis=-1, keepdims=True)
        lights = np.tile(self._light.direction, (len(states), 1))
        batch = SceneBatch(names, states[..., :3], quaternions, lights, None)
        images = self._renderer.render(batch, (self._camera,), quality=PLANNING).rgb[:, 0]
        return ((images - self._image) ** 2).mean(axis=(1, 2, 3), dtype=float)


# Pose goals, and the running and terminal cost of rollouts by distances of poses.


ARM_M = 0.06  # a rotation counts as its angle times this
TERMINAL_WEIGHT = 2.0  # of the last state, against the mean over the horizon


class Cost(Protocol):
    """A cost of futures."""

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
        """Return how far each object has to go, horizontally, in the order of the state [m]."""
        return self.poses_of(state.names).position[:, :2] - state.poses.position[:, :2]


@dataclass(frozen=True, eq=False, slots=True)
class PoseCost:
    """Distance of poses: `S = mean_t c(t) + 2 c(T)`, `c(t) = sum_n |p_n(t) - p_n*| + arm * angle(q_n(t), q_n*)` [m].

    Positions p are compared horizontally.

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
