"""How good estimators are: first frames, tracking without masks, goals, ablations and spoiled inputs.

Each task is a random scene of known objects under a hidden light that stands 10 degrees or higher. First
frames show it to four cameras with masks. Tracks follow 20 steps of pushes without masks, each estimate starting from
the last one. Goals show some objects elsewhere under another light to the goal camera. Nothing of the truth ever
reaches an estimator. Each finished part of a task is kept, so that an evaluation can be killed, resumed and run in
pieces; pictures and report.json lie beside the kept results.

Times are of estimates alone: fields are loaded and unpacked, code is compiled and the ways in which objects can
lie are found in a warm-up on a scene that no figure uses, because all that is done once in a program's life. They
are kept with the rest, so times mean something only where the machine had nothing else to do.
"""

from __future__ import annotations

import hashlib
import json
import time
from collections.abc import Callable, Iterable, Iterator, Mapping, Sequence
from concurrent.futures import Executor
from dataclasses import asdict, dataclass, field, replace
from functools import cache, cached_property, lru_cache, partial
from pathlib import Path
from typing import Any, Literal, NamedTuple, TypeVar

import numpy as np
from jaxtyping import Float
from scipy.special import erf

from osfcore.errors import InvalidInput, OsfError
from osfcore.estimation.first_frame import FirstFrameConfig, estimate_first
from osfcore.estimation.goal_image import GoalImageConfig, estimate_goal
from osfcore.estimation.objective import ObjectModels
from osfcore.estimation.steps import EstimateStep
from osfcore.estimation.tracking import TrackingConfig, estimate_next
from osfcore.experiments import estimation_tasks as tasks
from osfcore.experiments.charts import Axis, Chart, Curve, cumulative, write_charts
from osfcore.experiments.estimation_tasks import STEPS, Absence, BadScore, last_estimate, warm_models
from osfcore.experiments.factors import Factor, factor_named
from osfcore.experiments.harness import (
    MAX_TASKS,
    EvaluationStep,
    Piece,
    TaskCache,
    TaskResult,
    check_run,
    chosen_objects,
    file_sha256,
    results_of,
    scene_circumstances,
)
from osfcore.experiments.statistics import mean, median, quantile, spread
from osfcore.fields.field_library import FieldLibrary
from osfcore.geometry.cameras import DEFAULT_IMAGE_SIDE, default_cameras, goal_camera
from osfcore.geometry.states import MAX_OBJECTS, EstimatedState, Observation, SceneState
from osfcore.inspection.contact_sheet import Comparison, contact_sheet, put_text, stacked
from osfcore.io.files import write_json
from osfcore.io.image_file import to_uint8, write_png
from osfcore.io.json_codec import decode, encode
from osfcore.io.scene_file import estimated_from_json, estimated_to_json
from osfcore.metrics.pose_errors import adds, direction_components, pose_error, rotation_components
from osfcore.objects.asset import ObjectAsset
from osfcore.objects.asset_library import AssetLibrary
from osfcore.random_streams import Stream, stream_rng
from osfcore.render.types import Quality, SceneBatch
from osfcore.world.tasks import Draw, draw_scene

VERSION = 2  # raised by hand when figures may change
REPORT_FILE = "report.json"
Part = Literal["first", "track", "goal", "ablations"]
PARTS: tuple[Part, ...] = ("first", "track", "goal", "ablations")
ALL_VIEWS = (0, 1, 2, 3)  # the default cameras
VIEWS: dict[int, tuple[int, ...]] = {1: (0,), 2: (0, 2)}  # cameras that an ablation keeps: two face each other
_SHOWN_QUALITY = Quality(samples_per_side=2)
_OVERHEAD = (0.0, 0.0, 1.0)
_FACTOR = "factor_"  # and its name: a part
ScoreT = TypeVar("ScoreT")


@dataclass(frozen=True, slots=True)
class EvaluateEstimate:
    """Evaluate the estimators against the simulator.

    Attributes:
        out: folder for results; those of an earlier run with the same weights, meshes and settings are taken over.
            Changes to the estimators' code do not show in these: measure them in a new folder.
        tasks: number of scenes, each with its own objects, arrangement and light.
        objects: in each scene.
        seed: of scenes and searches.
        parts: what to measure; first frames are measured in any case, since everything else begins with them.
        bad: number of spoiled inputs.
        names: objects to draw from; all that have a field and a mesh if None.
        steps: of an episode.
        size: side of the images [px].
        effort: of first frames.
        track: of later frames.
        goal: of goals.
        factors: names of factors of variation, under each of which first frames are measured too.
    """

    out: Path
    tasks: int = 20
    objects: int = 3
    seed: int = 0
    parts: tuple[Part, ...] = PARTS
    bad: int = 0
    names: tuple[str, ...] | None = None
    steps: int = STEPS
    size: int = DEFAULT_IMAGE_SIDE
    effort: FirstFrameConfig = field(default_factory=FirstFrameConfig)
    track: TrackingConfig = field(default_factory=TrackingConfig)
    goal: GoalImageConfig = field(default_factory=GoalImageConfig)
    factors: tuple[str, ...] = ()

    @property
    def folder(self) -> Path:
        """Where the results for this number of objects and this seed are."""
        return self.out / "estimate" / f"{self.objects}-objects-seed-{self.seed}"


