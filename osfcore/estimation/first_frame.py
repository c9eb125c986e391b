"""The first frame: all poses and the light from images with masks (paper section 4.2).

The method follows the paper:

1. The light is held overhead, and CMA-ES optimises each object's pose within its own masks (eq. 5).
2. CMA-ES optimises all poses and the light over whole images (eq. 6).

Deviations: step 1 starts from every resting orientation of an object and not from one guess, since the loss has many
local minima over orientations. A grid search over the hemisphere initialises the light. Gauss-Newton refines the result
of CMA-ES.

Images may differ from those that the fields were trained for in exposure, encoding, ambient light and table colour.
`check_table` decides what to do:

- "usual": the table looks as expected. The method above does everything.
- "unclear": no full shadow is visible, so that the lamp and the exposure cannot be separated. The method above runs
  first. Its estimate is kept if its loss is low, or if the image model fitted at its poses is the usual one.
  Otherwise, the next case applies.
- "other": an image model is fitted first (`Calibrator`), with each object in the pose that fits its masks best at any
  brightness. This is done for linear and for sRGB values. The method above then runs on the adapted images and fields,
  first with the encoding that leaves less unexplained. The other encoding is tried if the loss is high or the estimate
  doubtful; the lower loss decides. Finally image model, poses and lamp are refined in turn until the lamp stays still.
"""

from __future__ import annotations

from collections.abc import Iterator
from dataclasses import dataclass, replace
from typing import Literal, get_args

import numpy as np

from osfcore.errors import InvalidInput
from osfcore.estimation.camera_response import Encoding, linear_from_encoded
from osfcore.estimation.hypotheses import OUT_OF_VIEW, compare_orientations, side_hypotheses, yaw_hypotheses
from osfcore.estimation.objective import (
    FINE_SIDE,
    LIGHT,
    ObjectModels,
    ObjectView,
    ObservedViews,
    SceneParameters,
    crop_to_masks,
    views_of,
)
from osfcore.estimation.photometry import Calibration, Calibrator, adapted, check_table
from osfcore.estimation.search import (
    OVERHEAD,
    SHIFT_M,
    TURN_RAD,
    GaussNewtonState,
    MultistartCMA,
    RankedPoses,
    StepReporter,
    gauss_newton,
    initial_poses,
    rank_poses,
    search_light,
    search_scene,
)
from osfcore.estimation.steps import EstimateStep, Stage, all_but_last
from osfcore.estimation.uncertainty import AMBIGUOUS, estimate_with_uncertainty, evaluate_fit, relative_allowance
from osfcore.geometry.poses import Pose
from osfcore.geometry.states import EstimatedState, Observation
from osfcore.progress import Progress

_COARSE_SIDE, _ROUGH_SIDE = FINE_SIDE // 2, FINE_SIDE // 4
_LIGHT_RAD, _UNKNOWN_RAD = 0.03, 0.6  # the first spread of the light, where it was searched before and where not
_HYPOTHESES = 3  # orientations of each object that the whole images choose from
_RANKED_SHARP = 100
_SHOWN = 24  # candidates of a ranking that are shown
# Of unknown image models:
_TINT = 0.1  # weight of the gains' spread over the colours: lamps are nearly white
_LEAST_GAIN, _MOST_GAIN = 0.05, 20.0  # beyond, pictures show nothing, or nothing else
_ROUNDS, _ITERATIONS = 3, 2  # of image model and poses in turn, at most; of Gauss-Newton in each
_STILL_RAD = np.deg2rad(1.0)  # a lamp that moves less in a round has been found
_SETTLED = 2e-4  # photometric loss; pictures decoded wrongly ended at 3e-4 and more


