"""Takes an episode's events and keeps its course: a `Trajectory`."""

from __future__ import annotations

from typing import Protocol

import numpy as np

from app.episodes.trajectory import LookAt, LookFrame, Round, Trajectory
from app.processes.plan_summary import sketch_of
from osfcore.control.events import ActionExecuted, Event, GoalFound, Looking, Planning, Stepped
from osfcore.estimation.steps import EstimateStep
from osfcore.geometry.poses import Pose
from osfcore.geometry.states import SceneState
from osfcore.planning.mppi import PlanRound

CANDIDATES = 24  # kept of each object
_MOST_LOOKS = 64  # kept of each look; of more, every other one is dropped


class Truth(Protocol):
    """What knows where everything truly is."""

    def truth(self) -> SceneState:
        """The true state now."""
        ...


class TrajectoryRecorder:
    """Keeps what is worth drawing again of an episode.

    Args:
        start: the true state before the first action.

    Attributes:
        states: true ones, at the beginning and after each action.
    """

    states: list[SceneState]

    def __init__(self, start: SceneState) -> None:
        self.states = [start]
        self._goal: Pose | None = None
        self._looks: dict[str, _Thinned] = {}
        self._rounds: list[Round] = []
        self._plan: PlanRound | None = None

    @property
    def trajectory(self) -> Trajectory:
        """The course so far."""
        looks = tuple(look for thinned in self._looks.values() for look in thinned.kept)
        return Trajectory(tuple(self.states), self._goal, looks, tuple(self._rounds))

    def take(self, event: Event, table: Truth) -> None:
        """Note an event, and where everything truly is after an action."""
        names = self.states[0].names
        match event:
            case Looking() if event.look == "first" or event.look == "goal":
                self._looks.setdefault(event.look, _Thinned()).add(_frame(event.look, event.step))
            case GoalFound(goal):
                self._goal = goal.poses[[goal.names.index(name) for name in names]]
            case Planning():
                self._plan = event.round
            case ActionExecuted():
                self.states.append(table.truth())
            case Stepped(number, _, estimate):
                plan = None if self._plan is None else sketch_of(number, self._plan)
                self._rounds.append(Round(number, estimate, plan))
                self._plan = None
            case _:
                pass


class _Thinned:
    """At most so many of a sequence whose length is not known beforehand, evenly spaced, and the last one."""

    def __init__(self) -> None:
        self._every, self._count = 1, 0
        self._frames: list[LookFrame] = []
        self._last: LookFrame | None = None

    def add(self, frame: LookFrame) -> None:
        if self._count % self._every == 0:
            self._frames.append(frame)
        if len(self._frames) > _MOST_LOOKS:
            self._frames, self._every = self._frames[::2], 2 * self._every
        self._count, self._last = self._count + 1, frame

    @property
    def kept(self) -> list[LookFrame]:
        last = self._last
        return self._frames if last is None or self._frames[-1] is last else [*self._frames, last]


def _frame(look: LookAt, step: EstimateStep) -> LookFrame:
    progress = step.progress
    count = len(step.state.names)
    candidates = Pose(np.zeros((0, count, 3)), np.zeros((0, count, 4)))
    if step.candidates is not None:
        tried = len(step.candidates.position)
        candidates = step.candidates[np.unique(np.linspace(0, tried - 1, min(CANDIDATES, tried)).astype(int))]
    done = min(progress.done / max(progress.total, 1), 1.0)
    return LookFrame(look, done, step.loss, step.state, candidates)
