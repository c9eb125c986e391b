"""The nodes that replay an episode in the 3D view of one browser, in place of the live table."""

from __future__ import annotations

import viser

from app.episodes.replay_clock import Moment, ReplayClock
from app.episodes.trajectory import LookFrame, Round, Trajectory
from app.viewer.nodes.episode_nodes import EpisodeNodes
from app.viewer.nodes.estimate_nodes import TRACKED
from app.viewer.nodes.scene_nodes import LAMP, LIVE_NODES, SceneNodes
from osfcore.control.events import Looking
from osfcore.estimation.steps import EstimateStep
from osfcore.geometry.states import SceneState
from osfcore.objects.asset_library import AssetLibrary
from osfcore.planning.costs import PoseGoal
from osfcore.progress import Progress

ROOT = "/replay"


class ReplayNodes:
    """What one browser sees of a trajectory; the others go on seeing the live table. One thread at a time.

    Args:
        client: the browser.
        library: meshes of the objects.
        trajectory: of the episode, perhaps of one that goes on.
    """

    def __init__(self, client: viser.ClientHandle, library: AssetLibrary, trajectory: Trajectory) -> None:
        self._client = client
        # Invisible nodes of a browser's own take the places of those that all browsers see, with all below them.
        self._hidden = [client.scene.add_frame(path, show_axes=False, visible=False) for path in LIVE_NODES]
        # What is hidden as a whole needs a node of its own.
        self._root, *_ = (client.scene.add_frame(f"{ROOT}{path}", show_axes=False) for path in ("", "/objects"))
        self._table = SceneNodes(client, library, root=ROOT)
        self._table.show_names(is_on=False)
        self._episode = EpisodeNodes(client, library, self._table.names, root=f"{ROOT}/episode")
        client.scene.add_frame(f"{ROOT}/episode/estimate/{TRACKED}", show_axes=False)
        self._table.begin(trajectory.states[0])
        self.follow(trajectory)

    @property
    def clock(self) -> ReplayClock:
        """When what is on view."""
        return self._clock

    def state(self) -> SceneState:
        """What is on view."""
        return self._table.state()

    def follow(self, trajectory: Trajectory) -> None:
        """Replay a longer trajectory of the same episode from now on."""
        self._trajectory, self._clock = trajectory, ReplayClock(trajectory)
        self._shown = Moment(-1.0)

    def at(self, at_s: float) -> None:
        """Show a moment [s]."""
        moment, before = self._clock.moment(at_s), self._shown
        if moment.action != before.action:
            self._table.place(self._trajectory.state_at(moment.action))
        if moment.look is not before.look:
            self._show_look(moment.look)
        if moment.estimate is not before.estimate:
            self._show_estimate(moment.estimate)
        if moment.plan is not before.plan:
            self._episode.show_plan(None if moment.plan is None else moment.plan.plan)
        if moment.plan is not None:
            self._episode.play_to(moment.planned)
        self._shown = moment

    def remove(self) -> None:
        """Back to the live table."""
        lamp = self._client.scene.get_handle_by_name(LAMP)
        for node in (self._root, *self._hidden, lamp):
            if node is not None:
                node.remove()

    def _show_look(self, look: LookFrame | None) -> None:
        if look is None:
            self._episode.show_goal(self._goal())
            return
        if look.look == "first":
            self._episode.show_goal(None)
        candidates = look.candidates if len(look.candidates.position) else None
        step = EstimateStep(Progress(0, 1, ""), "done", look.state, candidates)
        self._episode.show_look(Looking(0, look.look, step))

    def _show_estimate(self, round_: Round | None) -> None:
        self._episode.show_estimate(None if round_ is None else round_.estimate)
        if round_ is not None:
            self._episode.show_goal(self._goal())

    def _goal(self) -> PoseGoal | None:
        goal = self._trajectory.goal
        return None if goal is None else PoseGoal(self._trajectory.names, goal)
