"""Estimates from later frames, without masks, starting at an expected state (paper section 4.2, last part).

Objects with a small photometric residual at their expected poses are refined by Gauss-Newton. The others are searched,
with cheap searches first: along the pusher's motion (`push_hypotheses`), by CMA-ES with a small spread, and in their
other resting orientations. Fine images decide about yaw, since coarse images do not resolve labels. The light is held.
It is searched again only if the residual of the table grows and another light lowers it, that is, if the lamp moved.
"""

from __future__ import annotations

from collections.abc import Iterator, Sequence
from dataclasses import dataclass, replace
from itertools import product

import numpy as np
from jaxtyping import Bool, Float

from osfcore.errors import InvalidInput
from osfcore.estimation.hypotheses import compare_orientations, yaw_hypotheses
from osfcore.estimation.objective import (
    FINE_SIDE,
    POSE,
    ObjectModels,
    ObservedViews,
    SceneParameters,
    crop_to_object,
    crop_to_silhouette,
    loss_of,
    photometric_loss,
    pose_losses,
    residuals,
    views_of,
    yaw_quaternions,
)
from osfcore.estimation.search import (
    GaussNewtonState,
    StepReporter,
    gauss_newton,
    light_loss_ratio,
    search_light,
    search_scene,
)
from osfcore.estimation.steps import EstimateStep
from osfcore.estimation.uncertainty import (
    MAX_RESIDUAL,
    FitQuality,
    allowed_residuals,
    estimate_with_uncertainty,
    evaluate_fit,
    object_residuals,
)
from osfcore.geometry.poses import Pose, quaternion_conjugate, quaternion_exp, quaternion_multiply, rotate
from osfcore.geometry.states import Observation, SceneState


@dataclass(frozen=True, slots=True)
class TrackingConfig:
    """Settings of `estimate_next`. A residual is a root mean square error over an object's pixels [radiance].

    Attributes:
        stays_below: largest residual of an object that counts as being where it was expected.
        fits_below: largest residual of an object that was searched and counts as found.
        fits_finely_below: the same in images of full resolution.
        lamp_above: residual of all other pixels above which the lamp may have moved.
        lamp_hint: share of the loss that the best of a few other lights must reach before more lights are tried.
        lamp_gain: share of the loss that another light must reach to be accepted.
        rough_sweeps: sweeps of Gauss-Newton over the objects that moved, at a quarter of the resolution.
        sweeps: sweeps at half the resolution.
        fine_sweeps: sweeps at half the resolution with more rays per pixel.
        closest_sweeps: sweeps at full resolution, over objects that do not fit there.
        population: population of CMA-ES for objects that do not fit.
        generations: its generations.
        shift: its initial standard deviation of positions [m].
        turn: its initial standard deviation about the vertical [rad]; a quarter of it about other axes.
        turned_within: ratio of the loss of an object turned about the vertical to its own loss, below which the object
            may be turned wrongly.
        reach: margin around an object's expected position in which images are compared [m].
    """

    stays_below: float = 0.05
    fits_below: float = 0.045
    fits_finely_below: float = 0.04
    lamp_above: float = 0.03
    lamp_hint: float = 0.9
    lamp_gain: float = 0.7
    rough_sweeps: int = 3
    sweeps: int = 4
    fine_sweeps: int = 2
    closest_sweeps: int = 3
    population: int = 14
    generations: int = 5
    shift: float = 0.01
    turn: float = 0.2
    turned_within: float = 1.8
    reach: float = 0.03


def estimate_next(
    models: ObjectModels,
    observation: Observation,
    expected: SceneState,
    rng: np.random.Generator,
    config: TrackingConfig | None = None,
    usual: Float[np.ndarray, "N"] | None = None,
) -> Iterator[EstimateStep]:
    """Estimate poses, and the light if it moved, in images that follow an earlier estimate.

    Args:
        models: models of the objects and the table.
        observation: one or more views. Masks are ignored.
        expected: the last estimate, or a prediction from it, with the last estimate of the light.
        rng: random generator of the search.
        config: settings.
        usual: residuals that are normal for these objects [radiance], as
            `osfcore.estimation.uncertainty.expected_residuals` returns them; 0 by default.

    Returns:
        Steps of the search. The last one has `estimate`.

    Raises:
        InvalidInput: if the expected state has other objects.
        UnknownName: if an object has no field.

    Example:
        >>> *_, last = estimate_next(models, observation, state, np.random.default_rng(0))
        >>> last.estimate.trusted
        True
    """
    models.check(observation.names)
    if set(expected.names) != set(observation.names):
        raise InvalidInput("objects of the expected state", ", ".join(expected.names), ", ".join(observation.names))
    allowed = np.zeros(len(expected.names)) if usual is None else allowed_residuals(usual)
    yield from _Tracker(models, observation, expected, rng, config or TrackingConfig(), allowed).steps()


