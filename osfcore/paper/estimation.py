"""Inverse parameter estimation as published (paper section 4.2): CMA-ES alone, for poses and light.

The first frame has masks. For some iterations the light is held overhead and each object's pose is optimised by its own
CMA-ES within its masks (eq. 5); then one CMA-ES optimises all poses and the light together (the sum of eq. 5, whose
light stays overhead, and eq. 6). Later frames have no masks: the light is that of the first frame, and one CMA-ES over
the poses begins at the last estimate, with a smaller initial standard deviation, and compares whole images (eq. 6; with
masks after all, as the paper's own evaluation has them, eq. 5 is added as before). Poses are position and quaternion,
s in R^7; the light is a position L^p in R^3 of which the direction counts. There are no resting orientations, no
gradients, no rivals, no predictions, no doubts.

Choices where the paper says nothing: positions begin at the masks' centroids, triangulated, and orientations upright;
the first five iterations have a population large enough to find an orientation; populations, iterations and standard
deviations are chosen so that an estimate takes about as long as ours; images are compared at half their resolution,
rendered as coarsely as our estimation renders them. `osfcore.experiments.paper_estimation` measures other choices.
"""

from __future__ import annotations

from collections.abc import Generator, Iterator, Mapping
from dataclasses import dataclass, replace

import numpy as np
from jaxtyping import Bool, Float, Float32

from osfcore.errors import InvalidInput
from osfcore.estimation.objective import FINE_SIDE, ObjectModels, ObservedViews, SceneParameters, views_of
from osfcore.estimation.search import CMAES, StepReporter
from osfcore.estimation.steps import EstimateStep
from osfcore.geometry.light import MIN_LIGHT_ELEVATION_DEG
from osfcore.geometry.poses import Pose
from osfcore.geometry.states import EstimatedState, Observation, SceneState
from osfcore.render.types import SceneBatch

POSE, LIGHT = 7, 3
OVERHEAD = (0.0, 0.0, 1.0)
_LOWEST_SLOPE = np.tan(np.deg2rad(MIN_LIGHT_ELEVATION_DEG + 1e-3))


@dataclass(frozen=True, slots=True)
class PaperEstimationConfig:
    """How much work an estimate is.

    Attributes:
        masked_iterations: of each search for an object in its masks (the paper's five).
        masked_population: candidates in each.
        joint_iterations: of all poses and the light.
        joint_population: candidates in each.
        later_iterations: of a later frame.
        later_population: candidates in each.
        masked_spread: initial standard deviations in the masks: positions [m], quaternions' numbers.
        joint_spread: of positions [m], quaternions' numbers, light [m] when these poses are refined together.
        later_spread: of positions and quaternions' numbers in later frames, where the light is held.
        rounds: how often the first frame is searched in the masks and as a whole; after the first time eq. 5 has the
            light that was found, not the one overhead.
        converged: overall step of CMA-ES, 1 at the beginning, below which a search of the first frame ends early.
        side: of the images that are compared [px].
    """

    masked_iterations: int = 5
    masked_population: int = 200
    joint_iterations: int = 60
    joint_population: int = 24
    later_iterations: int = 8
    later_population: int = 20
    masked_spread: tuple[float, float] = (0.02, 1.0)
    joint_spread: tuple[float, float, float] = (0.01, 0.15, 0.5)
    later_spread: tuple[float, float] = (0.01, 0.1)
    rounds: int = 1
    converged: float = 0.0
    side: int = FINE_SIDE // 2


def estimate_first(
    models: ObjectModels,
    observation: Observation,
    rng: np.random.Generator,
    config: PaperEstimationConfig,
    starts: Mapping[str, Float[np.ndarray, "K 4"]] | None = None,
) -> Iterator[EstimateStep]:
    """Find all poses and the light; the last step holds the estimate.

    Args:
        models: fields of the objects and the table.
        observation: one or more views with masks.
        rng: of the searches.
        config: how much work to do.
        starts: orientations of each object from which searches in its masks begin, the best of which counts; upright
            alone if None.

    Raises:
        InvalidInput: without masks, or if an object's masks are all empty.
        UnknownName: if an object has no field.
    """
    models.check(observation.names)
    if observation.masks is None:
        raise InvalidInput("masks of the first frame", "missing", "given: one per camera and object")
    views, names = views_of(observation, config.side), observation.names
    masks = [observation.masks[:, n] for n in range(len(names))]
    places = np.array([_triangulated(observation, mask, n) for n, mask in enumerate(masks)]).reshape(-1, 3)
    upright = np.array([[1.0, 0.0, 0.0, 0.0]])
    turned = [upright if starts is None else starts[name] for name in names]
    best = SceneParameters(names, places, np.tile(upright, (len(names), 1)), np.array(OVERHEAD), observation.pusher)
    reporter = StepReporter(config.rounds * (config.masked_iterations + config.joint_iterations) + 1)
    spread = (*config.masked_spread, 0.0)

    def begun(n: int, quaternion: Float[np.ndarray, "4"]) -> _Search:
        alone = SceneParameters((names[n],), best.positions[[n]], quaternion[None], best.light, None)
        return _Search(alone, spread, config.masked_population, rng, config.converged)

    for number in range(1, config.rounds + 1):
        light = best.light  # that eq. 5 has
        searches = [[begun(n, quaternion) for quaternion in turned[n]] for n in range(len(names))]
        best = yield from _search_in_masks(models, views, best, searches, config.masked_iterations, reporter)
        search = _Search(best, config.joint_spread, config.joint_population, rng, config.converged)
        last = yield from _descend(models, views, search, config.joint_iterations, reporter, light)
        best = search.best
        if number == config.rounds:
            yield last


