"""Orientation hypotheses of one object, refined by Gauss-Newton and compared by the photometric loss around it."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
from jaxtyping import Float

from osfcore.estimation.objective.object_models import ObjectModels
from osfcore.estimation.objective.observed_views import ObservedViews, crop_to_object
from osfcore.estimation.objective.parametrization import SceneParameters
from osfcore.estimation.objective.photometric_loss import loss_of, photometric_loss, residuals
from osfcore.estimation.objective.resting_orientations import yaw_quaternions
from osfcore.estimation.search.gauss_newton import GaussNewtonState, gauss_newton
from osfcore.estimation.uncertainty import evaluate_fit, object_residuals
from osfcore.geometry.poses import (
    Pose,
    quaternion_conjugate,
    quaternion_exp,
    quaternion_multiply,
    rotate,
    rotation_angle,
)

_YAWS = 24
_DOWN = np.array([0.0, 0.0, -1.0])
_RANKED_COARSE = 64  # hypotheses that are ranked again in coarse images
_REFINED_ROUGH = 8  # of these, so many that differ are refined in rough images
_REFINED_COARSE = 3  # of these, so many are refined in coarse ones
_ITERATIONS, _FINE_ITERATIONS = 2, 3
_FAR, _EXPLAINED = (
    1.5,
    0.035,
)  # nothing is refined where all losses are as high and the object differs by less [radiance]
_CLOSE = 1.5  # ratio to the present loss up to which a hypothesis is refined on fine images
_BETTER = 0.98  # times the loss: what is less is no reason to turn an object
_SAME_RAD = np.deg2rad(12.0)


def yaw_hypotheses(models: ObjectModels, params: SceneParameters, number: int) -> Pose:
    """An object turned in place about the vertical through its centre of mass, by equal steps; a batch of poses.

    Args:
        models: fields, for the centre of mass.
        params: the guess; the object's own pose is not among the result.
        number: of the object.
    """
    turns = yaw_quaternions(np.arange(1, _YAWS) * 2 * np.pi / _YAWS)
    quaternions = quaternion_multiply(turns, params.quaternions[number][None])
    centre = models.resting(params.names[number]).centre
    middle = params.positions[number] + rotate(params.quaternions[number], centre)
    return Pose(middle - rotate(quaternions, centre), quaternions)


def side_hypotheses(models: ObjectModels, params: SceneParameters, number: int) -> Pose:
    """An object tipped over in place, by the least rotation, onto each side that it may lie on; a batch of poses.

    A can on its side is rolled about its axis so: labels that repeat around it make it look alike in coarse images.
    Each pose is among the result also turned by 180 deg about the vertical. The axis of a rotation by about 180 deg is
    the object's longest one.

    Args:
        models: fields, for the sides, and the centre of mass.
        params: the guess; the side that the object lies on is not among the result.
        number: of the object.
    """
    resting, own = models.resting(params.names[number]), params.quaternions[number]
    sides = rotate(quaternion_conjugate(resting.quaternions), _DOWN)
    sides, first = np.unique(np.round(sides, 6), axis=0, return_index=True)
    now = rotate(own, sides)
    axes, angles = np.cross(now, _DOWN), np.arccos((now @ _DOWN).clip(-1, 1))
    longest = rotate(own, np.linalg.svd(resting.hull - resting.hull.mean(axis=0), full_matrices=False)[2][0])
    axes[angles > np.pi - _SAME_RAD] = longest * [1, 1, 0]
    other = angles > _SAME_RAD
    turns = axes[other] / np.linalg.norm(axes[other], axis=1, keepdims=True).clip(1e-9) * angles[other, None]
    tipped = quaternion_multiply(quaternion_exp(turns), own[None])
    quaternions = np.concatenate([tipped, quaternion_multiply(yaw_quaternions(np.array([np.pi])), tipped)])
    middle = np.tile(params.positions[number] + rotate(own, resting.centre), (len(quaternions), 1))
    middle[:, 2] = np.tile(resting.heights[first][other], 2)
    return Pose(middle - rotate(quaternions, resting.centre), quaternions)


def compare_orientations(
    models: ObjectModels,
    rough: ObservedViews,
    coarse: ObservedViews,
    fine: ObservedViews,
    at: GaussNewtonState,
    number: int,
    others: Pose,
) -> tuple[GaussNewtonState, float]:
    """Compare an object's orientation with the best of other hypotheses.

    None is refined where the object explains its pixels already and every hypothesis is far worse: under right
    orientations residuals are 0.038 at most, under wrong ones 0.038 and more (`docs/estimation.md`).

    Args:
        models: fields.
        rough: images in which hypotheses are ranked and first refined: they have the widest basins of attraction.
        coarse: images in which the first of them are ranked again, and the best refined further.
        fine: images in which the best of them is compared.
        at: the scene so far.
        number: of the object.
        others: poses that it might have instead, a batch.

    Returns:
        The better scene, and the ratio of the worse loss to the better one; infinite without a distinct hypothesis.
    """
    name, own_quaternion = at.params.names[number], at.params.quaternions[number]
    far = others[models.turned(name, own_quaternion, others.quaternion) > _SAME_RAD]
    if not len(far.position):
        return at, np.inf
    own = crop_to_object(rough, models, at.params, number)
    far = far[np.argsort(pose_losses(models, own, at.params, number, far))[:_RANKED_COARSE]]
    own = crop_to_object(coarse, models, at.params, number)
    losses = pose_losses(models, own, at.params, number, far)
    far, nearest = far[np.argsort(losses)], float(losses.min() / max(loss_of(models, own, at.params), 1e-12))
    if nearest > _FAR and object_residuals(evaluate_fit(models, fine, at.params))[number] < _EXPLAINED:
        return at, nearest
    tried = [_refine(models, rough, at, number, far[k], _ITERATIONS) for k in _distinct_orientations(far)]
    tried = sorted(tried, key=lambda one: loss_of(models, own, one.params))[:_REFINED_COARSE]
    tried = [_refine(models, coarse, one, number, _pose(one.params, number), _ITERATIONS) for one in tried]
    ends = [loss_of(models, own, refined.params) for refined in tried]
    rival = tried[int(np.argmin(ends))]
    if min(ends) < _CLOSE * loss_of(models, own, at.params):
        rival = _refine(models, fine, rival, number, _pose(rival.params, number), _FINE_ITERATIONS)
    own = crop_to_object(fine, models, at.params, number)
    here, there = (loss_of(models, own, params) for params in (at.params, rival.params))
    angle = models.turned(name, own_quaternion, rival.params.quaternions[number][None])[0]
    ratio = np.inf if angle < _SAME_RAD else max(here, there) / max(min(here, there), 1e-12)
    return (replace(rival, losses=at.losses) if there < _BETTER * here else at), float(ratio)


def _refine(
    models: ObjectModels, views: ObservedViews, at: GaussNewtonState, number: int, pose: Pose, iterations: int
) -> GaussNewtonState:
    """Gauss-Newton of one object from a pose; its normal matrix stays that of before until it moves."""
    rival = replace(at, params=with_pose(at.params, number, pose), dampings=GaussNewtonState.at(at.params).dampings)
    return list(gauss_newton(models, views, rival, iterations=iterations, objects=(number,)))[-1]


def _distinct_orientations(poses: Pose) -> list[int]:
    """Indices of the first few poses that differ from each other."""
    kept: list[int] = []
    for k in range(len(poses.position)):
        if all(rotation_angle(poses.quaternion[k], poses.quaternion[o]) > _SAME_RAD * 1.5 for o in kept):
            kept.append(k)
        if len(kept) == _REFINED_ROUGH:
            break
    return kept


def with_pose(params: SceneParameters, number: int, pose: Pose) -> SceneParameters:
    """A guess with one object in another pose.

    Args:
        params: the guess, which stays as it is.
        number: of the object.
        pose: its new `T_world_object`.
    """
    positions, quaternions = params.positions.copy(), params.quaternions.copy()
    positions[number], quaternions[number] = pose.position, pose.quaternion
    return replace(params, positions=positions, quaternions=quaternions)


def _pose(params: SceneParameters, number: int) -> Pose:
    return Pose(params.positions[number], params.quaternions[number])


def pose_losses(
    models: ObjectModels, views: ObservedViews, params: SceneParameters, number: int, poses: Pose
) -> Float[np.ndarray, "K"]:
    """Photometric loss of a scene with one object in each of K poses.

    Args:
        models: fields.
        views: images to compare with, whole ones or windows around the object.
        params: the guess; all other objects and the light stay.
        number: of the object.
        poses: the K poses, a batch of `T_world_object`.
    """
    batch = params.perturbed(np.zeros((len(poses.position), params.size)))
    positions, quaternions = batch.positions.copy(), batch.quaternions.copy()
    positions[:, number], quaternions[:, number] = poses.position, poses.quaternion
    return photometric_loss(residuals(models, views, replace(batch, positions=positions, quaternions=quaternions)))
