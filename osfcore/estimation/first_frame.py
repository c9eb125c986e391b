"""The first frame: all poses and the light from images with masks (paper section 4.2).

In the paper's order: the light is held overhead and each object is searched inside its own masks (eq. 5); then poses
and light together explain the whole images (eq. 6). Deviations: the first part begins with every way an object can
lie on a table, not with one guess, since orientation has many local minima; the light is found by a search of the
hemisphere before CMA refines it; Gauss-Newton finishes what CMA began.
"""

from __future__ import annotations

from collections.abc import Iterator
from dataclasses import dataclass, replace
from typing import Literal

import numpy as np

from osfcore.errors import InvalidInput
from osfcore.estimation.hypotheses.orientation_hypotheses import compare_orientations, turned
from osfcore.estimation.objective.object_models import ObjectModels
from osfcore.estimation.objective.observed_views import FINE_SIDE, ObjectView, ObservedViews, part_of, views_of
from osfcore.estimation.objective.parametrization import LIGHT, SceneParameters
from osfcore.estimation.objective.photometric_loss import photometric_loss, residuals
from osfcore.estimation.search.cma_es import CMAES
from osfcore.estimation.search.gauss_newton import GaussNewtonState, gauss_newton
from osfcore.estimation.search.light_search import search_light
from osfcore.estimation.search.multistart_cma import SHIFT_M, TURN_RAD, MultistartCMA
from osfcore.estimation.search.pose_initialization import OVERHEAD, RankedPoses, initial_poses, rank_poses
from osfcore.estimation.steps import EstimateStep, Stage
from osfcore.estimation.uncertainty import gather, judged
from osfcore.geometry.poses import Pose
from osfcore.geometry.states import Observation
from osfcore.progress import Progress

_COARSE_SIDE, _ROUGH_SIDE = FINE_SIDE // 2, FINE_SIDE // 4
_LIGHT_RAD = 0.03  # the first spread of the light, where it was searched before
_RIVALS = 3  # orientations of each object that the whole images choose from
_RANKED_SHARP = 100
_SHOWN = 24  # candidates of a ranking that are shown


@dataclass(frozen=True, slots=True)
class FirstFrameConfig:
    """How much work a first estimate is.

    Attributes:
        starts: orientations of each object that CMA refines.
        population: candidates per generation and start, masked (eq. 5).
        generations: masked.
        joint_population: candidates per generation of the whole scene (eq. 6).
        joint_generations: likewise.
        coarse_iterations: of the final descent on half the resolution.
        fine_iterations: at full resolution.
        light: "search" for a search of the hemisphere before CMA, "cma" for CMA alone from overhead as in the paper,
            "overhead" to hold it there (to measure what knowing the light is worth).
    """

    starts: int = 3
    population: int = 10
    generations: int = 8
    joint_population: int = 16
    joint_generations: int = 5
    coarse_iterations: int = 3
    fine_iterations: int = 3
    light: Literal["search", "cma", "overhead"] = "search"


def estimate_first(
    models: ObjectModels, observation: Observation, rng: np.random.Generator, effort: FirstFrameConfig | None = None
) -> Iterator[EstimateStep]:
    """Find all poses and the light; the last step holds the estimate.

    Args:
        models: fields of the objects and the table.
        observation: one or more views with masks.
        rng: of the searches.
        effort: how much work to do.

    Raises:
        InvalidInput: without masks, or if an object's masks are all empty.
        UnknownName: if an object has no field.
    """
    models.check(observation.names)
    _check_masks(observation)
    yield from _First(models, observation, rng, effort or FirstFrameConfig()).steps()


def _check_masks(observation: Observation) -> None:
    if observation.masks is None:
        raise InvalidInput("masks of the first frame", "missing", "given: one per camera and object")
    for name, masks in zip(observation.names, np.moveaxis(observation.masks, 1, 0), strict=True):
        if not masks.any():
            raise InvalidInput(f"mask of {name}", "empty in every view", "not empty in at least one view")


