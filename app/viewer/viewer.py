"""The live 3D view: draws the current scene with viser and turns what people do there into runner commands.

viser's loop never waits: drawing happens in the playback's thread, commands in another one.
"""

from __future__ import annotations

import contextlib
import ctypes
import gc
import io
import logging
from collections.abc import Callable, Collection
from concurrent.futures import ThreadPoolExecutor
from pathlib import Path

import viser

from osfcore.errors import OsfError
from osfcore.geometry.light import Light
from osfcore.geometry.poses import Pose

from ..jobs.job import JobChanged
from ..processes.client import ProcessClient
from ..processes.messages.scene_messages import SceneRecord
from ..services.driver import DriverChanged
from ..services.event_hub import CurrentScene
from ..services.goals import DraftChanged, Goals
from ..services.pushes import Pushes
from ..services.runner import Runner
from ..storage.paths import without_places
from ..storage.records import Poses
from .drawing import DrawingThread, Panel, Playback
from .goal_panel import GoalPanel
from .job_panels import EpisodePanel, EstimatePanel
from .nodes.episode_nodes import EpisodeNodes
from .nodes.estimate_nodes import EstimateNodes
from .nodes.room import add_room
from .nodes.scene_nodes import Client, SceneNodes
from .page_views import PageViews
from .private_server import PrivateViser
from .push_panel import PushPanel

_AFTER_LEAVING_S, _RELEASE_INTERVAL_S = 1.0, 5.0  # when memory of browsers that have left is freed, at most so often
_log = logging.getLogger(__name__)


