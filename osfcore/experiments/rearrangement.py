"""Measure how well tables become what a goal image shows (paper, section 5.4 and figure 7).

The loop sees four cameras, masks in the first frame, and the goal image; it has 30 actions, or as many as are asked
for. The same tasks are given to the same planner with true poses, whose best of several tries counts (an oracle: an
upper bound), and to nobody. A goal that is refused counts as a failure, for nothing is moved then; beside it stands
what happens if the doubt is overruled. Results of finished tasks are kept in the output folder: a killed evaluation
goes on where it was. Methods other than ours refuse no goal.
"""

from __future__ import annotations

import time
from collections.abc import Callable, Iterator, Mapping, Sequence
from concurrent.futures import Executor
from dataclasses import asdict, dataclass, field, replace
from functools import cached_property, partial
from pathlib import Path
from typing import Any

import numpy as np
import torch
from jaxtyping import Float

from osfcore.control.estimators import SceneModels, load_scene_models
from osfcore.control.events import (
    ActionExecuted,
    CostKind,
    EpisodeSettings,
    Event,
    Finished,
    GoalFound,
    Noticed,
    Stepped,
)
from osfcore.dynamics.graph import read_network
from osfcore.dynamics.rollout import PushModel, network_path, shipped
from osfcore.errors import InvalidInput
from osfcore.experiments.charts import Axis, Chart, cumulative, write_charts
from osfcore.experiments.dynamics import MOVED_DEG, MOVED_MM
from osfcore.experiments.factors import UNSEEN_NETWORK, Factor, factor_named
from osfcore.experiments.harness import (
    EvaluationStep,
    Piece,
    TaskCache,
    TaskResult,
    check_run,
    chosen_objects,
    file_sha256,
    finished,
    table_sha256,
)
from osfcore.experiments.images import field_path, known_names
from osfcore.experiments.rearrangement_runs import (
    Ended,
    TrueState,
    Variant,
    check_variant,
    loop_parts,
    run_from_images,
    run_told_the_truth,
)
from osfcore.experiments.rivals.fitvid import fitvid_path, read_fitvid
from osfcore.experiments.rivals.visual_foresight import Foreseen, ForesightSettings, run_visual_foresight
from osfcore.experiments.statistics import (
    compare_means,
    compare_shares,
    mean,
    mean_interval,
    median,
    rounded,
    share_interval,
)
from osfcore.fields.field_library import FieldLibrary
from osfcore.geometry.poses import Pose
from osfcore.geometry.states import SceneState
from osfcore.geometry.workspace import STEP_S
from osfcore.inspection.contact_sheet import Comparison, contact_sheet
from osfcore.io.files import write_json
from osfcore.io.image_file import to_uint8, write_png
from osfcore.io.json_codec import decode
from osfcore.metrics.pose_errors import pose_error
from osfcore.metrics.success import SUCCESS_M, RearrangementScore, RearrangementTask, score_of
from osfcore.objects.asset import Symmetry
from osfcore.objects.asset_library import AssetLibrary
from osfcore.paper.dynamics import weights_path
from osfcore.paper.mppi import GaussianPlanSettings
from osfcore.planning.mppi import PlanSettings
from osfcore.random_streams import Stream, stream_rng
from osfcore.world.simulators import Simulator, default_simulator
from osfcore.world.tasks import DrawnTask, Family, TaskSet, check_tasks, draw_task

# How well the pushes are predicted that the planner itself makes, from estimated poses.
#
# Open-loop evaluations start from true poses and take pushes of a random pusher; a planner sees neither.


AHEAD = 4  # actions


@dataclass(slots=True)
class Course:
    """An episode as it went: grows while it runs.

    Attributes:
        actions: by their number, from 1 [m/s].
        estimated: states by the number of actions before them.
        true: likewise.
    """

    actions: dict[int, Float[np.ndarray, "3"]] = field(default_factory=dict)
    estimated: dict[int, SceneState] = field(default_factory=dict)
    true: dict[int, SceneState] = field(default_factory=dict)


