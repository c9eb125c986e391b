"""The threads that draw: panels draw the newest of what was noted, the playback each change in order, at its own pace.

What is to be drawn comes from viser's loop, from jobs and from the simulation, none of which may wait for drawing: they
only note it.
"""

from __future__ import annotations

import contextlib
import logging
import math
import queue
import threading
import time
from abc import ABC, abstractmethod
from collections.abc import Callable, Iterator

from osfcore.geometry.states import SceneState

from ..processes.messages.scene_messages import SceneChanged, SceneRecord
from ..services.event_hub import CurrentScene
from .nodes.scene_nodes import Client, SceneNodes

_log = logging.getLogger(__name__)
RunCommand = Callable[[Callable[[], object], Client], None]


class DrawingThread:
    """Draws when something was noted.

    Args:
        name: of the thread, for logs.
        draw: draws the newest of what was noted, which it reads under `changed`; called without holding it.
        interval_s: the least time between the beginnings of two drawings.

    Attributes:
        changed: guards what is noted; whoever holds it may call everything here but `stop`.
    """

    def __init__(self, name: str, draw: Callable[[], None], interval_s: float = 0.0) -> None:
        self.changed = threading.Condition()
        self._draw = draw
        self._interval_s = interval_s
        self._due_at, self._earliest = math.inf, -math.inf
        self._is_drawing = self._is_stopped = False
        self._thread = threading.Thread(target=self._run, name=name, daemon=True)

    @property
    def is_idle(self) -> bool:
        """Whether everything that is due is drawn."""
        with self.changed:
            return self._due_at > time.monotonic() and not self._is_drawing

    def start(self) -> None:
        """Begin to draw, what was noted before included."""
        self._thread.start()

    def stop(self) -> None:
        """End the thread; what is noted later is never drawn. Calling it again does nothing."""
        with self.changed:
            self._is_stopped = True
            self.changed.notify()
        if self._thread.is_alive():
            self._thread.join()

    def wake(self, after_s: float = 0.0) -> None:
        """Let it draw, after some time if nothing else wakes it before. Any thread may call."""
        with self.changed:
            self._due_at = min(self._due_at, time.monotonic() + after_s)
            self.changed.notify()

    @contextlib.contextmanager
    def changing(self) -> Iterator[None]:
        """Hold `changed` while something is noted, and let it be drawn."""
        with self.changed:
            yield
            self.wake()

    def _run(self) -> None:
        while self._wait():
            try:
                self._draw()
            except Exception:  # a defect; what is noted next may fare better
                _log.exception("%s could not draw", self._thread.name)
            with self.changed:
                self._is_drawing = False

    def _wait(self) -> bool:
        """Wait until it is time to draw; false if that is never again."""
        with self.changed:
            while not self._is_stopped:
                wait_s = max(self._due_at, self._earliest) - time.monotonic()
                if wait_s <= 0:
                    self._due_at, self._is_drawing = math.inf, True
                    self._earliest = time.monotonic() + self._interval_s
                    return True
                self.changed.wait(None if math.isinf(wait_s) else wait_s)
            return False


class Panel(ABC):
    """What draws some nodes: stores events as they come, and draws the newest state in a thread.

    Args:
        name: of the thread, for logs.
        interval_s: least time between the beginnings of two drawings [s].
    """

    def __init__(self, name: str, interval_s: float = 0.0) -> None:
        self._thread = DrawingThread(name, self._draw, interval_s)
        self._current: str | None = None  # the scene on view

    @property
    def is_idle(self) -> bool:
        """Whether everything that was shown so far is drawn."""
        return self._thread.is_idle

    def start(self, record: SceneRecord | None) -> None:
        """Begin to draw, with the scene on view."""
        self.show(CurrentScene(record))
        self._thread.start()

    def show(self, event: object) -> None:
        """Draw what an event says, soon; events of other kinds are ignored. Any thread may call."""
        with self._thread.changed:
            if isinstance(event, CurrentScene):
                self._current = None if event.record is None else event.record.id
            if self._store(event):
                self._thread.wake()

    def close(self) -> None:
        """End the thread. Calling it again does nothing."""
        self._thread.stop()

    def _store(self, event: object) -> bool:
        """Keep what an event says; false if nothing changes. Called with `_thread.changed` held."""
        del event  # what is drawn comes by other ways
        return False

    @abstractmethod
    def _draw(self) -> None:
        """Draw the newest state. Called in the thread."""


# The playback

_CATCH_UP_S = 0.5  # further behind than this, playing goes faster than time
_Change = CurrentScene | SceneChanged


class Playback:
    """A queue of changes of the scene, and the thread that draws them in order, at their own pace.

    The simulation computes faster than time, people want to see it move. A jump (another scene, a reset, a hand)
    overtakes what still waits to be played.

    Args:
        drawing: shows the scene.
    """

    def __init__(self, drawing: SceneNodes) -> None:
        self._drawing = drawing
        self._queue: queue.Queue[tuple[_Change, int] | None] = queue.Queue()  # with the generation of each
        self._lock = threading.Lock()
        self._generation = 0  # what is of an older one was overtaken by a jump
        self._waiting_s = 0.0
        self._noted: str | None = None  # the scene that will be shown once everything in line is drawn
        self._shown: str | None = None
        self._thread = threading.Thread(target=self._play, name="playback", daemon=True)

    def start(self) -> None:
        """Begin to draw."""
        self._thread.start()

    def stop(self) -> None:
        """Leave what waits undrawn and end the thread. Calling it again does nothing."""
        with self._lock:
            self._generation += 1
        self._queue.put(None)
        if self._thread.is_alive():
            self._thread.join()

    def note(self, event: object) -> None:
        """Put an event in line; events of other kinds are ignored. Any thread may call."""
        with self._lock:
            match event:
                case CurrentScene(record):
                    self._noted = None if record is None else record.id
                    self._generation += 1
                case SceneChanged(record, states, interval_s) if record.id == self._noted:
                    self._generation += not states
                    self._waiting_s += interval_s * len(states)
                case _:
                    return
            self._queue.put((event, self._generation))

    def _play(self) -> None:
        while (item := self._queue.get()) is not None:
            event, generation = item
            try:
                self._draw(event, generation)
            except Exception:  # one event that cannot be drawn must not end the view
                _log.exception("the viewer could not draw %s", type(event).__name__)

    def _draw(self, event: _Change, generation: int) -> None:
        match event:
            case CurrentScene(record):
                self._shown = None if record is None else record.id
                self._drawing.show(None if record is None else record.state)
            case SceneChanged(record, states, interval_s):
                try:
                    self._play_states(states, interval_s, generation)
                finally:
                    with self._lock:
                        self._waiting_s -= interval_s * len(states)
                if generation == self._generation and record.id == self._shown:
                    self._drawing.place(record.state)

    def _play_states(self, states: tuple[SceneState, ...], interval_s: float, generation: int) -> None:
        due = time.monotonic()
        for state in states:
            if generation != self._generation:
                return
            self._drawing.place(state)
            due += interval_s / max(1.0, self._waiting_s / _CATCH_UP_S)
            time.sleep(max(due - time.monotonic(), 0.0))