def evaluate_estimate(
    config: EvaluateEstimate, fields: FieldLibrary, assets: AssetLibrary, executor: Executor | None = None
) -> Iterator[EvaluationStep[EstimateReport]]:
    """Measure every part that is asked for, task by task; pictures and report.json go to `config.folder`.

    Args:
        config: what to measure.
        fields: of the objects and the table.
        assets: meshes, for the simulator.
        executor: does tasks side by side, if given; then their times are those of a busy machine.

    Raises:
        UnknownName, MissingAssets: if an object lacks a field or a mesh, or no factor is called so.
        InvalidInput: if a number is out of range.
        WorkerDied: if a worker process ended.
        CorruptFile, CannotWrite: as files are.
    """
    limits = ("number of bad cases", config.bad, 0, MAX_TASKS), ("objects in a scene", config.objects, 1, MAX_OBJECTS)
    check_run(config.tasks, config.seed, *limits, size=config.size)
    for part in config.parts:
        if part not in PARTS:
            raise InvalidInput("part", part, f"one of {', '.join(PARTS)}")
    for factor in config.factors:
        factor_named(factor)  # raises UnknownName
    names = chosen_objects(config.names, fields, assets)
    least = config.objects + (1 if config.bad else 0)  # a bad case calls an object by another's name
    if len(names) < least:
        raise InvalidInput("number of names", len(names), f"{least} or more for {config.objects} objects in a scene")
    if config.bad and config.objects < 2:
        raise InvalidInput("objects in a scene", config.objects, "2 or more with bad cases, which swap masks")
    runner = TaskRunner(config, names, fields, assets)
    kept: dict[str, list[TaskResult]] = {}
    jobs = _jobs(config, runner, kept)
    total, done = sum(count for _, count, _ in jobs.values()), 0
    for key, (title, count, work) in jobs.items():
        for results in results_of([work(number) for number in range(count)], executor):
            kept[key] = [result for result in results if result is not None]
            if (ready := len(kept[key])) < count:
                yield EvaluationStep(done + ready, total, f"{title} ({ready + 1} of {count})")
        done += count
    report = _report(kept)
    write_plots(config.folder, report)
    _write_galleries(config.folder, report, kept)
    write_json(config.folder / REPORT_FILE, report.to_json())
    yield EvaluationStep(total, total, "Everything is measured", report)


def _jobs(
    config: EvaluateEstimate, runner: TaskRunner, kept: Mapping[str, Sequence[TaskResult]]
) -> dict[str, tuple[str, int, Callable[[int], Piece]]]:
    """Return title, number and maker of the pieces of each part; tracks and goals begin with first frames in `kept`."""
    count = config.tasks
    jobs: dict[str, tuple[str, int, Callable[[int], Piece]]] = {"first": ("First frames", count, runner.first)}
    if "track" in config.parts:
        jobs["track"] = "Tracks", count, lambda number: runner.track(number, kept["first"][number])
    if "goal" in config.parts:
        jobs["goal"] = "Goals", count, lambda number: runner.goal(number, kept["first"][number])
    if "ablations" in config.parts:
        jobs["fixed_light"] = "Light held overhead", count, runner.fixed_light
        for views, cameras in VIEWS.items():
            title = f"{views} of {len(ALL_VIEWS)} views"
            jobs[f"views_{views}"] = title, count, partial(runner.first, cameras=cameras)
    for factor in config.factors:
        jobs[f"{_FACTOR}{factor}"] = f"Factor {factor}", count, partial(runner.varied, factor=factor)
    if config.bad:
        jobs["bad"] = "Bad cases", config.bad, runner.bad
    return jobs