def prediction_errors(course: Course, models: SceneModels) -> dict[str, list[float]]:
    """Return errors four actions ahead of all objects that truly moved by over 1 cm or 5 deg meanwhile.

    Args:
        course: of the episode.
        models: of its objects.

    Returns:
        "mm" and "deg", symmetries considered, one entry for each object and start.
    """
    errors: dict[str, list[float]] = {"mm": [], "deg": []}
    for start, state in sorted(course.estimated.items()):
        numbers = range(start + 1, start + AHEAD + 1)
        if start + AHEAD not in course.true or any(number not in course.actions for number in numbers):
            continue
        actions = np.array([course.actions[number] for number in numbers])
        rollouts = models.dynamics.rollout(state, actions[None], course.estimated.get(start - 1))
        before, after = course.true[start], course.true[start + AHEAD]
        for n, name in enumerate(rollouts.names):
            way_mm, way_deg = pose_error(models.symmetries[name], before.pose(name), after.pose(name))
            if way_mm > MOVED_MM or way_deg > MOVED_DEG:
                predicted = Pose(rollouts.positions[0, AHEAD, n], rollouts.quaternions[0, AHEAD, n])
                mm, deg = pose_error(models.symmetries[name], predicted, after.pose(name))
                errors["mm"].append(round(mm, 3))
                errors["deg"].append(round(deg, 3))
    return errors


# Single episodes, measured: those of methods that see images, and of the planner that knows the truth.


@dataclass(frozen=True, eq=False, slots=True)
class MeasuredEpisodes:
    """Runs single tasks; can be sent to other processes.

    Attributes:
        tasks: which.
        fields: of their objects.
        assets: meshes for the simulator.
        data_dir: where networks trained on this machine are.
        factor: what differs from the usual world.
        variant: whose episodes.
    """

    tasks: TaskSet
    fields: FieldLibrary
    assets: AssetLibrary
    data_dir: Path
    factor: Factor
    variant: Variant

    def from_images(self, number: int, settings: EpisodeSettings, published: GaussianPlanSettings) -> TaskResult:
        """Run a task with a method that sees images alone; doubts about its goal are noted and overruled."""
        drawn = self._drawn(number)
        models = load_scene_models(drawn.task.start.names, self.fields, self.assets, self.data_dir)
        if self.factor.has_unseen_objects:
            models = replace(models, dynamics=PushModel(read_network(shipped(UNSEEN_NETWORK)), models.shapes))
        lights = drawn.task.start.light, drawn.task.goal.light
        parts = loop_parts(self.variant, models, self.fields, self.data_dir, lights)
        settings, rng = replace(settings, despite_doubts=True), stream_rng(self.tasks.seed, Stream.EPISODE, number)
        log = _Log(drawn.task, models.symmetries)
        given = drawn.task, self.assets, parts, settings, rng, self.factor, self.variant, published
        ended = log.follow(run_from_images(*given))
        return self._scored(drawn, ended, {**log.summary(), "predicted": prediction_errors(log.course, parts.models)})

    def by_foresight(self, number: int, settings: ForesightSettings, actions: int) -> TaskResult:
        """Run a task with visual foresight, which pushes until all actions are done and predicts no poses."""
        drawn = self._drawn(number)
        rng = stream_rng(self.tasks.seed, Stream.EPISODE, number)
        log, predictor = _Log(drawn.task, {}), read_fitvid(fitvid_path(self.data_dir), torch.bfloat16)
        given = drawn.task, self.assets, predictor, settings, actions, rng, self.factor, predictor.settings.side
        ended = log.follow(run_visual_foresight(*given))
        return self._scored(drawn, ended, {**log.summary(), "predicted": {"mm": [], "deg": []}})

    def oracle(self, number: int, settings: EpisodeSettings, tries: int) -> TaskResult:
        """Run the planner with true poses several times, and return the best; the simulator can be set back.

        Tries end with the first that succeeds. The last one has the simulator as its dynamics, which takes far longer
        than the learned model, and plans before every second action.
        """
        drawn = self._drawn(number)
        models = load_scene_models(drawn.task.start.names, self.fields, self.assets, self.data_dir)
        slow = replace(settings, replan_every=2, plan=replace(settings.plan, begins_m=0.0))
        ends: list[tuple[RearrangementScore, Ended]] = []
        for count in range(1, tries + 1):
            rng, is_last = stream_rng(self.tasks.seed, Stream.ORACLE, number, count), count == tries
            given = drawn.task, self.assets, models, slow if is_last else settings, rng
            end = run_told_the_truth(*given, knows_pushes=is_last, simulator=self.tasks.simulator)
            ends.append((self._score(drawn.task, end.state), end))
            if ends[-1][0].is_tight():
                break
        _, best = max(ends, key=lambda one: (one[0].is_tight(), one[0].is_success(), -one[0].pose6d_symmetric))
        return self._scored(drawn, best, {"tries": len(ends)})

    def _drawn(self, number: int) -> DrawnTask:
        drawn = draw_task(self.assets, self.tasks, number)
        task = self.factor.task(drawn.task, stream_rng(self.tasks.seed, Stream.FACTOR_LIGHT, number))
        return replace(drawn, task=task)

    def _scored(self, drawn: DrawnTask, ended: Ended, figures: dict[str, Any]) -> TaskResult:
        task = drawn.task
        score, nothing = (self._score(task, state) for state in (ended.state, task.start))
        scores = {"score": score.to_json(), "noaction": nothing.to_json(), "rejected": dict(drawn.rejected)}
        label = f"{task.number}: {score.moved_mm:.0f} mm"
        return TaskResult({**scores, **figures}, (Comparison(label, to_uint8(ended.goal), to_uint8(ended.image)),))

    def _score(self, task: RearrangementTask, state: SceneState) -> RearrangementScore:
        return score_of(task, state, {name: self.assets.info(name).symmetry for name in task.start.names})


