"""Plays scene changes at their own pace: the simulation computes faster than time, people want to see it move."""

from __future__ import annotations

import logging
import queue
import threading
import time
from dataclasses import dataclass
from typing import Protocol

import numpy as np

from app.processes.messages.scene_messages import FramesTaken, SceneChanged, SceneRecord
from app.services.event_hub import CurrentScene
from osfcore.geometry.states import SceneState

_CATCH_UP_S = 0.5  # further behind than this, playing goes faster than time
_log = logging.getLogger(__name__)


class Drawing(Protocol):
    """What can show a scene."""

    def show(self, record: SceneRecord | None) -> None:
        """Begin with a scene, or clear the table."""
        ...

    def place(self, state: SceneState) -> None:
        """Move everything to where it is in a state of the same scene."""
        ...

    def show_frames(self, names: tuple[str, ...], images: np.ndarray) -> None:
        """Put live images (V, h, w, 3) into the cameras."""
        ...


@dataclass(frozen=True, eq=False, slots=True)
class _Item:
    """Something to draw; what is of an older generation was overtaken by a jump."""

    event: CurrentScene | SceneChanged | FramesTaken
    generation: int


class Playback:
    """A queue of events and the thread that draws them in order.

    A jump (another scene, a reset, a hand) overtakes what still waits to be played.
    """

    def __init__(self, drawing: Drawing) -> None:
        self._drawing = drawing
        self._queue: queue.Queue[_Item | None] = queue.Queue()
        self._lock = threading.Lock()
        self._generation = 0
        self._waiting_s = 0.0
        self._noted: str | None = None  # the scene that will be shown once everything in line is drawn
        self._shown: str | None = None
        self._thread = threading.Thread(target=self._play, name="playback", daemon=True)

    @property
    def shown(self) -> str | None:
        """The scene on view."""
        return self._shown

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
                case SceneChanged(record, states, interval_s):
                    if record.id != self._noted:
                        return
                    self._generation += not states
                    self._waiting_s += interval_s * len(states)
                case FramesTaken(scene):
                    if scene != self._noted:
                        return
                case _:
                    return
            self._queue.put(_Item(event, self._generation))

    def _play(self) -> None:
        while (item := self._queue.get()) is not None:
            try:
                self._draw(item)
            except Exception:  # one event that cannot be drawn must not end the view
                _log.exception("the viewer could not draw %s", type(item.event).__name__)

    def _draw(self, item: _Item) -> None:
        match item.event:
            case CurrentScene(record):
                self._shown = None if record is None else record.id
                self._drawing.show(record)
            case SceneChanged(record, states, interval_s):
                try:
                    self._play_states(item, states, interval_s)
                finally:
                    with self._lock:
                        self._waiting_s -= interval_s * len(states)
                if item.generation == self._generation and record.id == self._shown:
                    self._drawing.place(record.state)
            case FramesTaken(_, _, names, images):
                if item.generation == self._generation:
                    self._drawing.show_frames(names, images)

    def _play_states(self, item: _Item, states: tuple[SceneState, ...], interval_s: float) -> None:
        due = time.monotonic()
        for state in states:
            if item.generation != self._generation:
                return
            self._drawing.place(state)
            due += interval_s / max(1.0, self._waiting_s / _CATCH_UP_S)
            time.sleep(max(due - time.monotonic(), 0.0))
