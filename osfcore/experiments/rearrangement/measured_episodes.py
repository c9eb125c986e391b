"""Single episodes, measured: those of methods that see images, and of the planner that is told the truth."""

from __future__ import annotations

import time
from collections.abc import Iterator, Mapping
from dataclasses import dataclass, field, replace
from pathlib import Path
from types import MappingProxyType
from typing import Any

import numpy as np
import torch

from osfcore.control.episode_settings import EpisodeSettings
from osfcore.control.events import ActionExecuted, Event, Finished, GoalFound, Noticed, Stepped
from osfcore.control.scene_models import load_scene_models
from osfcore.dynamics.network_weights import read_network
from osfcore.dynamics.push_models import shipped
from osfcore.dynamics.rollout import PushModel
from osfcore.experiments.rearrangement.factors import UNSEEN_NETWORK, Factor, factor_named
from osfcore.experiments.rearrangement.methods import Variant, loop_parts
from osfcore.experiments.rearrangement.own_pushes import Course, prediction_errors
from osfcore.experiments.rearrangement.runs import Ended, TrueState, run_from_images, run_told_the_truth
from osfcore.experiments.rivals.fitvid.weights import fitvid_path, read_fitvid
from osfcore.experiments.rivals.visual_foresight import Foreseen, ForesightSettings, run_visual_foresight
from osfcore.experiments.task_cache import TaskResult
from osfcore.fields.field_library import FieldLibrary
from osfcore.geometry.states import SceneState
from osfcore.geometry.workspace import STEP_S
from osfcore.inspection.contact_sheet import Comparison
from osfcore.io.image_file import to_uint8
from osfcore.metrics.success import RearrangementScore, RearrangementTask, score_of
from osfcore.objects.asset import Symmetry
from osfcore.objects.asset_library import AssetLibrary
from osfcore.paper.mppi import GaussianPlanSettings
from osfcore.random_streams import Stream, stream_rng
from osfcore.world.rearrangement_tasks import DrawnTask, TaskSet, draw_task

_NO_ERRORS: Mapping[str, list[float]] = MappingProxyType({"mm": [], "deg": []})  # of who predicts no poses


@dataclass(frozen=True, eq=False, slots=True)
class MeasuredEpisodes:
    """Runs single tasks; can be sent to other processes.

    Attributes:
        tasks: which.
        fields: of their objects.
        assets: meshes for the simulator.
        data_dir: where networks trained on this machine are.
        factor: name of what differs from the usual world; "" for nothing.
        variant: whose episodes.
    """

    tasks: TaskSet
    fields: FieldLibrary
    assets: AssetLibrary
    data_dir: Path
    factor: str = ""
    variant: Variant = field(default_factory=Variant)

    def from_images(
        self, number: int, settings: EpisodeSettings, published: GaussianPlanSettings | None = None
    ) -> TaskResult:
        """A task for a method that sees images alone; doubts about its goal are noted and overruled."""
        drawn = self._drawn(number)
        models = load_scene_models(drawn.task.start.names, self.fields, self.assets, self.data_dir)
        if self._factor().has_unseen_objects:
            models = replace(models, dynamics=PushModel(read_network(shipped(UNSEEN_NETWORK)), models.shapes))
        parts = loop_parts(self.variant, models, drawn.task, self.fields, self.data_dir)
        settings, rng = replace(settings, despite_doubts=True), stream_rng(self.tasks.seed, Stream.EPISODE, number)
        log = _Log(drawn.task, models.symmetries)
        given = drawn.task, self.assets, parts, settings, rng, self._factor(), self.variant, published
        ended = log.follow(run_from_images(*given))
        return self._scored(drawn, ended, {**log.summary(), "predicted": prediction_errors(log.course, parts.models)})

    def by_foresight(self, number: int, settings: ForesightSettings, actions: int) -> TaskResult:
        """A task for visual foresight, which pushes until all actions are done."""
        drawn = self._drawn(number)
        rng = stream_rng(self.tasks.seed, Stream.EPISODE, number)
        log, predictor = _Log(drawn.task, {}), read_fitvid(fitvid_path(self.data_dir), torch.bfloat16)
        given = drawn.task, self.assets, predictor, settings, actions, rng, self._factor(), predictor.settings.side
        ended = log.follow(run_visual_foresight(*given))
        return self._scored(drawn, ended, {**log.summary(), "predicted": dict(_NO_ERRORS)})

    def oracle(self, number: int, settings: EpisodeSettings, tries: int) -> TaskResult:
        """The best of several tries of the planner at a task with true poses; the simulator can be set back.

        They end with the first that succeeds. The last has the simulator as its dynamics, which takes far longer than
        the learned model, and plans before every second action.
        """
        drawn = self._drawn(number)
        models = load_scene_models(drawn.task.start.names, self.fields, self.assets, self.data_dir)
        slow = replace(settings, replan_every=2, plan=replace(settings.plan, begins_m=0.0))
        ends: list[tuple[RearrangementScore, Ended]] = []
        for count in range(1, tries + 1):
            rng, is_last = stream_rng(self.tasks.seed, Stream.ORACLE, number, count), count == tries
            given = drawn.task, self.assets, models, slow if is_last else settings, rng
            end = run_told_the_truth(*given, knows_pushes=is_last)
            ends.append((self._score(drawn.task, end.state), end))
            if ends[-1][0].is_tight():
                break
        _, best = max(ends, key=lambda tried: _quality(tried[0]))
        return self._scored(drawn, best, {"tries": len(ends)})

    def _drawn(self, number: int) -> DrawnTask:
        drawn = draw_task(self.assets, self.tasks, number)
        task = self._factor().task(drawn.task, stream_rng(self.tasks.seed, Stream.FACTOR_LIGHT, number))
        return replace(drawn, task=task)

    def _factor(self) -> Factor:
        return factor_named(self.factor) if self.factor else Factor()

    def _scored(self, drawn: DrawnTask, ended: Ended, figures: dict[str, Any]) -> TaskResult:
        task = drawn.task
        score, nothing = (self._score(task, state) for state in (ended.state, task.start))
        told = {"score": score.to_json(), "noaction": nothing.to_json(), "rejected": dict(drawn.rejected), **figures}
        label = f"{task.number}: {score.moved_mm:.0f} mm"
        return TaskResult(told, (Comparison(label, to_uint8(ended.goal), to_uint8(ended.image)),))

    def _score(self, task: RearrangementTask, state: SceneState) -> RearrangementScore:
        return score_of(task, state, {name: self.assets.info(name).symmetry for name in task.start.names})


def _quality(score: RearrangementScore) -> tuple[bool, bool, float]:
    """What makes one end better than another."""
    return score.is_tight(), score.is_success(), -score.pose6d_symmetric


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
        """Take note of all events of an episode; how it ended is the last of them."""
        began, ended = time.perf_counter(), None
        for event in events:
            if isinstance(event, Ended):
                ended = event
            else:
                self.take(event)
        assert ended is not None, "the last event tells how it ended"
        self.figures["episode_s"] = round(time.perf_counter() - began, 2)
        return ended

    def take(self, event: Event | TrueState | Foreseen) -> None:
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
            case Foreseen():
                self._seconds.setdefault("plan", []).append(event.plan.seconds)
                self._note_end("out of steps", event.number + 1)
            case Finished():
                self._note_end(event.outcome, event.number)
            case _:
                pass

    def _note_end(self, outcome: str, steps: int) -> None:
        self.figures |= {"outcome": outcome, "steps": steps, "robot_s": round(STEP_S * steps, 3)}

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
