"""How good estimators are: first frames, tracking without masks, goals, ablations and spoiled inputs.

Each task is a random scene of known objects under a hidden light that stands 10 degrees or higher. First
frames show it to four cameras with masks. Tracks follow 20 steps of pushes without masks, each estimate starting from
the last one. Goals show some objects elsewhere under another light to the goal camera. Nothing of the truth ever
reaches an estimator. Each finished part of a task is kept, so that an evaluation can be killed, resumed and run in
pieces; pictures and report.json lie beside the kept results.
"""

from __future__ import annotations

import hashlib
import json
import time
from collections.abc import Callable, Iterable, Iterator, Mapping, Sequence
from concurrent.futures import Executor
from dataclasses import asdict, dataclass, field, replace
from functools import cached_property, lru_cache, partial
from pathlib import Path
from typing import Any, Literal

import numpy as np
from jaxtyping import UInt8
from scipy.special import erf

from osfcore.control.first_frame import estimate_first
from osfcore.errors import InvalidInput, MissingAssets, OsfError, check_ranges, check_seed
from osfcore.estimation.first_frame import FirstFrameConfig
from osfcore.estimation.goal_image import GoalImageConfig, estimate_goal
from osfcore.estimation.objective import ObjectModels
from osfcore.estimation.steps import EstimateStep
from osfcore.estimation.tracking import TrackingConfig, estimate_next
from osfcore.experiments.charts import Axis, Chart, Curve, cumulative, write_charts
from osfcore.experiments.estimation_scores import (
    FrameScore,
    TrackScore,
    coverage,
    flagged_shares,
    flags,
    is_right,
    median,
    objects_of,
    pose_errors,
    quantile,
    ratios_of,
    refused_frame,
    score_frame,
    share_right,
)
from osfcore.experiments.estimation_scores import is_right as is_right_pose
from osfcore.experiments.estimation_tasks import (
    FIRST_SCENE,
    STEPS,
    BadCase,
    BadScore,
    Frame,
    bad_case,
    episode,
    first_frame,
    goals,
    summary,
)
from osfcore.experiments.estimation_warmup import WARM_SCENE, last_estimate, warm_models
from osfcore.experiments.factors import Factor, factor_named
from osfcore.experiments.fields import MAX_TASKS
from osfcore.experiments.harness import Piece, TaskCache, TaskResult, file_sha256, results_of, table_sha256
from osfcore.fields.field_library import FieldLibrary
from osfcore.geometry.cameras import DEFAULT_IMAGE_SIDE, default_cameras, goal_camera, image_side
from osfcore.geometry.states import MAX_OBJECTS, EstimatedState, Observation, SceneState
from osfcore.inspection.contact_sheet import Comparison, contact_sheet, put_text
from osfcore.io.files import write_json
from osfcore.io.image_file import to_uint8, write_png
from osfcore.io.json_codec import decode, encode
from osfcore.io.scene_file import estimated_from_json, estimated_to_json
from osfcore.objects.asset import ObjectAsset
from osfcore.objects.asset_library import AssetLibrary
from osfcore.random_streams import Stream, stream_rng
from osfcore.render.types import Quality, SceneBatch
from osfcore.world.tasks import Draw, draw_scene

# The parts of the evaluation of estimators, one task at a time, each kept on disk when it is done.
#
# Times are of estimates alone: fields are loaded and unpacked, code is compiled and the ways in which objects can
# lie are found in a warm-up on a scene that no figure uses, because all that is done once in a program's life. They
# are kept with the rest, so times mean something only where the machine had nothing else to do.