@dataclass(frozen=True, slots=True)
class FirstFrameConfig:
    """Settings of `estimate_first`.

    Attributes:
        starts: orientations of each object that CMA-ES refines.
        population: population of CMA-ES for one object and start, by the masked loss (eq. 5).
        generations: its generations.
        joint_population: population of CMA-ES for the whole scene, by the photometric loss (eq. 6).
        joint_generations: its generations.
        coarse_iterations: iterations of Gauss-Newton at half the resolution.
        fine_iterations: iterations of Gauss-Newton at full resolution.
        light: "search" to search the hemisphere before CMA-ES, "cma" for CMA-ES alone, starting from a light overhead
            as in the paper.
        held_light: unit vector toward a known light, which is then not estimated; None to estimate the light.
    """

    starts: int = 3
    population: int = 10
    generations: int = 8
    joint_population: int = 16
    joint_generations: int = 5
    coarse_iterations: int = 3
    fine_iterations: int = 3
    light: Literal["search", "cma"] = "search"
    held_light: tuple[float, float, float] | None = None


def estimate_first(
    models: ObjectModels, observation: Observation, rng: np.random.Generator, config: FirstFrameConfig | None = None
) -> Iterator[EstimateStep]:
    """Estimate the poses of all objects and the light from images with masks, without an initial guess.

    Args:
        models: models of the objects and the table.
        observation: one or more views with masks. Any exposure works, and both linear and sRGB values.
        rng: random generator of the searches.
        config: settings. With `held_light`, the exposure is assumed to be the usual one.

    Returns:
        Steps of the search. The last one has `estimate`, and `image_model` if the exposure is not the usual one.

    Raises:
        InvalidInput: if there are no masks, or all masks of an object are empty.
        UnknownName: if an object has no field.

    Example:
        >>> from osfcore.estimation.first_frame import FirstFrameConfig
        >>> quick = FirstFrameConfig(starts=1, fine_iterations=1)
        >>> *_, last = estimate_first(models, observation, np.random.default_rng(0), quick)
        >>> error = last.estimate.state.pose(name).position - state.pose(name).position
        >>> bool(np.linalg.norm(error) < 0.002)  # [m]
        True
    """
    config = config or FirstFrameConfig()
    models.check(observation.names)
    _check_masks(observation)
    can_adapt = models.can_change and config.held_light is None and len(observation.names) > 0
    verdict = check_table(models, views_of(observation, FINE_SIDE)) if can_adapt else "usual"
    if verdict == "usual":
        yield from estimate_first_calibrated(models, observation, rng, config)
        return
    calibrator = Calibrator(models, observation.names)
    if verdict == "unclear":
        last = yield from all_but_last(estimate_first_calibrated(models, observation, rng, config))
        if _is_settled(last):
            yield last
            return
        assert last.estimate is not None
        params = SceneParameters.of(last.estimate.state, observation.pusher)
        views = views_of(observation, _COARSE_SIDE, samples=2)
        if calibrator.refine(views, params, 1.0, hold_light=True).model.is_usual:
            yield last
            return
    poses = _rough_poses(models, observation)
    both = (_calibrated(calibrator, observation, poses, encoding) for encoding in get_args(Encoding))
    found: list[EstimateStep] = []
    for one in sorted((one for one in both if one.is_sane), key=lambda one: one.loss):
        if found:  # and leaves much unexplained
            yield replace(found[0], estimate=None)
        found.append((yield from all_but_last(_estimate_with(models, calibrator, one, rng, config))))
        if _is_settled(found[-1]):
            break
    if found:
        yield min(found, key=lambda last: (not _is_settled(last), last.loss))
    else:
        yield from estimate_first_calibrated(models, observation, rng, config)


def estimate_first_calibrated(
    models: ObjectModels, observation: Observation, rng: np.random.Generator, config: FirstFrameConfig | None = None
) -> Iterator[EstimateStep]:
    """Estimate all poses and the light in images like those that the fields were trained for.

    Arguments, steps and errors are the same as for `estimate_first`.
    """
    models.check(observation.names)
    _check_masks(observation)
    yield from _FirstFrameEstimator(models, observation, rng, config or FirstFrameConfig()).steps()


def _check_masks(observation: Observation) -> None:
    """Check that an observation has a mask of each object.

    Raises:
        InvalidInput: if there are no masks, or all masks of an object are empty.
    """
    if observation.masks is None:
        raise InvalidInput("masks of the first frame", "missing", "given: one per camera and object")
    for name, masks in zip(observation.names, np.moveaxis(observation.masks, 1, 0), strict=True):
        if not masks.any():
            raise InvalidInput(f"mask of {name}", "empty in every view", "not empty in at least one view")