class _Log:
    """What is kept of a task's events."""

    def __init__(self, task: RearrangementTask, symmetries: Mapping[str, Symmetry]) -> None:
        self._task, self._symmetries = task, symmetries
        unknown = dict.fromkeys(("goal_mm", "first_mm", "first_deg", "light_deg"))
        self.figures: dict[str, Any] = {"goal_doubt": "", "noticed": [], **unknown}
        self._seconds: dict[str, list[float]] = {}
        self.course = Course()
        self._truth: SceneState | None = None

    def follow(self, events: Iterator[Event | TrueState | Foreseen | Ended]) -> Ended:
        """Take note of all events of an episode; the last of them, how it ended, is returned."""
        began, ended = time.perf_counter(), None
        for event in events:
            match event:
                case GoalFound():
                    if event.estimate is not None:
                        self.figures["goal_doubt"] = event.estimate.reason
                        offsets = event.goal.offsets_m(self._task.goal)
                        self.figures["goal_mm"] = 1000 * float(np.linalg.norm(offsets, axis=1).max())
                case Noticed():
                    self.figures["noticed"].append([event.number, event.matter, event.text])
                case TrueState():
                    self._truth = event.state
                case ActionExecuted():
                    self.course.actions[event.number] = event.action
                case Stepped():
                    self.course.estimated[event.number] = event.estimate.state
                    if self._truth is not None:
                        self.course.true[event.number] = self._truth
                    if event.number == 0:  # means over all objects
                        start = self._task.start
                        score = score_of(replace(self._task, goal=start), event.estimate.state, self._symmetries)
                        self.figures["first_mm"] = float(np.mean([one.mm for one in score.objects]))
                        self.figures["first_deg"] = float(np.mean([one.deg for one in score.objects]))
                        turn_rad = event.estimate.state.light.angle_to(start.light)
                        self.figures["light_deg"] = float(np.rad2deg(turn_rad))
                    for stage, seconds in event.seconds.items():
                        self._seconds.setdefault(stage, []).append(seconds)
                case Foreseen():
                    self._seconds.setdefault("plan", []).append(event.plan.seconds)
                    self._note_end("out of steps", event.number + 1)
                case Finished():
                    self._note_end(event.outcome, event.number)
                case Ended():
                    ended = event
        assert ended is not None  # for the type checker
        self.figures["episode_s"] = round(time.perf_counter() - began, 2)
        return ended

    def _note_end(self, outcome: str, steps: int) -> None:
        self.figures |= {"outcome": outcome, "steps": steps, "robot_s": round(STEP_S * steps, 3)}

    def summary(self) -> dict[str, Any]:
        """Return all figures, with the median time of each stage [s]."""
        stages = ("first", "goal", "estimate", "plan")
        return {**self.figures, **{f"{one}_s": rounded(median(self._seconds.get(one, ())), 3) for one in stages}}


