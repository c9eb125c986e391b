"""Damped Gauss-Newton (Levenberg-Marquardt) on the photometric loss: block coordinate descent over objects and light.

For the parameters delta of one block, with residuals r, their Jacobian J by central differences, Huber weights
w = min(1, h / |r|) (iteratively reweighted least squares) and D = diag(J^T W J), each iteration solves

    (J^T W J + lambda D) delta = -J^T W r

for several lambda at once, clips delta to a trust region, renders all candidates as one batch and keeps the best if it
lowers the loss. Deviation from the textbook: the least damped steps are also tried scaled by 4 and 2, because texture
makes Gauss-Newton underestimate the step far from the minimum. A block's images are cropped to the object; what blocks
share, shadows on each other, is small, and further sweeps take care of it.

Deviation from the paper, which uses CMA-ES throughout: near the solution the loss is smooth over differences wider than
a pixel, so a few iterations suffice, and J^T W J gives the uncertainty, which CMA-ES's final spread does not.
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
_SHIFT_M, _TURN_RAD, _LIGHT_RAD = 4e-3, 0.1, 0.02  # half the width of central differences
_MOST_SHIFT_M, _MOST_TURN_RAD, _MOST_LIGHT_RAD = 0.03, 0.4, 0.3
_DAMPINGS = np.array(
    [0.1, 0.1, 0.1, 1.0, 10.0, 100.0]
)  # lambda: these multiples of the last good one are tried at once
_STEP_SCALES = (4.0, 2.0, 1.0, 1.0, 1.0, 1.0)  # of delta, for each of these lambdas
_FIRST_DAMPING, _LEAST_DAMPING, _MOST_DAMPING = 1e-2, 1e-5, 1e6
_CONVERGED_RATIO = 0.97  # of the losses after and before a sweep, from which on it counts as converged
_TINY = 1e-9


@dataclass(frozen=True, eq=False, slots=True)
class GaussNewtonState:
    """The current iterate.

    Attributes:
        params: the best scene so far.
        losses: `photometric_loss` of each object's windows, and last that of the whole images if the light is searched.
        normals: Gauss-Newton's matrices of the summed losses, one for each object and one for the light; zero where
            nothing was searched [1 / unit^2].
        dampings: to go on with, one for each block.
    """

    params: SceneParameters
    losses: Float[np.ndarray, "N+1"]
    normals: tuple[Float[np.ndarray, "P P"], ...]
    dampings: tuple[float, ...]

    @staticmethod
    def at(params: SceneParameters) -> GaussNewtonState:
        """Before the first iteration."""
        count = len(params.names)
        normals = (*(np.zeros((POSE, POSE)) for _ in range(count)), np.zeros((LIGHT, LIGHT)))
        return GaussNewtonState(params, np.full(count + 1, np.inf), normals, (_FIRST_DAMPING,) * (count + 1))


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
    """Minimise the photometric loss; yields after each sweep over the objects and the light.

    Args:
        models: fields.
        views: what was observed.
        start: where to begin.
        iterations: sweeps.
        objects: which objects may move; all by default.
        light: images in which to search the light, coarse ones will do; None holds it.
        numbers: which of an object's six numbers may change, `POSE_PARAMETERS` or `PLANAR_PARAMETERS`.
        until_settled: stop when a sweep hardly lowers the objects' losses.

    Yields:
        The iterate after each sweep.
    """
    at = start
    moving = list(range(len(at.params.names)) if objects is None else objects)
    before = np.inf
    for _ in range(iterations):
        for n in moving:
            own = crop_to_silhouette(views, models, at.params, n)
            at = _damped_step(models, own, at, n, np.array([POSE * n + k for k in numbers]))
        if light is not None:
            first = POSE * len(at.params.names)
            at = _damped_step(models, light, at, len(at.params.names), np.arange(first, first + LIGHT))
        yield at
        loss = float(at.losses[moving].sum())
        if until_settled and loss > _CONVERGED_RATIO * before:
            return
        before = loss


def _damped_step(
    models: ObjectModels, views: ObservedViews, at: GaussNewtonState, block: int, numbers: Int[np.ndarray, "n"]
) -> GaussNewtonState:
    """One damped step on some entries of the parameter vector (equation in the module's docstring)."""
    params, half = at.params, difference_steps(len(at.params.names))
    probes = np.zeros((1 + 2 * len(numbers), params.size))
    for row, number in enumerate(numbers):
        probes[1 + 2 * row, number], probes[2 + 2 * row, number] = half[number], -half[number]
    errors = residuals(models, views, params.perturbed(probes)).reshape(len(probes), -1)
    jacobian = (errors[1::2] - errors[2::2]) / (2 * half[numbers, None].astype(np.float32))
    weights = np.minimum(1, HUBER / np.maximum(np.abs(errors[0]), _TINY))
    normal = ((jacobian * weights) @ jacobian.T).astype(float)
    gradient = jacobian @ (weights * errors[0])
    dampings = at.dampings[block] * _DAMPINGS
    steps = np.zeros((len(dampings), params.size))
    for row, (damping, scale) in enumerate(zip(dampings, _STEP_SCALES, strict=True)):
        damped = normal + np.diag(damping * np.diag(normal) + _TINY)
        steps[row, numbers] = -scale * np.linalg.solve(damped, gradient)
    steps /= np.maximum(1, (np.abs(steps) / _max_step(len(params.names))).max(axis=1, keepdims=True))
    here = float(photometric_loss(errors[:1])[0])
    losses = photometric_loss(residuals(models, views, params.perturbed(steps)))
    best = int(np.argmin(losses))
    if losses[best] < here:
        params, here = params.updated(steps[best]), float(losses[best])
        damping = max(float(dampings[best]), _LEAST_DAMPING)
    else:
        damping = min(float(dampings[-1]), _MOST_DAMPING)
    whole = np.zeros_like(at.normals[block])
    own = numbers - POSE * block
    whole[np.ix_(own, own)] = normal
    return _accept_step(at, params, block, here, whole, damping)


def _accept_step(
    at: GaussNewtonState, params: SceneParameters, block: int, loss: float, normal: np.ndarray, damping: float
) -> GaussNewtonState:
    losses = at.losses.copy()
    losses[block] = loss
    normals = (*at.normals[:block], normal, *at.normals[block + 1 :])
    dampings = (*at.dampings[:block], damping, *at.dampings[block + 1 :])
    return GaussNewtonState(params, losses, normals, dampings)


def difference_steps(count: int) -> Float[np.ndarray, "P"]:
    """Half the width of the central differences of each parameter, for a scene of `count` objects."""
    return np.array([*([_SHIFT_M] * 3 + [_TURN_RAD] * (POSE - 3)) * count, *[_LIGHT_RAD] * LIGHT])


def _max_step(count: int) -> Float[np.ndarray, "P"]:
    return np.array([*([_MOST_SHIFT_M] * 3 + [_MOST_TURN_RAD] * (POSE - 3)) * count, *[_MOST_LIGHT_RAD] * LIGHT])
