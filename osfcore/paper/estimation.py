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
rendered as coarsely as our estimation renders them.
"""

from __future__ import annotations

from collections.abc import Iterator
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
        masked_iterations: of each object in its masks, the light overhead (the paper's five).
        masked_population: candidates in each.
        joint_iterations: of all poses and the light.
        joint_population: candidates in each.
        later_iterations: of a later frame.
        later_population: candidates in each.
        masked_spread: initial standard deviations in the masks: positions [m], quaternions' numbers.
        joint_spread: of positions [m], quaternions' numbers, light [m] when these poses are refined together.
        later_spread: of positions and quaternions' numbers in later frames, where the light is held.
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


def estimate_first(
    models: ObjectModels, observation: Observation, rng: np.random.Generator, config: PaperEstimationConfig
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
    if observation.masks is None:
        raise InvalidInput("masks of the first frame", "missing", "given: one per camera and object")
    views, names = views_of(observation, FINE_SIDE // 2), observation.names
    starts = np.array([_triangulated(observation, observation.masks[:, n], n) for n in range(len(names))]).reshape(
        -1, 3
    )
    upright = np.tile([1.0, 0.0, 0.0, 0.0], (len(names), 1))
    params = SceneParameters(names, starts, upright, np.array(OVERHEAD), observation.pusher)
    reporter = StepReporter(config.masked_iterations + config.joint_iterations + 1)
    spread = (*config.masked_spread, 0.0)
    alone = [SceneParameters((name,), starts[[n]], upright[[n]], params.light, None) for n, name in enumerate(names)]
    searches = [_Search(one, spread, config.masked_population, rng) for one in alone]
    for _ in range(config.masked_iterations):
        tried, losses = [], []
        for n, search in enumerate(searches):
            batch = search.ask()
            losses.append(search.tell(masked_error(models, views, n, batch)))
            tried.append(Pose(batch.positions[:, 0], batch.quaternions[:, 0]))
        positions, quaternions = ([getattr(s.best, part) for s in searches] for part in ("positions", "quaternions"))
        params = replace(params, positions=np.concatenate(positions), quaternions=np.concatenate(quaternions))
        sigma = searches[0].sigma if searches else 1.0
        yield reporter.step("objects", "Each object in its masks", params, tried, losses, sigma)
    search = _Search(params, config.joint_spread, config.joint_population, rng)
    yield from _descend(models, views, search, config.joint_iterations, reporter, has_masks=True)


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
    views = views_of(observation, FINE_SIDE // 2)
    params = SceneParameters.of(before.reordered(observation.names), observation.pusher)
    search = _Search(params, (*config.later_spread, 0.0), config.later_population, rng)
    reporter = StepReporter(config.later_iterations + 1)
    yield from _descend(models, views, search, config.later_iterations, reporter, has_masks=views.masks is not None)


def masked_error(models: ObjectModels, views: ObservedViews, number: int, batch: SceneBatch) -> Float[np.ndarray, "B"]:
    """Return eq. 5: mean squared difference between one object rendered alone and the images inside its masks.

    Args:
        models: fields.
        views: with masks.
        number: of the object in the views.
        batch: B scenes of this object alone, whose light does not count: L_init is overhead.
    """
    if views.masks is None:
        raise InvalidInput("masks of the views", "missing", "given: one per camera and object")
    wanted = views.images * views.masks[:, number, ..., None]
    overhead = np.broadcast_to(OVERHEAD, batch.lights.shape)
    alone = SceneBatch(batch.names, batch.positions, batch.quaternions, overhead, None)
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
    models: ObjectModels, views: ObservedViews, search: _Search, iterations: int, reporter: StepReporter, *,
    has_masks: bool,
) -> Iterator[EstimateStep]:  # fmt: skip
    """Run CMA-ES over all poses and the light; with masks, eq. 5 of every object is added to eq. 6."""
    names = search.best.names
    loss = np.inf
    for _ in range(iterations):
        batch = search.ask()
        errors = scene_error(models, views, batch)
        for n, name in enumerate(names if has_masks else ()):
            own = SceneBatch((name,), batch.positions[:, [n]], batch.quaternions[:, [n]], batch.lights, None)
            errors = errors + masked_error(models, views, n, own)
        loss = search.tell(errors)
        tried = [Pose(batch.positions[:, n], batch.quaternions[:, n]) for n in range(len(names))]
        note = "All objects and the light" if search.scales[2] else "All objects"
        yield reporter.step("together", note, search.best, tried, [], search.sigma, batch.lights, loss)
    shift, turn, light = (scale * search.sigma for scale in search.scales)
    deviations = np.full(len(names), shift), np.full(len(names), 2 * turn)
    estimate = EstimatedState(search.best.state(), *deviations, light, ("",) * len(names), "")
    last = reporter.step("done", "Done", search.best, loss=loss)
    yield replace(last, estimate=estimate)


class _Search:
    """CMA-ES around a scene, over 7 numbers for each object and 3 for the light."""

    def __init__(
        self, start: SceneParameters, scales: tuple[float, float, float], population: int, rng: np.random.Generator
    ) -> None:
        self.best, self.scales, self._start, self._least = start, scales, start, np.inf
        shift, turn, light = scales
        spread = np.array(([shift] * 3 + [turn] * 4) * len(start.names) + [light] * LIGHT)
        self._strategy = CMAES(spread, population, rng)
        self._asked: SceneBatch | None = None

    @property
    def sigma(self) -> float:
        """Overall step, 1 at the beginning."""
        return self._strategy.sigma

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
        if losses[k] < self._least and batch is not None:
            self._least = float(losses[k])
            poses = {"positions": batch.positions[k], "quaternions": batch.quaternions[k]}
            self.best = replace(self.best, **poses, light=batch.lights[k])
        return self._least


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
