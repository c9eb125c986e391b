"""Neural renderings in the 3D view: on or off for each browser, and a thread that keeps its picture up to date."""

from __future__ import annotations

import logging
import threading
import time
from collections.abc import Callable, Collection
from concurrent.futures import Future
from dataclasses import dataclass

import numpy as np
import viser

from osfcore.errors import OsfError
from osfcore.geometry.cameras import Camera
from osfcore.geometry.states import SceneState

from ..processes.client import ProcessClient
from ..processes.messages.neural_messages import DrawnView, DrawView, NeuralAnswer
from ..processes.render_cameras import view_camera
from .drawing import Panel

WARM_UP = "The renderer is loading, which can take half a minute the first time; until then you see meshes."
_LATE_S = 1.0
_NOTHING_M = 100.0  # depth where a ray meets nothing
_BEHIND_M = 0.003  # pictures lie that much farther away, so that what stands on the table is not half in it
_QUICK_JPEG_QUALITY, _SHARP_JPEG_QUALITY = 75, 92
_NEURAL = "neural pictures"
_log = logging.getLogger(__name__)
Seen = Callable[[], tuple[SceneState, str]]


class HiddenNodes:
    """Hides nodes in one browser, each for as long as somebody wants that. Any thread may call.

    A node that all browsers see is covered by an invisible one of the same path that is this browser's own. A node of
    its own would be removed by that, with all below it; it becomes invisible itself.

    Args:
        client: the browser.
    """

    def __init__(self, client: viser.ClientHandle) -> None:
        self._scene = client.scene
        self._lock = threading.Lock()
        self._wanted: dict[str, frozenset[str]] = {}
        self._covers: dict[str, viser.SceneNodeHandle | None] = {}  # by path; None for a node of its own

    def hide(self, by: str, paths: Collection[str]) -> None:
        """Hide some paths, and no longer others, as far as `by` is concerned."""
        with self._lock:
            self._wanted[by] = frozenset(paths)
            every = frozenset().union(*self._wanted.values())
            for path in self._covers.keys() - every:
                self._uncover(path)
            for path in every:
                self._cover(path)

    def _cover(self, path: str) -> None:
        node = self._scene.get_handle_by_name(path)
        if node is None:
            self._covers[path] = self._scene.add_frame(path, show_axes=False, visible=False)
        elif node is not self._covers.get(path):
            self._covers[path] = None
            node.visible = False

    def _uncover(self, path: str) -> None:
        cover, node = self._covers.pop(path), self._scene.get_handle_by_name(path)
        if node is not None and node is cover:
            node.remove()
        elif node is not None and cover is None:
            node.visible = True  # else somebody else has covered it meanwhile


REST_S = 0.3


@dataclass(frozen=True, slots=True)
class Step:
    """One stage of refinement.

    Attributes:
        rows: height of the picture [px].
        is_sharp: whether it is rendered with fine sampling and with depth.
    """

    rows: int
    is_sharp: bool


STEPS = (Step(112, is_sharp=False), Step(256, is_sharp=True), Step(480, is_sharp=True))


@dataclass(frozen=True, slots=True)
class RenderTicket:
    """A requested picture.

    Attributes:
        movement: number of the movement after which it was requested.
        step: index into `STEPS`.
    """

    movement: int
    step: int


class Refinement:
    """How careful the next picture of a view should be: coarse while something moves, sharper once it rests.

    Times are in seconds of one clock; one thread at a time.
    """

    def __init__(self) -> None:
        self._movement = 0
        self._moved_at = 0.0
        self._step = 0
        self._ordered: RenderTicket | None = None

    def moved(self, now: float) -> None:
        """Something that the view shows has moved, or the view itself."""
        self._movement += 1
        self._moved_at, self._step = now, 0

    def due_at(self) -> float | None:
        """When the next picture should be ordered; None while an ordered one is worth waiting for, and at the end.

        A quick picture is waited for even while things move on: that sets the pace. A sharp one is not.
        """
        waits = self._ordered is not None and (self._ordered.step == 0 or self._ordered.movement == self._movement)
        if waits or self._step == len(STEPS):
            return None
        return self._moved_at if self._step == 0 else self._moved_at + REST_S

    def order(self) -> RenderTicket:
        """Note that the next picture is being made; whatever was ordered before does not count any more."""
        self._ordered = RenderTicket(self._movement, self._step)
        return self._ordered

    def accept(self, ticket: RenderTicket, *, is_there: bool) -> bool:
        """Note the answer to an order, with a picture or without; returns whether the picture should be shown."""
        if ticket != self._ordered:
            return False
        self._ordered = None
        is_fresh = ticket.movement == self._movement
        if is_there and is_fresh:
            self._step = ticket.step + 1
        return is_there and (is_fresh or ticket.step == 0)

    def give_up(self, ticket: RenderTicket) -> None:
        """Note that no picture can be made before something moves."""
        if ticket == self._ordered:
            self._ordered, self._step = None, len(STEPS)


