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

import viser

from app.episodes.trajectory import read_trajectory
from app.processes.process_client import ProcessClient
from app.viewer.nodes.atomic import atomic
from app.viewer.nodes.estimate_nodes import TRACKED
from app.viewer.panels.neural_panel import NeuralPanel
from app.viewer.panels.panel import Panel
from app.viewer.replay_nodes import ROOT, ReplayNodes
from osfcore.errors import OsfError
from osfcore.geometry.states import SceneState
from osfcore.objects.asset_library import AssetLibrary

DRAW_INTERVAL_S = 0.04
_TRACKED = f"/episode/estimate/{TRACKED}"
_HIDDEN = {  # below the root of what is on view
    "meshes": (_TRACKED,), "fields": (_TRACKED,), "beliefs": ("/objects", "/shadows", "/names"),
}  # fmt: skip
_BY_PAGE = "page"
Shows = Literal["meshes", "fields", "beliefs"]
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
    """

    replay: Replay | None = None
    shows: Shows = "meshes"


@dataclass(slots=True)
class _Page:
    """A page's wish, and what its view shows of it.

    Attributes:
        wish: what it has asked for.
        since: when it asked, by the monotonic clock [s].
        client: the browser's view, once it is open.
        nodes: that replay.
        shown: the file that they replay, and when it was last written.
        is_due: whether there is something to draw.
    """

    wish: Wish = Wish()
    since: float = 0.0
    client: viser.ClientHandle | None = None
    nodes: ReplayNodes | None = None
    shown: tuple[Path, int] | None = None
    is_due: bool = False


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
        self.neural = NeuralPanel(link, self.seen, fields, library.label)
        self._pages: OrderedDict[str, _Page] = OrderedDict()  # guarded by `_thread.changed`, but for what is drawn

    def ask(self, page: str, wish: Wish) -> bool:
        """Show an episode in a page's view, or the live table; tells whether the view is open. Any thread may call.

        Raises:
            CorruptFile: if the trajectory cannot be read; then nothing changes.
        """
        if wish.replay is not None:
            read_trajectory(wish.replay.trajectory)
        with self._thread.changed:
            known = self._pages.setdefault(page, _Page())
            self._pages.move_to_end(page)
            if wish.replay != known.wish.replay:  # else only another look at it is wanted: what plays goes on
                known.since = time.monotonic()
            known.wish, known.is_due = wish, True
            idle = [name for name, one in self._pages.items() if one.client is None]
            for name in idle[: max(len(self._pages) - _MOST_PAGES, 0)]:
                del self._pages[name]
            self._thread.wake()
            return known.client is not None

    def add_client(self, client: viser.ClientHandle) -> None:
        """A browser has opened the view of a page, perhaps once more."""
        page = self._page_of(client.client_id)
        if page is None:
            return
        with self._thread.changed:
            known = self._pages.setdefault(page, _Page())
            known.client, known.nodes, known.shown, known.is_due = client, None, None, True
            self._thread.wake()

    def remove_client(self, client: viser.ClientHandle) -> None:
        """A browser has closed it."""
        with self._thread.changed:
            for known in self._pages.values():
                if known.client is client:
                    known.client = known.nodes = known.shown = None

    def seen(self, client: int) -> tuple[SceneState, str]:
        """What a browser shows now, and the root of its nodes. Any thread may call."""
        with self._thread.changed:
            for page in self._pages.values():
                if page.client is not None and page.client.client_id == client and page.nodes is not None:
                    return page.nodes.state(), ROOT
        return self._live(), ""

    def _store(self, event: object) -> bool:
        return False  # wishes come by `ask`

    def _draw(self) -> None:
        with self._thread.changed:
            due = [(name, page) for name, page in self._pages.items() if page.is_due and page.client is not None]
            for _, page in due:
                page.is_due = False
        for name, page in due:
            try:
                self._draw_at_once(page)
            except Exception as error:  # the views of others go on
                if isinstance(error, OsfError):
                    _log.warning("a replay cannot go on: %s", error)
                elif page.client is not None:  # else it has left in between
                    _log.exception("the view of page %s failed", name)

    def _draw_at_once(self, page: _Page) -> None:
        """Draw in one change, so that live table and replay are never seen together."""
        client = page.client
        if client is not None:
            with atomic(client):
                self._draw_page(page, client)

    def _draw_page(self, page: _Page, client: viser.ClientHandle) -> None:
        wish, now = page.wish, time.monotonic()
        if wish.replay is not None:
            self._draw_replay(page, wish.replay, client, now)
        elif page.nodes is not None:
            self._close(page)
        root = ROOT if wish.replay is not None else ""
        hidden = self.neural.hidden(client.client_id)
        if hidden is not None:
            hidden.hide(_BY_PAGE, {f"{root}{path}" for path in _HIDDEN[wish.shows]})
        self.neural.switch(client.client_id, is_on=wish.shows == "fields")
        self.neural.view_moved(client.client_id)

    def _draw_replay(self, page: _Page, wish: Replay, client: viser.ClientHandle, now: float) -> None:
        nodes = self._opened(page, wish, client)
        played_s = wish.speed * (now - page.since) if wish.plays else 0.0
        nodes.at(wish.at_s + played_s)
        if wish.plays and wish.at_s + played_s < nodes.clock.length_s:
            with self._thread.changed:
                page.is_due = True
                self._thread.wake(DRAW_INTERVAL_S)

    @staticmethod
    def _close(page: _Page) -> None:
        """Back to the live table."""
        if page.nodes is not None:
            page.nodes.remove()
        page.nodes = page.shown = None

    def _opened(self, page: _Page, wish: Replay, client: viser.ClientHandle) -> ReplayNodes:
        """The nodes for a wish; an episode that goes on is read again once there is more of it."""
        version = wish.trajectory, wish.trajectory.stat().st_mtime_ns
        if page.nodes is None or page.shown is None or page.shown[0] != wish.trajectory:
            self._close(page)
            page.nodes = ReplayNodes(client, self._library, read_trajectory(wish.trajectory))
        elif page.shown != version:
            page.nodes.follow(read_trajectory(wish.trajectory))
        page.shown = version
        return page.nodes