class _FirstFrameEstimator:
    """One estimation; `steps` runs it."""

    def __init__(
        self, models: ObjectModels, observation: Observation, rng: np.random.Generator, config: FirstFrameConfig
    ) -> None:
        self._models, self._rng, self._config = models, rng, config
        self._names, self._pusher = observation.names, observation.pusher
        self._coarse = views_of(observation, _COARSE_SIDE)
        self._middle = views_of(observation, _COARSE_SIDE, samples=2)
        self._rough = views_of(observation, _ROUGH_SIDE)
        self._sharp = views_of(observation, FINE_SIDE)
        self._fine = views_of(observation, FINE_SIDE, samples=2)
        searches = config.generations + config.joint_generations
        refinements = config.coarse_iterations + config.fine_iterations
        self._reporter = StepReporter(3 * len(self._names) + searches + refinements + 2)
        self._rivals: dict[int, float] = {}
        self._held = None if config.held_light is None else np.array(config.held_light)

    def steps(self) -> Iterator[EstimateStep]:
        parts = [_visible_part(self._coarse, n) for n in range(len(self._names))]
        better = [_visible_part(self._middle, n) for n in range(len(self._names))]
        starts: list[RankedPoses] = []
        for name, part in zip(self._names, parts, strict=True):
            starts.append(initial_poses(self._models, name, part))
            yield self._ranking_step("orientations", f"{name}: possible orientations", starts, OVERHEAD)
        light = self._held
        if light is None and self._config.light == "search":
            light = search_light(self._models, self._rough, self._coarse, self._initial_guess(starts, OVERHEAD))
        if light is None:
            light = OVERHEAD
        else:
            yield self._ranking_step("light", "Shading and shadows", starts, light)
            for n, name in enumerate(self._names):
                # The best again in full resolution, in which labels show.
                for views, count in ((self._coarse, len(starts[n].losses)), (self._sharp, _RANKED_SHARP)):
                    own, poses = _visible_part(views, n), starts[n].poses[:count]
                    starts[n] = rank_poses(self._models, name, own, poses, light)
                yield self._ranking_step("orientations", f"{name}: under this light", starts, light)
        starts = [found.distinct(self._config.starts) for found in starts]
        starts = yield from self._search_each(better, starts, light)
        params = yield from self._search_jointly(self._initial_guess(starts, light))
        at = yield from self._refine(params)
        at = yield from self._compare_orientations(at, starts)
        fit, is_held = evaluate_fit(self._models, self._fine, at.params), self._held is not None
        allowed = relative_allowance(fit)
        estimate = estimate_with_uncertainty(
            at.params, at.normals, fit, self._rivals, light_held=is_held, allowed=allowed
        )
        yield self._reporter.finish(at, estimate)

    def _search_each(
        self, parts: list[ObjectView], starts: list[RankedPoses], light: np.ndarray
    ) -> Iterator[EstimateStep]:  # returns the refined starts
        """Search each object's pose from its starts by CMA-ES on the masked loss (eq. 5), with the light held."""
        population, brightness = self._config.population, self._held is None and self._config.light == "cma"
        searches = [
            MultistartCMA(
                self._models, name, part, own, light, population=population, rng=self._rng, any_brightness=brightness
            )
            for name, part, own in zip(self._names, parts, starts, strict=True)
        ]
        for _ in range(self._config.generations):
            tried = [search.advance() for search in searches]
            shown, losses = [poses for poses, _ in tried], [loss for _, loss in tried]
            best = self._initial_guess(starts, light)
            sigma = searches[0].sigma if searches else 1.0
            yield self._reporter.step("objects", "Each object in its masks", best, shown, losses, sigma)
        refined = []
        for n, (name, search) in enumerate(zip(self._names, searches, strict=True)):
            part, ends = _visible_part(self._fine, n), search.best_poses()
            found = rank_poses(self._models, name, part, ends, light, any_brightness=brightness)
            refined.append(found.distinct(_HYPOTHESES))
        return refined

    def _search_jointly(self, params: SceneParameters) -> Iterator[EstimateStep]:  # returns the guess
        """Search all poses and the light by CMA-ES on the photometric loss of whole images (eq. 6)."""
        config = self._config
        spread = 0.0 if self._held is not None else {"search": _LIGHT_RAD, "cma": _UNKNOWN_RAD}[config.light]
        scales = np.array([*([SHIFT_M / 2] * 3 + [TURN_RAD / 2] * 3) * len(self._names), *[spread] * LIGHT])
        search = search_scene(
            self._models, self._middle, params, scales,
            population=config.joint_population, generations=config.joint_generations, rng=self._rng,
        )  # fmt: skip
        for found in search:
            params, note = found.best, "All objects and the light"
            yield self._reporter.step("together", note, params, found.tried, [], found.sigma, found.lights, found.loss)
        return params

    def _refine(self, params: SceneParameters) -> Iterator[EstimateStep]:  # returns a GaussNewtonState
        """Refine all poses and the light by Gauss-Newton, coarse to fine."""
        config = self._config
        light = None if self._held is not None else self._middle
        at = GaussNewtonState.at(params)
        rounds = (self._middle, config.coarse_iterations), (self._fine, config.fine_iterations)
        for views, iterations in rounds:
            sweeps = gauss_newton(self._models, views, at, iterations=iterations, light=light)
            at = yield from self._reporter.refinements("Refining all poses", at, sweeps)
        return at

    def _compare_orientations(
        self, at: GaussNewtonState, starts: list[RankedPoses]
    ) -> Iterator[EstimateStep]:  # returns a GaussNewtonState
        """Replace each object's orientation by a hypothesis with which the whole images fit better, if there is one."""
        for n, found in enumerate(starts):
            turned = (find(self._models, at.params, n) for find in (yaw_hypotheses, side_hypotheses))
            others = Pose.joined(found.poses, *turned)
            at, self._rivals[n] = compare_orientations(
                self._models, self._coarse, self._middle, self._fine, at, n, others
            )
            yield self._reporter.refinement(f"{self._names[n]}: turned around", at)
        return at

    def _initial_guess(self, starts: list[RankedPoses], light: np.ndarray) -> SceneParameters:
        """Return the best pose of each object. Objects without a pose yet are put far below the table, out of view."""
        best = [found.poses[0] for found in starts]
        poses = Pose.stacked(best + [OUT_OF_VIEW] * (len(self._names) - len(best)))
        return SceneParameters(self._names, poses.position, poses.quaternion, light, self._pusher)

    def _ranking_step(self, stage: Stage, note: str, starts: list[RankedPoses], light: np.ndarray) -> EstimateStep:
        params = self._initial_guess(starts, light)
        shown = [found.poses[:_SHOWN] for found in starts]
        return self._reporter.step(stage, note, params, shown, [float(s.losses[0]) for s in starts])