VERSION = 2  # raised by hand when figures may change
Part = Literal["first", "track", "goal", "ablations"]
PARTS: tuple[Part, ...] = ("first", "track", "goal", "ablations")
VIEWS: dict[int, tuple[int, ...]] = {1: (0,), 2: (0, 2)}  # cameras that an ablation keeps: two face each other
_SHOWN_QUALITY = Quality(samples_per_side=2)
_OVERHEAD = (0.0, 0.0, 1.0)


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
        self._assets: dict[str, ObjectAsset] = {}

    def __reduce__(self) -> tuple[object, ...]:
        """Be sent to another process, where all pieces share one."""
        return _shared_runner, (self._config, self._names, self._fields, self._library)

    # Parts

    def first(self, number: int) -> Piece:
        """The first frame of a task; its figures hold the score and the estimated state."""
        return self._first("first", number, self._config.effort, tuple(range(len(self._cameras))))

    def varied(self, number: int, factor: str) -> Piece:
        """The first frame of a task under a factor of variation."""
        draw, effort = self._draw(number), self._config.effort
        given = {**self._circumstances(draw, asdict(effort)), "factor": factor}
        work = partial(self._seen_first, draw, effort, tuple(range(len(self._cameras))), factor_named(factor))
        return self._piece(f"factor_{factor}", number, given, work)

    def fixed_light(self, number: int) -> Piece:
        """The first frame with the light held overhead."""
        effort = replace(self._config.effort, held_light=_OVERHEAD)
        return self._first("fixed_light", number, effort, tuple(range(len(self._cameras))))

    def few_views(self, number: int, views: int) -> Piece:
        """The first frame from one or two cameras."""
        return self._first(f"views_{views}", number, self._config.effort, VIEWS[views])

    def track(self, number: int, first: TaskResult) -> Piece:
        """Later frames of a task, from its first estimate on."""
        draw, effort = self._draw(number), self._config.track
        begun = {"first": digest(first.figures), "steps": self._config.steps}
        score = decode(FrameScore, first.figures["score"], "score")
        work = partial(self._tracked, draw, state_of(first), score, effort)
        return self._piece("track", number, {**self._circumstances(draw, asdict(effort)), **begun}, work)

    def goal(self, number: int, first: TaskResult) -> Piece:
        """The goals of a task, told how the objects lie by its first estimate."""
        draw, effort = self._draw(number), self._config.goal
        given = {**self._circumstances(draw, asdict(effort)), "first": digest(first.figures)}
        return self._piece("goal", number, given, partial(self._goals, draw, state_of(first), effort))

    def bad(self, number: int) -> Piece:
        """A spoiled input."""
        config = self._config
        draw = self._draw(FIRST_SCENE + number)
        given = self._circumstances(draw, {"first": asdict(config.effort), "goal": asdict(config.goal)})
        # A case may call up an object that its scene does not hold.
        given["all"] = {name: [self._weights[name], self._library.digest(name)] for name in self._names}
        return self._piece("bad", number, given, partial(self._spoiled, number, draw.seed))

    def _first(self, part: str, number: int, effort: FirstFrameConfig, views: tuple[int, ...]) -> Piece:
        draw = self._draw(number)
        given = {**self._circumstances(draw, asdict(effort)), "views": list(views)}
        return self._piece(part, number, given, partial(self._seen_first, draw, effort, views))

    def _piece(self, part: str, number: int, given: dict[str, Any], work: Callable[[], TaskResult]) -> Piece:
        return Piece(f"{number:04d}", TaskCache(self._config.folder / part), given, work)

    # How they are measured

    def _seen_first(
        self, draw: Draw, effort: FirstFrameConfig, views: tuple[int, ...], factor: Factor | None = None
    ) -> TaskResult:
        frame = first_frame(draw, self._library, tuple(self._cameras[view] for view in views), factor)
        rng = stream_rng(draw.seed, Stream.FIRST_FRAME)
        score, estimate = self._timed(estimate_first(self._models, frame.observation, rng, effort), frame)
        figures = {"score": encode(score), "state": None if estimate is None else estimated_to_json(estimate)}
        return TaskResult(figures, self._compared(frame.observation, None if estimate is None else estimate.state))

    def _tracked(self, draw: Draw, start: SceneState | None, first: FrameScore, effort: TrackingConfig) -> TaskResult:
        pushes = episode(draw, self._library, self._cameras, steps=self._config.steps)
        if start is None:
            score = TrackScore(
                draw.names, (False,) * len(draw.names), (), (), (), (), (), pushes.moved_m, first.refused
            )
            return TaskResult({"score": encode(score)}, self._compared(pushes.frames[-1].observation, None))
        models, assets, expected = self._models, self._meshes(draw.names), start
        rng = stream_rng(draw.seed, Stream.TRACKING)
        rows: dict[str, Any] = {key: [] for key in ("position_mm", "rotation_deg", "doubted", "seconds")}
        states = []
        for frame in pushes.frames:
            began = time.perf_counter()
            estimate = last_estimate(estimate_next(models, frame.observation, expected, rng, effort))
            rows["seconds"].append(time.perf_counter() - began)
            expected = estimate.state
            position, rotation = pose_errors(expected, frame.truth, assets)
            rows["position_mm"].append(tuple(position.tolist()))
            rows["rotation_deg"].append(tuple(rotation.tolist()))
            rows["doubted"].append(flags(estimate))
            states.append(expected)
        score = TrackScore(
            draw.names,
            tuple(one.is_right for one in first.objects),
            tuple(rows["position_mm"]),
            tuple(rows["rotation_deg"]),
            tuple(frame.absent for frame in pushes.frames),
            tuple(rows["doubted"]),
            tuple(rows["seconds"]),
            pushes.moved_m,
        )
        lost = [step for step in score.lost_at if step is not None]
        step = min(lost, default=len(states) - 1)  # where it went wrong, or how it ended
        shown = self._compared(pushes.frames[step].observation, states[step])
        return TaskResult({"score": encode(score), "shown_step": step, "redrawn": pushes.redrawn}, shown)

    def _goals(self, draw: Draw, prior: SceneState | None, effort: GoalImageConfig) -> TaskResult:
        scores, shown, moved, models = [], [], [], self._models
        for goal in goals(draw, self._library, goal_camera(self._config.size)):
            frame, estimate = goal.frame, None
            if prior is None:
                score = refused_frame(draw.names, "The first frame was refused.", 0.0)
            else:
                score, estimate = self._timed(estimate_goal(models, frame.observation, prior, effort), frame)
            scores.append(encode(score))
            moved.append(list(goal.moved))
            shown += self._compared(frame.observation, None if estimate is None else estimate.state)
        return TaskResult({"scores": scores, "moved": moved}, tuple(shown))

    def _spoiled(self, number: int, seed: int) -> TaskResult:
        models, config, rng = self._models, self._config, stream_rng(seed, Stream.FIRST_FRAME)
        case = bad_case(self._names, config.objects, config.seed, number, self._library, config.size)
        began, estimate, refused = time.perf_counter(), None, ""
        try:
            if case.start is None:
                estimate = last_estimate(estimate_first(models, case.observation, rng, config.effort))
            else:
                prior = last_estimate(estimate_first(models, case.start, rng, config.effort)).state
                began = time.perf_counter()
                estimate = last_estimate(estimate_goal(models, case.observation, prior, config.goal))
        except OsfError as error:
            refused = str(error)
        seconds = time.perf_counter() - began
        shown = self._compared(case.observation, None if estimate is None else estimate.state)
        score = BadScore(case.kind, refused, "", is_right=False, seconds=seconds)
        if estimate is not None:
            score = replace(self._judged(estimate, case), seconds=seconds)
        return TaskResult({"score": encode(score)}, shown)

    def _judged(self, estimate: EstimatedState, case: BadCase) -> BadScore:
        """Errors of objects that are there; an answer that names one that is not there is wrong."""
        there = [n for n, name in enumerate(estimate.state.names) if name in case.truth.names]
        names = tuple(estimate.state.names[n] for n in there)
        state = replace(estimate.state, names=names, poses=estimate.state.poses[there])
        position, rotation = pose_errors(state, case.truth, self._meshes(names))
        is_right = len(names) == len(estimate.state.names) and all(map(is_right_pose, position, rotation))
        return BadScore(
            case.kind, "", estimate.reason, is_right, tuple(position.tolist()), tuple(rotation.tolist())
        )  # fmt: skip

    def _timed(self, steps: Iterator[EstimateStep], frame: Frame) -> tuple[FrameScore, EstimatedState | None]:
        """Run an estimate; a refusal is a result too."""
        began = time.perf_counter()
        try:
            estimate = last_estimate(steps)
        except OsfError as error:
            return refused_frame(frame.truth.names, str(error), time.perf_counter() - began), None
        seconds = time.perf_counter() - began
        meshes = self._meshes(frame.truth.names)
        return score_frame(estimate, frame.truth, meshes, seconds, frame.absent), estimate

    def _compared(self, observation: Observation, state: SceneState | None) -> tuple[Comparison, ...]:
        """Each view, observed and rendered from the estimate; black where there is none."""
        ours = np.zeros_like(observation.images)
        if state is not None:
            batch = SceneBatch.of(state)
            ours = self._models.together.render(batch, observation.cameras, quality=_SHOWN_QUALITY).rgb[0]
        rows = zip(observation.cameras, observation.images, ours, strict=True)
        return tuple(Comparison(f"camera {camera.name}", to_uint8(a), to_uint8(b)) for camera, a, b in rows)

    # What they depend on

    @cached_property
    def _models(self) -> ObjectModels:
        """Loaded when the first estimate is asked for: all may be known from earlier runs."""
        config = self._config
        goal = "goal" in config.parts or config.bad > 0
        draw = self._draw(WARM_SCENE)
        return warm_models(self._names, self._fields, self._library, draw, config.size, goal=goal)

    @cached_property
    def _weights(self) -> dict[str, str]:
        return {name: file_sha256(self._fields.info(name).path) for name in self._names}

    @cached_property
    def _table(self) -> str:
        return table_sha256(self._fields.load_table())

    def _circumstances(self, draw: Draw, effort: dict[str, Any]) -> dict[str, Any]:
        """Everything that a result depends on."""
        return {
            "version": VERSION,
            "weights": {name: self._weights[name] for name in draw.names},
            "assets": {name: self._library.digest(name) for name in draw.names},
            "table": self._table,
            "arrangement": draw.seed,
            "light": draw.light.direction.tolist(),
            "size": self._config.size,
            "effort": effort,
        }

    def _draw(self, number: int) -> Draw:
        return draw_scene(self._names, self._config.objects, self._config.seed, number)

    def _meshes(self, names: Sequence[str]) -> dict[str, ObjectAsset]:
        for name in names:
            if name not in self._assets:
                self._assets[name] = self._library.load(name)
        return {name: self._assets[name] for name in names}


