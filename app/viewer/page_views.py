"""What the 3D view shows in one page: the live table, or an episode in its place, as scrubbed and played there.

A page calls itself something, opens the view under that name, and asks for what it wants to see; other pages are not
concerned. What was asked for outlives a reload of the view, and a view that opens later than it was asked for.
"""

from __future__ import annotations

import logging
import time
from collections import OrderedDict
from collections.abc import Callable, Collection
from dataclasses import dataclass
from pathlib import Path
from typing import Literal

import numpy as np
import viser
from jaxtyping import Float

from osfcore.errors import OsfError
from osfcore.geometry.poses import Pose
from osfcore.geometry.states import SceneState
from osfcore.objects.asset_library import AssetLibrary

from ..episodes.trajectory import LookFrame, Moment, ReplayClock, Round, Trajectory, read_trajectory
from ..processes.client import ProcessClient
from ..services.event_hub import CurrentScene
from ..storage.records import GoalRecord
from .drawing import Panel
from .neural_panel import NeuralPanel
from .nodes.episode_nodes import EpisodeNodes, add_copy
from .nodes.estimate_nodes import TRACKED
from .nodes.room import VIEW_FOV_RAD, atomic, framing
from .nodes.scene_nodes import LAMP, LIVE_NODES, SceneNodes, extent_m, pointed_at

DRAW_INTERVAL_S = 0.04
_ROOT, _CHOSEN = "/replay", "/chosen"
# What one may choose not to see, below the root of what is on view.
_TRACKED, _HANDLES = f"/episode/estimate/{TRACKED}", "/handles"
_TRUTH = "/objects", "/shadows", "/light", "/light_ray", _HANDLES
Shows = Literal["meshes", "fields", "beliefs"]
_POINTED_ROWS = 500
_MOST_PAGES = 200  # that are remembered; those that asked longest ago are forgotten
_log = logging.getLogger(__name__)


@dataclass(frozen=True, slots=True)
class Replay:
    """An episode on view in place of the live table.

    Attributes:
        trajectory: its file.
        at_s: the moment to show [s].
        plays: whether it goes on from there.
        speed: of going on; 1 is real time.
    """

    trajectory: Path
    at_s: float = 0.0
    plays: bool = False
    speed: float = 1.0


@dataclass(frozen=True, slots=True)
class Wish:
    """What a page wants to see.

    Attributes:
        replay: an episode; None for the live table.
        shows: things as meshes, as their fields render them, or only what is believed of them.
        goal: whose objects are drawn in gold on the live table, if their places are known.
        handles: whether objects have handles to lift and turn them.
    """

    replay: Replay | None = None
    shows: Shows = "meshes"
    goal: GoalRecord | None = None
    handles: bool = False


class _View:
    """A browser that shows the view of a page. All but `client` and `picture` belongs to the thread that draws.

    Args:
        client: the browser.
        neural: makes its neural pictures.
        live: what is on the live table now.

    Attributes:
        picture: the neural picture, and what the browser does not see.
        nodes: the replay that it shows in place of the live table.
    """

    def __init__(self, client: viser.ClientHandle, neural: NeuralPanel, live: Callable[[], SceneState]) -> None:
        self.client = client
        self.nodes: ReplayNodes | None = None
        self._shown: tuple[Path, int] | None = None  # the file that they replay, and when it was last written
        self._goal: tuple[str, list[viser.MeshHandle]] = "", []  # whose objects are golden, and their nodes
        self.picture = neural.add(
            client, lambda: (live(), "") if (nodes := self.nodes) is None else (nodes.table.state(), _ROOT)
        )

    def opened(self, trajectory: Path, library: AssetLibrary) -> ReplayNodes:
        """Make the nodes for a trajectory, or keep them; an episode that goes on is read again once there is more."""
        version = trajectory, trajectory.stat().st_mtime_ns
        if self.nodes is None or self._shown is None or self._shown[0] != trajectory:
            self.close()
            self.nodes = ReplayNodes(self.client, library, read_trajectory(trajectory))
        elif self._shown != version:
            self.nodes.follow(read_trajectory(trajectory))
        self._shown = version
        return self.nodes

    def show_goal(self, goal: GoalRecord | None, library: AssetLibrary) -> bool:
        """Show where objects of the live table should be; returns whether more has to be in view than before."""
        before, nodes = self._goal
        name = "" if goal is None else goal.id
        if name == before:
            return False
        for node in nodes:
            node.remove()
        poses = () if goal is None else goal.poses or ()
        nodes = [add_copy(self.client.scene, f"{_CHOSEN}/{of}", library, of) for of, _ in poses]
        for node, (_, pose) in zip(nodes, poses, strict=True):
            node.position, node.wxyz = pose.position, pose.quaternion
        self._goal = name, nodes
        return bool(nodes)

    def frame(self, points_m: Float[np.ndarray, "N 3"]) -> None:
        """Let the camera stand where points fill the view [m]."""
        camera = self.client.camera  # which may not know its field of view yet
        camera.position, camera.look_at = framing(points_m, VIEW_FOV_RAD, camera.aspect)

    def close(self) -> None:
        """Show the live table again."""
        if self.nodes is not None:
            self.nodes.remove()
        self.nodes = self._shown = None