class ClientView:
    """One browser, and the picture on view. All but `hidden` and `is_on` belongs to the thread of `NeuralPanel`.

    Args:
        client: the browser.
        seen: what it shows now, and the root of its nodes.

    Attributes:
        hidden: what this browser does not see, for whatever reason.
        is_on: whether neural pictures are switched on.
    """

    def __init__(self, client: viser.ClientHandle, seen: Seen) -> None:
        self.client, self.seen = client, seen
        self.is_on = False
        self.refinement = Refinement()
        self.answers: list[Callable[[], None]] = []  # what to do with those that have come
        self.waiting_since: float | None = None  # for a first picture
        self.hidden = HiddenNodes(client)
        self._waiting: viser.NotificationHandle | None = None
        self._meshes: tuple[str, ...] = ()
        self._is_clear = True

    def due_at(self) -> float | None:
        """When there is something to do; None if there is nothing."""
        if not self.is_on:
            return None if self._is_clear else 0.0
        if self.answers:
            return 0.0
        late_at = None if self.waiting_since is None or self._waiting else self.waiting_since + _LATE_S
        times = [at for at in (self.refinement.due_at(), late_at) if at is not None]
        return min(times, default=None)

    def camera(self, rows: int) -> Camera | None:
        """The view now; None while the browser's numbers make no sense."""
        view = self.client.camera
        if view.image_height < 1:
            return None
        return view_camera(view.position, view.wxyz, view.fov, view.aspect, min(rows, view.image_height))

    def show(self, picture: DrawnView, names: tuple[str, ...], root: str) -> None:
        """Put a picture behind everything, in place of the meshes of some objects, of the table and of the pusher.

        Args:
            picture: of the fields.
            names: of the objects in it.
            root: of the nodes that it stands for.
        """
        depth, quality = picture.depth, _QUICK_JPEG_QUALITY
        if depth is not None:
            depth = np.where(depth > 0, depth + np.float32(_BEHIND_M), np.float32(_NOTHING_M))
            quality = _SHARP_JPEG_QUALITY
        self.client.scene.set_background_image(picture.image, "jpeg", jpeg_quality=quality, depth=depth)
        # Of a replay, which stands in place of the live table, the same nodes lie below its own.
        parts = ("/pusher", "/shadows", *(f"/objects/{name}" for name in names))
        self.hidden.hide(_NEURAL, {"/table", *(f"{root}{part}" for part in parts)})
        self._stop_waiting()
        self._is_clear = False

    def clear(self) -> None:
        """Show meshes again."""
        self.hidden.hide(_NEURAL, ())
        self.client.scene.set_background_image(None)
        self._stop_waiting()
        self.notify_meshes(())
        self._is_clear = True

    def refuse(self, reason: str) -> None:
        """Switch off, and say why."""
        self.is_on = False
        self.clear()
        self.client.add_notification("No neural fields", reason, color="orange", auto_close_seconds=10.0)

    def notify_delay(self, now: float) -> None:
        """Say that the renderer takes its time, if it does."""
        if self.waiting_since is not None and self._waiting is None and now >= self.waiting_since + _LATE_S:
            self._waiting = self.client.add_notification("Neural fields", WARM_UP, loading=True)

    def notify_meshes(self, names: tuple[str, ...]) -> None:
        """Say which objects have no field, once."""
        before, self._meshes = self._meshes, names
        if names and names != before:
            text = f"Without a field, so still shown as meshes: {', '.join(names)}. Train them in Your objects."
            self.client.add_notification("Neural fields", text, auto_close_seconds=8.0)

    def _stop_waiting(self) -> None:
        self.waiting_since = None
        if self._waiting is not None:
            self._waiting.remove()
            self._waiting = None


