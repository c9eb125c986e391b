"""The last millimetres: damped Gauss-Newton on the loss of whole scenes, object by object, then the light.

All derivatives of a block come from one batch of images, of the windows around the object alone; what objects share,
their shadows on each other, is small, and sweeping over them again takes care of it.

Deviation from the paper, which uses CMA throughout: near the solution the loss is smooth, and its slopes, taken over
steps wide enough to bridge pixels, find the minimum in a few iterations. They also tell how sharp it is, which CMA's
final spread does not.
"""

from __future__ import annotations

from collections.abc import Iterator, Sequence
from dataclasses import dataclass

import numpy as np
from jaxtyping import Float, Int

from osfcore.estimation.objective.object_models import ObjectModels
from osfcore.estimation.objective.observed_views import ObservedViews, crop_to_silhouette
from osfcore.estimation.objective.parametrization import LIGHT, POSE, SceneParameters
from osfcore.estimation.objective.photometric_loss import HUBER, photometric_loss, residuals

PLANAR_PARAMETERS = (0, 1, 5)  # among an object's numbers: x, y and the turn about the vertical
POSE_PARAMETERS = tuple(range(POSE))
_SHIFT_M, _TURN_RAD, _LIGHT_RAD = 4e-3, 0.1, 0.02  # half the width of the differences
_MOST_SHIFT_M, _MOST_TURN_RAD, _MOST_LIGHT_RAD = 0.03, 0.4, 0.3
_DAMPINGS = np.array([0.1, 0.1, 0.1, 1.0, 10.0, 100.0])  # tried at once, times the last good one
_STEP_SCALES = (4.0, 2.0, 1.0, 1.0, 1.0, 1.0)  # far from the solution, texture makes Gauss-Newton's steps too short
_FIRST_DAMPING, _LEAST_DAMPING, _MOST_DAMPING = 1e-2, 1e-5, 1e6
_CONVERGED_RATIO = 0.97  # share of its loss before a sweep from which more sweeps promise little
_TINY = 1e-9


@dataclass(frozen=True, eq=False, slots=True)
class GaussNewtonState:
    """Where a descent is.

    Attributes:
        guess: the best scene so far.
        losses: `photometric_loss` of each object's windows, and last that of the whole images if the light is searched.
        normals: Gauss-Newton's matrices of the summed losses, one for each object and one for the light; zero where
            nothing was searched [1 / unit^2].
        dampings: to go on with, one for each block.
    """

    guess: SceneParameters
    losses: Float[np.ndarray, "N+1"]
    normals: tuple[Float[np.ndarray, "P P"], ...]
    dampings: tuple[float, ...]

    @staticmethod
    def at(guess: SceneParameters) -> GaussNewtonState:
        """Before the first iteration."""
        count = len(guess.names)
        normals = (*(np.zeros((POSE, POSE)) for _ in range(count)), np.zeros((LIGHT, LIGHT)))
        return GaussNewtonState(guess, np.full(count + 1, np.inf), normals, (_FIRST_DAMPING,) * (count + 1))


def gauss_newton(
    models: ObjectModels,
    views: ObservedViews,
    start: GaussNewtonState,
    *,
    iterations: int,
    objects: Sequence[int] | None = None,
    light: ObservedViews | None = None,
    numbers: Sequence[int] = POSE_PARAMETERS,
    until_settled: bool = False,
) -> Iterator[GaussNewtonState]:
    """Descend; yields after each sweep over the objects and the light.

    Args:
        models: fields.
        views: what was observed.
        start: where to begin.
        iterations: sweeps.
        objects: which objects may move; all by default.
        light: images in which to search the light, coarse ones will do; None holds it.
        numbers: which of an object's six numbers may change, `POSE_PARAMETERS` or `PLANAR_PARAMETERS`.
        until_settled: stop before if a sweep hardly lowers the objects' losses.
    """
    at = start
    moving = list(range(len(at.guess.names)) if objects is None else objects)
    before = np.inf
    for _ in range(iterations):
        for n in moving:
            own = crop_to_silhouette(views, models, at.guess, n)
            at = _normal_equations(models, own, at, n, np.array([POSE * n + k for k in numbers]))
        if light is not None:
            first = POSE * len(at.guess.names)
            at = _normal_equations(models, light, at, len(at.guess.names), np.arange(first, first + LIGHT))
        yield at
        loss = float(at.losses[moving].sum())
        if until_settled and loss > _CONVERGED_RATIO * before:
            return
        before = loss


def _normal_equations(
    models: ObjectModels, views: ObservedViews, at: GaussNewtonState, block: int, numbers: Int[np.ndarray, "n"]
) -> GaussNewtonState:
    """One iteration on some numbers of the vector of changes."""
    guess, half = at.guess, difference_steps(len(at.guess.names))
    probes = np.zeros((1 + 2 * len(numbers), guess.size))
    for row, number in enumerate(numbers):
        probes[1 + 2 * row, number], probes[2 + 2 * row, number] = half[number], -half[number]
    errors = residuals(models, views, guess.perturbed(probes)).reshape(len(probes), -1)
    slopes = (errors[1::2] - errors[2::2]) / (2 * half[numbers, None].astype(np.float32))
    weights = np.minimum(1, HUBER / np.maximum(np.abs(errors[0]), _TINY))
    normal = ((slopes * weights) @ slopes.T).astype(float)
    gradient = slopes @ (weights * errors[0])
    dampings = at.dampings[block] * _DAMPINGS
    steps = np.zeros((len(dampings), guess.size))
    for row, (damping, stretch) in enumerate(zip(dampings, _STEP_SCALES, strict=True)):
        damped = normal + np.diag(damping * np.diag(normal) + _TINY)
        steps[row, numbers] = -stretch * np.linalg.solve(damped, gradient)
    steps /= np.maximum(1, (np.abs(steps) / _max_step(len(guess.names))).max(axis=1, keepdims=True))
    here = float(photometric_loss(errors[:1])[0])
    losses = photometric_loss(residuals(models, views, guess.perturbed(steps)))
    best = int(np.argmin(losses))
    if losses[best] < here:
        guess, here = guess.updated(steps[best]), float(losses[best])
        damping = max(float(dampings[best]), _LEAST_DAMPING)
    else:
        damping = min(float(dampings[-1]), _MOST_DAMPING)
    whole = np.zeros_like(at.normals[block])
    own = numbers - POSE * block
    whole[np.ix_(own, own)] = normal
    return _accept_step(at, guess, block, here, whole, damping)


def _accept_step(
    at: GaussNewtonState, guess: SceneParameters, block: int, loss: float, normal: np.ndarray, damping: float
) -> GaussNewtonState:
    losses = at.losses.copy()
    losses[block] = loss
    normals = (*at.normals[:block], normal, *at.normals[block + 1 :])
    dampings = (*at.dampings[:block], damping, *at.dampings[block + 1 :])
    return GaussNewtonState(guess, losses, normals, dampings)


def difference_steps(count: int) -> Float[np.ndarray, "P"]:
    """Half the width of the differences that make slopes, for a scene of `count` objects."""
    return np.array([*([_SHIFT_M] * 3 + [_TURN_RAD] * (POSE - 3)) * count, *[_LIGHT_RAD] * LIGHT])


def _max_step(count: int) -> Float[np.ndarray, "P"]:
    return np.array([*([_MOST_SHIFT_M] * 3 + [_MOST_TURN_RAD] * (POSE - 3)) * count, *[_MOST_LIGHT_RAD] * LIGHT])