def state_of(first: TaskResult) -> SceneState | None:
    """What was estimated of a first frame, as it was kept."""
    state = first.figures["state"]
    return None if state is None else estimated_from_json(state).state


def digest(figures: dict[str, Any]) -> str:
    """Of a first estimate, which others begin with."""
    return hashlib.sha256(json.dumps(figures["state"], sort_keys=True).encode()).hexdigest()


@lru_cache(maxsize=1)
def _shared_runner(
    config: EvaluateEstimate, names: tuple[str, ...], fields: FieldLibrary, assets: AssetLibrary
) -> TaskRunner:
    """The runner of a worker process."""
    return TaskRunner(config, names, fields, assets)


# What the parts of the evaluation of estimators amount to.


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
        """First frames by number of cameras, the main ones among them."""
        cameras = 4  # the default ones
        return {**(self.views or {}), cameras: self.first}

    def to_json(self) -> dict[str, Any]:
        """The report as plain numbers: millimetres, degrees, seconds, shares in [0, 1]; null for what was not measured.

        `flagged_good` and `flagged_bad` are over first frames and goals together.
        """
        flagged_good, flagged_bad = flagged_shares([*self.first, *self.all_goals])
        return {
            "tasks": len(self.first),
            **_frames(self.first, "first"),
            "by_object": _by_object(self.first),
            **_uncertainty(self.first),
            **_goals(self.goals),
            "flagged_good": flagged_good,
            "flagged_bad": flagged_bad,
            **_tracks(self.tracks),
            "frac_1cm_5deg_fixed_light": None if self.fixed_light is None else share_right(self.fixed_light),
            "fixed_light": None if self.fixed_light is None else _brief(self.fixed_light),
            "by_views": None if self.views is None else {str(n): _brief(f) for n, f in self.by_views().items()},
            **(summary(self.bad) if self.bad is not None else {}),
            **(
                {"by_factor": {name: _varied_figures(frames) for name, frames in self.factors.items()}}
                if self.factors
                else {}
            ),
        }