class NeuralPanel(Panel):
    """The views of browsers, and the thread that requests and shows their pictures.

    Args:
        link: to the renderer.
        fields: names of the objects that have one.
        label: what people call an object.
    """

    def __init__(
        self, link: ProcessClient, fields: Callable[[], Collection[str]], label: Callable[[str], str] = str
    ) -> None:
        super().__init__("neural-panel")
        self._label = label
        self._link = link
        self._fields = fields
        self._views: list[ClientView] = []  # guarded by `_thread.changed`, with what belongs to them

    def add(self, client: viser.ClientHandle, seen: Seen) -> ClientView:
        """Look after a new browser.

        Args:
            client: the browser.
            seen: what it shows now, and the root of its nodes.
        """
        view = ClientView(client, seen)
        client.camera.on_update(lambda _: self.moved(view))
        with self._thread.changed:
            self._views.append(view)
        return view

    def remove(self, view: ClientView) -> None:
        """Forget a browser that has left."""
        with self._thread.changed:
            self._views = [other for other in self._views if other is not view]

    def switch(self, view: ClientView, *, is_on: bool) -> None:
        """Switch neural pictures on or off in one browser. Any thread may call."""
        with self._thread.changed:
            if view.is_on != is_on:
                view.is_on = is_on
                self.moved(view)

    def moved(self, view: ClientView | None = None) -> None:
        """Note that what one browser shows has changed, or all; any thread may call, and never waits for a picture."""
        with self._thread.changing():
            for one in self._views if view is None else [view]:
                one.refinement.moved(time.monotonic())

    def _draw(self) -> None:
        now = time.monotonic()
        with self._thread.changed:
            due = [view for view in self._views if (at := view.due_at()) is not None and at <= now]
        for view in due:
            try:
                self._look_after(view, now)
            except Exception:  # a defect; the other browsers still get their pictures
                _log.exception("the neural pictures of a browser failed")
                self.remove(view)
        with self._thread.changed:
            times = [at for view in self._views if (at := view.due_at()) is not None]
            if times:
                self._thread.wake(max(min(times) - time.monotonic(), 0.0))

    def _look_after(self, view: ClientView, now: float) -> None:
        with self._thread.changed:
            answers, view.answers = view.answers, []
        for take in answers:
            take()
        if not view.is_on:
            view.clear()
            return
        view.notify_delay(now)
        with self._thread.changed:
            due_at = view.refinement.due_at()
            ticket = view.refinement.order() if due_at is not None and due_at <= now else None
        if ticket is not None:
            self._order(view, ticket, now)

    def _order(self, view: ClientView, ticket: RenderTicket, now: float) -> None:
        step = STEPS[ticket.step]
        (seen, root), camera = view.seen(), view.camera(step.rows)
        if camera is None:
            with self._thread.changed:
                view.refinement.give_up(ticket)
            return
        known = self._fields()
        rows = [row for row, name in enumerate(seen.names) if name in known]
        names = tuple(seen.names[row] for row in rows)
        view.notify_meshes(tuple(self._label(name) for name in seen.names if name not in known))
        if not self._link.is_warm and view.waiting_since is None:
            view.waiting_since = now
        state = SceneState(names, seen.poses[rows], seen.light, seen.pusher)

        def receive(done: Future[NeuralAnswer]) -> None:
            with self._thread.changing():
                view.answers.append(lambda: self._take(view, ticket, done, names, root))

        order = DrawView(f"view-{view.client.client_id}", state, camera, step.is_sharp)
        self._link.submit(order).add_done_callback(receive)

    def _take(
        self, view: ClientView, ticket: RenderTicket, answer: Future[NeuralAnswer], names: tuple[str, ...], root: str
    ) -> None:
        """Show a picture of some objects, which stand below a root, unless it is overtaken."""
        error = answer.exception()
        picture = None if error else answer.result()
        with self._thread.changed:
            is_current = view.refinement.accept(ticket, is_there=picture is not None)
        if not view.is_on:
            return
        if isinstance(error, OsfError):
            view.refuse(str(error))
        elif error is not None:
            raise error
        elif is_current and isinstance(picture, DrawnView):
            view.show(picture, names, root)