@dataclass(slots=True)
class _Page:
    """A page's wish, and its view.

    Attributes:
        wish: what it has asked for.
        since: when it asked, by the monotonic clock [s].
        view: once it is open; another one after each reload.
        is_due: whether there is something to draw.
        framed: what the camera shall be placed for; None leaves it where it is.
    """

    wish: Wish = Wish()
    since: float = 0.0
    view: _View | None = None
    is_due: bool = False
    framed: SceneState | None = None


class PageViews(Panel):
    """The views of all pages, and the thread that draws in them.

    Args:
        library: meshes of the objects.
        page_of: what the page calls itself in which a browser shows the view, by its number.
        live: what is on the live table now.
        link: to the renderer.
        fields: names of the objects that have one.

    Attributes:
        neural: the neural pictures of what each browser shows.
    """

    def __init__(
        self,
        library: AssetLibrary,
        page_of: Callable[[int], str | None],
        live: Callable[[], SceneState],
        link: ProcessClient,
        fields: Callable[[], Collection[str]],
    ) -> None:
        super().__init__("page-views", DRAW_INTERVAL_S)
        self._library = library
        self._page_of = page_of
        self._live = live
        self.neural = NeuralPanel(link, fields, library.label)
        self._framed: str | None = None  # the scene for which the cameras were placed last
        self._pages: OrderedDict[str, _Page] = OrderedDict()  # guarded by `_thread.changed`, the newest wish last

    def ask(self, page: str, wish: Wish) -> bool:
        """Show an episode in a page's view, or the live table. Any thread may call.

        Returns:
            Whether the view is open.

        Raises:
            CorruptFile: if the trajectory cannot be read; then nothing changes.
        """
        if wish.replay is not None:
            read_trajectory(wish.replay.trajectory)
        with self._thread.changing():
            known = self._page(page)
            if wish.replay != known.wish.replay:  # else only another look at it is wanted: what plays goes on
                known.since = time.monotonic()
            if wish.replay is None and known.wish.replay is not None:
                known.framed = self._live()
            known.wish, known.is_due = wish, True
            return known.view is not None

    def frame(self, page: str) -> None:
        """Place the camera of a page's view anew, so that the objects fill it, if it is open. Any thread may call."""
        with self._thread.changing():
            known = self._page(page)
            view = known.view
            if view is not None:
                known.framed = self._live() if view.nodes is None else view.nodes.table.state()
            known.is_due = True

    def pointed_at(self, page: str, across: float, down: float) -> str | None:
        """Return what stands at a place in a page's view, as `pointed_at` names it. Any thread may call.

        Args:
            page: what it calls itself.
            across: share of the view's width, from the left.
            down: share of its height, from the top.
        """
        with self._thread.changed:
            view = self._page(page).view
        camera = None if view is None else view.picture.camera(_POINTED_ROWS)
        if view is None or camera is None:
            return None
        pixel = np.array([across * camera.width, down * camera.height])
        eye, way = camera.T_world_camera.position, camera.ray_directions(pixel)
        return pointed_at(view.picture.seen()[0], self._library, eye, way)

    def add_client(self, client: viser.ClientHandle) -> None:
        """Show what a page has asked for in the browser that has opened its view, perhaps once more."""
        page = self._page_of(client.client_id)
        if page is not None:
            with self._thread.changing():
                known = self._page(page)
                if known.view is not None:  # reloaded, and not known yet to have left
                    self.neural.remove(known.view.picture)
                known.view, known.is_due = _View(client, self.neural, self._live), True
                known.framed = self._live()

    def remove_client(self, client: viser.ClientHandle) -> None:
        """Forget a browser that has left; what its page has asked for is remembered."""
        with self._thread.changed:
            for known in self._pages.values():
                if known.view is not None and known.view.client is client:
                    self.neural.remove(known.view.picture)
                    known.view = None

    def _page(self, name: str) -> _Page:
        """Remember a page, and no longer those without a view that were heard of longest ago."""
        known = self._pages.setdefault(name, _Page())
        self._pages.move_to_end(name)
        idle = [other for other, page in self._pages.items() if page.view is None and page is not known]
        for other in idle[: max(len(self._pages) - _MOST_PAGES, 0)]:
            del self._pages[other]
        return known

    def _store(self, event: object) -> bool:
        """Frame what is on a table that was not on view before."""
        match event:
            case CurrentScene(record) if record is not None and record.id != self._framed:
                self._framed = record.id
                for page in self._pages.values():
                    page.framed, page.is_due = record.state, True
                return True
        return False

    def _draw(self) -> None:
        with self._thread.changed:
            due = [(name, page, page.view) for name, page in self._pages.items() if page.is_due and page.view]
            for _, page, _ in due:
                page.is_due = False
        for name, page, view in due:
            if page.view is not view:
                continue  # it has left in between
            try:
                with atomic(view.client):  # live table and replay are never seen together
                    self._draw_view(page, view)
            except OsfError as error:
                _log.warning("a replay cannot go on: %s", error)
            except Exception:  # the views of others go on
                if page.view is view:  # else it has left in between
                    _log.exception("the view of page %s failed", name)

    def _draw_view(self, page: _Page, view: _View) -> None:
        with self._thread.changed:
            wish, since = page.wish, page.since
            framed, page.framed = page.framed, None
        root, replay = "", wish.replay
        goal = wish.goal if replay is None else None
        if view.show_goal(goal, self._library):
            framed = framed or self._live()
        if replay is None:
            view.close()
        else:
            root, before = _ROOT, view.nodes
            at_s = replay.at_s + (replay.speed * (time.monotonic() - since) if replay.plays else 0.0)
            nodes = view.opened(replay.trajectory, self._library)
            nodes.at(at_s)
            if nodes is not before:
                framed = nodes.table.state()
            if replay.plays and at_s < nodes.clock.length_s:
                with self._thread.changed:
                    page.is_due = True
                    self._thread.wake(DRAW_INTERVAL_S)
        hidden = {*_TRUTH} if wish.shows == "beliefs" else {_TRACKED}
        if not wish.handles:
            hidden.add(_HANDLES)
        view.picture.hidden.hide("page", {f"{root}{path}" for path in hidden})
        if framed is not None and framed.names:
            view.frame(extent_m(framed, self._library, goal.poses or () if goal else ()))
        self.neural.switch(view.picture, is_on=wish.shows == "fields")
        self.neural.moved(view.picture)