# Figures and pictures.


CURVE_MM = (5, 10, 15, 20, 30, 40, 60, 80, 100)
_LOOSE_DEG = 15.0
_NEVER_MM = 1e6  # the error of a task in which something else was pushed away
_CHART_MM, _CHART_6D = 60.0, 0.6
_PER_ROW = 10
_DISTANCES = ("pose6d", "pose6d_symmetric")
_Test = Callable[[RearrangementScore], bool]
_TESTS: dict[str, _Test] = {
    "success_tight": RearrangementScore.is_tight,
    "success_2cm": RearrangementScore.is_success,
    "success_2cm_15deg": lambda score: score.is_success(SUCCESS_M, _LOOSE_DEG),
}


@dataclass(frozen=True, eq=False)
class MpcReport:
    """Results of all tasks, in their order.

    Attributes:
        ours: of the method, which sees images.
        oracle: of the planner that knows the truth.
        may_refuse: whether nothing is moved where the goal is doubted, as ours ships; a doubt of our loop about what
            another method's fields show counts for nothing.
    """

    ours: tuple[TaskResult, ...]
    oracle: tuple[TaskResult, ...]
    may_refuse: bool = True

    @cached_property
    def overruled(self) -> list[RearrangementScore]:
        """How our tables ended, where doubts about the goal were overruled."""
        return scores_of(self.ours, "score")

    @cached_property
    def nothing(self) -> list[RearrangementScore]:
        """How they are without any action."""
        return scores_of(self.ours, "noaction")

    @cached_property
    def shipped(self) -> list[RearrangementScore]:
        """How the method's tables end: ours moves nothing where the goal is doubted."""
        if not self.may_refuse:
            return self.overruled
        trio = zip(self.ours, self.overruled, self.nothing, strict=True)
        return [nothing if result.figures["goal_doubt"] else overruled for result, overruled, nothing in trio]

    @cached_property
    def told_truth(self) -> list[RearrangementScore]:
        """How the oracle's tables ended."""
        return scores_of(self.oracle, "score")

    def to_json(self) -> dict[str, Any]:
        """Return all figures; lengths in mm, angles in degrees, shares in [0, 1]."""
        scores, nothing = self.shipped, self.nothing
        final = [score.moved_mm for score in scores]
        rejected = [result.figures["rejected"] for result in self.ours]
        reasons = sorted({reason for one in rejected for reason in one})
        # Until the loop ended, over tasks within 2 cm.
        robot_s = [one.figures["robot_s"] for one, score in zip(self.ours, scores, strict=True) if score.is_success()]
        # The share of tight successes after one try, after two, and so on: whether more still help.
        pairs = list(zip(self.told_truth, [one.figures["tries"] for one in self.oracle], strict=True))
        most = max((tries for _, tries in pairs), default=0)
        by_try = [_share(pairs, lambda one, n=n: one[0].is_tight() and one[1] <= n) for n in range(1, most + 1)]
        return {
            "tasks": len(scores),
            **_figures(scores, ""),
            **_figures(self.told_truth, "oracle_"),
            **_figures(nothing, "noaction_"),
            **{f"{key}_overruled": _share(self.overruled, test) for key, test in _TESTS.items()},
            "refused": sum(bool(result.figures["goal_doubt"]) for result in self.ours),
            "success_by_moved": self._by_moved(_TESTS["success_2cm"]),
            "success_tight_by_moved": self._by_moved(_TESTS["success_tight"]),
            "success_curve": {str(mm): _share(scores, lambda s, mm=mm: s.is_success(mm / 1000)) for mm in CURVE_MM},
            "final_mm_mean": rounded(mean(final), 2),
            "final_mm_median": rounded(median(final), 2),
            "final_deg_median": rounded(median(score.moved_deg for score in scores), 2),
            "start_mm_mean": rounded(mean(score.moved_mm for score in nothing), 1),
            "oracle_success_tight_by_try": by_try if self.oracle else None,
            "oracle_final_mm_mean": rounded(mean(score.moved_mm for score in self.told_truth), 2),
            "seconds_robot_median": rounded(median(robot_s), 2),
            **{f"{name}_s_median": self._median(f"{key}_s") for name, key in _STAGES.items()},
            "steps_median": self._median("steps"),
            **self._own_pushes(),
            **{f"{key}_median": self._median(key) for key in ("goal_mm", "first_mm", "first_deg", "light_deg")},
            "against_noaction": paired(scores, nothing),
            "against_oracle": paired(scores, self.told_truth) if self.oracle else None,
            "by_object": _by_object(scores),
            "rejected_layouts": {reason: sum(one.get(reason, 0) for one in rejected) for reason in reasons},
        }

    def _by_moved(self, test: _Test) -> dict[str, float | None]:
        counts = sorted({len(score.moved) for score in self.shipped})
        return {str(n): _share([score for score in self.shipped if len(score.moved) == n], test) for n in counts}

    def _own_pushes(self) -> dict[str, Any]:
        """Return how well our own pushes were predicted four actions ahead, from estimated poses."""
        figures: dict[str, Any] = {}
        for unit in ("mm", "deg"):
            values = [value for result in self.ours for value in result.figures["predicted"][unit]]
            figures[f"own_pushes_mean_{unit}_4"] = rounded(mean(values), 2)
            figures[f"own_pushes_median_{unit}_4"] = rounded(median(values), 2)
            figures["own_pushes"] = len(values)
        return figures

    def _median(self, key: str) -> float | None:
        return rounded(median(result.figures[key] for result in self.ours), 3)


