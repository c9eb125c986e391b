"""The parts of the evaluation of estimators, one task at a time, each kept on disk when it is done.

Times are of estimates alone: fields are loaded and unpacked, code is compiled and the ways in which objects can lie are
found in a warm-up on a scene that no figure uses, because all that is done once in a program's life. They are kept with
the rest, so times mean something only where the machine had nothing else to do.
"""

from __future__ import annotations

import hashlib
import json
import time
from collections.abc import Callable, Iterator, Sequence
from dataclasses import asdict, dataclass, field, replace
from functools import cached_property, lru_cache, partial
from pathlib import Path
from typing import Any, Literal

import numpy as np

from osfcore.control.first_frame import estimate_first
from osfcore.errors import OsfError
from osfcore.estimation.first_frame import FirstFrameConfig
from osfcore.estimation.goal_image import estimate_goal
from osfcore.estimation.goal_refinement import GoalImageConfig
from osfcore.estimation.objective.object_models import ObjectModels
from osfcore.estimation.steps import EstimateStep
from osfcore.estimation.tracking import TrackingConfig, estimate_next
from osfcore.experiments.estimation.scores import FrameScore, TrackScore, flags, pose_errors, refused_frame, score_frame
from osfcore.experiments.estimation.scores import is_right as is_right_pose
from osfcore.experiments.estimation.spoiled_inputs import FIRST_SCENE, BadCase, BadScore, bad_case
from osfcore.experiments.estimation.tasks import STEPS, Frame, episode, first_frame, goals
from osfcore.experiments.estimation.warmup import WARM_SCENE, last_estimate, warm_models
from osfcore.experiments.pieces import Piece
from osfcore.experiments.rearrangement.factors import Factor, factor_named
from osfcore.experiments.task_cache import TaskCache, TaskResult, file_sha256, table_sha256
from osfcore.fields.field_library import FieldLibrary
from osfcore.geometry.cameras import DEFAULT_IMAGE_SIDE, default_cameras, goal_camera
from osfcore.geometry.estimated_state import EstimatedState
from osfcore.geometry.states import Observation, SceneState
from osfcore.inspection.contact_sheet import Comparison
from osfcore.io.image_file import to_uint8
from osfcore.io.json_codec import decode, encode
from osfcore.io.state_file import estimated_from_json, estimated_to_json
from osfcore.objects.asset import ObjectAsset
from osfcore.objects.asset_library import AssetLibrary
from osfcore.random_streams import Stream, stream_rng
from osfcore.render.types import Quality, SceneBatch
from osfcore.world.random_scenes import Draw, draw_scene

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