class ReplayNodes:
    """What one browser sees of a trajectory; the others go on seeing the live table. One thread at a time.

    Args:
        client: the browser.
        library: meshes of the objects.
        trajectory: of the episode, perhaps of one that goes on.

    Attributes:
        table: the objects, the pusher and the light.
        clock: when what is on view.
    """

    clock: ReplayClock

    def __init__(self, client: viser.ClientHandle, library: AssetLibrary, trajectory: Trajectory) -> None:
        self._client = client
        # Invisible nodes of a browser's own take the places of those that all browsers see, with all below them.
        self._hidden = [client.scene.add_frame(path, show_axes=False, visible=False) for path in LIVE_NODES]
        self._root = client.scene.add_frame(_ROOT, show_axes=False)
        client.scene.add_frame(f"{_ROOT}/objects", show_axes=False)  # what is hidden as a whole needs a node of its own
        self.table = SceneNodes(client, library, root=_ROOT)
        self._episode = EpisodeNodes(client, library, root=f"{_ROOT}/episode")
        client.scene.add_frame(f"{_ROOT}{_TRACKED}", show_axes=False)
        self.table.show(trajectory.states[0])
        self.follow(trajectory)

    def follow(self, trajectory: Trajectory) -> None:
        """Replay a longer trajectory of the same episode from now on."""
        self._trajectory, self.clock = trajectory, ReplayClock(trajectory)
        self._shown = Moment(-1.0)

    def at(self, at_s: float) -> None:
        """Show a moment [s]."""
        moment, before = self.clock.moment(at_s), self._shown
        if moment.action != before.action:
            self.table.place(self._trajectory.state_at(moment.action))
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
        """Show the live table again."""
        lamp = self._client.scene.get_handle_by_name(LAMP)
        for node in (self._root, *self._hidden, lamp):
            if node is not None:
                node.remove()

    def _show_look(self, look: LookFrame | None) -> None:
        if look is None:
            self._episode.show_goal(self._goal())
            return
        if look.look == "first":
            self._episode.show_goal({})
        candidates = look.candidates if len(look.candidates.position) else None
        self._episode.show_look(look.state, candidates, of_goal=look.look == "goal")

    def _show_estimate(self, round_: Round | None) -> None:
        if round_ is None:
            self._episode.show_estimate(None)
        else:
            self._episode.show_estimate(round_.estimate.state, round_.estimate.doubts)
            self._episode.show_goal(self._goal())

    def _goal(self) -> dict[str, Pose]:
        goal, names = self._trajectory.goal, self._trajectory.names
        return {} if goal is None else {name: goal[n] for n, name in enumerate(names)}