class _First:
    """The state of one estimation between its steps."""

    def __init__(
        self, models: ObjectModels, observation: Observation, rng: np.random.Generator, effort: FirstFrameConfig
    ) -> None:
        self._models, self._rng, self._effort = models, rng, effort
        self._names, self._pusher = observation.names, observation.pusher
        self._coarse = views_of(observation, _COARSE_SIDE)
        self._middle = views_of(observation, _COARSE_SIDE, samples=2)
        self._rough = views_of(observation, _ROUGH_SIDE)
        self._sharp = views_of(observation, FINE_SIDE)
        self._fine = views_of(observation, FINE_SIDE, samples=2)
        e = effort
        count = len(self._names)
        self._total = (
            2 * count + 1 + e.generations + e.joint_generations + e.coarse_iterations + e.fine_iterations + count + 1
        )
        self._done = 0
        self._rivals: dict[int, float] = {}

    def steps(self) -> Iterator[EstimateStep]:
        parts = [_visible_part(self._coarse, n) for n in range(len(self._names))]
        better = [_visible_part(self._middle, n) for n in range(len(self._names))]
        starts: list[RankedPoses] = []
        for name, part in zip(self._names, parts, strict=True):
            starts.append(initial_poses(self._models, name, part))
            yield self._ranking("orientations", f"{name}: how it may lie", starts, OVERHEAD)
        light = OVERHEAD
        if self._effort.light == "search":
            light = search_light(self._models, self._rough, self._coarse, self._guess(starts, OVERHEAD))
            yield self._ranking("light", "Shading and shadows", starts, light)
            for n, name in enumerate(self._names):
                starts[n] = self._ranked_again(n, starts[n], light)
                yield self._ranking("orientations", f"{name}: under this light", starts, light)
        starts = [found.distinct(self._effort.starts) for found in starts]
        starts = yield from self._search_objects(better, starts, light)
        guess = yield from self._search_together(self._guess(starts, light))
        at = yield from self._descend(guess)
        at = yield from self._compare(at, starts)
        yield self._finish(at)

    def _ranked_again(self, n: int, starts: RankedPoses, light: np.ndarray) -> RankedPoses:
        """In the order that the light gives, the best of them in full resolution: labels tell sides apart."""
        for views, count in ((self._coarse, len(starts.losses)), (self._sharp, _RANKED_SHARP)):
            part, best = _visible_part(views, n), starts.best(count)
            starts = rank_poses(self._models, self._names[n], part, best.positions, best.quaternions, light)
        return starts

    def _search_objects(
        self, parts: list[ObjectView], starts: list[RankedPoses], light: np.ndarray
    ) -> Iterator[EstimateStep]:  # returns the refined starts
        e, brightness = self._effort, self._effort.light == "cma"
        swarms = [
            MultistartCMA(
                self._models, name, part, own, light, population=e.population, rng=self._rng, any_brightness=brightness
            )
            for name, part, own in zip(self._names, parts, starts, strict=True)
        ]
        for _ in range(e.generations):
            tried = [swarm.advance() for swarm in swarms]
            shown, losses = [t.candidates for t in tried], [t.loss for t in tried]
            best = self._guess(starts, light)
            sigma = tried[0].sigma if tried else 1.0
            yield self._step("objects", "Each object in its masks", best, shown, losses, sigma)
        refined = []
        for n, (name, swarm) in enumerate(zip(self._names, swarms, strict=True)):
            part, ends = _visible_part(self._fine, n), swarm.ends()
            found = rank_poses(
                self._models, name, part, ends.position, ends.quaternion, light, any_brightness=brightness
            )
            refined.append(found.distinct(_RIVALS))
        return refined

    def _search_together(self, guess: SceneParameters) -> Iterator[EstimateStep]:  # returns the guess
        e = self._effort
        spread = {"search": _LIGHT_RAD, "cma": 0.6, "overhead": 0.0}[e.light]
        scales = np.array([*([SHIFT_M / 2] * 3 + [TURN_RAD / 2] * 3) * len(self._names), *[spread] * LIGHT])
        search = CMAES(scales, e.joint_population, self._rng)
        best, least = guess, np.inf
        for _ in range(e.joint_generations):
            batch = guess.moved(np.concatenate([np.zeros((1, guess.size)), search.ask()]))
            losses = photometric_loss(residuals(self._models, self._middle, batch))
            search.tell(losses[1:])
            k = int(np.argmin(losses))
            if losses[k] < least:
                least = float(losses[k])
                found = batch.positions[k], batch.quaternions[k], batch.lights[k]
                best = replace(guess, positions=found[0], quaternions=found[1], light=found[2])
            poses = [Pose(batch.positions[:, n], batch.quaternions[:, n]) for n in range(len(self._names))]
            note = "All objects and the light"
            yield self._step("together", note, best, poses, [], search.sigma, batch.lights, least)
        return best

    def _descend(self, guess: SceneParameters) -> Iterator[EstimateStep]:  # returns the last Descent
        light = None if self._effort.light == "overhead" else self._middle
        at = GaussNewtonState.at(guess)
        e = self._effort
        rounds = (self._middle, e.coarse_iterations), (self._fine, e.fine_iterations)
        for views, iterations in rounds:
            for step in gauss_newton(self._models, views, at, iterations=iterations, light=light):
                at = step
                yield self._polishing("The last millimetres", at)
        return at

    def _compare(
        self, at: GaussNewtonState, starts: list[RankedPoses]
    ) -> Iterator[EstimateStep]:  # returns the better Descent
        """Put other orientations of each object into the scene and let the whole images decide."""
        for n, found in enumerate(starts):
            others = Pose.joined(Pose(found.positions, found.quaternions), turned(self._models, at.guess, n))
            at, self._rivals[n] = compare_orientations(
                self._models, self._coarse, self._middle, self._fine, at, n, others
            )
            yield self._polishing(f"{self._names[n]}: the other way round", at)
        return at

    def _finish(self, at: GaussNewtonState) -> EstimateStep:
        evidence = gather(self._models, self._fine, at.guess)
        estimate = judged(at.guess, at.normals, evidence, self._rivals, light_held=self._effort.light == "overhead")
        self._done = self._total - 1
        step = self._polishing("Done" if estimate.trusted else estimate.reason, at)
        return replace(step, stage="done", estimate=estimate)

    def _polishing(self, note: str, at: GaussNewtonState) -> EstimateStep:
        return self._step("polish", note, at.guess, losses=at.losses[:-1].tolist(), loss=float(at.losses[-1]))

    def _guess(self, starts: list[RankedPoses], light: np.ndarray) -> SceneParameters:
        """The best of each object's poses; objects not looked at yet are put far below the table."""
        count = len(self._names)
        positions = np.tile([0.0, 0.0, -1.0], (count, 1))
        quaternions = np.tile([1.0, 0.0, 0.0, 0.0], (count, 1))
        for n, found in enumerate(starts):
            positions[n], quaternions[n] = found.positions[0], found.quaternions[0]
        return SceneParameters(self._names, positions, quaternions, light, self._pusher)

    def _ranking(self, stage: Stage, note: str, starts: list[RankedPoses], light: np.ndarray) -> EstimateStep:
        guess = self._guess(starts, light)
        shown = [Pose(s.positions[:_SHOWN], s.quaternions[:_SHOWN]) for s in starts]
        return self._step(stage, note, guess, shown, [float(s.losses[0]) for s in starts])

    def _step(
        self,
        stage: Stage,
        note: str,
        guess: SceneParameters,
        shown: list[Pose] | None = None,
        losses: list[float] | None = None,
        sigma: float = 1.0,
        lights: np.ndarray | None = None,
        loss: float = float("nan"),
    ) -> EstimateStep:
        self._done = min(self._done + 1, self._total)
        candidates = None
        if shown and len(shown) == len(self._names):
            count = min(len(p.position) for p in shown)
            candidates = Pose(
                np.stack([p.position[:count] for p in shown], 1), np.stack([p.quaternion[:count] for p in shown], 1)
            )
        progress = Progress(self._done, self._total, note)
        return EstimateStep(progress, stage, guess.state(), candidates, lights, sigma, tuple(losses or ()), loss)


def _visible_part(views: ObservedViews, number: int) -> ObjectView:
    """An object's part; where its masks are too thin for this resolution, their brightest pixel stands for them."""
    assert views.masks is not None
    own = views.masks[:, number]
    if own.max() > 0.5:
        return part_of(views, number)
    masks = views.masks.copy()
    masks[:, number] = own / own.max()
    return part_of(replace(views, masks=masks), number)