def _search_in_masks(
    models: ObjectModels,
    views: ObservedViews,
    best: SceneParameters,
    searches: list[list[_Search]],
    iterations: int,
    reporter: StepReporter,
) -> Generator[EstimateStep, None, SceneParameters]:
    """Run the searches for each object in its masks; return the scene with the best pose of each."""
    for _ in range(iterations):
        tried, losses, leading = [], [], []
        for n, own in enumerate(searches):
            poses = []
            for search in own:
                if not search.is_over:
                    batch = search.ask()
                    search.tell(masked_error(models, views, n, batch, best.light))
                    poses.append(Pose(batch.positions[:, 0], batch.quaternions[:, 0]))
            leading.append(min(own, key=lambda search: search.least))
            losses.append(leading[-1].least)
            if poses:
                tried.append(Pose.joined(*poses))
        if not tried:  # all searches are over
            break
        positions, quaternions = ([getattr(s.best, part) for s in leading] for part in ("positions", "quaternions"))
        best = replace(best, positions=np.concatenate(positions), quaternions=np.concatenate(quaternions))
        yield reporter.step("objects", "Each object in its masks", best, tried, losses, leading[0].sigma)
    return best


def estimate_next(
    models: ObjectModels,
    observation: Observation,
    before: SceneState,
    rng: np.random.Generator,
    config: PaperEstimationConfig,
) -> Iterator[EstimateStep]:
    """Find the poses again, under the light that is known; the last step holds the estimate.

    Args:
        models: fields of the objects and the table.
        observation: one or more views, with masks or without.
        before: the last estimate.
        rng: of the search.
        config: how much work to do.

    Raises:
        InvalidInput: if the last estimate is of other objects.
        UnknownName: if an object has no field.
    """
    models.check(observation.names)
    if set(before.names) != set(observation.names):
        raise InvalidInput("objects of the last estimate", ", ".join(before.names), ", ".join(observation.names))
    views = views_of(observation, config.side)
    params = SceneParameters.of(before.reordered(observation.names), observation.pusher)
    search = _Search(params, (*config.later_spread, 0.0), config.later_population, rng)
    reporter = StepReporter(config.later_iterations + 1)
    overhead = None if views.masks is None else np.array(OVERHEAD)
    yield (yield from _descend(models, views, search, config.later_iterations, reporter, overhead))


def masked_error(
    models: ObjectModels,
    views: ObservedViews,
    number: int,
    batch: SceneBatch,
    light: Float[np.ndarray, "3"] | tuple[float, float, float] = OVERHEAD,
) -> Float[np.ndarray, "B"]:
    """Return eq. 5: mean squared difference between one object rendered alone and the images inside its masks.

    Args:
        models: fields.
        views: with masks.
        number: of the object in the views.
        batch: B scenes of this object alone, whose own light does not count.
        light: unit vector toward the light (L_init).
    """
    if views.masks is None:
        raise InvalidInput("masks of the views", "missing", "given: one per camera and object")
    wanted = views.images * views.masks[:, number, ..., None]
    lights = np.broadcast_to(light, batch.lights.shape)
    alone = SceneBatch(batch.names, batch.positions, batch.quaternions, lights, None)
    return _mean_square(models.alone.render(alone, views.cameras, quality=views.quality).rgb, wanted)


def scene_error(models: ObjectModels, views: ObservedViews, batch: SceneBatch) -> Float[np.ndarray, "B"]:
    """Return eq. 6: mean squared difference between B whole scenes, with shadows, and the images.

    Args:
        models: fields of the objects and the table.
        views: what was observed.
        batch: B scenes.
    """
    return _mean_square(models.together.render(batch, views.cameras, quality=views.quality).rgb, views.images)


def _mean_square(
    rendered: Float32[np.ndarray, "B V h w 3"], wanted: Float32[np.ndarray, "V h w 3"]
) -> Float[np.ndarray, "B"]:
    return ((rendered - wanted) ** 2).mean(axis=(1, 2, 3, 4), dtype=float)


