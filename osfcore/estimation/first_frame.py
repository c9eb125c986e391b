"""The first frame: all poses and the light from images with masks (paper section 4.2).

In the paper's order: the light is held overhead and each object's pose is optimised by CMA-ES within its own masks
(eq. 5); then CMA-ES optimises all poses and the light over whole images (eq. 6). Deviations: the first part starts from
every resting orientation of an object rather than from one guess, since the loss has many local minima over
orientations; a grid search of the hemisphere initialises the light; Gauss-Newton refines what CMA-ES finds.
"""

from __future__ import annotations

from collections.abc import Iterator
from dataclasses import dataclass, replace
from typing import Literal

import numpy as np

from osfcore.errors import InvalidInput
from osfcore.estimation.hypotheses import compare_orientations, side_hypotheses, yaw_hypotheses
from osfcore.estimation.objective import (
    FINE_SIDE,
    LIGHT,
    ObjectModels,
    ObjectView,
    ObservedViews,
    SceneParameters,
    crop_to_masks,
    photometric_loss,
    residuals,
    views_of,
)
from osfcore.estimation.search import (
    CMAES,
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
)
from osfcore.estimation.steps import EstimateStep, Stage
from osfcore.estimation.uncertainty import estimate_with_uncertainty, evaluate_fit, relative_allowance
from osfcore.geometry.poses import Pose
from osfcore.geometry.states import Observation

_COARSE_SIDE, _ROUGH_SIDE = FINE_SIDE // 2, FINE_SIDE // 4
_LIGHT_RAD, _UNKNOWN_RAD = 0.03, 0.6  # the first spread of the light, where it was searched before and where not
_HYPOTHESES = 3  # orientations of each object that the whole images choose from
_RANKED_SHARP = 100
_SHOWN = 24  # candidates of a ranking that are shown