def _frames(frames: Sequence[FrameScore], what: str) -> dict[str, Any]:
    objects = objects_of(frames)
    position, rotation = [o.position_mm for o in objects], [o.rotation_deg for o in objects]
    return {
        "objects_total": sum(len(frame.names) for frame in frames),
        "frac_1cm_5deg": share_right(frames),
        **_spread("position_mm", position),
        **_spread("rotation_deg", rotation),
        **_spread("adds_mm", [o.adds_mm for o in objects]),
        **_spread("light_deg", [frame.light_deg for frame in frames if frame.light_deg is not None]),
        **_spread(f"{what}_s", [frame.seconds for frame in frames]),
        f"{what}_refused": sum(bool(frame.refused) for frame in frames),
        f"{what}_out_of_view": sum(bool(o.absent) for o in objects),
    }


def _spread(what: str, values: Sequence[float]) -> dict[str, float | None]:
    """Median, mean and tails."""
    return {
        f"{what}_median": median(values),
        f"{what}_mean": float(np.mean(values)) if len(values) else None,
        f"{what}_p90": quantile(values, 0.9),
        f"{what}_p95": quantile(values, 0.95),
    }


def _by_object(frames: Sequence[FrameScore]) -> dict[str, dict[str, Any]]:
    """Of each object: how often it was seen, how often it was right, and its errors."""
    rows: dict[str, dict[str, Any]] = {}
    for name in sorted({name for frame in frames for name in frame.names}):
        own = [o for o in objects_of(frames) if o.name == name]
        shown = sum(name in frame.names for frame in frames)
        rows[name] = {
            "frames": shown,
            "frac_1cm_5deg": sum(o.is_right for o in own) / shown,
            **_spread("position_mm", [o.position_mm for o in own]),
            **_spread("rotation_deg", [o.rotation_deg for o in own]),
        }
    return rows