class TaskRunner:
    """Makes pieces of work; what a piece needs is loaded once in each process that does some.

    Args:
        config: what to measure.
        names: objects to draw from.
        fields: of these objects and the table.
        assets: their meshes.
    """

    def __init__(
        self, config: EvaluateEstimate, names: tuple[str, ...], fields: FieldLibrary, assets: AssetLibrary
    ) -> None:
        self._config, self._names, self._fields, self._library = config, names, fields, assets
        self._cameras = default_cameras(config.size)
        self._load = cache(assets.load)

    def __reduce__(self) -> tuple[object, ...]:
        """Be sent to another process, where all pieces share one."""
        return _shared_runner, (self._config, self._names, self._fields, self._library)

    # Parts

    def first(self, number: int, cameras: tuple[int, ...] = ALL_VIEWS) -> Piece:
        """Return the first frame of a task, seen by some cameras; its figures hold score and estimated state."""
        part = "first" if cameras == ALL_VIEWS else f"views_{len(cameras)}"
        return self._first(part, number, self._config.effort, cameras)

    def fixed_light(self, number: int) -> Piece:
        """Return the first frame with the light held overhead."""
        return self._first("fixed_light", number, replace(self._config.effort, held_light=_OVERHEAD))

    def varied(self, number: int, factor: str) -> Piece:
        """Return the first frame of a task under a factor of variation."""
        draw, effort = self._draw(number), self._config.effort
        work = partial(self._seen_first, draw, effort, ALL_VIEWS, factor_named(factor))
        return self._piece(f"{_FACTOR}{factor}", number, draw, asdict(effort), work, factor=factor)

    def track(self, number: int, first: TaskResult) -> Piece:
        """Return later frames of a task, from its first estimate on."""
        draw, effort = self._draw(number), self._config.track
        score = decode(FrameScore, first.figures["score"], "score")
        work = partial(self._tracked, draw, state_of(first), score, effort)
        more = {"first": _digest(first), "steps": self._config.steps}
        return self._piece("track", number, draw, asdict(effort), work, **more)

    def goal(self, number: int, first: TaskResult) -> Piece:
        """Return the goals of a task; how the objects lie is known from its first estimate."""
        draw, effort = self._draw(number), self._config.goal
        work = partial(self._goals, draw, state_of(first), effort)
        return self._piece("goal", number, draw, asdict(effort), work, first=_digest(first))

    def bad(self, number: int) -> Piece:
        """Return a spoiled input."""
        draw = self._draw(tasks.FIRST_SCENE + number)
        effort = {"first": asdict(self._config.effort), "goal": asdict(self._config.goal)}
        # A case may call up an object that its scene does not hold.
        return self._piece("bad", number, draw, effort, partial(self._spoiled, number, draw.seed), all=self._checksums)

    def _first(self, part: str, number: int, effort: FirstFrameConfig, cameras: tuple[int, ...] = ALL_VIEWS) -> Piece:
        draw = self._draw(number)
        work = partial(self._seen_first, draw, effort, cameras)
        return self._piece(part, number, draw, asdict(effort), work, views=list(cameras))

    def _piece(
        self, part: str, number: int, draw: Draw, effort: dict[str, Any], work: Callable[[], TaskResult], **more: object
    ) -> Piece:
        scene = scene_circumstances(draw, self._fields, self._library)
        given = {"version": VERSION, **scene, "size": self._config.size, "effort": effort, **more}
        return Piece(f"{number:04d}", TaskCache(self._config.folder / part), given, work)

    # How they are measured

    def _seen_first(
        self, draw: Draw, effort: FirstFrameConfig, cameras: tuple[int, ...], factor: Factor | None = None
    ) -> TaskResult:
        frame = tasks.first_frame(draw, self._library, tuple(self._cameras[n] for n in cameras), factor)
        rng = stream_rng(draw.seed, Stream.FIRST_FRAME)
        score, estimate = self._timed(estimate_first(self._models, frame.observation, rng, effort), frame)
        figures = {"score": encode(score), "state": None if estimate is None else estimated_to_json(estimate)}
        return TaskResult(figures, self._compared(frame.observation, estimate))

    def _tracked(self, draw: Draw, start: SceneState | None, first: FrameScore, effort: TrackingConfig) -> TaskResult:
        pushes = tasks.episode(draw, self._library, self._cameras, steps=self._config.steps)
        if start is None:
            nothing = (False,) * len(draw.names)
            score = TrackScore(draw.names, nothing, (), (), (), (), (), pushes.moved_m, first.refused)
            return TaskResult({"score": encode(score)}, self._compared(pushes.frames[-1].observation, None))
        models, assets, expected = self._models, self._meshes(draw.names), start
        rng = stream_rng(draw.seed, Stream.TRACKING)
        estimates, errors, seconds = [], [], []
        for frame in pushes.frames:
            began = time.perf_counter()
            estimates.append(last_estimate(estimate_next(models, frame.observation, expected, rng, effort)))
            seconds.append(time.perf_counter() - began)
            expected = estimates[-1].state
            errors.append([tuple(one.tolist()) for one in pose_errors(expected, frame.truth, assets)])
        score = TrackScore(
            names=draw.names,
            right_at_start=tuple(one.is_right for one in first.objects),
            position_mm=tuple(position for position, _ in errors),
            rotation_deg=tuple(rotation for _, rotation in errors),
            absent=tuple(frame.absent for frame in pushes.frames),
            doubted=tuple(map(flags, estimates)),
            seconds=tuple(seconds),
            moved_m=pushes.moved_m,
        )
        lost = [step for step in score.lost_at if step is not None]
        step = min(lost, default=len(estimates) - 1)  # where it went wrong, or how it ended
        shown = self._compared(pushes.frames[step].observation, estimates[step])
        return TaskResult({"score": encode(score), "shown_step": step, "redrawn": pushes.redrawn}, shown)

    def _goals(self, draw: Draw, prior: SceneState | None, effort: GoalImageConfig) -> TaskResult:
        scores, shown, moved, models = [], [], [], self._models
        for goal in tasks.goals(draw, self._library, goal_camera(self._config.size)):
            frame, estimate = goal.frame, None
            if prior is None:
                score = refused_frame(draw.names, "The first frame was refused.", 0.0)
            else:
                score, estimate = self._timed(estimate_goal(models, frame.observation, prior, effort), frame)
            scores.append(encode(score))
            moved.append(list(goal.moved))
            shown += self._compared(frame.observation, estimate)
        return TaskResult({"scores": scores, "moved": moved}, tuple(shown))

    def _spoiled(self, number: int, seed: int) -> TaskResult:
        models, config, rng = self._models, self._config, stream_rng(seed, Stream.FIRST_FRAME)
        case = tasks.bad_case(self._names, config.objects, config.seed, number, self._library, config.size)
        began = time.perf_counter()
        try:
            steps = estimate_first(models, case.observation if case.start is None else case.start, rng, config.effort)
            if case.start is not None:
                prior = last_estimate(steps).state
                began = time.perf_counter()
                steps = estimate_goal(models, case.observation, prior, config.goal)
            estimate = last_estimate(steps)
        except OsfError as error:
            seconds = time.perf_counter() - began
            score = BadScore(case.kind, str(error), "", is_right=False, seconds=seconds)
            return TaskResult({"score": encode(score)}, self._compared(case.observation, None))
        seconds = time.perf_counter() - began
        # An answer that names an object that is not there is wrong.
        there = [n for n, name in enumerate(estimate.state.names) if name in case.truth.names]
        names = tuple(estimate.state.names[n] for n in there)
        state = replace(estimate.state, names=names, poses=estimate.state.poses[there])
        shifts, turns = (tuple(one.tolist()) for one in pose_errors(state, case.truth, self._meshes(names)))
        are_right = len(names) == len(estimate.state.names) and all(map(is_right, shifts, turns))
        score = BadScore(case.kind, "", estimate.reason, are_right, shifts, turns, seconds)
        return TaskResult({"score": encode(score)}, self._compared(case.observation, estimate))

    def _timed(self, steps: Iterator[EstimateStep], frame: tasks.Frame) -> tuple[FrameScore, EstimatedState | None]:
        """Run an estimate; a refusal is a result too."""
        began = time.perf_counter()
        try:
            estimate = last_estimate(steps)
        except OsfError as error:
            return refused_frame(frame.truth.names, str(error), time.perf_counter() - began), None
        seconds = time.perf_counter() - began
        return score_frame(estimate, frame.truth, self._meshes(frame.truth.names), seconds, frame.absent), estimate

    def _compared(self, observation: Observation, estimate: EstimatedState | None) -> tuple[Comparison, ...]:
        """Return each view, observed and rendered from the estimate; black where there is none."""
        ours = np.zeros_like(observation.images)
        if estimate is not None:
            batch = SceneBatch.of(estimate.state)
            ours = self._models.together.render(batch, observation.cameras, quality=_SHOWN_QUALITY).rgb[0]
        rows = zip(observation.cameras, observation.images, ours, strict=True)
        return tuple(Comparison(f"camera {camera.name}", to_uint8(a), to_uint8(b)) for camera, a, b in rows)

    @cached_property
    def _models(self) -> ObjectModels:
        """Loaded when the first estimate is asked for: all may be known from earlier runs."""
        config = self._config
        goal = "goal" in config.parts or config.bad > 0
        draw = self._draw(tasks.WARM_SCENE)
        return warm_models(self._names, self._fields, self._library, draw, config.size, goal=goal)

    @cached_property
    def _checksums(self) -> dict[str, list[str]]:
        """Checksums of all objects' fields and meshes."""
        return {name: [file_sha256(self._fields.info(name).path), self._library.digest(name)] for name in self._names}

    def _draw(self, number: int) -> Draw:
        return draw_scene(self._names, self._config.objects, self._config.seed, number)

    def _meshes(self, names: Iterable[str]) -> dict[str, ObjectAsset]:
        return {name: self._load(name) for name in names}