@dataclass(frozen=True, slots=True)
class FirstFrameConfig:
    """How much work a first estimate is.

    Attributes:
        starts: orientations of each object that CMA refines.
        population: of CMA-ES for one object and start, by the masked loss (eq. 5).
        generations: likewise.
        joint_population: of CMA-ES for the whole scene, by the photometric loss (eq. 6).
        joint_generations: likewise.
        coarse_iterations: of Gauss-Newton at half the resolution.
        fine_iterations: at full resolution.
        light: "search" for a search of the hemisphere before CMA, "cma" for CMA alone from overhead as in the paper.
        held_light: unit vector toward a light that is not estimated, to measure what knowing it is worth; None to
            estimate it.
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
    """Find all poses and the light; the last step holds the estimate.

    Args:
        models: fields of the objects and the table.
        observation: one or more views with masks.
        rng: of the searches.
        config: how much work to do.

    Raises:
        InvalidInput: without masks, or if an object's masks are all empty.
        UnknownName: if an object has no field.
    """
    models.check(observation.names)
    check_masks(observation)
    yield from _FirstFrameEstimator(models, observation, rng, config or FirstFrameConfig()).steps()


def check_masks(observation: Observation) -> None:
    """Refuse an observation that does not show where each object is.

    Raises:
        InvalidInput: without masks, or if an object's masks are all empty.
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
        parts = [visible_part(self._coarse, n) for n in range(len(self._names))]
        better = [visible_part(self._middle, n) for n in range(len(self._names))]
        starts: list[RankedPoses] = []
        for name, part in zip(self._names, parts, strict=True):
            starts.append(initial_poses(self._models, name, part))
            yield self._ranking_step("orientations", f"{name}: how it may lie", starts, OVERHEAD)
        light = self._held
        if light is None and self._config.light == "search":
            light = search_light(self._models, self._rough, self._coarse, self._initial_guess(starts, OVERHEAD))
        if light is None:
            light = OVERHEAD
        else:
            yield self._ranking_step("light", "Shading and shadows", starts, light)
            for n, name in enumerate(self._names):
                starts[n] = self._rerank(n, starts[n], light)
                yield self._ranking_step("orientations", f"{name}: under this light", starts, light)
        starts = [found.distinct(self._config.starts) for found in starts]
        starts = yield from self._search_each(better, starts, light)
        params = yield from self._search_jointly(self._initial_guess(starts, light))
        at = yield from self._refine(params)
        at = yield from self._compare_orientations(at, starts)
        yield self._finish(at)

    def _rerank(self, n: int, starts: RankedPoses, light: np.ndarray) -> RankedPoses:
        """Rank poses again under a known light, the best in full resolution, where labels tell sides apart."""
        for views, count in ((self._coarse, len(starts.losses)), (self._sharp, _RANKED_SHARP)):
            part, best = visible_part(views, n), starts.best(count)
            starts = rank_poses(self._models, self._names[n], part, best.positions, best.quaternions, light)
        return starts

    def _search_each(
        self, parts: list[ObjectView], starts: list[RankedPoses], light: np.ndarray
    ) -> Iterator[EstimateStep]:  # returns the refined starts
        """MultistartCMA of each object's pose by the masked loss (eq. 5), the light held."""
        population, brightness = self._config.population, self._held is None and self._config.light == "cma"
        searches = [
            MultistartCMA(
                self._models, name, part, own, light, population=population, rng=self._rng, any_brightness=brightness
            )
            for name, part, own in zip(self._names, parts, starts, strict=True)
        ]
        for _ in range(self._config.generations):
            tried = [search.advance() for search in searches]
            shown, losses = [t.candidates for t in tried], [t.loss for t in tried]
            best = self._initial_guess(starts, light)
            sigma = tried[0].sigma if tried else 1.0
            yield self._reporter.step("objects", "Each object in its masks", best, shown, losses, sigma)
        refined = []
        for n, (name, search) in enumerate(zip(self._names, searches, strict=True)):
            part, ends = visible_part(self._fine, n), search.best_poses()
            found = rank_poses(
                self._models, name, part, ends.position, ends.quaternion, light, any_brightness=brightness
            )
            refined.append(found.distinct(_HYPOTHESES))
        return refined

    def _search_jointly(self, params: SceneParameters) -> Iterator[EstimateStep]:  # returns the guess
        """CMA-ES over all poses and the light by the photometric loss of whole images (eq. 6)."""
        config = self._config
        spread = 0.0 if self._held is not None else {"search": _LIGHT_RAD, "cma": _UNKNOWN_RAD}[config.light]
        scales = np.array([*([SHIFT_M / 2] * 3 + [TURN_RAD / 2] * 3) * len(self._names), *[spread] * LIGHT])
        search = CMAES(scales, config.joint_population, self._rng)
        best, least = params, np.inf
        for _ in range(config.joint_generations):
            batch = params.perturbed(np.concatenate([np.zeros((1, params.size)), search.ask()]))
            losses = photometric_loss(residuals(self._models, self._middle, batch))
            search.tell(losses[1:])
            k = int(np.argmin(losses))
            if losses[k] < least:
                least = float(losses[k])
                found = batch.positions[k], batch.quaternions[k], batch.lights[k]
                best = replace(params, positions=found[0], quaternions=found[1], light=found[2])
            poses = [Pose(batch.positions[:, n], batch.quaternions[:, n]) for n in range(len(self._names))]
            note = "All objects and the light"
            yield self._reporter.step("together", note, best, poses, [], search.sigma, batch.lights, least)
        return best

    def _refine(self, params: SceneParameters) -> Iterator[EstimateStep]:  # returns a GaussNewtonState
        """Gauss-Newton over all poses and the light, coarse to fine."""
        config = self._config
        light = None if self._held is not None else self._middle
        at = GaussNewtonState.at(params)
        rounds = (self._middle, config.coarse_iterations), (self._fine, config.fine_iterations)
        for views, iterations in rounds:
            for step in gauss_newton(self._models, views, at, iterations=iterations, light=light):
                at = step
                yield self._reporter.refinement("The last millimetres", at)
        return at

    def _compare_orientations(
        self, at: GaussNewtonState, starts: list[RankedPoses]
    ) -> Iterator[EstimateStep]:  # returns a GaussNewtonState
        """Replace each object's orientation by any hypothesis under which the whole images fit better."""
        for n, found in enumerate(starts):
            turned = (find(self._models, at.params, n) for find in (yaw_hypotheses, side_hypotheses))
            others = Pose.joined(Pose(found.positions, found.quaternions), *turned)
            at, self._rivals[n] = compare_orientations(
                self._models, self._coarse, self._middle, self._fine, at, n, others
            )
            yield self._reporter.refinement(f"{self._names[n]}: the other way round", at)
        return at

    def _finish(self, at: GaussNewtonState) -> EstimateStep:
        fit = evaluate_fit(self._models, self._fine, at.params)
        estimate = estimate_with_uncertainty(
            at.params, at.normals, fit, self._rivals, light_held=self._held is not None, allowed=relative_allowance(fit)
        )
        return self._reporter.finish(at, estimate)

    def _initial_guess(self, starts: list[RankedPoses], light: np.ndarray) -> SceneParameters:
        """The best of each object's poses; objects without any yet are put far below the table, out of view."""
        count = len(self._names)
        positions = np.tile([0.0, 0.0, -1.0], (count, 1))
        quaternions = np.tile([1.0, 0.0, 0.0, 0.0], (count, 1))
        for n, found in enumerate(starts):
            positions[n], quaternions[n] = found.positions[0], found.quaternions[0]
        return SceneParameters(self._names, positions, quaternions, light, self._pusher)

    def _ranking_step(self, stage: Stage, note: str, starts: list[RankedPoses], light: np.ndarray) -> EstimateStep:
        params = self._initial_guess(starts, light)
        shown = [Pose(s.positions[:_SHOWN], s.quaternions[:_SHOWN]) for s in starts]
        return self._reporter.step(stage, note, params, shown, [float(s.losses[0]) for s in starts])


def visible_part(views: ObservedViews, number: int) -> ObjectView:
    """An object's part; where its masks are too thin for this resolution, their brightest pixel stands for them."""
    assert views.masks is not None
    own = views.masks[:, number]
    if own.max() > 0.5:
        return crop_to_masks(views, number)
    masks = views.masks.copy()
    masks[:, number] = own / own.max()
    return crop_to_masks(replace(views, masks=masks), number)