def _uncertainty(frames: Sequence[FrameScore]) -> dict[str, Any]:
    """How honest claimed deviations are, and how large; of right estimates alone."""
    ratios = ratios_of(frames)
    claimed = [o.position_std_mm for o in objects_of(frames) if o.is_right and o.position_std_mm is not None]
    return {
        "two_sigma_coverage": coverage(ratios.pooled),
        "two_sigma_coverage_position": coverage(ratios.position),
        "two_sigma_coverage_rotation": coverage(ratios.rotation),
        "two_sigma_coverage_light": coverage(ratios.light),
        "mean_position_std_mm": float(np.mean(claimed)) if claimed else None,
    }


def _goals(goals: Sequence[Sequence[FrameScore]] | None) -> dict[str, Any]:
    flat = [goal for task in goals or () for goal in task]
    row = _frames(flat, "goal")
    by_moved: dict[str, float | None] = {}
    for moved in range(max((len(task) for task in goals or ()), default=0)):
        by_moved[str(moved + 1)] = share_right([task[moved] for task in goals or () if len(task) > moved])
    errors = [f"{what}_{of}" for what in ("position_mm", "rotation_deg", "light_deg") for of in _OF]
    keys = ("frac_1cm_5deg", "objects_total", *errors)
    own = (*(f"goal_s_{of}" for of in _OF), "goal_refused", "goal_out_of_view")
    if goals is None:
        return {**dict.fromkeys([f"goal_{key}" for key in keys] + list(own)), "goal_frac_1cm_5deg_by_moved": None}
    return {
        **{f"goal_{key}": row[key] for key in keys},
        **{key: row[key] for key in own},
        "goal_frac_1cm_5deg_by_moved": by_moved,
    }


def _tracks(tracks: Sequence[TrackScore] | None) -> dict[str, Any]:
    """How tracking went.

    An episode is lost when one of its objects is; `track_lost_from_wrong_start` counts those among them whose lost
    objects were all wrong in the first frame already. Steps at which an object lay beside the table or hidden from all
    cameras are left out of drift and losses and counted here, as pairs of object and step.
    """
    keys = (
        "refine_hz", *(f"refine_s_{of}" for of in _OF), "track_episodes", "track_lost", "track_lost_from_wrong_start",
        "track_objects_lost", "track_frac_1cm_5deg", "track_off_table", "track_out_of_view", "drift_mm", "drift_deg",
        "track_moved", "track_resting",
    )  # fmt: skip
    if tracks is None:
        return dict.fromkeys(keys)
    seconds = [second for track in tracks for second in track.seconds]
    typical = median(seconds)
    lost = [[n for n, step in enumerate(track.lost_at) if step is not None] for track in tracks]
    pairs = list(zip(tracks, lost, strict=True))
    excused = [bool(gone) and not any(track.right_at_start[n] for n in gone) for track, gone in pairs]
    absent = [why for track in tracks for row in track.absent for why in row]
    right = [is_right(p, r) for track in tracks for step in range(len(track.seconds)) for p, r in _seen(track, step)]
    values = (
        1 / typical if typical else None, *_spread("", seconds).values(), len(tracks), sum(map(bool, lost)),
        sum(excused), sum(map(len, lost)), sum(right) / len(right) if right else None,
        absent.count("off the table"), absent.count("out of view"), drift(tracks, 0), drift(tracks, 1),
        _apart(tracks, has_moved=True), _apart(tracks, has_moved=False),
    )  # fmt: skip
    return dict(zip(keys, values, strict=True))


def drift(tracks: Iterable[TrackScore], which: int) -> dict[str, float | None]:
    """Median error of position [mm] (0) or rotation [deg] (1) over all visible objects, by step."""
    known = list(tracks)
    return {str(step): median(errors_at(known, step, which)) for step in DRIFT_STEPS}


def errors_at(tracks: Iterable[TrackScore], step: int, which: int) -> list[float]:
    """Errors of all visible objects at one step.

    Args:
        tracks: those that ended before this step have none.
        step: from 1.
        which: 0 for position [mm], 1 for rotation [deg].
    """
    return [pair[which] for track in tracks if len(track.seconds) >= step for pair in _seen(track, step - 1)]


def _apart(tracks: Sequence[TrackScore], *, has_moved: bool) -> dict[str, float | None]:
    """Errors over all steps of the objects that were pushed at least 1 cm away in their episode, or of all others."""
    rows = [
        (track.position_mm[step][n], track.rotation_deg[step][n])
        for track in tracks
        for n, way_m in enumerate(track.moved_m)
        if (way_m >= _MOVED_M) == has_moved
        for step in range(len(track.seconds))
        if not track.absent[step][n]
    ]
    position, rotation = ([row[k] for row in rows] for k in (0, 1))
    return {**_spread("position_mm", position), **_spread("rotation_deg", rotation)}