_STAGES = {"replan": "plan", "estimate": "estimate", "first": "first", "goal": "goal", "episode": "episode"}


def _figures(scores: Sequence[RearrangementScore], who: str) -> dict[str, Any]:
    """Return the figures that the method, the oracle and doing nothing all have; None without scores."""
    figures: dict[str, Any] = {}
    for key, test in _TESTS.items():
        interval = share_interval(sum(test(score) for score in scores), len(scores)) if scores else None
        figures[who + key] = _share(scores, test)
        figures[f"{who}{key}_interval"] = rounded(interval, 3)
    for key in _DISTANCES:
        values = [getattr(score, key) for score in scores]
        figures[f"{who}{key}_mean"] = rounded(mean(values), 4)
        figures[f"{who}{key}_median"] = rounded(median(values), 4)
        figures[f"{who}{key}_mean_interval"] = rounded(mean_interval(values), 4)
    return figures


def paired(ours: Sequence[RearrangementScore], others: Sequence[RearrangementScore]) -> dict[str, Any]:
    """Compare two methods task by task: differences with intervals, and McNemar's test of the shares."""
    both = ours, others
    shares = {key: [[_TESTS[key](s) for s in them] for them in both] for key in ("success_tight", "success_2cm")}
    distances = {key: [[getattr(s, key) for s in them] for them in both] for key in _DISTANCES}
    found = {key: compare_shares(*sides) for key, sides in shares.items()}
    return found | {key: compare_means(*sides) for key, sides in distances.items()}


