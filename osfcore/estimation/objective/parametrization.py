"""The parameter vector of a scene: changes of poses and light in the tangent space of a current scene.

delta = (t_1, w_1, ..., t_N, w_N, a, b): for each of N objects a translation t [m] and a rotation vector w [rad] along
the world's axes, p <- p + t, q <- exp(w) q; then two components of the light, l <- normalize(l + a e_1 + b e_2) with
e_1, e_2 orthogonal to l. The exponential map has no singularities and keeps quaternions unit.
"""

from __future__ import annotations

from dataclasses import dataclass, replace

import numpy as np
from jaxtyping import Float

from osfcore.geometry.light import MIN_LIGHT_ELEVATION_DEG, Light
from osfcore.geometry.poses import Pose, orthogonal_basis, quaternion_exp, quaternion_multiply
from osfcore.geometry.states import SceneState
from osfcore.render.types import SceneBatch

POSE = 6  # numbers per object
LIGHT = 2
_LOWEST_SLOPE = np.tan(np.deg2rad(MIN_LIGHT_ELEVATION_DEG + 1e-3))


@dataclass(frozen=True, eq=False, slots=True)
class SceneParameters:
    """The scene at which the parameter vector is zero.

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
    def of(state: SceneState, pusher: Float[np.ndarray, "3"] | None) -> SceneParameters:
        """The objects and the light of a state, with this pusher."""
        return SceneParameters(state.names, state.poses.position, state.poses.quaternion, state.light.direction, pusher)

    @property
    def size(self) -> int:
        """Length of the parameter vector."""
        return POSE * len(self.names) + LIGHT

    def state(self) -> SceneState:
        """The scene as a state."""
        return SceneState(self.names, Pose(self.positions, self.quaternions), Light(self.light), self.pusher)

    def perturbed(self, changes: Float[np.ndarray, "B P"]) -> SceneBatch:
        """The B scenes that the rows of a batch of parameter vectors stand for."""
        count = len(self.names)
        poses = changes[:, : POSE * count].reshape(len(changes), count, POSE)
        positions = self.positions + poses[..., :3]
        quaternions = quaternion_multiply(quaternion_exp(poses[..., 3:]), self.quaternions[None])
        quaternions /= np.linalg.norm(quaternions, axis=-1, keepdims=True)
        first, second = orthogonal_basis(self.light)
        lights = self.light + changes[:, -2:-1] * first + changes[:, -1:] * second
        lights[:, 2] = np.maximum(lights[:, 2], _LOWEST_SLOPE * np.hypot(lights[:, 0], lights[:, 1]))
        lights /= np.linalg.norm(lights, axis=1, keepdims=True)
        pusher = None if self.pusher is None else np.tile(self.pusher, (len(changes), 1))
        return SceneBatch(self.names, positions, quaternions, lights, pusher)

    def updated(self, change: Float[np.ndarray, "P"]) -> SceneParameters:
        """The scene that one parameter vector stands for."""
        batch = self.perturbed(change[None])
        return replace(self, positions=batch.positions[0], quaternions=batch.quaternions[0], light=batch.lights[0])
