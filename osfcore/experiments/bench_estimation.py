"""Time estimates: a first frame, a later frame, a goal; medians over a fixed set of scenes.

Fields are loaded, code is compiled and resting orientations are known before anything is timed. A later frame begins
with the estimate of the frame before it and follows a push.
"""

from __future__ import annotations

import time
from collections.abc import Iterator
from dataclasses import dataclass, field

import numpy as np

from osfcore.errors import InvalidInput, check_ranges, check_seed
from osfcore.estimation.first_frame import FirstFrameConfig, estimate_first_calibrated
from osfcore.estimation.goal_image import GoalImageConfig, estimate_goal
from osfcore.estimation.steps import EstimateStep
from osfcore.estimation.tracking import TrackingConfig, estimate_next
from osfcore.experiments.estimation_tasks import WARM_SCENE, episode, first_frame, goals, last_estimate, warm_models
from osfcore.experiments.harness import MAX_TASKS, EvaluationStep, measurable
from osfcore.fields.field_library import FieldLibrary
from osfcore.geometry.cameras import DEFAULT_IMAGE_SIDE, default_cameras, goal_camera
from osfcore.geometry.states import MAX_OBJECTS, SceneState
from osfcore.objects.asset_library import AssetLibrary
from osfcore.objects.catalogue import DEFAULT_NAMES
from osfcore.random_streams import Stream, stream_rng
from osfcore.world.tasks import draw_scene

_FIRST_SCENE = 700_000  # no figure of accuracy is measured on these scenes


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


def bench_estimate(config: BenchEstimate, fields: FieldLibrary, assets: AssetLibrary) -> Iterator[EvaluationStep]:
    """Time every kind of estimate, scene by scene.

    The report has medians of first frames with four views and masks "first_s", of later frames "next_s" and of goals
    "goal_s" [s], what nine of ten later frames stay below "next_s_p90" [s], later frames a second by the median
    "refine_hz", the numbers of "scenes" and "objects" in each, and the "threads" that compiled code may use.

    Args:
        config: what to measure, and how often.
        fields: of the objects and the table; where enough of the default objects have both field and mesh, only these.
        assets: meshes, for the simulator.

    Raises:
        InvalidInput: if a number is out of range, or there are too few objects.
        MissingAssets: if no object has both a field and a mesh.
    """
    import numba

    check_seed(config.seed)
    check_ranges(
        ("number of scenes", config.scenes, 1, MAX_TASKS),
        ("later frames of each scene", config.steps, 1, MAX_TASKS),
        ("objects in a scene", config.objects, 1, MAX_OBJECTS),
    )
    there = measurable(fields, assets)
    names = tuple(name for name in there if name in DEFAULT_NAMES)
    names = names if len(names) >= config.objects else there
    if len(names) < config.objects:
        raise InvalidInput("objects in a scene", config.objects, f"at most {len(names)}, which have field and mesh")
    cameras, total = default_cameras(config.size), config.scenes
    yield EvaluationStep(0, total, "Warming up")
    draw = draw_scene(names, config.objects, config.seed, WARM_SCENE)
    models = warm_models(names, fields, assets, draw, config.size)
    first: list[float] = []
    later: list[float] = []
    goal: list[float] = []
    for number in range(total):
        yield EvaluationStep(number, total, f"Estimating (scene {number + 1} of {total})")
        draw = draw_scene(names, config.objects, config.seed, _FIRST_SCENE + number)
        seen = first_frame(draw, assets, cameras).observation
        pushes = episode(draw, assets, cameras, steps=config.steps)
        goal_image = goals(draw, assets, goal_camera(config.size))[0].frame.observation
        rng = stream_rng(config.seed, Stream.BENCHMARK, number)
        start = _timed(estimate_first_calibrated(models, seen, rng, config.effort), first)
        expected = start
        for frame in pushes.frames:
            expected = _timed(estimate_next(models, frame.observation, expected, rng, config.track), later)
        _timed(estimate_goal(models, goal_image, start, config.goal), goal)
    typical = float(np.median(later))
    costs = {
        "first_s": float(np.median(first)),
        "next_s": typical,
        "next_s_p90": float(np.quantile(later, 0.9)),
        "goal_s": float(np.median(goal)),
        "refine_hz": 1 / typical,
        "scenes": total,
        "objects": config.objects,
        "threads": int(numba.get_num_threads()),
    }
    yield EvaluationStep(total, total, "Everything is measured", costs)


def _timed(steps: Iterator[EstimateStep], seconds: list[float]) -> SceneState:
    """Run an estimate, which does nothing before its first step, and note how long it took [s]."""
    start = time.perf_counter()
    estimate = last_estimate(steps)
    seconds.append(time.perf_counter() - start)
    return estimate.state
