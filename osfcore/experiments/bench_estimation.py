"""What estimates cost: a first frame, a later frame, a goal; medians over a fixed set of scenes.

Fields are loaded, code is compiled and resting orientations are known before anything is timed. A later frame begins
with the estimate of the frame before it and follows a push.
"""

from __future__ import annotations

import time
from collections.abc import Iterator
from dataclasses import asdict, dataclass, field

import numpy as np

from osfcore.errors import InvalidInput, check_ranges, check_seed
from osfcore.estimation.first_frame import FirstFrameConfig, estimate_first
from osfcore.estimation.goal_image import GoalImageConfig, estimate_goal
from osfcore.estimation.steps import EstimateStep
from osfcore.estimation.tracking import TrackingConfig, estimate_next
from osfcore.experiments.estimation_tasks import episode, first_frame, goals
from osfcore.experiments.estimation_warmup import WARM_SCENE, last_estimate, warm_models
from osfcore.experiments.fields import measurable
from osfcore.fields.field_library import FieldLibrary
from osfcore.geometry.cameras import DEFAULT_IMAGE_SIDE, default_cameras, goal_camera
from osfcore.geometry.states import MAX_OBJECTS, EstimatedState
from osfcore.objects.asset_library import AssetLibrary
from osfcore.objects.catalogue import DEFAULT_NAMES
from osfcore.random_streams import Stream, stream_rng
from osfcore.world.tasks import Draw, draw_scene

_FIRST_SCENE = 700_000  # no figure of accuracy is measured on these scenes
_MOST_SCENES = 10_000


@dataclass(frozen=True, slots=True)
class BenchEstimate:
    """What to measure, and how often.

    Attributes:
        scenes: each gives one first frame, some later frames and one goal.
        objects: in each scene.
        steps: later frames of each scene.
        seed: of all scenes.
        size: side of the images [px].
        effort: of first frames.
        track: of later frames.
        goal: of goals.
    """

    scenes: int = 5
    objects: int = 3
    steps: int = 10
    seed: int = 0
    size: int = DEFAULT_IMAGE_SIDE
    effort: FirstFrameConfig = field(default_factory=FirstFrameConfig)
    track: TrackingConfig = field(default_factory=TrackingConfig)
    goal: GoalImageConfig = field(default_factory=GoalImageConfig)


@dataclass(frozen=True, slots=True)
class EstimateCosts:
    """Times of estimates.

    Attributes:
        first_s: median of first frames with four views and masks [s].
        next_s: median of later frames [s].
        next_s_p90: what nine of ten later frames stay below [s].
        goal_s: median of goals [s].
        refine_hz: later frames a second, by the median.
        scenes: how many.
        objects: in each of them.
        threads: that compiled code may use.
    """

    first_s: float
    next_s: float
    next_s_p90: float
    goal_s: float
    refine_hz: float
    scenes: int
    objects: int
    threads: int

    def to_json(self) -> dict[str, float | int]:
        """As plain numbers."""
        return asdict(self)


@dataclass(frozen=True, eq=False, slots=True)
class BenchEstimateStep:
    """How far the measurement is.

    Attributes:
        done: scenes finished.
        total: scenes in all.
        note: what is being done.
        report: with the last step only.
    """

    done: int
    total: int
    note: str
    report: EstimateCosts | None = None


def bench_estimate(config: BenchEstimate, fields: FieldLibrary, assets: AssetLibrary) -> Iterator[BenchEstimateStep]:
    """Time every kind of estimate, scene by scene.

    Args:
        config: what to measure, and how often.
        fields: of the objects and the table; where enough of the default objects have both field and mesh, only these.
        assets: meshes, for the simulator.

    Raises:
        InvalidInput: if a number is out of range, or there are too few objects.
        MissingAssets: if no object has both a field and a mesh.
    """
    names = _checked(config, fields, assets)
    yield BenchEstimateStep(0, config.scenes, "Warming up")
    draw = draw_scene(names, config.objects, config.seed, WARM_SCENE)
    models = warm_models(names, fields, assets, draw, config.size)
    first: list[float] = []
    later: list[float] = []
    goal: list[float] = []
    for number in range(config.scenes):
        yield BenchEstimateStep(number, config.scenes, f"Estimating (scene {number + 1} of {config.scenes})")
        scene, rng = _Scene(config, assets, names, number), stream_rng(config.seed, Stream.BENCHMARK, number)
        start, seconds = _timed(estimate_first(models, scene.first, rng, config.effort))
        first.append(seconds)
        expected = start.state
        for observation in scene.later:
            estimate, seconds = _timed(estimate_next(models, observation, expected, rng, config.track))
            later.append(seconds)
            expected = estimate.state
        _, seconds = _timed(estimate_goal(models, scene.goal, start.state, config.goal))
        goal.append(seconds)
    yield BenchEstimateStep(config.scenes, config.scenes, "Everything is measured", _costs(config, first, later, goal))


class _Scene:
    """What the estimators are shown of one scene."""

    def __init__(self, config: BenchEstimate, assets: AssetLibrary, names: tuple[str, ...], number: int) -> None:
        draw: Draw = draw_scene(names, config.objects, config.seed, _FIRST_SCENE + number)
        cameras = default_cameras(config.size)
        self.first = first_frame(draw, assets, cameras).observation
        self.later = [frame.observation for frame in episode(draw, assets, cameras, steps=config.steps).frames]
        self.goal = goals(draw, assets, goal_camera(config.size))[0].frame.observation


def _timed(steps: Iterator[EstimateStep]) -> tuple[EstimatedState, float]:
    """Run an estimate, which does nothing before its first step; its result, and how long it took [s]."""
    start = time.perf_counter()
    estimate = last_estimate(steps)
    return estimate, time.perf_counter() - start


def _costs(config: BenchEstimate, first: list[float], later: list[float], goal: list[float]) -> EstimateCosts:
    import numba

    typical = float(np.median(later))
    return EstimateCosts(
        first_s=float(np.median(first)),
        next_s=typical,
        next_s_p90=float(np.quantile(later, 0.9)),
        goal_s=float(np.median(goal)),
        refine_hz=1 / typical,
        scenes=config.scenes,
        objects=config.objects,
        threads=int(numba.get_num_threads()),
    )


def _checked(config: BenchEstimate, fields: FieldLibrary, assets: AssetLibrary) -> tuple[str, ...]:
    check_ranges(
        ("number of scenes", config.scenes, 1, _MOST_SCENES),
        ("later frames of each scene", config.steps, 1, _MOST_SCENES),
        ("objects in a scene", config.objects, 1, MAX_OBJECTS),
    )
    check_seed(config.seed)
    there = measurable(fields, assets)
    names = tuple(name for name in there if name in DEFAULT_NAMES)
    if len(names) < config.objects:
        names = there
    if len(names) < config.objects:
        raise InvalidInput("objects in a scene", config.objects, f"at most {len(names)}, which have field and mesh")
    return names