def state_of(first: TaskResult) -> SceneState | None:
    """Return the estimated state of a first frame, as it was kept; None if the frame was refused."""
    state = first.figures["state"]
    return None if state is None else estimated_from_json(state).state


def _digest(first: TaskResult) -> str:
    """Return the checksum of a first estimate, which others begin with."""
    return hashlib.sha256(json.dumps(first.figures["state"], sort_keys=True).encode()).hexdigest()


@lru_cache(maxsize=1)
def _shared_runner(
    config: EvaluateEstimate, names: tuple[str, ...], fields: FieldLibrary, assets: AssetLibrary
) -> TaskRunner:
    """Return the one runner of a worker process."""
    return TaskRunner(config, names, fields, assets)


# Scores: errors of one frame and of a tracked episode, and figures of many of them.
#
# An object's pose is right if it is off by less than 1 cm and 5 deg, symmetries considered. Whatever an estimator
# refused counts as wrong in every share and is left out of medians, which would have no number for it. A wrong first
# pose stays wrong in what follows: nothing is put right by the truth.


RIGHT_MM, RIGHT_DEG = 10.0, 5.0
LOST_MM, LOST_DEG = 30.0, 20.0
LOST_STEPS = 2  # running
COVERED = 2.0  # standard deviations; of Gaussian errors .954 lie within them
_POINTS = 2000  # of a mesh that ADD-S looks at
_MOST_RATIO = 1e6  # of an error over a deviation of 0


@dataclass(frozen=True, slots=True)
class ObjectScore:
    """Errors of one object's estimate.

    Attributes:
        name: of the object.
        position_mm: distance from the true position [mm].
        rotation_deg: angle to the nearest orientation that looks like the true one [deg].
        adds_mm: ADD-S [mm].
        position_std_mm: claimed, per axis [mm]; None if it is boundless.
        position_ratios: |error| over the claimed deviation, for each axis.
        rotation_ratios: the same of the rotation vector; two numbers for a body of revolution.
        flagged: the estimator doubts this object; or it doubts the whole without naming an object.
        doubt: why, in its words.
        absent: why no image shows the object; "" where one does.
    """

    name: str
    position_mm: float
    rotation_deg: float
    adds_mm: float
    position_std_mm: float | None
    position_ratios: tuple[float, ...]
    rotation_ratios: tuple[float, ...]
    flagged: bool
    doubt: str
    absent: Absence = ""

    @property
    def is_right(self) -> bool:
        """Whether the pose is off by less than 1 cm and 5 deg."""
        return is_right(self.position_mm, self.rotation_deg)


@dataclass(frozen=True, slots=True)
class FrameScore:
    """Errors of the estimate of one frame or goal.

    Attributes:
        names: the objects in it.
        objects: their scores; none if the frame was refused.
        light_deg: angle between estimated and true light [deg]; None if refused.
        light_ratios: |error| over the claimed deviation, across the true direction; none if the light was given.
        seconds: that the estimate took.
        trusted: by the estimator, as a whole.
        refused: why there is no estimate; "" if there is one.
    """

    names: tuple[str, ...]
    objects: tuple[ObjectScore, ...]
    light_deg: float | None
    light_ratios: tuple[float, ...]
    seconds: float
    trusted: bool
    refused: str = ""

    @property
    def is_right(self) -> bool:
        """Whether all objects are right."""
        return not self.refused and all(score.is_right for score in self.objects)


@dataclass(frozen=True, slots=True)
class TrackScore:
    """Errors of an episode; each list has one row for each step and in it one entry for each object.

    Attributes:
        names: the objects.
        right_at_start: whether their first poses were right.
        position_mm: distances from the true positions [mm].
        rotation_deg: angles, symmetries considered [deg].
        absent: why no image shows an object; "" where one does.
        doubted: whether the estimator doubts an object.
        seconds: that each step's estimate took.
        moved_m: how far each object came from its first place [m].
        refused: why there is no track; "" if there is one.
    """

    names: tuple[str, ...]
    right_at_start: tuple[bool, ...]
    position_mm: tuple[tuple[float, ...], ...]
    rotation_deg: tuple[tuple[float, ...], ...]
    absent: tuple[tuple[Absence, ...], ...]
    doubted: tuple[tuple[bool, ...], ...]
    seconds: tuple[float, ...]
    moved_m: tuple[float, ...]
    refused: str = ""

    @property
    def lost_at(self) -> tuple[int | None, ...]:
        """The step at which the track of each object counts as lost, from 0; None where it is kept."""
        if self.refused:
            return (0,) * len(self.names)
        by_object = (zip(*table, strict=True) for table in (self.position_mm, self.rotation_deg, self.absent))
        return tuple(map(lost_at, *by_object))


def is_right(position_mm: float, rotation_deg: float) -> bool:
    """Return whether a pose is off by less than 1 cm and 5 deg."""
    return position_mm < RIGHT_MM and rotation_deg < RIGHT_DEG


def lost_at(position_mm: Sequence[float], rotation_deg: Sequence[float], absent: Sequence[Absence]) -> int | None:
    """Return the first step at which an object was over 3 cm or 20 deg off for two steps running; None if never.

    Args:
        position_mm: errors, step by step [mm].
        rotation_deg: likewise, symmetries considered [deg].
        absent: why no image shows the object; "" where one does. A step without an image interrupts the run.

    Returns:
        The second of the two steps, from 0.
    """
    run = 0
    for step, (position, rotation, why) in enumerate(zip(position_mm, rotation_deg, absent, strict=True)):
        run = run + 1 if not why and (position > LOST_MM or rotation > LOST_DEG) else 0
        if run == LOST_STEPS:
            return step
    return None


def pose_errors(
    estimate: SceneState, truth: SceneState, assets: Mapping[str, ObjectAsset]
) -> tuple[Float[np.ndarray, "N"], Float[np.ndarray, "N"]]:
    """Return the errors of position [mm] and rotation [deg], objects in the order of the estimate.

    Args:
        estimate: poses of objects.
        truth: of the same objects, in any order.
        assets: by name; their symmetries say which rotations look alike.
    """
    names = estimate.names
    pairs = [pose_error(assets[name].info.symmetry, estimate.pose(name), truth.pose(name)) for name in names]
    return np.array([mm for mm, _ in pairs]), np.array([deg for _, deg in pairs])


