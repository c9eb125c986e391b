"""Estimates and episodes in the 3D view: the threads that draw their newest events.

Events come from the jobs' thread and are only stored there; drawing, at most some times a second, happens here.
"""

from __future__ import annotations

import time
from collections.abc import Callable
from dataclasses import dataclass, replace

from osfcore.control.events import GoalFound, Looking, Stepped
from osfcore.estimation.steps import EstimateStep
from osfcore.geometry.states import EstimatedState
from osfcore.planning.costs import PoseGoal
from osfcore.planning.mppi import PlanSketch

from ..jobs.job import Job, JobChanged, JobView
from ..jobs.kinds.estimates import EstimateParams
from ..processes.messages.scene_messages import SceneChanged
from ..services import episodes, estimates
from ..services.event_hub import CurrentScene
from ..services.goals import DraftChanged
from .drawing import Panel
from .nodes.episode_nodes import EpisodeNodes
from .nodes.estimate_nodes import EstimateNodes

ESTIMATE_INTERVAL_S, EPISODE_INTERVAL_S = 0.1, 0.08  # least time between two drawings


def takes_view(job: Job, shown: Job | None) -> bool:
    """Decide whether a job that has changed takes the view from the one that is shown; one that waits does not."""
    if job.is_finished:  # else one that is renamed would take the place of what is drawn
        return shown is not None and shown.id == job.id
    return shown is None or shown.id == job.id or shown.is_finished or job.state == "running"


class EstimatePanel(Panel):
    """The nodes of estimates; the same in all browsers."""

    def __init__(self, nodes: EstimateNodes) -> None:
        super().__init__("estimate-panel", ESTIMATE_INTERVAL_S)
        self._nodes = nodes
        self._job: Job | None = None
        self._step: EstimateStep | None = None  # not drawn yet
        self._drawn_job: str | None = None

    def forget(self) -> None:
        """Remove what a finished estimate has drawn. Any thread may call."""
        with self._thread.changing():
            if self._job is None or self._job.is_finished:
                self._job, self._step = None, None

    def _store(self, event: object) -> bool:
        match event:
            case JobView(job, EstimateStep() as step) if job.kind == estimates.KIND and self._is_here(job):
                self._job, self._step = job, step
            case JobChanged(_, job) if job.kind == estimates.KIND and self._is_here(job) and takes_view(job, self._job):
                self._job = job
            case CurrentScene():
                if self._job is not None and not self._is_here(self._job):
                    self._job, self._step = None, None
            case SceneChanged(record) if record.id == self._current and self._job is not None:
                if self._job.is_finished:  # what it found has moved
                    self._job, self._step = None, None
            case _:
                return False
        return True

    def _is_here(self, job: Job) -> bool:
        """Check whether it is about what is on view; uploads are shown on any table."""
        return EstimateParams.from_json(job.params).of.scene in (None, self._current)

    def _draw(self) -> None:
        with self._thread.changed:
            job, step, self._step = self._job, self._step, None
        if job is None or job.state in ("cancelled", "failed") or job.id != self._drawn_job:
            self._nodes.clear()
            self._drawn_job = None if job is None else job.id
        if step is not None:
            self._nodes.show(step.state, step.candidates, step.lights, step.estimate)


@dataclass(frozen=True, eq=False, slots=True)
class _EpisodeState:
    """The newest events of an episode, as far as they are drawn; one replaces the older ones of its kind only.

    Attributes:
        job: that runs the episode.
        goal: target poses.
        sight: a step of an estimator at work, or the last estimate.
        plan: the last round of planning.
    """

    job: Job | None = None
    goal: PoseGoal | None = None
    sight: Looking | EstimatedState | None = None
    plan: PlanSketch | None = None

    @property
    def is_live(self) -> bool:
        """Whether there is more to come."""
        return self.job is not None and not self.job.is_finished

    def is_on(self, scene: str | None) -> bool:
        """Check whether it is about a scene."""
        return self.job is not None and self.job.scene == scene

    def with_job(self, job: Job) -> _EpisodeState:
        """Make the state after a change of the job; empty for another job."""
        if self.job is None or self.job.id != job.id:
            return _EpisodeState(job)
        if not job.is_finished:
            return replace(self, job=job)
        return replace(self, job=job, plan=None, sight=None if isinstance(self.sight, Looking) else self.sight)

    def with_event(self, event: object) -> _EpisodeState:
        """Make the state after an event."""
        match event:
            case Looking(look="next", step=EstimateStep(candidates=None)):
                return self  # too short to be seen
            case Looking():
                return replace(self, sight=event)
            case GoalFound(goal):
                return replace(self, goal=goal)
            case PlanSketch():
                return replace(self, plan=event)
            case Stepped(estimate=estimate):
                return replace(self, sight=estimate)
            case _:
                return self


class EpisodePanel(Panel):
    """The nodes of episodes; the same in all browsers.

    Args:
        nodes: of episodes.
        make_room: called before an episode is drawn, to remove what would be in its way.
    """

    def __init__(self, nodes: EpisodeNodes, make_room: Callable[[], object]) -> None:
        super().__init__("episode-panel", EPISODE_INTERVAL_S)
        self._nodes = nodes
        self._make_room = make_room
        self._state = _EpisodeState()
        self._drawn = _EpisodeState()
        self._plan_at = 0.0

    def _store(self, event: object) -> bool:
        state = self._state
        match event:
            case JobView(job, view) if job.kind == episodes.KIND:
                self._state = state.with_job(job).with_event(view)
            case JobChanged(_, job) if job.kind == episodes.KIND and takes_view(job, state.job):
                self._state = state.with_job(job)
            case CurrentScene():
                if not state.is_live and not state.is_on(self._current):
                    self._state = _EpisodeState()
            case DraftChanged(draft) if draft is not None and not state.is_live:
                self._state = _EpisodeState()  # a new goal begins: the former one would be taken for it
            case SceneChanged(record) if not state.is_live and state.is_on(record.id):
                self._state = replace(state, sight=None)  # somebody has moved something: the estimate is outdated
            case JobView(_, EstimateStep()) if not state.is_live:
                self._state = replace(state, sight=None)
            case _:
                return False
        return True

    def _draw(self) -> None:
        with self._thread.changed:
            state = self._state if self._state.is_on(self._current) else _EpisodeState()
        if state is not self._drawn:
            self._draw_changes(state)
        if state.plan is not None:
            self._nodes.play(time.monotonic() - self._plan_at)
            self._thread.wake(EPISODE_INTERVAL_S)

    def _draw_changes(self, state: _EpisodeState) -> None:
        drawn = self._drawn
        if _id(state.job) != _id(drawn.job):
            self._nodes.clear()
            drawn = _EpisodeState(state.job)
            if state.is_live:
                self._make_room()
        if state.sight is not drawn.sight:
            match state.sight:
                case Looking(look=look, step=step):
                    of_goal = look == "goal"
                    self._nodes.show_look(step.state, step.candidates, step.lights, step.estimate, of_goal=of_goal)
                case EstimatedState(state=believed, doubts=doubts):
                    self._nodes.show_estimate(believed, doubts)
                case None:
                    self._nodes.show_estimate(None)
        if state.goal is not drawn.goal:  # after what was seen while it was looked for
            goal = state.goal
            self._nodes.show_goal({} if goal is None else {name: goal.pose(name) for name in goal.names})
        if state.plan is not drawn.plan:
            self._nodes.show_plan(state.plan)
            self._plan_at = time.monotonic()
        self._drawn = state


def _id(job: Job | None) -> str | None:
    return None if job is None else job.id
