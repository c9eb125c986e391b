"""Episodes in the 3D view: the folder in the panel, and the thread that draws the newest events.

Events come from the jobs' thread and are only stored there; drawing, at most some times a second, happens here.
"""

from __future__ import annotations

import time
from collections.abc import Callable
from dataclasses import dataclass, replace

import viser

from app.jobs.job import Job, JobChanged, JobView
from app.processes.messages.scene_messages import SceneChanged
from app.processes.plan_summary import PlanSketch
from app.services.episodes import KIND
from app.services.event_hub import CurrentScene
from app.services.goals.goals import DraftChanged
from app.viewer.nodes.episode_nodes import EpisodeNodes, Part
from app.viewer.nodes.scene_nodes import SceneNodes
from app.viewer.panels.panel import Panel
from osfcore.control.events import GoalFound, Looking, Stepped
from osfcore.estimation.steps import EstimateStep
from osfcore.geometry.states import EstimatedState
from osfcore.planning.costs import PoseGoal

DRAW_INTERVAL_S = 0.08
_SHOWN: tuple[tuple[Part, str, str], ...] = (
    ("goal", "Show goal", "Golden: where everything should be."),
    ("plan", "Show plan", "Ways of the pusher, cheap ones green; purple: the best one, and where it leads."),
    ("estimate", "Show estimate", "Where the cameras have found objects and light; what is doubted is orange."),
)


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

    def with_job(self, job: Job) -> _EpisodeState:
        """The state after a change of the job; empty for another job."""
        if self.job is None or self.job.id != job.id:
            return _EpisodeState(job)
        if not job.is_finished:
            return replace(self, job=job)
        return replace(self, job=job, plan=None, sight=None if isinstance(self.sight, Looking) else self.sight)

    def with_event(self, event: object) -> _EpisodeState:
        """The state after an event."""
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
    """The nodes of episodes, and a folder to choose which are drawn; the same in all browsers.

    Args:
        server: whose panel gets the folder.
        nodes: of the table, whose own light is the true one, and of episodes.
        make_room: called before an episode is drawn, to remove what would be in its way.
    """

    def __init__(
        self, server: viser.ViserServer, nodes: tuple[SceneNodes, EpisodeNodes], make_room: Callable[[], object]
    ) -> None:
        super().__init__("episode-panel", DRAW_INTERVAL_S)
        self._table, self._nodes = nodes
        self._make_room = make_room
        self._state = _EpisodeState()
        self._current: str | None = None
        self._drawn = _EpisodeState()
        self._plan_at = 0.0
        self._add_panel(server.gui)

    def _store(self, event: object) -> bool:
        state = self._state
        match event:
            case JobView(job, view) if job.kind == KIND:
                self._state = state.with_job(job).with_event(view)
            case JobChanged(_, job) if job.kind == KIND and self._is_latest(job):
                self._state = state.with_job(job)
            case CurrentScene(record):
                self._current = None if record is None else record.id
                if not state.is_live and not self._is_here(state):
                    self._state = _EpisodeState()
            case DraftChanged(draft) if draft is not None and not state.is_live:
                self._state = _EpisodeState()  # a new goal begins: the former one would be taken for it
            case SceneChanged(record) if not state.is_live and self._is_of(state, record.id):
                self._state = replace(state, sight=None)  # somebody has moved something: the estimate is outdated
            case JobView(_, EstimateStep()) if not state.is_live:
                self._state = replace(state, sight=None)
            case _:
                return False
        return True

    def _is_here(self, state: _EpisodeState) -> bool:
        """Whether it is about what is on view."""
        return self._current is not None and self._is_of(state, self._current)

    @staticmethod
    def _is_of(state: _EpisodeState, scene: str) -> bool:
        return state.job is not None and state.job.params["scene"] == scene

    def _is_latest(self, job: Job) -> bool:
        """One that waits does not take the view from one that runs."""
        mine = self._state.job
        if job.is_finished:  # else one that is renamed would take the place of what is drawn
            return mine is not None and mine.id == job.id
        return mine is None or mine.id == job.id or job.state == "running" or not self._state.is_live

    # The panel

    def _add_panel(self, gui: viser.GuiApi) -> None:
        with gui.add_folder("Episode", expand_by_default=False):
            for part, label, hint in _SHOWN:
                self._add_part(gui, part, label, hint)
            self._wants_truth = gui.add_checkbox(
                "Show true light", False, hint="The simulation's own light, which the estimator does not know."
            )
            clear = gui.add_button("Clear", hint="Remove what a finished episode has drawn.")
        self._wants_truth.on_update(lambda _: self._draw_truth())
        clear.on_click(lambda _: self._forget())

    def _add_part(self, gui: viser.GuiApi, part: Part, label: str, hint: str) -> None:
        box = gui.add_checkbox(label, True, hint=hint)

        def show(_: object) -> None:
            self._nodes.show_part(part, box.value)
            self._draw_truth()

        box.on_update(show)

    def _forget(self) -> None:
        with self._thread.changed:
            if not self._state.is_live:
                self._state = _EpisodeState()
                self._thread.wake()

    # The thread

    def _draw(self) -> None:
        with self._thread.changed:
            state = self._state if self._is_here(self._state) else _EpisodeState()
        if state is not self._drawn:
            self._draw_changes(state)
        if state.plan is not None:
            self._nodes.play(time.monotonic() - self._plan_at)
            self._thread.wake(DRAW_INTERVAL_S)

    def _draw_changes(self, state: _EpisodeState) -> None:
        drawn = self._drawn
        if _id(state.job) != _id(drawn.job):
            self._nodes.clear()
            drawn = _EpisodeState(state.job)
            if state.is_live:
                self._make_room()
        if state.sight is not drawn.sight:
            if isinstance(state.sight, Looking):
                self._nodes.show_look(state.sight)
            else:
                self._nodes.show_estimate(state.sight)
        if state.goal is not drawn.goal:  # after what was seen while it was looked for
            self._nodes.show_goal(state.goal)
        if state.plan is not drawn.plan:
            self._nodes.show_plan(state.plan)
            self._plan_at = time.monotonic()
        self._draw_truth()
        self._drawn = state

    def _draw_truth(self) -> None:
        """While an estimate is on view, the green cube is its own; the lamp is shown on demand, in another colour."""
        if self._nodes.shows_light:
            self._table.show_lamp(is_on=self._wants_truth.value, name="true light", by=KIND)
        else:
            self._table.show_lamp(is_on=True, by=KIND)


def _id(job: Job | None) -> str | None:
    return None if job is None else job.id