def score_frame(
    estimate: EstimatedState,
    truth: SceneState,
    assets: Mapping[str, ObjectAsset],
    seconds: float,
    absent: Sequence[Absence] | None = None,
) -> FrameScore:
    """Score one estimate.

    Args:
        estimate: of the objects of the truth, in any order.
        truth: poses and light.
        assets: by name.
        seconds: that it took.
        absent: for each object of the truth.
    """
    state = estimate.state
    apart = direction_components(state.light.direction, truth.light.direction)
    unseen = dict(zip(truth.names, absent or ("",) * len(truth.names), strict=True))
    objects = tuple(_object(estimate, n, truth, assets[name], unseen[name]) for n, name in enumerate(state.names))
    ratios = _ratios(apart, estimate.light_std) if estimate.light_std > 0 else ()
    light_deg = float(np.rad2deg(np.linalg.norm(apart)))
    return FrameScore(state.names, objects, light_deg, ratios, seconds, estimate.trusted)


def refused_frame(names: tuple[str, ...], reason: str, seconds: float) -> FrameScore:
    """Score a frame that the estimator refused.

    Args:
        names: the objects in it.
        reason: why it was refused; not empty.
        seconds: until it was refused [s].
    """
    return FrameScore(names, (), None, (), seconds, False, reason)


def flags(estimate: EstimatedState) -> tuple[bool, ...]:
    """Return which objects the estimator warns of; a warning that names none is one of them all."""
    doubted = tuple(bool(doubt) for doubt in estimate.doubts)
    return doubted if any(doubted) else (not estimate.trusted,) * len(doubted)