def _visible_part(views: ObservedViews, number: int) -> ObjectView:
    """Crop the images to an object. A mask too thin for this resolution is replaced by its strongest pixel."""
    assert views.masks is not None
    own = views.masks[:, number]
    if own.max() > 0.5:
        return crop_to_masks(views, number)
    masks = views.masks.copy()
    masks[:, number] = own / own.max()
    return crop_to_masks(replace(views, masks=masks), number)


# Images of unknown exposure, encoding, ambient light and table.


def _is_settled(last: EstimateStep) -> bool:
    """Return whether an estimate needs no other image model."""
    return last.loss < _SETTLED and last.estimate is not None and last.estimate.trusted


@dataclass(frozen=True, eq=False, slots=True)
class _Calibrated:
    """Images decoded with one encoding, and the image model fitted to them."""

    encoding: Encoding
    observation: Observation
    found: Calibration

    @property
    def loss(self) -> float:
        return self.found.unexplained + _TINT * float(np.std(np.log(self.found.model.gain)))

    @property
    def is_sane(self) -> bool:
        gain = self.found.model.gain
        return bool(np.all((gain > _LEAST_GAIN) & (gain < _MOST_GAIN)))


def _rough_poses(models: ObjectModels, observation: Observation) -> SceneParameters:
    """Return the pose of each object that fits its masks best, at any brightness."""
    coarse = views_of(observation, _COARSE_SIDE)
    parts = ((name, _visible_part(coarse, n)) for n, name in enumerate(observation.names))
    best = Pose.stacked(initial_poses(models, name, part).poses[0] for name, part in parts)
    return SceneParameters(observation.names, best.position, best.quaternion, OVERHEAD, observation.pusher)