def _seen(track: TrackScore, step: int) -> list[tuple[float, float]]:
    """Errors at a step of the objects that some image shows."""
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


# Pictures of an evaluation of estimators: curves of errors, and galleries of what went wrong.


MOST_SHOWN = 20  # tasks in a gallery
_PER_ROW = 4
_LINE_PX = 16
_LEAST_WIDTH_PX = 680
_SHARE = Axis("share of objects", 0, 1)
_POSITION, _ROTATION = Axis("position error [mm]", 0, 20), Axis("rotation error [deg]", 0, 10)


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


def write_plots(folder: Path, report: EstimateReport) -> None:
    """Draw errors.png and calibration.png, and track.png and views.png where these parts were measured.

    Raises:
        CannotWrite: if the disk refuses.
    """
    write_charts(folder / "errors.png", errors_charts(report))
    write_charts(folder / "calibration.png", calibration_charts(report.first))
    if report.tracks:
        write_charts(folder / "track.png", track_charts(report.tracks))
    if report.views is not None:
        write_charts(folder / "views.png", views_charts(report))


def errors_charts(report: EstimateReport) -> list[Chart]:
    """Cumulative errors of position and rotation; refused objects keep a curve below 1."""
    kinds = {"first frame, 4 views": report.first, "goal, 1 view": report.all_goals}
    kinds["light held overhead"] = report.fixed_light or ()
    panels = []
    for axis, key in ((_POSITION, "position_mm"), (_ROTATION, "rotation_deg")):
        curves = []
        for name, frames in kinds.items():
            if frames:
                values = [getattr(score, key) for score in objects_of(frames)]
                curves.append(cumulative(name, values, axis, sum(len(frame.names) for frame in frames)))
        panels.append(Chart("Objects with at most this error", axis, _SHARE, curves))
    return panels


def calibration_charts(frames: Sequence[FrameScore]) -> list[Chart]:
    """How often errors lie within so many claimed deviations, against Gaussian errors."""
    axis, ratios = Axis("|error| / claimed deviation", 0, 5), ratios_of(frames)
    x = np.linspace(0, 5, 200)
    curves = [
        Curve("if it were Gaussian", x, erf(x / np.sqrt(2))),
        *(cumulative(key, getattr(ratios, key), axis) for key in ("position", "rotation", "light")),
    ]
    return [Chart("Right estimates: are deviations honest?", axis, Axis("share of components", 0, 1), curves)]


def track_charts(tracks: Sequence[TrackScore]) -> list[Chart]:
    """Errors along episodes: median, and what nine of ten stay below."""
    count = max((len(track.seconds) for track in tracks), default=0)
    steps = np.arange(1, count + 1)
    panels = []
    for which, axis in enumerate((_POSITION, _ROTATION)):
        values = [errors_at(tracks, int(step), which) for step in steps]
        curves = [
            Curve("median", steps.astype(float), np.array([median(v) for v in values], float), dots=True),
            Curve("90 % below", steps.astype(float), np.array([quantile(v, 0.9) for v in values], float), dots=True),
        ]
        errors = Axis(axis.label, 0)
        panels.append(Chart("Without masks, step by step", Axis("step", 0, max(count, 1)), errors, curves))
    return panels


def views_charts(report: EstimateReport) -> list[Chart]:
    """Accuracy by number of cameras."""
    views = report.by_views()
    x = np.array(sorted(views), float)
    axis = Axis("cameras", 0, float(x.max()) + 1)
    frames = [views[int(n)] for n in x]
    right = np.array([share_right(f) for f in frames], float)
    errors = [
        Curve(name, x, np.array([median(getattr(o, key) for o in objects_of(f)) for f in frames], float), dots=True)
        for name, key in (("position, median [mm]", "position_mm"), ("rotation, median [deg]", "rotation_deg"))
    ]
    light = np.array([median(frame.light_deg for frame in f) for f in frames], float)
    errors.append(Curve("light, median [deg]", x, light, dots=True))
    return [
        Chart("Under 1 cm and 5 deg", axis, _SHARE, [Curve("share", x, right, dots=True)]),
        Chart("Errors", axis, Axis("error", 0), errors),
    ]


# Galleries