class Viewer:
    """The view of the runner's current scene, the same for any number of browsers."""

    def __init__(
        self, runner: Runner, neural: ProcessClient, fields: Callable[[], Collection[str]], pushes: Pushes, goals: Goals
    ) -> None:
        """Prepare the view.

        Args:
            runner: executes commands on scenes.
            neural: renders fields.
            fields: names of the objects that have a field.
            pushes: the push that is tried.
            goals: goal images, and the draft of one.
        """
        self._goals = goals
        self._pushes = pushes
        self._runner = runner
        self._neural = neural
        self._fields = fields
        self._commands = ThreadPoolExecutor(1, thread_name_prefix="viewer-commands")
        self._memory = DrawingThread("viewer-memory", release_memory, _RELEASE_INTERVAL_S)
        self._server: PrivateViser | None = None
        self._driver: str | None = None
        self._undo: list[Callable[[], None]] = []

    @property
    def client_page(self) -> Path:
        """The client's one file."""
        return Path(viser.__file__).parent / "client" / "build" / "index.html"

    @property
    def server(self) -> PrivateViser:
        """The loopback server; only while it runs."""
        assert self._server is not None
        return self._server

    @property
    def port(self) -> int:
        """Of the loopback server."""
        return self.server.get_port()

    def start(self) -> None:
        """Open the loopback server and draw what there is."""
        self._server = PrivateViser()
        add_room(self._server)
        self._drawing = SceneNodes(self._server, self._runner.library, self._move_object, self._move_light)
        self._playback = Playback(self._drawing)
        self.pages = PageViews(
            self._runner.library, self._server.page_of, self._drawing.state, self._neural, self._fields
        )
        self._drawing.watch(self.pages.neural.moved)
        self._panels = self._make_panels(self._server)
        self._server.on_client_connect(self._add_client)
        self._server.on_client_disconnect(self._remove_client)
        self._playback.start()
        for panel in self._panels:
            panel.start(self._current_record())
        listeners = (self._playback.note, *(panel.show for panel in self._panels), self._on_event)
        self._undo = [self._runner.hub.subscribe(listener) for listener in listeners]
        self._show_current()
        self._update_gizmos()
        gc.freeze()  # what is there by now stays: looking for what browsers leave is twenty times as fast without it
        self._memory.start()

    def stop(self) -> None:
        """Close the server and end the threads. Calling it again does nothing."""
        if self._server is None:
            return
        for undo in self._undo:
            undo()
        self._playback.stop()
        self._memory.stop()
        gc.unfreeze()
        for panel in self._panels:
            panel.close()
        self._commands.shutdown(wait=False, cancel_futures=True)
        with contextlib.redirect_stdout(io.StringIO()):
            self._server.stop()
        self._server = None

    def put_handles_back(self) -> None:
        """Show all handles where they were, in every browser: one was dragged by somebody who only watches."""
        self._drawing.put_handles_back()
        self._goal_panel.put_handles_back()

    def _make_panels(self, server: PrivateViser) -> tuple[Panel, ...]:
        """Make what draws jobs, goals and pushes."""
        library = self._runner.library
        estimate = EstimatePanel(EstimateNodes(server, library))
        self._goal_panel = GoalPanel(server, library, self._goals, self._commands, self._run_command)
        episode = EpisodePanel(EpisodeNodes(server, library), estimate.forget)
        push = PushPanel(server, library, self._drawing.pusher, self._pushes, self._commands, self._run_command)
        return self.pages.neural, self.pages, estimate, self._goal_panel, episode, push

    def _add_client(self, client: viser.ClientHandle) -> None:
        self.pages.add_client(client)

    def _remove_client(self, client: viser.ClientHandle) -> None:
        self.pages.remove_client(client)
        self._memory.wake(_AFTER_LEAVING_S)

    def _show_current(self) -> None:
        self._playback.note(CurrentScene(self._current_record()))

    def _current_record(self) -> SceneRecord | None:
        current = self._runner.scenes.current
        return None if current is None else self._runner.scenes.get(current)

    def _move_object(self, name: str, pose: Pose, client: Client) -> None:
        """An object was let go. Called on viser's loop."""
        self._edit(client, poses=((name, pose),), settle=True)

    def _move_light(self, light: Light, client: Client) -> None:
        """The light was let go. Called on viser's loop."""
        self._edit(client, light=light)

    def _edit(self, client: Client, light: Light | None = None, poses: Poses = (), *, settle: bool = False) -> None:
        """Change the scene as a hand did; what is refused goes back."""

        def edit(scene: str) -> None:
            try:
                self._runner.scenes.edit(scene, light, poses, settle=settle)
            except OsfError:
                self._show_current()
                raise

        self._commands.submit(self._on_current, edit, client)

    def _on_current(self, command: Callable[[str], object], client: Client) -> None:
        scene = self._runner.scenes.current
        if scene is not None:
            self._run_command(lambda: command(scene), client)

    def _run_command(self, command: Callable[[], object], client: Client) -> None:
        """Carry out a command; notify the client if it is refused."""
        try:
            command()
        except OsfError as error:
            if client is not None:
                library = self._runner.library
                sentence = library.in_words(without_places(str(error), library.root.parent))
                client.add_notification("Not possible", sentence, color="orange", auto_close_seconds=6.0)
        except Exception:
            _log.exception("a command from the viewer failed")

    def _on_event(self, event: object) -> None:
        if isinstance(event, JobChanged | DraftChanged | CurrentScene):
            self._update_gizmos()
        if isinstance(event, DriverChanged) and event.driver != self._driver:
            self._driver = event.driver
            self._show_current()  # what the former driver still holds is let go
            self._goal_panel.put_handles_back()

    def _update_gizmos(self) -> None:
        """Let objects be dragged while no job holds the scene and no goal is being composed."""
        current = self._runner.scenes.current
        is_free = current is not None and self._runner.jobs.holder(current) is None
        is_free = is_free and not self._goal_panel.is_composing
        self._drawing.let_grab(is_free)
        self._drawing.show_gizmos(is_free)


def release_memory() -> None:
    """Free what browsers that have left still occupy, and return it to the system.

    viser's closed connections are parts of reference cycles and keep some megabytes each (the state of compressors)
    until Python looks through its oldest objects, which may be a thousand connections later. The C library in turn
    keeps what was freed.
    """
    gc.collect()
    with contextlib.suppress(AttributeError):  # glibc alone has it
        ctypes.CDLL(None).malloc_trim(0)