class _Tracker:
    """One estimation; `steps` runs it."""

    def __init__(
        self,
        models: ObjectModels,
        observation: Observation,
        expected: SceneState,
        rng: np.random.Generator,
        config: TrackingConfig,
        allowed: Float[np.ndarray, "N"],
    ) -> None:
        self._allowed = allowed
        self._models, self._rng, self._config = models, rng, config
        self._initial = SceneParameters.of(expected.reordered(observation.names), observation.pusher)
        self._middle = views_of(observation, FINE_SIDE // 2, samples=2)
        self._fine = views_of(observation, FINE_SIDE, samples=2)
        self._sharp = views_of(observation, FINE_SIDE)
        self._coarse = views_of(observation, FINE_SIDE // 2)
        self._rough = views_of(observation, FINE_SIDE // 4)
        self._push = np.zeros(3)  # of the pusher along the table [m]; zero where it was or is not there
        if expected.pusher is not None and observation.pusher is not None:
            self._push[:2] = (observation.pusher - expected.pusher)[:2]
        self._rivals: dict[int, float] = {}
        self._last_fit: tuple[SceneParameters, FitQuality] | None = None
        self._light_held = True
        self._reporter = StepReporter(4)

    def steps(self) -> Iterator[EstimateStep]:
        at = GaussNewtonState.at(self._initial)
        before = evaluate_fit(self._models, self._middle, at.params)
        if before.surroundings > self._config.lamp_above:
            at = yield from self._search_light(at)
            before = evaluate_fit(self._models, self._middle, at.params)
        misfit = object_residuals(before) > np.maximum(self._config.stays_below, self._allowed)
        if misfit.any():
            at = yield from self._refine(at, misfit, self._coarse, 1)
            misfit &= self._poorly_fitted(at.params)
        moved, e = misfit, self._config
        coarse_to_fine = (self._rough, e.rough_sweeps), (self._coarse, e.sweeps), (self._middle, e.fine_sweeps)
        for look in (self._try_pushes, self._search):
            if misfit.any():
                at = yield from look(at, misfit)
                for views, sweeps in coarse_to_fine:
                    at = yield from self._refine(at.undamped(), misfit, views, sweeps)
                misfit = misfit & self._poorly_fitted(at.params)
        if misfit.any():
            at = yield from self._recover(at, misfit)
            at = yield from self._refine(at, misfit, self._middle, self._config.fine_sweeps)
            misfit = misfit & self._poorly_fitted(at.params)
        at = yield from self._refine(at, ~moved, self._middle, 1)
        at = yield from self._refine_finely(at, moved & ~misfit)
        if not self._light_held:  # descent also says how well it is known
            *_, at = gauss_newton(self._models, self._coarse, at, iterations=4, objects=[], light=self._middle)
        fit, allowed = self._fit_finely(at.params), np.maximum(MAX_RESIDUAL, self._allowed)
        estimate = estimate_with_uncertainty(
            at.params, at.normals, fit, self._rivals, light_held=self._light_held, allowed=allowed
        )
        yield self._reporter.finish(at, estimate)

    def _poorly_fitted(self, params: SceneParameters) -> Bool[np.ndarray, "N"]:
        """Return the objects whose residual is larger than allowed."""
        residual = object_residuals(evaluate_fit(self._models, self._middle, params))
        return residual > np.maximum(self._config.fits_below, self._allowed)

    def _search_light(self, at: GaussNewtonState) -> Iterator[EstimateStep]:  # returns a GaussNewtonState
        """Search the light with all objects at their expected poses; keep it if the loss falls far enough."""
        if light_loss_ratio(self._models, self._rough, at.params) > self._config.lamp_hint:
            return at  # objects that moved are no reason to search on
        params = replace(at.params, light=search_light(self._models, self._rough, self._coarse, at.params))
        here, there = (loss_of(self._models, self._coarse, one) for one in (at.params, params))
        if there < self._config.lamp_gain * here:
            at, self._light_held = replace(at, params=params), False
        yield self._reporter.refinement("Shading and shadows", at, "light")
        return at

    def _refine(
        self, at: GaussNewtonState, moving: Bool[np.ndarray, "N"], views: ObservedViews, sweeps: int
    ) -> Iterator[EstimateStep]:  # returns a GaussNewtonState
        objects = np.flatnonzero(moving).tolist()
        refined = gauss_newton(self._models, views, at, iterations=sweeps, objects=objects, until_settled=True)
        return (yield from self._reporter.refinements("Refining all poses", at, refined))

    def _try_pushes(
        self, at: GaussNewtonState, misfit: Bool[np.ndarray, "N"]
    ) -> Iterator[EstimateStep]:  # returns a GaussNewtonState
        """Choose the best motion that the push may have caused, for all objects together, then for each alone."""
        numbers = np.flatnonzero(misfit).tolist()
        together = joint_push_hypotheses(at.params, numbers, self._push)
        batch = replace(at.params.repeated(len(together)), positions=together)
        best = int(photometric_loss(residuals(self._models, self._coarse, batch)).argmin())
        at = replace(at, params=replace(at.params, positions=together[best]))
        for n in numbers:
            views = crop_to_object(self._coarse, self._models, at.params, n, reach=self._config.reach)
            tried = push_hypotheses(self._models, at.params, n, self._push)
            losses = pose_losses(self._models, views, at.params, n, tried)
            at = replace(at, params=at.params.with_pose(n, tried[int(losses.argmin())]))
            at = replace(at, params=self._best_rolling_pose(at.params, n))
            yield self._reporter.refinement(f"{at.params.names[n]}: along the push", at, "together")
        return at

    def _search(
        self, at: GaussNewtonState, misfit: Bool[np.ndarray, "N"]
    ) -> Iterator[EstimateStep]:  # returns a GaussNewtonState
        """Search the pose of each poorly fitted object by CMA-ES, in a window around it."""
        e = self._config
        for n in np.flatnonzero(misfit).tolist():
            views = crop_to_object(self._coarse, self._models, at.params, n, reach=e.reach)
            scales = np.zeros(at.params.size)
            scales[POSE * n : POSE * (n + 1)] = e.shift, e.shift, e.shift / 3, e.turn / 2, e.turn / 2, e.turn
            search = search_scene(
                self._models, views, at.params, scales,
                population=e.population, generations=e.generations, rng=self._rng,
            )  # fmt: skip
            losses, note = at.losses[:-1].tolist(), f"{at.params.names[n]}: near its expected pose"
            for found in search:
                at = replace(at, params=found.best)
                yield self._reporter.step(
                    "together", note, found.best, found.tried, losses, sigma=found.sigma, loss=found.loss
                )
        return at

    def _best_rolling_pose(self, params: SceneParameters, n: int) -> SceneParameters:
        """Return the guess with an object rolled by the angle of the lowest loss. Slip while rolling is unknown."""
        tried = rolling_hypotheses(self._models, params, n, self._push)
        if len(tried.position) == 1:
            return params
        losses = pose_losses(self._models, crop_to_object(self._middle, self._models, params, n), params, n, tried)
        return params.with_pose(n, tried[int(losses.argmin())])

    def _recover(
        self, at: GaussNewtonState, misfit: Bool[np.ndarray, "N"]
    ) -> Iterator[EstimateStep]:  # returns a GaussNewtonState
        """Try all resting orientations of poorly fitted objects, at their present and their expected positions."""
        for n in np.flatnonzero(misfit).tolist():
            others = Pose.joined(*(resting_hypotheses(self._models, one, n) for one in (at.params, self._initial)))
            at = self._compare_orientations(at, n, others)
            yield self._reporter.refinement(f"{at.params.names[n]}: other resting orientations", at, "together")
        return at

    def _refine_finely(
        self, at: GaussNewtonState, moved: Bool[np.ndarray, "N"]
    ) -> Iterator[EstimateStep]:  # returns a GaussNewtonState
        """Refine objects that do not fit, in fine images; compare orientations of those that still do not, or moved."""
        bad = self._poorly_fitted_finely(at.params)
        if bad.any():
            at = yield from self._refine(at, bad, self._fine, self._config.closest_sweeps)
            bad &= self._poorly_fitted_finely(at.params)
        for n in np.flatnonzero(bad | moved).tolist():
            others = yaw_hypotheses(self._models, at.params, n)
            if bad[n] or self._may_be_turned(at.params, n, others):
                others = Pose.joined(others, resting_hypotheses(self._models, at.params, n))
                at = self._compare_orientations(at, n, others)
                yield self._reporter.refinement(f"{at.params.names[n]}: turned around", at, "together")
        return at

    def _poorly_fitted_finely(self, params: SceneParameters) -> Bool[np.ndarray, "N"]:
        return object_residuals(self._fit_finely(params)) > np.maximum(self._config.fits_finely_below, self._allowed)

    def _fit_finely(self, params: SceneParameters) -> FitQuality:
        """Return the fit in fine images. It is rendered again only if the guess has changed."""
        if self._last_fit is None or self._last_fit[0] is not params:
            self._last_fit = params, evaluate_fit(self._models, self._fine, params)
        return self._last_fit[1]

    def _may_be_turned(self, params: SceneParameters, n: int, others: Pose) -> bool:
        """Return whether another yaw has a loss within a factor of the present one."""
        views = crop_to_silhouette(self._sharp, self._models, params, n)
        here, *there = pose_losses(self._models, views, params, n, Pose.joined(params.state().poses[n][None], others))
        return min(there) < self._config.turned_within * here

    def _compare_orientations(self, at: GaussNewtonState, n: int, others: Pose) -> GaussNewtonState:
        at, self._rivals[n] = compare_orientations(self._models, self._coarse, self._sharp, self._fine, at, n, others)
        return at


# Motion hypotheses: poses that an object may have after a push. Searches start from them, and the photometric loss
# decides between them.
#
# An object moves by a share of the pusher's motion, alone or with others. It keeps its orientation, turns about the
# vertical, or rolls without slipping. This is fast and deliberately coarse; it is no dynamics model.


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
    """Return positions of all objects [m] after some were moved by shares of a push: K combinations, the guess first.

    Args:
        params: guess of the scene.
        numbers: indices of the objects that may have moved; up to four are combined in all ways, more move by one
            share.
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
    """Return a batch of poses of one object: on a grid along and across a push, turned by yaw angles, and rolled.

    Args:
        models: models of the objects, for the centre of mass and the ways an object can roll.
        params: the guess, around which the grid lies.
        number: index of the object.
        push: motion of the pusher [m]. Below 5 mm the grid covers about 2 cm around the guess, and nothing rolls.
    """
    length = float(np.linalg.norm(push))
    step = push if length > _MIN_PUSH_M else np.array([_NEAR_M / _ALONG[-1], 0.0, 0.0])
    beside = np.array([-step[1], step[0], 0.0])
    shifts = (_ALONG[:, None, None] * step + _ACROSS[:, None] * beside).reshape(-1, 3)
    turns = yaw_quaternions(_TURNS_RAD)
    slid = [(shift, turn) for shift in shifts for turn in turns]
    axis = _rolling_axis(models, params, number, push)
    rolled = []
    if axis.any():
        rolled = [(shift, _roll_along(models, params, number, axis, push + shift)) for shift in shifts]
    return _combine_shifts_and_turns(models, params, number, *map(np.array, zip(*slid, *rolled, strict=True)))


def rolling_hypotheses(
    models: ObjectModels, params: SceneParameters, number: int, push: Float[np.ndarray, "3"]
) -> Pose:
    """Return a batch of poses of one object, rolled about the axis about which a push rolls it; its own pose is first.

    Args:
        models: models of the objects, for the centre of mass and the ways an object can roll.
        params: the guess. The object's centre of mass stays.
        number: index of the object.
        push: motion of the pusher [m]. If it cannot roll the object, only its own pose is returned.
    """
    axis = _rolling_axis(models, params, number, push)
    angles = np.arange(_ROLLS if axis.any() else 1) * 2 * np.pi / _ROLLS
    turns = quaternion_exp(angles[:, None] * axis)
    return _combine_shifts_and_turns(models, params, number, np.zeros((len(angles), 3)), turns)


def resting_hypotheses(models: ObjectModels, params: SceneParameters, number: int) -> Pose:
    """Return a batch of poses of one object, in all its resting orientations.

    Args:
        models: models of the objects, for the resting orientations.
        params: the guess. The centre of mass stays above the same point of the table.
        number: index of the object.
    """
    resting, centre = models.resting(params.names[number]), models.centre_of_mass(params, number)
    centres = np.column_stack([np.tile(centre[:2], (len(resting.heights), 1)), resting.heights])
    return resting.poses_at(centres, resting.quaternions)


def _rolling_axis(
    models: ObjectModels, params: SceneParameters, number: int, push: np.ndarray
) -> Float[np.ndarray, "3"]:
    """Return the unit vector about which a push rolls a body forward; zero if the push cannot roll it.

    Of several possible axes, it is the one closest to perpendicular to the push.

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
    """Return the rotation of a body that rolls along a path without slipping, with its centre at its present height."""
    height, radius = models.centre_of_mass(params, number)[2], models.resting(params.names[number]).radius
    forward = np.array([axis[1], -axis[0], 0.0])
    return quaternion_exp(axis * (forward @ path) / max(float(height), 0.25 * radius))


def _combine_shifts_and_turns(
    models: ObjectModels, params: SceneParameters, number: int, shifts: np.ndarray, turns: np.ndarray
) -> Pose:
    """Return poses of one object shifted, and turned about its centre of mass."""
    quaternions = quaternion_multiply(turns, params.quaternions[number][None])
    return models.resting(params.names[number]).poses_at(models.centre_of_mass(params, number) + shifts, quaternions)
