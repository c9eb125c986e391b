"""What would have happened had things been a little elsewhere and moved a little otherwise.

Recorded motion shows only states that physics leads to. A network that predicts many steps in a row leads itself to
others: an object too fast, turning too slowly, a hair off the pusher. From recorded states, disturbed in that way, the
simulator tells what the next substep would do, so that a network learns to fall back rather than to err on.
"""

from __future__ import annotations

from collections.abc import Mapping

import numpy as np
from jaxtyping import Bool, Float, Int

from osfcore.dynamics.pusher_path import SUBSTEPS, pusher_path
from osfcore.dynamics.recorded_states import SLEEP_M, SLEEP_RAD, is_on_table, substates
from osfcore.geometry.poses import (
    Pose,
    quaternion_conjugate,
    quaternion_exp,
    quaternion_log,
    quaternion_multiply,
    rotate,
)
from osfcore.geometry.workspace import PUSHER_CENTRE_Z_M, STEP_S
from osfcore.io.push_file import Disturbed, PushEpisode
from osfcore.world.physics import TIME_STEP_S, BodyModel, Physics

_SUBSTEP_S = STEP_S / SUBSTEPS
_TICKS = round(_SUBSTEP_S / TIME_STEP_S)
_MOST = 0.5  # of its own size, and of the following, by which a velocity is disturbed at most (one sigma)
_SPEED_M, _SPEED_RAD = 0.002, 0.04  # in a substep
_ALONG = np.array([1, 1, 0.3])  # less upward, for things stay on the table
_ABOUT = np.array([0.5, 0.5, 1])
_OFF_M, _OFF_RAD = 5e-4, 0.01  # sigma of a disturbed pose, at most
_OFF_SHARE = 0.6  # of the objects whose pose is disturbed as well


def disturbed(episode: PushEpisode, models: Mapping[str, BodyModel], rng: np.random.Generator, count: int) -> Disturbed:
    """Substeps from disturbed states of an episode, `count` for each substep in which something moves.

    Args:
        episode: recorded with poses within its actions.
        models: of its objects.
        rng: draws the disturbances.
        count: of disturbances of each such state.

    Raises:
        InvalidInput: if the episode was recorded without poses within its actions.
    """
    track = _Track(episode, models)
    physics = Physics({name: models[name] for name in episode.names})
    try:
        parts = [track.disturb(physics, int(step), rng) for step in np.repeat(track.busy, count)]
    finally:
        physics.close()
    n = len(episode.names)
    shapes = ((), (n, 3), (n, 4), (n, 3), (n, 3), (n, 3), (n, 4))
    columns = list(zip(*parts, strict=True)) or [()] * len(shapes)
    stacked = [np.array(column).reshape(len(parts), *shape) for column, shape in zip(columns, shapes, strict=True)]
    return Disturbed(stacked[0].astype(int), *(column.astype(np.float32) for column in stacked[1:]))


class _Track:
    """An episode substep by substep.

    Attributes:
        busy: substeps before which and in which something moves, everything on the table.
    """

    busy: Int[np.ndarray, "S"]

    def __init__(self, episode: PushEpisode, models: Mapping[str, BodyModel]) -> None:
        self._episode = episode
        poses = substates(episode)
        self._positions, self._quaternions = poses.position, poses.quaternion
        self._offset = np.array([models[name].T_object_inertial.position for name in episode.names])
        centre = self._positions + rotate(self._quaternions, np.broadcast_to(self._offset, self._positions.shape))
        self._linear = np.diff(centre, axis=0)
        turned = quaternion_multiply(self._quaternions[1:], quaternion_conjugate(self._quaternions[:-1]))
        self._angular = quaternion_log(turned)
        self._path = pusher_path(episode.pusher[0, :2], episode.actions[:, :2])
        safe = is_on_table(episode)
        is_safe = np.repeat(safe[:-1] & safe[1:], SUBSTEPS)
        moves: Bool[np.ndarray, "S"] = np.any(self._awake(self._linear, self._angular), axis=1)
        self.busy = 1 + np.flatnonzero(moves[1:] & moves[:-1] & is_safe[1:])

    @staticmethod
    def _awake(linear: np.ndarray, angular: np.ndarray) -> np.ndarray:
        return (np.linalg.norm(linear, axis=-1) > SLEEP_M) | (np.linalg.norm(angular, axis=-1) > SLEEP_RAD)

    def disturb(self, physics: Physics, step: int, rng: np.random.Generator) -> tuple[object, ...]:
        """One substep from a disturbed state: the row of a `Disturbed`.

        Args:
            physics: a simulation of the episode's objects.
            step: number of the substep, at least 1: velocities are those of the one before.
            rng: draws the disturbance.
        """
        linear, angular = self._linear[step - 1], self._angular[step - 1]
        awake = self._awake(linear, angular)[:, None]
        share = _MOST * rng.random((len(awake), 1))
        linear = awake * (linear + _noise(linear, share, _SPEED_M, rng) * _ALONG)
        angular = awake * (angular + _noise(angular, share, _SPEED_RAD, rng) * _ABOUT)
        off = awake * rng.random((len(awake), 1)) * (rng.random((len(awake), 1)) < _OFF_SHARE)
        shift = np.pad(_OFF_M * off * rng.normal(size=(len(awake), 2)), ((0, 0), (0, 1)))
        turn = np.pad(_OFF_RAD * off * rng.normal(size=(len(awake), 1)), ((0, 0), (2, 0)))
        position = self._positions[step] + shift
        quaternion = quaternion_multiply(quaternion_exp(turn), self._quaternions[step])
        after = self._play(physics, step, Pose(position, quaternion), linear, angular)
        arm = -rotate(quaternion, self._offset)  # from the centre of mass to the object's origin
        origin = linear + np.cross(angular, arm)
        return step, position, quaternion, origin, angular, after.position, after.quaternion

    def _play(
        self, physics: Physics, step: int, start: Pose, linear: Float[np.ndarray, "N 3"], angular: np.ndarray
    ) -> Pose:
        """Where everything is one substep later."""
        names = self._episode.names
        for i, name in enumerate(names):
            physics.place(name, Pose(start.position[i], start.quaternion[i]))
            physics.set_velocity(name, linear[i] / _SUBSTEP_S, angular[i] / _SUBSTEP_S)
        physics.place_pusher(np.array([*self._path[step], PUSHER_CENTRE_Z_M]))
        for _ in range(_TICKS):
            physics.step(self._episode.actions[step // SUBSTEPS])
        poses = [physics.pose(name) for name in names]
        return Pose.stacked(poses)


def _noise(
    velocity: Float[np.ndarray, "N 3"], share: Float[np.ndarray, "N 1"], base: float, rng: np.random.Generator
) -> Float[np.ndarray, "N 3"]:
    return share * (np.linalg.norm(velocity, axis=1, keepdims=True) + base) * rng.normal(size=velocity.shape)