def _by_object(scores: Sequence[RearrangementScore]) -> dict[str, dict[str, float | None]]:
    """Return how each object ended where it had to move."""
    moved = [one for score in scores for one in score.moved]
    rows = {name: [one for one in moved if one.name == name] for name in sorted({one.name for one in moved})}
    return {
        name: {
            "moved": len(ends),
            "tight": rounded(mean(end.is_tight() for end in ends), 4),
            "within_2cm": rounded(mean(end.is_within(SUCCESS_M, np.inf) for end in ends), 4),
            "mm_median": rounded(median(end.mm for end in ends), 2),
            "deg_median": rounded(median(end.deg for end in ends), 2),
        }
        for name, ends in rows.items()
    }


def scores_of(results: Sequence[TaskResult], key: str) -> list[RearrangementScore]:
    """Return the scores among the figures of results."""
    return [decode(RearrangementScore, result.figures[key], "score") for result in results]


def write_pictures(folder: Path, report: MpcReport) -> None:
    """Draw mpc.svg, success by threshold and errors of 6D poses, and mpc_tasks.png, goals and what was reached.

    Raises:
        CannotWrite: if the disk refuses.
    """
    kinds = {"from images": report.shipped, "no action": report.nothing}
    if report.oracle:
        kinds["told the truth"] = report.told_truth
    share, mm, sixd = Axis("share of tasks", 0, 1), Axis("threshold [mm]", 0, _CHART_MM), Axis("distance", 0, _CHART_6D)
    farthest = {
        name: [max(one.mm for one in s.moved) if s.others_mm <= 1000 * SUCCESS_M else _NEVER_MM for s in scores]
        for name, scores in kinds.items()
    }
    reached = [cumulative(name, errors, mm) for name, errors in farthest.items()]
    poses = [cumulative(name, [score.pose6d for score in scores], sixd) for name, scores in kinds.items()]
    charts = (Chart("Objects that had to move", mm, share, reached), Chart("6D poses, all objects", sixd, share, poses))
    write_charts(folder / "mpc.svg", charts)
    shown = [comparison for result in report.ours for comparison in result.shown]
    write_png(folder / "mpc_tasks.png", contact_sheet(shown, per_row=_PER_ROW, truth="goal"))


def _share(scores: Sequence[Any], test: Callable[[Any], bool]) -> float | None:
    return rounded(mean(test(score) for score in scores), 4)


# The evaluation.


REPORT_FILE = "mpc.json"
MAX_TRIES = 1000
ORACLE_PLAN = PlanSettings(samples=192)
_ORACLE_REACHED_RAD = 0.05  # half of what counts as success: ours stops earlier

VERSION = 1  # raised by hand when figures may change

Plan = PlanSettings | GaussianPlanSettings | ForesightSettings