def _object(estimate: EstimatedState, n: int, truth: SceneState, asset: ObjectAsset, absent: Absence) -> ObjectScore:
    name = estimate.state.names[n]
    mine, true = estimate.state.pose(name), truth.pose(name)
    shift = mine.position - true.position
    turn = rotation_components(asset.info.symmetry, mine.quaternion, true.quaternion)
    vertices = asset.mesh.vertices
    points = vertices[:: max(1, len(vertices) // _POINTS)].astype(float)
    deviation = float(estimate.position_std[n])
    return ObjectScore(
        name=name,
        position_mm=1000 * float(np.linalg.norm(shift)),
        rotation_deg=float(np.rad2deg(np.linalg.norm(turn))),
        adds_mm=1000 * adds(points, mine, true),
        position_std_mm=1000 * deviation if np.isfinite(deviation) else None,
        position_ratios=_ratios(shift, deviation),
        rotation_ratios=_ratios(turn, float(estimate.rotation_std[n])),
        flagged=flags(estimate)[n],
        doubt=estimate.doubts[n],
        absent=absent,
    )


def _ratios(errors: np.ndarray, deviation: float) -> tuple[float, ...]:
    """Return |error| / deviation; 0 for a boundless deviation."""
    return tuple(np.minimum(np.abs(errors) / max(deviation, 1e-300), _MOST_RATIO).tolist())


# Figures of many scores


def objects_of(frames: Iterable[FrameScore]) -> list[ObjectScore]:
    """Return the scores of all objects that were estimated."""
    return [score for frame in frames for score in frame.objects]


def share_right(frames: Sequence[FrameScore]) -> float | None:
    """Return the share of all objects, also those of refused frames, that are right; None without objects."""
    total = sum(len(frame.names) for frame in frames)
    return sum(score.is_right for score in objects_of(frames)) / total if total else None


class Ratios(NamedTuple):
    """|error| over claimed deviation of right estimates, axis by axis.

    Attributes:
        position: of right objects.
        rotation: of right objects.
        light: of frames in which every object is right.
    """

    position: tuple[float, ...]
    rotation: tuple[float, ...]
    light: tuple[float, ...]


def ratios_of(frames: Sequence[FrameScore]) -> Ratios:
    """Collect the ratios of right estimates: a deviation describes errors around the truth, not gross mistakes."""
    right = [score for score in objects_of(frames) if score.is_right]
    return Ratios(
        tuple(ratio for score in right for ratio in score.position_ratios),
        tuple(ratio for score in right for ratio in score.rotation_ratios),
        tuple(ratio for frame in frames if frame.is_right for ratio in frame.light_ratios),
    )


def coverage(ratios: Iterable[float]) -> float | None:
    """Return the share within two standard deviations; None without ratios."""
    return mean(ratio <= COVERED for ratio in ratios)


# The report.


DRIFT_STEPS = (5, 10, 15, 20)
_OF = ("median", "mean", "p90", "p95")
_MOVED_M = 0.01
_LIGHT_DEG = 10.0


@dataclass(frozen=True, eq=False, slots=True)
class EstimateReport:
    """The scores of all tasks; None for parts that were not asked for.

    Attributes:
        first: one first frame for each task, from all cameras.
        tracks: one episode for each task.
        goals: each task's goals, which move one object, two, and so on.
        fixed_light: first frames with the light held overhead.
        views: first frames from fewer cameras, by their number.
        bad: spoiled inputs.
        factors: first frames under factors of variation, by name.
    """

    first: tuple[FrameScore, ...]
    tracks: tuple[TrackScore, ...] | None = None
    goals: tuple[tuple[FrameScore, ...], ...] | None = None
    fixed_light: tuple[FrameScore, ...] | None = None
    views: Mapping[int, tuple[FrameScore, ...]] | None = None
    bad: tuple[BadScore, ...] | None = None
    factors: Mapping[str, tuple[FrameScore, ...]] = field(default_factory=dict)

    @property
    def all_goals(self) -> tuple[FrameScore, ...]:
        """The goals of all tasks in one row."""
        return tuple(goal for task in self.goals or () for goal in task)

    def by_views(self) -> dict[int, tuple[FrameScore, ...]]:
        """Return first frames by number of cameras, those from all cameras among them."""
        return {**(self.views or {}), len(ALL_VIEWS): self.first}

    def to_json(self) -> dict[str, Any]:
        """Return plain numbers: millimetres, degrees, seconds, shares in [0, 1]; null for what was not measured.

        `flagged_good` and `flagged_bad` are over first frames and goals together.
        """
        ratios, objects = ratios_of(self.first), objects_of([*self.first, *self.all_goals])
        report = {
            "tasks": len(self.first),
            **_frames(self.first, "first"),
            "by_object": _by_object(self.first),
            # How honest claimed deviations are, and how large; of right estimates alone.
            "two_sigma_coverage": coverage(ratios.position + ratios.rotation + ratios.light),
            "two_sigma_coverage_position": coverage(ratios.position),
            "two_sigma_coverage_rotation": coverage(ratios.rotation),
            "two_sigma_coverage_light": coverage(ratios.light),
            "mean_position_std_mm": mean(o.position_std_mm for o in objects_of(self.first) if o.is_right),
            **_goals(self),
            "flagged_good": mean(o.flagged for o in objects if o.is_right),
            "flagged_bad": mean(o.flagged for o in objects if not o.is_right),
            **_tracks(self.tracks),
            "frac_1cm_5deg_fixed_light": None if self.fixed_light is None else share_right(self.fixed_light),
            "fixed_light": None if self.fixed_light is None else _brief(self.fixed_light),
            "by_views": None if self.views is None else {str(n): _brief(f) for n, f in self.by_views().items()},
        }
        if self.bad is not None:
            report |= tasks.summary(self.bad)
        if self.factors:
            report["by_factor"] = {name: _varied_figures(frames) for name, frames in self.factors.items()}
        return report


def _report(kept: Mapping[str, Sequence[TaskResult]]) -> EstimateReport:
    def scores(kind: type[ScoreT], key: str) -> tuple[ScoreT, ...]:
        return tuple(decode(kind, result.figures["score"], "score") for result in kept[key])

    def goals(result: TaskResult) -> tuple[FrameScore, ...]:
        return tuple(decode(FrameScore, score, "score") for score in result.figures["scores"])

    return EstimateReport(
        first=scores(FrameScore, "first"),
        tracks=scores(TrackScore, "track") if "track" in kept else None,
        goals=tuple(map(goals, kept["goal"])) if "goal" in kept else None,
        fixed_light=scores(FrameScore, "fixed_light") if "fixed_light" in kept else None,
        views={n: scores(FrameScore, f"views_{n}") for n in VIEWS} if "fixed_light" in kept else None,
        bad=scores(BadScore, "bad") if "bad" in kept else None,
        factors={key.removeprefix(_FACTOR): scores(FrameScore, key) for key in kept if key.startswith(_FACTOR)},
    )


def _frames(frames: Sequence[FrameScore], what: str) -> dict[str, Any]:
    objects = objects_of(frames)
    return {
        "objects_total": sum(len(frame.names) for frame in frames),
        "frac_1cm_5deg": share_right(frames),
        **spread("position_mm", [o.position_mm for o in objects], _OF),
        **spread("rotation_deg", [o.rotation_deg for o in objects], _OF),
        **spread("adds_mm", [o.adds_mm for o in objects], _OF),
        **spread("light_deg", [frame.light_deg for frame in frames if frame.light_deg is not None], _OF),
        **spread(f"{what}_s", [frame.seconds for frame in frames], _OF),
        f"{what}_refused": sum(bool(frame.refused) for frame in frames),
        f"{what}_out_of_view": sum(bool(o.absent) for o in objects),
    }


def _by_object(frames: Sequence[FrameScore]) -> dict[str, dict[str, Any]]:
    """Return for each object how often it was seen, how often it was right, and its errors."""
    rows: dict[str, dict[str, Any]] = {}
    for name in sorted({name for frame in frames for name in frame.names}):
        own = [o for o in objects_of(frames) if o.name == name]
        shown = sum(name in frame.names for frame in frames)
        rows[name] = {
            "frames": shown,
            "frac_1cm_5deg": sum(o.is_right for o in own) / shown,
            **spread("position_mm", [o.position_mm for o in own], _OF),
            **spread("rotation_deg", [o.rotation_deg for o in own], _OF),
        }
    return rows


def _goals(report: EstimateReport) -> dict[str, Any]:
    goals = report.goals or ()
    row = _frames(report.all_goals, "goal")
    errors = [f"{what}_{of}" for what in ("position_mm", "rotation_deg", "light_deg") for of in _OF]
    most = max(map(len, goals), default=0)
    figures = {
        **{f"goal_{key}": row[key] for key in ("frac_1cm_5deg", "objects_total", *errors)},
        **{key: value for key, value in row.items() if key.startswith("goal_")},
        "goal_frac_1cm_5deg_by_moved": {
            str(n + 1): share_right([task[n] for task in goals if len(task) > n]) for n in range(most)
        },
    }
    return dict.fromkeys(figures) if report.goals is None else figures


def _tracks(measured: Sequence[TrackScore] | None) -> dict[str, Any]:
    """Return figures of tracking.

    An episode is lost when one of its objects is; `track_lost_from_wrong_start` counts those among them whose lost
    objects were all wrong in the first frame already. Steps at which an object lay beside the table or hidden from all
    cameras are left out of drift and losses and counted here, as pairs of object and step.
    """
    tracks = measured or ()
    seconds = [second for track in tracks for second in track.seconds]
    typical = median(seconds)
    lost = [[n for n, step in enumerate(track.lost_at) if step is not None] for track in tracks]
    from_wrong = [
        bool(gone) and not any(track.right_at_start[n] for n in gone) for track, gone in zip(tracks, lost, strict=True)
    ]
    absent = [why for track in tracks for row in track.absent for why in row]
    steps = [pair for track in tracks for step in range(len(track.seconds)) for pair in _seen(track, step)]
    figures = {
        "refine_hz": 1 / typical if typical else None,
        **spread("refine_s", seconds, _OF),
        "track_episodes": len(tracks),
        "track_lost": sum(map(bool, lost)),
        "track_lost_from_wrong_start": sum(from_wrong),
        "track_objects_lost": sum(map(len, lost)),
        "track_frac_1cm_5deg": mean(is_right(position, rotation) for position, rotation in steps),
        "track_off_table": absent.count("off the table"),
        "track_out_of_view": absent.count("out of view"),
        "drift_mm": drift(tracks, 0),
        "drift_deg": drift(tracks, 1),
        "track_moved": _apart(tracks, has_moved=True),
        "track_resting": _apart(tracks, has_moved=False),
    }
    return dict.fromkeys(figures) if measured is None else figures


def drift(tracks: Sequence[TrackScore], which: int) -> dict[str, float | None]:
    """Return the median error of position [mm] (0) or rotation [deg] (1) over all visible objects, by step."""
    return {str(step): median(errors_at(tracks, step, which)) for step in DRIFT_STEPS}


def errors_at(tracks: Iterable[TrackScore], step: int, which: int) -> list[float]:
    """Return the errors of all visible objects at one step.

    Args:
        tracks: those that ended before this step have none.
        step: from 1.
        which: 0 for position [mm], 1 for rotation [deg].
    """
    return [pair[which] for track in tracks if len(track.seconds) >= step for pair in _seen(track, step - 1)]


def _apart(tracks: Sequence[TrackScore], *, has_moved: bool) -> dict[str, float | None]:
    """Return errors over all steps of objects that were pushed 1 cm or more in their episode, or of all others."""
    rows = [
        (track.position_mm[step][n], track.rotation_deg[step][n])
        for track in tracks
        for n, way_m in enumerate(track.moved_m)
        if (way_m >= _MOVED_M) == has_moved
        for step in range(len(track.seconds))
        if not track.absent[step][n]
    ]
    position, rotation = ([row[k] for row in rows] for k in (0, 1))
    return {**spread("position_mm", position, _OF), **spread("rotation_deg", rotation, _OF)}


def _seen(track: TrackScore, step: int) -> list[tuple[float, float]]:
    """Return the errors at a step of the objects that some image shows."""
    rows = zip(track.position_mm[step], track.rotation_deg[step], track.absent[step], strict=True)
    return [(position, rotation) for position, rotation, why in rows if not why]


def _brief(frames: Sequence[FrameScore]) -> dict[str, Any]:
    row = _frames(frames, "first")
    keys = (
        "frac_1cm_5deg", "position_mm_median", "rotation_deg_median", "adds_mm_median", "light_deg_median",
        "first_s_median", "first_refused",
    )  # fmt: skip
    return {key: row[key] for key in keys}


def _varied_figures(frames: Sequence[FrameScore]) -> dict[str, Any]:
    """As `_brief`, with the share of lights that are right, and objects that are wrong without a warning."""
    lights = [frame.light_deg for frame in frames]
    objects = objects_of(frames)
    return {
        **_brief(frames),
        "objects_total": sum(len(frame.names) for frame in frames),
        "light_frac_10deg": sum(deg is not None and deg < _LIGHT_DEG for deg in lights) / max(len(lights), 1),
        "light_deg_max": max((deg for deg in lights if deg is not None), default=None),
        "wrong_unflagged": sum(not o.is_right and not o.flagged for o in objects),
        "right_flagged": sum(o.is_right and o.flagged for o in objects),
    }


# Curves of errors.


_SHARE = Axis("share of objects", 0, 1)
_POSITION, _ROTATION = Axis("position error [mm]", 0, 20), Axis("rotation error [deg]", 0, 10)


def write_plots(folder: Path, report: EstimateReport) -> None:
    """Draw errors.svg and calibration.svg, and track.svg and views.svg where these parts were measured.

    Raises:
        CannotWrite: if the disk refuses.
    """
    write_charts(folder / "errors.svg", _errors_charts(report))
    write_charts(folder / "calibration.svg", [_calibration_chart(report.first)])
    if report.tracks:
        write_charts(folder / "track.svg", _track_charts(report.tracks))
    if report.views is not None:
        write_charts(folder / "views.svg", _views_charts(report))


def _errors_charts(report: EstimateReport) -> list[Chart]:
    """Draw cumulative errors of position and rotation; refused objects keep a curve below 1."""
    kinds = {
        "first frame, 4 views": report.first,
        "goal, 1 view": report.all_goals,
        "light held overhead": report.fixed_light,
    }
    panels = []
    for axis, key in ((_POSITION, "position_mm"), (_ROTATION, "rotation_deg")):
        curves = [
            cumulative(name, [getattr(o, key) for o in objects_of(frames)], axis, sum(len(f.names) for f in frames))
            for name, frames in kinds.items()
            if frames
        ]
        panels.append(Chart("Objects with at most this error", axis, _SHARE, curves))
    return panels


def _calibration_chart(frames: Sequence[FrameScore]) -> Chart:
    """Draw how often errors lie within so many claimed deviations, against Gaussian errors."""
    axis, ratios = Axis("|error| / claimed deviation", 0, 5), ratios_of(frames)
    x = np.linspace(0, 5, 200)
    curves = [
        Curve("if it were Gaussian", x, erf(x / np.sqrt(2))),
        *(cumulative(key, getattr(ratios, key), axis) for key in ("position", "rotation", "light")),
    ]
    return Chart("Right estimates: are deviations honest?", axis, Axis("share of components", 0, 1), curves)


def _dots(name: str, x: np.ndarray, values: Iterable[float | None]) -> Curve:
    return Curve(name, x, np.array(list(values), float), dots=True)


def _track_charts(tracks: Sequence[TrackScore]) -> list[Chart]:
    """Draw errors along episodes: median, and what nine of ten stay below."""
    count = max(len(track.seconds) for track in tracks)
    x = np.arange(1.0, count + 1)
    panels = []
    for which, axis in enumerate((_POSITION, _ROTATION)):
        values = [errors_at(tracks, step, which) for step in range(1, count + 1)]
        curves = [_dots("median", x, map(median, values)), _dots("90 % below", x, (quantile(v, 0.9) for v in values))]
        panels.append(Chart("Without masks, step by step", Axis("step", 0, max(count, 1)), Axis(axis.label, 0), curves))
    return panels


def _views_charts(report: EstimateReport) -> list[Chart]:
    """Draw accuracy by number of cameras."""
    views = dict(sorted(report.by_views().items()))
    x, frames = np.array(list(views), float), list(views.values())
    axis = Axis("cameras", 0, float(x.max()) + 1)
    errors = [
        _dots(name, x, (median(getattr(o, key) for o in objects_of(f)) for f in frames))
        for name, key in (("position, median [mm]", "position_mm"), ("rotation, median [deg]", "rotation_deg"))
    ]
    errors.append(_dots("light, median [deg]", x, (median(frame.light_deg for frame in f) for f in frames)))
    return [
        Chart("Under 1 cm and 5 deg", axis, _SHARE, [_dots("share", x, map(share_right, frames))]),
        Chart("Errors", axis, Axis("error", 0), errors),
    ]


# Galleries of failures.


MOST_SHOWN = 20  # tasks in a gallery
_PER_ROW = 4
_LINE_PX = 16
_LEAST_WIDTH_PX = 680


@dataclass(frozen=True, eq=False, slots=True)
class Failure:
    """One entry of a gallery.

    Attributes:
        badness: the worst first.
        lines: what went wrong.
        shown: observed and rendered images.
    """

    badness: float
    lines: tuple[str, ...]
    shown: tuple[Comparison, ...]


def frame_failure(title: str, score: FrameScore, shown: Sequence[Comparison]) -> Failure | None:
    """Describe a frame that was refused, or with an object that is wrong, or right and flagged; None otherwise.

    Args:
        title: of the task, for the first line.
        score: of the frame.
        shown: observed and rendered images.
    """
    if score.refused:
        return Failure(np.inf, (f"{title}: REFUSED: {score.refused}",), tuple(shown))
    if score.is_right and not any(o.flagged for o in score.objects):
        return None
    lines = [f"{title}, light off by {score.light_deg:.1f} deg"]
    for o in score.objects:
        verdict = "right" if o.is_right else "WRONG"
        warning = f"flagged: {o.doubt or 'the whole'}" if o.flagged else "unflagged"
        hidden = f", {o.absent}" if o.absent else ""
        lines.append(f"  {o.name}: {o.position_mm:.1f} mm, {o.rotation_deg:.1f} deg {verdict}{hidden}, {warning}")
    badness = sum(1 if o.flagged else 11 for o in score.objects if not o.is_right)
    return Failure(float(badness), tuple(lines), tuple(shown))


def track_failure(title: str, score: TrackScore, shown: Sequence[Comparison]) -> Failure | None:
    """Describe an episode in which an object was lost, or that had no start; None otherwise.

    Args:
        title: of the task, for the first line.
        score: of the episode.
        shown: observed and rendered images of the step at which the first object was lost.
    """
    if score.refused:
        return Failure(np.inf, (f"{title}: no start: {score.refused}",), tuple(shown))
    lost = {n: step for n, step in enumerate(score.lost_at) if step is not None}
    if not lost:
        return None
    lines = [f"{title}, shown at step {min(lost.values()) + 1}"]
    for n, step in lost.items():
        errors = f"{score.position_mm[step][n]:.0f} mm, {score.rotation_deg[step][n]:.0f} deg"
        start = "right" if score.right_at_start[n] else "wrong"
        warning = "flagged" if score.doubted[step][n] else "unflagged"
        lines.append(f"  {score.names[n]} LOST at step {step + 1}: {errors}, {warning}; first pose {start}")
    return Failure(float(len(lost)), tuple(lines), tuple(shown))


def bad_failure(title: str, score: BadScore, shown: Sequence[Comparison]) -> Failure | None:
    """Describe a spoiled input that was believed although the answer is wrong; None otherwise.

    Args:
        title: of the case, for the only line.
        score: of the answer.
        shown: observed and rendered images.
    """
    if not score.is_confidently_wrong:
        return None
    errors = ", ".join(f"{p:.0f} mm / {r:.0f} deg" for p, r in zip(score.position_mm, score.rotation_deg, strict=True))
    return Failure(1.0, (f"{title}: {score.kind}: wrong without a warning ({errors})",), tuple(shown))


def write_gallery(path: Path, failures: Iterable[Failure | None]) -> None:
    """Draw the worst failures below each other; without any, remove an older picture.

    Each is what went wrong in words, and below it observed images, rendered ones and their difference.

    Raises:
        CannotWrite: if the disk refuses.
    """
    chosen = sorted((f for f in failures if f is not None and f.shown), key=lambda f: -f.badness)[:MOST_SHOWN]
    if not chosen:
        path.unlink(missing_ok=True)
        return
    blocks = []
    for failure in chosen:
        sheet = contact_sheet(failure.shown, per_row=_PER_ROW, truth="seen")
        words = np.full((_LINE_PX * len(failure.lines) + 4, max(sheet.shape[1], _LEAST_WIDTH_PX), 3), 255, np.uint8)
        for number, line in enumerate(failure.lines):
            put_text(words, line, (4, _LINE_PX * (number + 1) - 4), words.shape[1] - 8)
        blocks += [words, sheet]
    write_png(path, stacked(blocks))


def _write_galleries(folder: Path, report: EstimateReport, kept: Mapping[str, Sequence[TaskResult]]) -> None:
    """Draw the failures of each part that was measured in a picture of its own."""
    rows: list[tuple[str, str, Callable[..., Failure | None], Sequence[Any] | None]] = [
        ("first", "task", frame_failure, report.first),
        ("fixed_light", "task", frame_failure, report.fixed_light),
        *((f"views_{n}", "task", frame_failure, frames) for n, frames in (report.views or {}).items()),
        *((f"{_FACTOR}{name}", "task", frame_failure, frames) for name, frames in report.factors.items()),
        ("track", "task", track_failure, report.tracks),
        ("bad", "bad case", bad_failure, report.bad),
    ]
    for key, title, failure, scores in rows:
        if scores is not None:
            pairs = enumerate(zip(scores, kept[key], strict=True))
            failures = [failure(f"{title} {n}", score, result.shown) for n, (score, result) in pairs]
            write_gallery(folder / f"failures_{key}.png", failures)
    if report.goals is not None:
        failures = [
            frame_failure(f"task {n}, goal with {m + 1} moved", score, (shown,))
            for n, (goals, result) in enumerate(zip(report.goals, kept["goal"], strict=True))
            for m, (score, shown) in enumerate(zip(goals, result.shown, strict=True))
        ]
        write_gallery(folder / "failures_goal.png", failures)
