"""Single episodes, measured: those of methods that see images, and of the planner that is told the truth.

Methods:
    ours         the loop as it ships.
    overhead     the same, but it takes the light to be overhead: what estimating the light is worth.
    known_light  the same, told the true lights of scene and goal image: what knowing them would be worth.
    paper        the method as published; each of its stages can be replaced by ours (`MeasuredEpisodes.replaced`).
"""

from __future__ import annotations

import time
from collections.abc import Mapping
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Any, Literal, get_args

import numpy as np

from osfcore.control.episode_settings import EpisodeSettings
from osfcore.control.estimators import Estimators
from osfcore.control.events import ActionExecuted, Event, Finished, GoalFound, Noticed, Stepped
from osfcore.control.scene_models import SceneModels, load_scene_models
from osfcore.experiments.rearrangement.factors import Factor, factor_named
from osfcore.experiments.rearrangement.own_pushes import Course, prediction_errors
from osfcore.experiments.rearrangement.runs import Ended, TrueState, run_from_images, run_told_the_truth
from osfcore.experiments.rearrangement.tasks import DrawnTask, TaskSet, draw_task
from osfcore.experiments.task_cache import TaskResult
from osfcore.fields.field_library import FieldLibrary
from osfcore.geometry.light import Light
from osfcore.geometry.states import SceneState
from osfcore.geometry.workspace import STEP_S
from osfcore.inspection.contact_sheet import Comparison
from osfcore.io.image_file import to_uint8
from osfcore.metrics.success import RearrangementTask, score_of
from osfcore.objects.asset import Symmetry
from osfcore.objects.asset_library import AssetLibrary
from osfcore.paper.stages import STAGES, PaperEstimators, StageName, with_paper_stages
from osfcore.random_streams import Stream, stream_rng

Method = Literal["ours", "overhead", "known_light", "paper"]
METHODS: tuple[Method, ...] = get_args(Method)


@dataclass(frozen=True, eq=False, slots=True)
class MeasuredEpisodes:
    """Runs single tasks; can be sent to other processes.

    Attributes:
        tasks: which.
        fields: of their objects.
        assets: meshes for the simulator.
        data_dir: where networks trained on this machine are.
        factor: name of what differs from the usual world; "" for nothing.
        replaced: stages of the paper's method that are ours.
    """

    tasks: TaskSet
    fields: FieldLibrary
    assets: AssetLibrary
    data_dir: Path
    factor: str = ""
    replaced: frozenset[StageName] = frozenset()

    def from_images(self, number: int, settings: EpisodeSettings, method: Method = "ours") -> TaskResult:
        """A task for a method that sees images alone; doubts about its goal are noted and overruled."""
        drawn, models = self._prepared(number)
        rng = stream_rng(self.tasks.seed, Stream.EPISODE, number)
        log, ended, began = _Log(drawn.task, models.symmetries), None, time.perf_counter()
        settings, estimators = replace(settings, despite_doubts=True), _estimators(method, drawn.task)
        stages = frozenset(STAGES) - self.replaced if method == "paper" else frozenset[StageName]()
        if stages:
            models = with_paper_stages(models, stages, self.fields, self.data_dir)
            estimators = PaperEstimators() if "estimation" in stages else estimators
        given = drawn.task, self.assets, models, settings, rng, estimators, self._factor()
        for event in run_from_images(*given, as_published="planning" in stages):
            if isinstance(event, Ended):
                ended = event
            else:
                log.take(event)
        assert ended is not None, "the last event tells how it ended"
        log.figures["episode_s"] = round(time.perf_counter() - began, 2)
        figures = {**log.summary(), "predicted": prediction_errors(log.course, models)}
        return self._scored(drawn, ended, figures)

    def oracle(self, number: int, settings: EpisodeSettings) -> TaskResult:
        """A task for the planner that is told the truth."""
        drawn, models = self._prepared(number)
        rng = stream_rng(self.tasks.seed, Stream.ORACLE, number)
        ended = run_told_the_truth(drawn.task, self.assets, models, settings, rng)
        return self._scored(drawn, ended, {})

    def _prepared(self, number: int) -> tuple[DrawnTask, SceneModels]:
        drawn = draw_task(self.assets, self.tasks, number)
        task = self._factor().task(drawn.task, stream_rng(self.tasks.seed, Stream.FACTOR_LIGHT, number))
        drawn = replace(drawn, task=task)
        return drawn, load_scene_models(drawn.task.start.names, self.fields, self.assets, self.data_dir)

    def _factor(self) -> Factor:
        return factor_named(self.factor) if self.factor else Factor()

    def _scored(self, drawn: DrawnTask, ended: Ended, figures: dict[str, Any]) -> TaskResult:
        task = drawn.task
        symmetries = {name: self.assets.info(name).symmetry for name in task.start.names}
        score, nothing = (score_of(task, state, symmetries) for state in (ended.state, task.start))
        told = {"score": score.to_json(), "noaction": nothing.to_json(), "rejected": dict(drawn.rejected), **figures}
        label = f"{task.number}: {score.moved_mm:.0f} mm"
        return TaskResult(told, (Comparison(label, to_uint8(ended.goal), to_uint8(ended.image)),))


def _estimators(method: Method, task: RearrangementTask) -> Estimators:
    overhead = Light(np.array([0.0, 0.0, 1.0]))
    match method:
        case "ours" | "paper":
            return Estimators()
        case "overhead":
            return Estimators.with_known_lights(overhead, overhead)
        case "known_light":
            return Estimators.with_known_lights(task.start.light, task.goal.light)


class _Log:
    """What is kept of a task's events."""

    def __init__(self, task: RearrangementTask, symmetries: Mapping[str, Symmetry]) -> None:
        self._task, self._symmetries = task, symmetries
        unknown = dict.fromkeys(("goal_mm", "first_mm", "first_deg", "light_deg"))
        self.figures: dict[str, Any] = {"goal_doubt": "", "noticed": [], **unknown}
        self._seconds: dict[str, list[float]] = {}
        self.course = Course()
        self._truth: SceneState | None = None

    def take(self, event: Event | TrueState) -> None:
        """Take note of an event."""
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
                if event.number == 0:
                    self.figures |= self._first_errors(event.estimate.state)
                for stage, seconds in event.seconds.items():
                    self._seconds.setdefault(stage, []).append(seconds)
            case Finished():
                robot_s = round(STEP_S * event.number, 3)
                self.figures |= {"outcome": event.outcome, "steps": event.number, "robot_s": robot_s}
            case _:
                pass

    def _first_errors(self, state: SceneState) -> dict[str, float]:
        """Of the first estimate: means over all objects [mm, deg], and the angle of the light [deg]."""
        start = self._task.start
        score = score_of(replace(self._task, goal=start), state, self._symmetries)
        return {
            "first_mm": float(np.mean([one.mm for one in score.objects])),
            "first_deg": float(np.mean([one.deg for one in score.objects])),
            "light_deg": float(np.rad2deg(state.light.angle_to(start.light))),
        }

    def summary(self) -> dict[str, Any]:
        """All figures."""
        seconds = {}
        for stage in ("first", "goal", "estimate", "plan"):
            told = self._seconds.get(stage)
            seconds[f"{stage}_s"] = round(float(np.median(told)), 3) if told else None
        return {**self.figures, **seconds}
