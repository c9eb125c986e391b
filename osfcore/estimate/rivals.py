"""Whether an object might as well lie another way round: other orientations refined, and compared in its windows."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
from jaxtyping import Float

from osfcore.estimate.models import Models
from osfcore.estimate.polish import Descent, polish
from osfcore.estimate.resting import about_z
from osfcore.estimate.tangent import Guess
from osfcore.estimate.views import Views, around
from osfcore.estimate.whole import residuals, whole_loss
from osfcore.poses import Pose, quaternion_multiply, rotate, rotation_angle

_YAWS = 24
_TRIED = 3  # rivals that are refined
_ITERATIONS = 3
_SAME_RAD = np.deg2rad(12.0)


def turned(models: Models, guess: Guess, number: int) -> Pose:
    """An object turned in place about the vertical through its centre of mass, by equal steps; a batch of poses."""
    turns = about_z(np.arange(1, _YAWS) * 2 * np.pi / _YAWS)
    quaternions = quaternion_multiply(turns, guess.quaternions[number][None])
    centre = models.resting(guess.names[number]).centre
    middle = guess.positions[number] + rotate(guess.quaternions[number], centre)
    return Pose(middle - rotate(quaternions, centre), quaternions)


def challenged(models: Models, views: Views, at: Descent, number: int, others: Pose) -> tuple[Descent, float]:
    """The better of a descent's pose of one object and its best rival, and by which factor the loser's loss is larger.

    Args:
        models: fields.
        views: what was observed.
        at: the scene so far.
        number: of the object.
        others: poses that it might have instead, a batch.
    """
    own = around(views, models, at.guess, number)
    here = float(_losses(models, own, at.guess, number, Pose(at.guess.positions[[number]], at.guess.quaternions[[number]]))[0])  # fmt: skip
    order = np.argsort(_losses(models, own, at.guess, number, others))
    far = [k for k in order if rotation_angle(others.quaternion[k], at.guess.quaternions[number]) > _SAME_RAD]
    best, least = at, np.inf
    for k in _distinct(far, others):
        guess = _with(at.guess, number, others[k])
        rival = replace(Descent.at(guess), normals=at.normals)
        for rival in polish(models, views, rival, iterations=_ITERATIONS, objects=(number,)):
            pass
        pose = Pose(rival.guess.positions[[number]], rival.guess.quaternions[[number]])
        loss = float(_losses(models, own, rival.guess, number, pose)[0])
        if rotation_angle(pose.quaternion[0], at.guess.quaternions[number]) < _SAME_RAD:  # it fell back
            if loss < here:
                at, here = replace(rival, losses=at.losses), loss
        elif loss < least:
            best, least = rival, loss
    if least < here:
        losses = at.losses.copy()
        losses[number] = least
        return replace(best, losses=losses, dampings=at.dampings), here / max(least, 1e-12)
    return at, least / max(here, 1e-12)


def _distinct(order: list[int], poses: Pose) -> list[int]:
    kept: list[int] = []
    for k in order:
        if all(rotation_angle(poses.quaternion[k], poses.quaternion[o]) > _SAME_RAD * 1.5 for o in kept):
            kept.append(k)
        if len(kept) == _TRIED:
            break
    return kept


def _with(guess: Guess, number: int, pose: Pose) -> Guess:
    positions, quaternions = guess.positions.copy(), guess.quaternions.copy()
    positions[number], quaternions[number] = pose.position, pose.quaternion
    return replace(guess, positions=positions, quaternions=quaternions)


def _losses(models: Models, views: Views, guess: Guess, number: int, poses: Pose) -> Float[np.ndarray, "K"]:
    """Loss of a scene with one object in K poses."""
    batch = guess.moved(np.zeros((len(poses.position), guess.size)))
    positions, quaternions = batch.positions.copy(), batch.quaternions.copy()
    positions[:, number], quaternions[:, number] = poses.position, poses.quaternion
    return whole_loss(residuals(models, views, replace(batch, positions=positions, quaternions=quaternions)))