def _calibrated(
    calibrator: Calibrator, observation: Observation, params: SceneParameters, encoding: Encoding
) -> _Calibrated:
    """Fit an image model to images of this encoding, at rough poses."""
    images = linear_from_encoded(observation.images, encoding).astype(np.float32)
    linear = replace(observation, images=images)
    found = calibrator.search(views_of(linear, _ROUGH_SIDE), views_of(linear, _COARSE_SIDE), params)
    return _Calibrated(encoding, linear, found)


def _estimate_with(
    models: ObjectModels, calibrator: Calibrator, rough: _Calibrated, rng: np.random.Generator, config: FirstFrameConfig
) -> Iterator[EstimateStep]:
    """Run the usual method on adapted images and models, then refine the image model and the poses."""
    model, linear, more = rough.found.model, rough.observation, (_ROUNDS + 1) * _ITERATIONS
    usual = estimate_first_calibrated(adapted(models, linear.names, model), model.normalized(linear), rng, config)
    before = next(usual)
    for step in usual:
        progress = before.progress
        yield replace(before, progress=Progress(progress.done, progress.total + more, progress.note))
        before = step
    assert before.estimate is not None
    reporter = StepReporter(before.progress.total + more)
    reporter.done = before.progress.total - 1
    yield from _refine_with_image_model(models, calibrator, rough, before.estimate, reporter)


def _refine_with_image_model(
    models: ObjectModels, calibrator: Calibrator, rough: _Calibrated, estimate: EstimatedState, reporter: StepReporter
) -> Iterator[EstimateStep]:
    """Fit image model, poses and lamp in turn until the lamp stays still.

    The image model is first searched again, since the one from rough poses may be far off.
    """
    linear = rough.observation
    at = GaussNewtonState.at(SceneParameters.of(estimate.state, linear.pusher))
    small, middle, fine = (views_of(linear, side, samples=2) for side in (_ROUGH_SIDE, _COARSE_SIDE, FINE_SIDE))
    found = calibrator.search(small, middle, at.params)
    for _ in range(_ROUNDS):
        before = at.params.light
        at = yield from _refine_poses_and_lamp(models, linear, found, at, reporter)
        if at.params.light @ before > np.cos(_STILL_RAD):
            break
        found = calibrator.refine(fine, at.params, found.model.ambient, hold_light=False)
    found = calibrator.refine(fine, at.params, found.model.ambient, hold_light=True)
    at = yield from _refine_poses_and_lamp(models, linear, found, at, reporter)
    model = replace(found.model, encoding=rough.encoding)
    sharp = views_of(found.model.normalized(linear), FINE_SIDE, samples=2)
    fit = evaluate_fit(adapted(models, linear.names, model), sharp, at.params)
    rivals = {n: 1.0 for n, doubt in enumerate(estimate.doubts) if doubt == AMBIGUOUS}
    sure = estimate_with_uncertainty(at.params, at.normals, fit, rivals, allowed=relative_allowance(fit))
    yield replace(reporter.finish(at, sure), image_model=model)


def _refine_poses_and_lamp(
    models: ObjectModels, linear: Observation, found: Calibration, at: GaussNewtonState, reporter: StepReporter
) -> Iterator[EstimateStep]:  # returns a GaussNewtonState
    """Refine poses and lamp by Gauss-Newton, with models and images adapted by a calibration."""
    fitting, normal = adapted(models, linear.names, found.model), found.model.normalized(linear)
    sharp, soft = (views_of(normal, side, samples=2) for side in (FINE_SIDE, _COARSE_SIDE))
    at = GaussNewtonState.at(replace(at.params, light=found.light))
    sweeps = gauss_newton(fitting, sharp, at, iterations=_ITERATIONS, light=soft)
    return (yield from reporter.refinements("Exposure and table", at, sweeps))
