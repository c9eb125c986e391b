"""Motion hypotheses: poses that an object may have after a push, as starts of a search; their photometric loss decides.

An object moves by a share of the pusher's motion, alone or with others, and keeps its orientation, turns about the
vertical, or rolls without slipping. Fast and deliberately coarse: not a dynamics model.
"""

from __future__ import annotations

from collections.abc import Sequence
from itertools import product

import numpy as np
from jaxtyping import Float

from osfcore.estimation.objective.object_models import ObjectModels
from osfcore.estimation.objective.parametrization import SceneParameters
from osfcore.estimation.objective.resting_orientations import yaw_quaternions
from osfcore.geometry.poses import Pose, quaternion_conjugate, quaternion_exp, quaternion_multiply, rotate

_SHARES = (0.0, 0.5, 1.0)  # of the push, by which each of several objects may have moved
_MAX_COMBINED = 4  # objects whose shares are combined in all ways; of more, all have the same
_NEAR_M = 0.02  # search radius where there was no push
_ALONG = np.array([-0.3, 0.0, 0.3])  # shares of the push, around where an object is guessed
_ACROSS = np.array([-0.25, 0.0, 0.25])
_TURNS_RAD = np.array([-0.5, 0.0, 0.5])
_MIN_PUSH_M = 0.005
_DOWN = np.array([0.0, 0.0, -1.0])
_ROLLED_RAD = np.deg2rad([20.0, 40.0, 60.0, 80.0])  # at which it is checked that a body can roll
_OBLIQUE_RAD = np.deg2rad([0.0, 20.0, -20.0, 40.0, -40.0, 60.0, -60.0])  # of an axis to the one square to a push
_ROLLS = 18  # equal steps of a whole roll
_ROLLING_RAD = np.deg2rad(15.0)  # from an orientation in which it can lie


def joint_push_hypotheses(
    params: SceneParameters, numbers: Sequence[int], push: Float[np.ndarray, "3"]
) -> Float[np.ndarray, "K N 3"]:
    """Positions of all objects if some were moved by shares of a push, K combinations; the first is the guess's [m].

    Args:
        params: the guess.
        numbers: of the objects that may have moved; up to four are combined in all ways, more move by one share.
        push: motion of the pusher [m].
    """
    if len(numbers) <= _MAX_COMBINED:
        shares = np.array(list(product(_SHARES, repeat=len(numbers))))
    else:
        shares = np.tile(np.array(_SHARES)[:, None], (1, len(numbers)))
    positions = np.repeat(params.positions[None], len(shares), axis=0)
    positions[:, list(numbers)] += shares[..., None] * push
    return positions


def push_hypotheses(models: ObjectModels, params: SceneParameters, number: int, push: Float[np.ndarray, "3"]) -> Pose:
    """Poses of one object on a grid along and across a push, times yaw angles, and rolled; a batch.

    Args:
        models: fields, for the object's centre of mass and how it can roll.
        params: the guess, around which the grid lies.
        number: of the object.
        push: motion of the pusher [m]; under 5 mm the grid covers about 2 cm around the guess, and nothing rolls.
    """
    length = float(np.linalg.norm(push))
    step = push if length > _MIN_PUSH_M else np.array([_NEAR_M / _ALONG[-1], 0.0, 0.0])
    beside = np.array([-step[1], step[0], 0.0])
    shifts = (_ALONG[:, None, None] * step + _ACROSS[:, None] * beside).reshape(-1, 3)
    turns = yaw_quaternions(_TURNS_RAD)
    slid = [(shift, turn) for shift in shifts for turn in turns]
    axis = _rolling_axis(models, params, number, push)
    rolled = (
        [(shift, _roll_along(models, params, number, axis, push + shift)) for shift in shifts] if axis.any() else []
    )
    return _combine_shifts_and_turns(models, params, number, *map(np.array, zip(*slid, *rolled, strict=True)))


def rolling_hypotheses(
    models: ObjectModels, params: SceneParameters, number: int, push: Float[np.ndarray, "3"]
) -> Pose:
    """Poses of one object turned about the axis about which a push rolls it, its own first; a batch.

    Args:
        models: fields, for the object's centre of mass and how it can roll.
        params: the guess; the object's centre of mass stays.
        number: of the object.
        push: motion of the pusher [m]; if it cannot roll the object, only its own pose is returned.
    """
    axis = _rolling_axis(models, params, number, push)
    angles = np.arange(_ROLLS if axis.any() else 1) * 2 * np.pi / _ROLLS
    return _combine_shifts_and_turns(
        models, params, number, np.zeros((len(angles), 3)), quaternion_exp(angles[:, None] * axis)
    )


def resting_hypotheses(models: ObjectModels, params: SceneParameters, number: int) -> Pose:
    """Poses of one object in all its resting orientations; a batch.

    Args:
        models: fields, for how the object can lie.
        params: the guess; the centre of mass stays above the same point of the table.
        number: of the object.
    """
    resting = models.resting(params.names[number])
    centre = params.positions[number] + rotate(params.quaternions[number], resting.centre)
    centres = np.column_stack([np.tile(centre[:2], (len(resting.heights), 1)), resting.heights])
    return Pose(centres - rotate(resting.quaternions, resting.centre), resting.quaternions)


def _rolling_axis(
    models: ObjectModels, params: SceneParameters, number: int, push: np.ndarray
) -> Float[np.ndarray, "3"]:
    """Unit vector about which a push rolls a body forward, the one nearest to square to the push; zero if none.

    A body can roll about an axis if it can rest in every orientation on the way.
    """
    length = float(np.linalg.norm(push))
    if length < _MIN_PUSH_M:
        return np.zeros(3)
    resting, now = models.resting(params.names[number]), params.quaternions[number]
    lying = rotate(quaternion_conjugate(resting.quaternions), _DOWN)
    for axis in rotate(yaw_quaternions(_OBLIQUE_RAD), np.array([-push[1], push[0], 0.0]) / length):
        rolled = quaternion_multiply(quaternion_exp(_ROLLED_RAD[:, None] * axis), now[None])
        down = rotate(quaternion_conjugate(rolled), _DOWN)
        if ((down @ lying.T).max(axis=1) > np.cos(_ROLLING_RAD)).all():
            return axis
    return np.zeros(3)


def _roll_along(
    models: ObjectModels, params: SceneParameters, number: int, axis: np.ndarray, path: np.ndarray
) -> Float[np.ndarray, "4"]:
    """The rotation of a body that rolls along a path without slipping, its centre as high as it is now."""
    resting = models.resting(params.names[number])
    height = params.positions[number, 2] + rotate(params.quaternions[number], resting.centre)[2]
    forward = np.array([axis[1], -axis[0], 0.0])
    return quaternion_exp(axis * (forward @ path) / max(float(height), 0.25 * resting.radius))


def _combine_shifts_and_turns(
    models: ObjectModels, params: SceneParameters, number: int, shifts: np.ndarray, turns: np.ndarray
) -> Pose:
    """One object shifted, and turned about its centre of mass."""
    centre, now = models.resting(params.names[number]).centre, params.quaternions[number]
    quaternions = quaternion_multiply(turns, now[None])
    middle = params.positions[number] + rotate(now, centre) + shifts
    return Pose(middle - rotate(quaternions, centre), quaternions)