def frame_failure(title: str, score: FrameScore, shown: Sequence[Comparison]) -> Failure | None:
    """A frame that was refused, or with an object that is wrong, or right and flagged; None if there is nothing to see.

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
    wrong = [o for o in score.objects if not o.is_right]
    badness = len(wrong) + sum(not o.flagged for o in wrong) * 10
    return Failure(float(badness), tuple(lines), tuple(shown))


def track_failure(title: str, score: TrackScore, shown: Sequence[Comparison]) -> Failure | None:
    """An episode in which an object was lost, or that had no start; None if there is nothing to see.

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
    """A spoiled input that was believed although the answer is wrong; None otherwise.

    Args:
        title: of the case, for the only line.
        score: of the answer.
        shown: observed and rendered images.
    """
    if not score.is_confidently_wrong:
        return None
    errors = ", ".join(f"{p:.0f} mm / {r:.0f} deg" for p, r in zip(score.position_mm, score.rotation_deg, strict=True))
    return Failure(1.0, (f"{title}: {score.kind}: wrong without a warning ({errors})",), tuple(shown))


def write_gallery(path: Path, failures: Sequence[Failure | None]) -> None:
    """The worst of them below each other, or no file (an older one goes) where nothing failed.

    Raises:
        CannotWrite: if the disk refuses.
    """
    chosen = sorted((f for f in failures if f is not None and f.shown), key=lambda f: -f.badness)[:MOST_SHOWN]
    if chosen:
        write_png(path, gallery(chosen))
    else:
        path.unlink(missing_ok=True)


def gallery(failures: Sequence[Failure]) -> UInt8[np.ndarray, "H W 3"]:
    """For each: what went wrong in words, and below it observed images, rendered ones and their difference."""
    blocks = []
    for failure in failures:
        sheet = contact_sheet(failure.shown, per_row=_PER_ROW, truth="seen")
        words = np.full((_LINE_PX * len(failure.lines) + 4, max(sheet.shape[1], _LEAST_WIDTH_PX), 3), 255, np.uint8)
        for number, line in enumerate(failure.lines):
            put_text(words, line, (4, _LINE_PX * (number + 1) - 4), words.shape[1] - 8)
        blocks += [words, sheet]
    width = max(block.shape[1] for block in blocks)
    return np.vstack([np.pad(b, ((0, 0), (0, width - b.shape[1]), (0, 0)), constant_values=255) for b in blocks])


REPORT_FILE = "report.json"
_FACTOR = "factor_"  # and its name: a part
_Results = dict[str, list[TaskResult]]


@dataclass(frozen=True, eq=False, slots=True)
class EstimateEvaluationStep:
    """How far an evaluation is.

    Attributes:
        done: parts of tasks finished.
        total: parts of tasks in all.
        note: what is being done.
        report: with the last step only.
    """

    done: int
    total: int
    note: str
    report: EstimateReport | None = None


def evaluate_estimate(
    config: EvaluateEstimate, fields: FieldLibrary, assets: AssetLibrary, executor: Executor | None = None
) -> Iterator[EstimateEvaluationStep]:
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
    runner = TaskRunner(config, _checked(config, fields, assets), fields, assets)
    kept: _Results = {}
    jobs = _jobs(config, runner, kept)
    total, done = sum(count for _, count, _ in jobs.values()), 0
    for key, (title, count, work) in jobs.items():
        for results in results_of([work(number) for number in range(count)], executor):
            kept[key] = [result for result in results if result is not None]
            if (ready := len(kept[key])) < count:
                yield EstimateEvaluationStep(done + ready, total, f"{title} ({ready + 1} of {count})")
        done += count
    report = _report(kept)
    write_plots(config.folder, report)
    _galleries(config, kept)
    write_json(config.folder / REPORT_FILE, report.to_json())
    yield EstimateEvaluationStep(total, total, "Everything is measured", report)


_Job = tuple[str, int, Callable[[int], Piece]]  # what it is called, how many, and one of them


def _jobs(config: EvaluateEstimate, runner: TaskRunner, kept: _Results) -> dict[str, _Job]:
    """What there is to do, in order; tracks and goals begin with the first frames in `kept`."""
    tasks = config.tasks
    jobs: dict[str, _Job] = {"first": ("First frames", tasks, runner.first)}
    if "track" in config.parts:
        jobs["track"] = "Tracks", tasks, lambda number: runner.track(number, kept["first"][number])
    if "goal" in config.parts:
        jobs["goal"] = "Goals", tasks, lambda number: runner.goal(number, kept["first"][number])
    if "ablations" in config.parts:
        jobs["fixed_light"] = "Light held overhead", tasks, runner.fixed_light
        for views in VIEWS:
            jobs[f"views_{views}"] = f"{views} of 4 views", tasks, _few_views(runner, views)
    for factor in config.factors:
        jobs[f"{_FACTOR}{factor}"] = f"Factor {factor}", tasks, _varied(runner, factor)
    if config.bad:
        jobs["bad"] = "Bad cases", config.bad, runner.bad
    return jobs