@dataclass(frozen=True, slots=True)
class EvaluateMpc:
    """What to measure.

    Attributes:
        folder: for results, pictures and mpc.json.
        data_dir: where objects, and fields and networks trained on this machine, are.
        tasks: how many.
        objects: in each scene.
        seed: of the tasks.
        family: what goals ask for.
        actions: that an episode may have.
        variant: whose episodes, and through how many cameras.
        factor: name of what differs from the usual world; "" for nothing.
        cost: what futures are compared by.
        names: objects to draw from; all that have a field and a mesh if None.
        oracle: also run the planner that knows the truth.
        oracle_tries: that it has at each task.
        settings: of the episodes but for their cost and number of actions.
        oracle_plan: how the oracle plans.
        published: how planning as published samples.
        foresight: how visual foresight plans.
        simulator: what moves the objects.
    """

    folder: Path
    data_dir: Path
    tasks: int = 20
    objects: int = 3
    seed: int = 0
    family: Family = "shifted"
    actions: int = 30
    variant: Variant = field(default_factory=Variant)
    factor: str = ""
    cost: CostKind = "pose"
    names: tuple[str, ...] | None = None
    oracle: bool = True
    oracle_tries: int = 8
    settings: EpisodeSettings = field(default_factory=EpisodeSettings)
    oracle_plan: PlanSettings = ORACLE_PLAN
    published: GaussianPlanSettings = field(default_factory=GaussianPlanSettings)
    foresight: ForesightSettings = field(default_factory=ForesightSettings)
    simulator: Simulator = field(default_factory=default_simulator)

    @property
    def plan(self) -> Plan:
        """How the method plans."""
        if self.variant.method == "foresight":
            return self.foresight
        return self.published if self.variant.published("planning") else self.settings.plan

    @property
    def world(self) -> Factor:
        """How the world differs from the usual one."""
        factor = factor_named(self.factor) if self.factor else Factor()
        return replace(factor, conditions=replace(factor.conditions, simulator=self.simulator))

    @property
    def task_set(self) -> TaskSet:
        """The tasks, as they are drawn."""
        return TaskSet(self.names or (), self.family, self.objects, self.seed, self.simulator)


def evaluate_mpc(
    config: EvaluateMpc, fields: FieldLibrary, assets: AssetLibrary, executor: Executor | None = None
) -> Iterator[EvaluationStep[dict[str, Any]]]:
    """Run all tasks; pictures and mpc.json go to `config.folder`.

    Args:
        config: what to measure.
        fields: of the objects.
        assets: meshes for the simulator.
        executor: runs tasks side by side, if given; then their times are those of a busy machine.

    Raises:
        UnknownName, MissingAssets: if an object lacks a field or a mesh, or no factor is called so.
        InvalidInput: if a number is out of range.
        NoRoom: if there is no room for a task's objects.
        WorkerDied: if a worker process ended.
        CorruptFile, CannotWrite: as files are.
    """
    config = checked(config, fields, assets)
    pieces = episode_pieces(config, fields, assets)
    results = yield from finished(pieces, executor, "episodes")
    report = episodes_report(config, results)
    write_pictures(config.folder, report)
    figures = figures_of(config, report)
    write_json(config.folder / REPORT_FILE, figures)
    yield EvaluationStep(len(pieces), len(pieces), "Everything is measured", figures)


def episodes_report(config: EvaluateMpc, results: Sequence[TaskResult]) -> MpcReport:
    """Return the report on results of `episode_pieces`, given in their order."""
    is_ours = config.variant.method == "ours"
    return MpcReport(tuple(results[: config.tasks]), tuple(results[config.tasks :]), may_refuse=is_ours)


def figures_of(config: EvaluateMpc, report: MpcReport) -> dict[str, Any]:
    """Return the figures of a report with what was measured, as plain JSON."""
    about = {key: getattr(config, key) for key in ("family", "objects", "actions", "seed", "factor", "simulator")}
    variant = config.variant
    about["cost"] = "image" if variant.method == "foresight" or variant.published("planning") else config.cost
    about |= {"names": list(config.names or ()), "samples": config.plan.samples, "horizon": config.plan.horizon}
    about |= {"method": variant.method, "views": variant.views, "masks": variant.has_masks}
    about |= {"ours": sorted(variant.replaced), "truths": sorted(variant.truths)}
    return {**report.to_json(), **about}


