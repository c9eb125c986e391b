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
    """Squared difference between rendered futures and the goal image: S = sum over t of |I(t) - I_goal|^2.

    |.|^2 is the mean over pixels, and I(t) is rendered from the goal camera. Deviations from the paper: images have 64
    pixels a side, and only every third state and the last one are rendered. A state that several sequences share is
    rendered once. The pusher is left out, because the goal image shows none.

    Args:
        renderer: renderer of the objects on the table.
        camera: camera of the goal image.
        image: goal image, linear RGB in [0, 1].
        light: light of the goal image, under which futures are rendered.
        every: actions between rendered states; 1 for the paper's sum over all of them.

    Raises:
        InvalidInput: if the image has another size than its camera.
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
        """Return the cost of each sequence."""
        horizon = rollouts.positions.shape[1] - 1
        times = np.arange(horizon, 0, -self._every)
        states = np.concatenate([rollouts.positions[:, times], rollouts.quaternions[:, times]], axis=-1)
        count = states.shape[0] * states.shape[1]
        shown, which = np.unique(states.round(_SAME).reshape(count, -1), axis=0, return_inverse=True)
        costs = self._costs(rollouts.names, shown.reshape(len(shown), -1, 7))[which.reshape(-1)]
        return horizon * costs.reshape(states.shape[:2]).mean(axis=1)

    def _costs(self, names: tuple[str, ...], states: Float[np.ndarray, "B N 7"]) -> Float[np.ndarray, "B"]:
        """Return the mean squared differences of single states."""
        quaternions = states[..., 3:] / np.linalg.norm(states[..., 3:], axis=-1, keepdims=True)
        lights = np.tile(self._light.direction, (len(states), 1))
        batch = SceneBatch(names, states[..., :3], quaternions, lights, None)
        images = self._renderer.render(batch, (self._camera,), quality=PLANNING).rgb[:, 0]
        return ((images - self._image) ** 2).mean(axis=(1, 2, 3), dtype=float)


# Pose goals, and the running and terminal cost of rollouts by distances of poses.


ARM_M = 0.06  # a rotation counts as its angle times this
TERMINAL_WEIGHT = 2.0  # of the last state, against the mean over the horizon


class Cost(Protocol):
    """A cost of futures: any function from `Rollouts` to one number for each."""

    def __call__(self, rollouts: Rollouts) -> Float[np.ndarray, "K"]:
        """Return the cost of each of the K futures; lower is better."""
        ...


@dataclass(frozen=True, eq=False, slots=True)
class PoseGoal:
    """The pose that each object should reach.

    Attributes:
        names: names of the N objects.
        poses: their goals `T_world_object`, a batch of N.

    Example:
        >>> there = Pose(np.array([0.08, 0.0, 0.095]), upright.quaternion)
        >>> goal = PoseGoal.of(state, {name: there})
        >>> goal.offsets_m(state)
        array([[0.08, 0.  ]])
    """

    names: tuple[str, ...]
    poses: Pose

    @staticmethod
    def of(state: SceneState, moved: Mapping[str, Pose]) -> PoseGoal:
        """Return a goal that moves some objects and leaves the others where they are.

        Args:
            state: state of the scene.
            moved: goals `T_world_object` of the objects that should move, by name.

        Raises:
            InvalidInput: if an object is not in the scene.
        """
        for name in moved:
            if name not in state.names:
                raise InvalidInput("object of the goal", name, f"one of {', '.join(state.names)}")
        return PoseGoal(state.names, state.poses).replaced(moved)

    def pose(self, name: str) -> Pose:
        """Return the goal `T_world_object` of one object."""
        return self.poses[self.names.index(name)]

    def replaced(self, poses: Mapping[str, Pose]) -> PoseGoal:
        """Return the goal with other poses for some objects."""
        every = [poses.get(name) or self.pose(name) for name in self.names]
        positions, quaternions = ([getattr(pose, part) for pose in every] for part in ("position", "quaternion"))
        return PoseGoal(self.names, Pose(np.array(positions), np.array(quaternions)))

    def poses_of(self, names: tuple[str, ...]) -> Pose:
        """Return the goal poses of objects in this order."""
        return self.poses[[self.names.index(name) for name in names]]

    def offsets_m(self, state: SceneState) -> Float[np.ndarray, "N 2"]:
        """Return the x and y distance from each object to its goal [m], in the order of the state."""
        return self.poses_of(state.names).position[:, :2] - state.poses.position[:, :2]


@dataclass(frozen=True, eq=False, slots=True)
class PoseCost:
    """Distance of futures from goal poses: the mean over the horizon plus twice the distance at its end [m].

    `S = mean_t c(t) + 2 c(T)` with `c(t) = sum_n |p_n(t) - p_n*| + arm * angle(q_n(t), q_n*)`. Positions p are compared
    in x and y only.

    Attributes:
        goal: the goal poses.
        arm_m: weight of rotations [m/rad]; 0 to ignore them.

    Example:
        >>> waiting = push_model.rollout(state, np.zeros((1, 5, 3)))
        >>> PoseCost(goal)(waiting).round(3)  # 3 x 0.08 m
        array([0.24])
    """

    goal: PoseGoal
    arm_m: float = ARM_M

    def __call__(self, rollouts: Rollouts) -> Float[np.ndarray, "K"]:
        """Return the cost of each future [m]."""
        running_cost = object_costs(rollouts, self.goal, self.arm_m)[:, 1:].sum(axis=2)
        return running_cost.mean(axis=1) + TERMINAL_WEIGHT * running_cost[:, -1]


def object_costs(rollouts: Rollouts, goal: PoseGoal, arm_m: float = ARM_M) -> Float[np.ndarray, "K T1 N"]:
    """Return |p_n(t) - p_n*| + arm * angle(q_n(t), q_n*) of each object, before the first and after each action [m].

    Args:
        rollouts: the futures.
        goal: the goal poses.
        arm_m: weight of rotations [m/rad]; 0 to ignore them.
    """
    order = [goal.names.index(name) for name in rollouts.names]
    cost = np.linalg.norm(rollouts.positions[..., :2] - goal.poses.position[order, :2], axis=-1)
    if arm_m > 0:
        target = np.broadcast_to(goal.poses.quaternion[order], rollouts.quaternions.shape)
        cost = cost + arm_m * rotation_angle(rollouts.quaternions, target)
    return cost