def _few_views(runner: TaskRunner, views: int) -> Callable[[int], Piece]:
    return lambda number: runner.few_views(number, views)


def _varied(runner: TaskRunner, factor: str) -> Callable[[int], Piece]:
    return lambda number: runner.varied(number, factor)


def _checked(config: EvaluateEstimate, fields: FieldLibrary, assets: AssetLibrary) -> tuple[str, ...]:
    """The objects to draw from, after everything asked for was found possible."""
    check_ranges(
        ("number of tasks", config.tasks, 1, MAX_TASKS),
        ("number of bad cases", config.bad, 0, MAX_TASKS),
        ("objects in a scene", config.objects, 1, MAX_OBJECTS),
    )
    check_seed(config.seed)
    for part in config.parts:
        if part not in PARTS:
            raise InvalidInput("part", part, f"one of {', '.join(PARTS)}")
    for factor in config.factors:
        factor_named(factor)  # raises UnknownName
    image_side(config.size)
    known = tuple(name for name in fields.names() if assets.has(name))
    if config.names is None and not known:
        raise MissingAssets(list(fields.names()))
    names = known if config.names is None else tuple(dict.fromkeys(config.names))
    for name in names:
        fields.info(name)  # raises UnknownName
    missing = [name for name in names if not assets.has(name)]
    if missing:
        assets.info(missing[0])
        raise MissingAssets(missing)
    least = config.objects + (1 if config.bad else 0)  # a bad case calls an object by another's name
    if len(names) < least:
        raise InvalidInput("number of names", len(names), f"{least} or more for {config.objects} objects in a scene")
    if config.bad and config.objects < 2:
        raise InvalidInput("objects in a scene", config.objects, "2 or more with bad cases, which swap masks")
    return names


def _report(kept: _Results) -> EstimateReport:
    def frames(key: str) -> tuple[FrameScore, ...]:
        return tuple(decode(FrameScore, result.figures["score"], "score") for result in kept[key])

    tracks = kept.get("track")
    bad = kept.get("bad")
    return EstimateReport(
        first=frames("first"),
        tracks=None
        if tracks is None
        else tuple(decode(TrackScore, result.figures["score"], "score") for result in tracks),
        goals=tuple(map(_goal_scores, kept["goal"])) if "goal" in kept else None,
        fixed_light=frames("fixed_light") if "fixed_light" in kept else None,
        views={views: frames(f"views_{views}") for views in VIEWS} if "fixed_light" in kept else None,
        bad=None if bad is None else tuple(decode(BadScore, result.figures["score"], "score") for result in bad),
        factors={key.removeprefix(_FACTOR): frames(key) for key in kept if key.startswith(_FACTOR)},
    )


def _goal_scores(result: TaskResult) -> tuple[FrameScore, ...]:
    return tuple(decode(FrameScore, score, "score") for score in result.figures["scores"])


def _galleries(config: EvaluateEstimate, kept: _Results) -> None:
    """What went wrong, each part in a picture of its own."""
    folder = config.folder
    factors = [key for key in kept if key.startswith(_FACTOR)]
    for key in ("first", "fixed_light", *(f"views_{views}" for views in VIEWS), *factors):
        if key in kept:
            scores = [decode(FrameScore, result.figures["score"], "score") for result in kept[key]]
            failures = [frame_failure(f"task {n}", score, kept[key][n].shown) for n, score in enumerate(scores)]
            write_gallery(folder / f"failures_{key}.png", failures)
    if "track" in kept:
        tracks = [decode(TrackScore, result.figures["score"], "score") for result in kept["track"]]
        failures = [track_failure(f"task {n}", score, kept["track"][n].shown) for n, score in enumerate(tracks)]
        write_gallery(folder / "failures_track.png", failures)
    if "goal" in kept:
        failures = []
        for n, result in enumerate(kept["goal"]):
            for m, (score, shown) in enumerate(zip(_goal_scores(result), result.shown, strict=True)):
                failures.append(frame_failure(f"task {n}, goal with {m + 1} moved", score, (shown,)))
        write_gallery(folder / "failures_goal.png", failures)
    if "bad" in kept:
        bad = [decode(BadScore, result.figures["score"], "score") for result in kept["bad"]]
        failures = [bad_failure(f"bad case {n}", score, kept["bad"][n].shown) for n, score in enumerate(bad)]
        write_gallery(folder / "failures_bad.png", failures)