def _descend(
    models: ObjectModels,
    views: ObservedViews,
    search: _Search,
    iterations: int,
    reporter: StepReporter,
    eq5_light: Float[np.ndarray, "3"] | None,
) -> Generator[EstimateStep, None, EstimateStep]:
    """Run CMA-ES over all poses and the light, and return the last step, with the estimate.

    With a light for it, eq. 5 of every object is added to eq. 6.
    """
    names = search.best.names
    loss = np.inf
    for _ in range(iterations):
        if search.is_over:
            break
        batch = search.ask()
        errors = scene_error(models, views, batch)
        if eq5_light is not None:
            for n, name in enumerate(names):
                own = SceneBatch((name,), batch.positions[:, [n]], batch.quaternions[:, [n]], batch.lights, None)
                errors = errors + masked_error(models, views, n, own, eq5_light)
        loss = search.tell(errors)
        tried = [Pose(batch.positions[:, n], batch.quaternions[:, n]) for n in range(len(names))]
        note = "All objects and the light" if search.scales[2] else "All objects"
        yield reporter.step("together", note, search.best, tried, [], search.sigma, batch.lights, loss)
    shift, turn, light = (scale * search.sigma for scale in search.scales)
    deviations = np.full(len(names), shift), np.full(len(names), 2 * turn)
    estimate = EstimatedState(search.best.state(), *deviations, light, ("",) * len(names), "")
    last = reporter.step("done", "Done", search.best, loss=loss)
    return replace(last, estimate=estimate)


class _Search:
    """CMA-ES around a scene, over 7 numbers for each object and 3 for the light."""

    def __init__(
        self,
        start: SceneParameters,
        scales: tuple[float, float, float],
        population: int,
        rng: np.random.Generator,
        converged: float = 0.0,
    ) -> None:
        self.best, self.scales, self.least = start, scales, np.inf
        self._start, self._converged = start, converged
        shift, turn, light = scales
        spread = np.array(([shift] * 3 + [turn] * 4) * len(start.names) + [light] * LIGHT)
        self._strategy = CMAES(spread, population, rng)
        self._asked: SceneBatch | None = None

    @property
    def sigma(self) -> float:
        """Overall step, 1 at the beginning."""
        return self._strategy.sigma

    @property
    def is_over(self) -> bool:
        """Whether the step has become so small that nothing more is found."""
        return self._strategy.sigma < self._converged

    def ask(self) -> SceneBatch:
        """Return the scenes of the next generation."""
        changes = self._strategy.ask()
        count = len(self._start.names)
        poses = changes[:, : POSE * count].reshape(len(changes), count, POSE)
        positions = self._start.positions + poses[..., :3]
        quaternions = self._start.quaternions + poses[..., 3:]
        quaternions /= np.maximum(np.linalg.norm(quaternions, axis=-1, keepdims=True), 1e-9)
        lights = self._start.light + changes[:, POSE * count :]
        lights[:, 2] = np.maximum(lights[:, 2], _LOWEST_SLOPE * np.hypot(lights[:, 0], lights[:, 1]) + 1e-6)
        lights /= np.linalg.norm(lights, axis=1, keepdims=True)
        pusher = None if self._start.pusher is None else np.tile(self._start.pusher, (len(changes), 1))
        self._asked = SceneBatch(self._start.names, positions, quaternions, lights, pusher)
        return self._asked

    def tell(self, losses: Float[np.ndarray, "B"]) -> float:
        """Take the losses of these scenes and return the least so far."""
        self._strategy.tell(losses)
        k, batch = int(np.argmin(losses)), self._asked
        if losses[k] < self.least and batch is not None:
            self.least = float(losses[k])
            poses = {"positions": batch.positions[k], "quaternions": batch.quaternions[k]}
            self.best = replace(self.best, **poses, light=batch.lights[k])
        return self.least


def _triangulated(observation: Observation, masks: Bool[np.ndarray, "V h w"], n: int) -> Float[np.ndarray, "3"]:
    """Return the point closest to the lines of sight through the centroids of the masks of object n [m]."""
    normal, target = 1e-6 * np.eye(3), np.zeros(3)
    for camera, mask in zip(observation.cameras, masks, strict=True):
        rows, columns = np.nonzero(mask)
        if not len(rows):
            continue
        direction = camera.ray_directions(np.array([columns.mean() + 0.5, rows.mean() + 0.5]))
        across = np.eye(3) - np.outer(direction, direction)
        normal += across
        target += across @ camera.T_world_camera.position
    if not target.any():
        raise InvalidInput(f"mask of {observation.names[n]}", "empty in every view", "not empty in at least one view")
    return np.linalg.solve(normal, target)