def checked(config: EvaluateMpc, fields: FieldLibrary, assets: AssetLibrary) -> EvaluateMpc:
    """Check that everything asked for is possible, and fill in the objects to draw from.

    Raises:
        UnknownName, MissingAssets, InvalidInput, NoRoom: as `evaluate_mpc` does.
    """
    check_run(config.tasks, config.seed, ("number of the oracle's tries", config.oracle_tries, 1, MAX_TRIES))
    check_variant(config.variant)
    if config.world.has_unseen_objects and config.variant.published("dynamics"):
        allowed = "left out with the paper's dynamics: they are of objects that have a name"
        raise InvalidInput("factor of variation", config.factor, allowed)
    if config.names is None:
        known = known_names(config.variant.fields, fields, config.data_dir)
        names = tuple(name for name in known if fields.has(name) and assets.has(name))
    else:
        names = chosen_objects(config.names, fields, assets)
        for name in names:
            field_path(config.variant.fields, name, fields, config.data_dir)
    config = replace(config, names=names)
    check_tasks(config.task_set)
    return config


def episode_pieces(config: EvaluateMpc, fields: FieldLibrary, assets: AssetLibrary) -> list[Piece]:
    """Return the method's episodes, then the oracle's.

    Args:
        config: what to measure, checked.
        fields: of the objects.
        assets: meshes for the simulator.
    """
    settings = replace(config.settings, cost=config.cost, steps=config.actions, renewed=False)
    episodes = MeasuredEpisodes(config.task_set, fields, assets, config.data_dir, config.world, config.variant)
    common, own = _circumstances(config, fields, assets)
    work: Callable[..., TaskResult]
    if config.variant.method == "foresight":
        work = partial(episodes.by_foresight, settings=config.foresight, actions=settings.steps)
    else:
        work = partial(episodes.from_images, settings=settings, published=config.published)
    name = _joined(config.variant.name(), config.cost, _plan_name(config.plan, type(config.plan)()), config.factor)
    kinds = {name: (work, {**own, "settings": asdict(settings), "plan": asdict(config.plan)})}
    if config.oracle:
        settings = replace(
            config.settings, steps=config.actions, plan=config.oracle_plan, reached_rad=_ORACLE_REACHED_RAD,
            renewed=False,
        )  # fmt: skip
        tries = config.oracle_tries
        work = partial(episodes.oracle, settings=settings, tries=tries)
        name = _joined("oracle", _plan_name(config.oracle_plan, ORACLE_PLAN))
        kinds[name] = work, {"settings": asdict(settings), "tries": tries}
    place = f"{config.family}-{config.objects}-{config.seed}-{config.actions}"
    folder = config.folder / "mpc" / (place if config.simulator == "pybullet" else f"{place}-{config.simulator}")
    return [
        Piece(f"{n:04d}", TaskCache(folder / kind), {**common, **circumstances}, partial(work, n))
        for kind, (work, circumstances) in kinds.items()
        for n in range(config.tasks)
    ]


def _joined(*parts: str) -> str:
    return "-".join(part for part in parts if part)


def _plan_name(plan: Plan, usual: Plan) -> str:
    """Return what marks results of unusual plans."""
    return "" if plan == usual else f"K{plan.samples}T{plan.horizon}"


def _circumstances(
    config: EvaluateMpc, fields: FieldLibrary, assets: AssetLibrary
) -> tuple[dict[str, Any], dict[str, Any]]:
    """Return what all results depend on, and what those of the method depend on besides."""
    names = config.names or ()
    common = {
        "names": {name: [file_sha256(fields.info(name).path), assets.digest(name)] for name in names},
        "network": file_sha256(network_path(config.data_dir)),
        "table": table_sha256(fields.load_table()),
        "version": VERSION,
    }
    own: dict[str, Any] = {}
    if config.variant.fields != "ours":
        paths = [field_path(config.variant.fields, name, fields, config.data_dir) for name in names]
        own["own_fields"] = [file_sha256(path) for path in paths]
    if config.variant.published("dynamics"):
        own["own_network"] = file_sha256(weights_path(config.data_dir))
    if config.variant.method == "foresight":
        own["own_network"] = file_sha256(fitvid_path(config.data_dir))
    if config.world.has_unseen_objects:
        own["own_network"] = file_sha256(shipped(UNSEEN_NETWORK))
    return common, own
