"""How well tables become what a goal image shows (paper, section 5.4 and figure 7).

Each task is a random scene under a hidden light, of which one, two or three objects shall lie elsewhere. The loop sees
four cameras, masks in the first frame, and the goal image; it has 30 actions. The same tasks are given to the same
planner with true poses and the simulator as its dynamics (an oracle), and to nobody. Results of finished tasks are kept
in the output folder: a killed evaluation goes on where it was.
"""

from __future__ import annotations

import time
from collections.abc import Iterator
from concurrent.futures import Executor
from dataclasses import asdict, dataclass, field, replace
from pathlib import Path
from typing import Any

import numpy as np

from osfcore import control, dynamics, estimation, experiments, planning, render, world
from osfcore.control.episode_settings import CostKind, EpisodeSettings
from osfcore.control.events import ActionExecuted, Finished, GoalFound, Looking, Noticed, Stepped
from osfcore.control.scene_models import load_scene_models
from osfcore.dynamics.push_models import network_path
from osfcore.errors import MAX_SEED, InvalidInput, MissingAssets
from osfcore.experiments.rearrangement.report import MpcReport, write_pictures
from osfcore.experiments.rearrangement.runs import Ended, run_from_images, run_told_the_truth
from osfcore.experiments.rearrangement.tasks import mpc_task
from osfcore.experiments.task_cache import TaskCache, TaskResult, code_sha256, file_sha256
from osfcore.fields.field_library import FieldLibrary
from osfcore.inspection.contact_sheet import Comparison
from osfcore.io.files import write_json
from osfcore.io.image_file import to_uint8
from osfcore.io.json_codec import encode
from osfcore.metrics.success import RearrangementTask, score_of
from osfcore.objects.asset_library import AssetLibrary
from osfcore.planning.mppi import PlanSettings

REPORT_FILE = "mpc.json"
MAX_TASKS = 10_000
OBJECTS = (1, 6)  # in a scene
_ORACLE = PlanSettings(samples=32)  # fewer than ours, for the simulator is slow; it does well enough with them
_ORACLE_EVERY = 2


@dataclass(frozen=True, slots=True)
class EvaluateMpc:
    """What to measure.

    Attributes:
        folder: for results, pictures and mpc.json.
        data_dir: where objects, and fields and networks trained on this machine, are.
        tasks: how many.
        objects: in each scene.
        seed: of the tasks.
        cost: what futures are compared by.
        names: objects to draw from; all that have a field and a mesh if None.
        oracle: also run the planner that is told the truth.
        settings: of the episodes but for their cost.
    """

    folder: Path
    data_dir: Path
    tasks: int = 20
    objects: int = 3
    seed: int = 0
    cost: CostKind = "pose"
    names: tuple[str, ...] | None = None
    oracle: bool = True
    settings: EpisodeSettings = field(default_factory=lambda: EpisodeSettings(despite_doubts=True))


@dataclass(frozen=True, eq=False, slots=True)
class MpcEvaluationStep:
    """How far an evaluation is.

    Attributes:
        done: tasks finished, ours and the oracle's.
        total: in all.
        note: what is being done.
        report: with the last step only.
    """

    done: int
    total: int
    note: str
    report: dict[str, Any] | None = None


def evaluate_mpc(
    config: EvaluateMpc, fields: FieldLibrary, assets: AssetLibrary, executor: Executor | None = None
) -> Iterator[MpcEvaluationStep]:
    """Run all tasks; pictures and mpc.json go to `config.folder`.

    Args:
        config: what to measure.
        fields: of the objects.
        assets: meshes for the simulator.
        executor: runs the oracle's tasks side by side, if given; ours run alone, for they are timed.

    Raises:
        UnknownName, MissingAssets: if an object lacks a field or a mesh.
        InvalidInput: if a number is out of range.
        NoRoom: if there is no room for a task's objects.
        CorruptFile, CannotWrite: as files are.
    """
    config = replace(config, names=_checked(config, fields, assets))
    runner = _Runner(config, fields, assets)
    total, done = config.tasks * (2 if config.oracle else 1), 0
    numbers = range(config.tasks)
    oracle: list[TaskResult] = []
    if config.oracle:
        told = map(runner.oracle, numbers) if executor is None else executor.map(runner.oracle, numbers)
        yield MpcEvaluationStep(done, total, "Told the truth")
        for result in told:
            oracle.append(result)
            done += 1
            yield MpcEvaluationStep(done, total, f"Told the truth ({done} of {config.tasks})")
    ours = []
    for number in numbers:
        for note in runner.steps(number):
            yield MpcEvaluationStep(done, total, f"Task {number + 1} of {config.tasks} ({note})")
        ours.append(runner.kept("ours", number))
        done += 1
    report = MpcReport(tuple(ours), tuple(oracle))
    write_pictures(config.folder, report)
    figures = {**report.to_json(), "objects": config.objects, "seed": config.seed, "cost": config.cost}
    write_json(config.folder / REPORT_FILE, figures)
    yield MpcEvaluationStep(total, total, "Everything is measured", figures)


def _checked(config: EvaluateMpc, fields: FieldLibrary, assets: AssetLibrary) -> tuple[str, ...]:
    for what, value, low, high in (
        ("number of tasks", config.tasks, 1, MAX_TASKS),
        ("objects in a scene", config.objects, *OBJECTS),
        ("seed", config.seed, 0, MAX_SEED),
    ):
        if not low <= value <= high:
            raise InvalidInput(what, value, f"between {low} and {high}")
    if config.names is None:
        names = tuple(name for name in fields.names() if assets.has(name))
    else:
        names = tuple(dict.fromkeys(config.names))
        for name in names:
            fields.info(name)
            if not assets.has(name):
                raise MissingAssets([name])
    if len(names) < config.objects:
        raise InvalidInput("number of objects with a field and a mesh", len(names), f"at least {config.objects}")
    return names


