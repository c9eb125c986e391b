"""How the pusher moves while data are collected: the paper's random walk, and one that seeks contact."""

from __future__ import annotations

from collections.abc import Mapping
from typing import Literal

import numpy as np
from jaxtyping import Float

from osfcore.geometry.poses import Pose, rotate
from osfcore.geometry.states import SceneState
from osfcore.geometry.workspace import MAX_SPEED_M_S, PUSHER_RADIUS_M, STEP_S, WORKSPACE_HALF_M
from osfcore.objects.asset import ObjectAsset

PolicyName = Literal["paper", "directed"]
_CLEARANCE_M = 0.02  # between pusher and object while travelling around it
_ARRIVED_M = 0.015
_TRAVEL_STEPS = 14  # then another object is tried
_NOISE_M_S = 0.03
_EDGE_M = 0.3


class PaperPolicy:
    """Each velocity component uniform in [-0.3, 0.3] m/s (paper, section 5.2)."""

    def __init__(self, rng: np.random.Generator) -> None:
        self._rng = rng

    def action(self, state: SceneState) -> Float[np.ndarray, "3"]:
        """The next velocity (vx, vy, 0) [m/s]; the state plays no part."""
        return np.array([*self._rng.uniform(-MAX_SPEED_M_S, MAX_SPEED_M_S, 2), 0.0])


class DirectedPolicy:
    """Goes behind a random object, pushes it some way toward a random place in the workspace, picks the next.

    Uses true poses: it makes data, it does not plan.

    Args:
        assets: shapes of the objects.
        rng: randomness.
    """

    def __init__(self, assets: Mapping[str, ObjectAsset], rng: np.random.Generator) -> None:
        self._parts = {name: np.concatenate(asset.parts) for name, asset in assets.items()}
        self._rng = rng
        self._target = ""
        self._direction = np.zeros(2)
        self._push_steps = 0
        self._travel_steps = 0
        self._speed = MAX_SPEED_M_S

    def action(self, state: SceneState) -> Float[np.ndarray, "3"]:
        """The next velocity (vx, vy, 0) [m/s], each component at most 0.3 m/s."""
        if state.pusher is None:
            raise ValueError("a pushing policy needs a pusher")
        pusher = state.pusher[:2]
        if self._push_steps == 0 and self._travel_steps == 0:
            self._choose(state)
        pose = state.pose(self._target)
        if self._travel_steps > 0:
            self._travel_steps -= 1
            way, arrived = self._way_behind(pusher, pose)
            if not arrived:
                if self._travel_steps == 0:
                    self._push_steps = 0  # it takes too long: choose anew
                return _limited(way / STEP_S)
            self._travel_steps = 0
        self._push_steps -= 1
        if np.abs(pose.position[:2]).max() > WORKSPACE_HALF_M or np.abs(state.poses.position[:, :2]).max() > _EDGE_M:
            self._push_steps = 0  # it leaves the workspace, or shoves another toward the table's edge: let it be
        aim = pose.position[:2] - pusher  # steer toward the object's middle, or it slips off sideways
        aim = 0.6 * self._direction + 0.4 * aim / max(np.linalg.norm(aim), 1e-6)
        return _limited(self._speed * aim + self._rng.normal(0, _NOISE_M_S, 2))

    def _choose(self, state: SceneState) -> None:
        """A random object and a way toward a random place in the workspace."""
        self._target = state.names[self._rng.integers(len(state.names))]
        place = self._rng.uniform(-WORKSPACE_HALF_M, WORKSPACE_HALF_M, 2)
        way = place - state.pose(self._target).position[:2]
        self._direction = way / max(np.linalg.norm(way), 1e-6)
        self._speed = self._rng.uniform(0.1, MAX_SPEED_M_S)
        self._push_steps = int(self._rng.integers(4, 11))
        self._travel_steps = _TRAVEL_STEPS

    def _way_behind(self, pusher: np.ndarray, pose: Pose) -> tuple[Float[np.ndarray, "2"], bool]:
        """The next stretch [m] on the way behind the object, around it if need be, and whether it is reached."""
        outline = rotate(pose.quaternion, self._parts[self._target])[:, :2]
        centre = pose.position[:2]
        standoff = float((outline @ -self._direction).max()) + PUSHER_RADIUS_M + _CLEARANCE_M
        behind = centre - self._direction * standoff
        way = behind - pusher
        if np.linalg.norm(way) < _ARRIVED_M:
            return way, True
        out = pusher - centre
        distance = max(float(np.linalg.norm(out)), 1e-6)
        if out @ -self._direction < 0.5 * distance:  # not yet behind it: follow a circle around it
            radius = np.linalg.norm(outline, axis=1).max() + PUSHER_RADIUS_M + _CLEARANCE_M
            tangent = np.array([-out[1], out[0]]) / distance
            tangent *= np.sign(tangent @ (behind - centre)) or 1.0
            way = tangent * MAX_SPEED_M_S * STEP_S + (radius - distance) * out / distance
        return way, False


def _limited(velocity: Float[np.ndarray, "2"]) -> Float[np.ndarray, "3"]:
    """Scaled into the speed limit without changing direction."""
    velocity = velocity / max(np.abs(velocity).max() / MAX_SPEED_M_S, 1.0)
    return np.array([*np.clip(velocity, -MAX_SPEED_M_S, MAX_SPEED_M_S), 0.0])
