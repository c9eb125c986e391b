"""Scenes near a scene: poses and light as one vector of small changes.

The vector holds, for each of N objects, a translation [m] and a rotation vector [rad], both along the world's axes, and
then two angles of the light [rad] along two directions across it. Rotations are applied by the exponential map, so
quaternions stay unit and nothing is singular.
"""

from __future__ import annotations

from dataclasses import dataclass, replace

import numpy as np
from jaxtyping import Float

from osfcore.poses import Pose, quaternion_exp, quaternion_multiply
from osfcore.render.scene_renderer import SceneBatch
from osfcore.scene import MIN_LIGHT_ELEVATION_DEG, Light, SceneState

POSE = 6  # numbers per object
LIGHT = 2
_LOWEST_SLOPE = np.tan(np.deg2rad(MIN_LIGHT_ELEVATION_DEG + 1e-3))


@dataclass(frozen=True, eq=False, slots=True)
class Guess:
    """A scene as the search has it.

    Attributes:
        names: of the N objects.
        positions: of the objects [m].
        quaternions: unit.
        light: unit vector toward the light.
        pusher: its centre [m], or None.
    """

    names: tuple[str, ...]
    positions: Float[np.ndarray, "N 3"]
    quaternions: Float[np.ndarray, "N 4"]
    light: Float[np.ndarray, "3"]
    pusher: Float[np.ndarray, "3"] | None

    @staticmethod
    def of(state: SceneState, pusher: Float[np.ndarray, "3"] | None) -> Guess:
        """The objects and the light of a state, with this pusher."""
        return Guess(state.names, state.poses.position, state.poses.quaternion, state.light.direction, pusher)

    @property
    def size(self) -> int:
        """Length of the vector of changes."""
        return POSE * len(self.names) + LIGHT

    def state(self) -> SceneState:
        """The guess as a state."""
        return SceneState(self.names, Pose(self.positions, self.quaternions), Light(self.light), self.pusher)

    def moved(self, changes: Float[np.ndarray, "B P"]) -> SceneBatch:
        """B scenes, each changed by one row."""
        count = len(self.names)
        poses = changes[:, : POSE * count].reshape(len(changes), count, POSE)
        positions = self.positions + poses[..., :3]
        quaternions = quaternion_multiply(quaternion_exp(poses[..., 3:]), self.quaternions[None])
        quaternions /= np.linalg.norm(quaternions, axis=-1, keepdims=True)
        first, second = across(self.light)
        lights = self.light + changes[:, -2:-1] * first + changes[:, -1:] * second
        lights[:, 2] = np.maximum(lights[:, 2], _LOWEST_SLOPE * np.hypot(lights[:, 0], lights[:, 1]))
        lights /= np.linalg.norm(lights, axis=1, keepdims=True)
        pusher = None if self.pusher is None else np.tile(self.pusher, (len(changes), 1))
        return SceneBatch(self.names, positions, quaternions, lights, pusher)

    def changed(self, change: Float[np.ndarray, "P"]) -> Guess:
        """The guess changed by a vector."""
        batch = self.moved(change[None])
        return replace(self, positions=batch.positions[0], quaternions=batch.quaternions[0], light=batch.lights[0])


def across(direction: Float[np.ndarray, "3"]) -> tuple[Float[np.ndarray, "3"], Float[np.ndarray, "3"]]:
    """Two unit vectors that stand on a unit vector and on each other."""
    helper = np.array([1.0, 0.0, 0.0]) if abs(direction[2]) > 0.9 else np.array([0.0, 0.0, 1.0])
    first = np.cross(direction, helper)
    first /= np.linalg.norm(first)
    return first, np.cross(direction, first)