class _Runner:
    """Runs single tasks, or finds what they left; can be sent to other processes."""

    def __init__(self, config: EvaluateMpc, fields: FieldLibrary, assets: AssetLibrary) -> None:
        assert config.names is not None
        self._config, self._fields, self._assets = config, fields, assets
        self._names = config.names
        self._told_truth = replace(config.settings, plan=_ORACLE, replan_every=_ORACLE_EVERY)
        self._given = {
            "names": {name: [file_sha256(fields.info(name).path), assets.digest(name)] for name in self._names},
            "network": file_sha256(network_path(config.data_dir)),
            "code": code_sha256(control, dynamics, estimation, experiments, planning, render, world),
        }

    def oracle(self, number: int) -> TaskResult:
        """A task for the planner that is told the truth."""
        kept = self.kept_or_none("oracle", number)
        if kept is None:
            config = self._config
            task = self._task(number)
            models = load_scene_models(task.start.names, self._fields, self._assets, config.data_dir)
            rng = np.random.default_rng([config.seed, number, 1])
            ended = run_told_the_truth(task, self._assets, models, self._told_truth, rng)
            kept = self._keep("oracle", number, task, ended, {})
        return kept

    def steps(self, number: int) -> Iterator[str]:
        """A task for us; what is being done, in a few words."""
        if self.kept_or_none("ours", number) is not None:
            return
        yield "preparing"
        task = self._task(number)
        config = self._config
        models = load_scene_models(task.start.names, self._fields, self._assets, config.data_dir)
        settings = replace(config.settings, cost=config.cost)
        rng = np.random.default_rng([config.seed, number, 2])
        log, ended, began = _Log(task), None, time.perf_counter()
        for event in run_from_images(task, self._assets, models, settings, rng):
            if isinstance(event, Ended):
                ended = event
            elif (note := log.told(event)) is not None:
                yield note
        assert ended is not None, "the last event tells how it ended"
        log.figures["episode_s"] = round(time.perf_counter() - began, 2)
        self._keep("ours", number, task, ended, log.summary())

    def kept(self, kind: str, number: int) -> TaskResult:
        """What a finished task left."""
        result = self.kept_or_none(kind, number)
        assert result is not None, "it was kept when it finished"
        return result

    def kept_or_none(self, kind: str, number: int) -> TaskResult | None:
        """The same; None if it has to be done."""
        return self._cache(kind).read(f"{number:04d}", self._circumstances(kind))

    def _task(self, number: int) -> RearrangementTask:
        config = self._config
        return mpc_task(self._assets, self._names, config.objects, config.seed, number)

    def _cache(self, kind: str) -> TaskCache:
        config = self._config
        which = "oracle" if kind == "oracle" else config.cost
        return TaskCache(config.folder / "mpc" / f"{which}-{config.objects}-{config.seed}")

    def _circumstances(self, kind: str) -> dict[str, Any]:
        settings = self._told_truth if kind == "oracle" else replace(self._config.settings, cost=self._config.cost)
        return {**self._given, "settings": asdict(settings)}

    def _keep(
        self, kind: str, number: int, task: RearrangementTask, ended: Ended, figures: dict[str, Any]
    ) -> TaskResult:
        symmetries = {name: self._assets.info(name).symmetry for name in task.start.names}
        score, nothing = (score_of(task, state, symmetries) for state in (ended.state, task.start))
        told = {"score": encode(score), "noaction": encode(nothing), "moved": list(task.moved), **figures}
        label = f"{number}: {score.moved_mm:.0f} mm"
        result = TaskResult(told, (Comparison(label, to_uint8(ended.goal), to_uint8(ended.image)),))
        self._cache(kind).write(f"{number:04d}", self._circumstances(kind), result)
        return result


class _Log:
    """What is kept of a task's events."""

    def __init__(self, task: RearrangementTask) -> None:
        self._task = task
        self.figures: dict[str, Any] = {"goal_doubt": "", "noticed": [], "goal_mm": None}
        self._seconds: dict[str, list[float]] = {}

    def told(self, event: object) -> str | None:
        """Take note of an event; a few words for a person, where it is worth them."""
        match event:
            case Looking(look="first" | "goal" as look):
                return "looking at the first frame" if look == "first" else "looking at the goal"
            case GoalFound():
                if event.estimate is not None:
                    self.figures["goal_doubt"] = event.estimate.reason
                    self.figures["goal_mm"] = 1000 * float(
                        np.linalg.norm(event.goal.offsets_m(self._task.goal), axis=1).max()
                    )
            case Noticed():
                self.figures["noticed"].append([event.number, event.matter, event.text])
            case ActionExecuted():
                return f"action {event.number}"
            case Stepped():
                for stage, seconds in event.seconds.items():
                    self._seconds.setdefault(stage, []).append(seconds)
            case Finished():
                self.figures |= {"outcome": event.outcome, "steps": event.number}
            case _:
                pass
        return None

    def summary(self) -> dict[str, Any]:
        """All figures."""
        seconds = {}
        for stage in ("first", "goal", "estimate", "plan"):
            told = self._seconds.get(stage)
            seconds[f"{stage}_s"] = round(float(np.median(told)), 3) if told else None
        return {**self.figures, **seconds}
