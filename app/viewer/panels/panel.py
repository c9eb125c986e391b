"""The base of the viewer's panels: what the viewer calls, and the thread in which they draw."""

from __future__ import annotations

from abc import ABC, abstractmethod
from collections.abc import Callable
from html import escape

import viser

from app.processes.messages.scene_messages import SceneRecord
from app.services.event_hub import CurrentScene
from app.viewer.drawing_thread import DrawingThread
from app.viewer.nodes.scene_nodes import Client

RunCommand = Callable[[Callable[[], object], Client], None]


class Panel(ABC):
    """A folder of controls and the nodes it draws: stores events as they come, and draws the newest state in a thread.

    Args:
        name: of the thread, for logs.
        interval_s: least time between the beginnings of two drawings [s].
    """

    def __init__(self, name: str, interval_s: float = 0.0) -> None:
        self._thread = DrawingThread(name, self._draw, interval_s)

    @property
    def is_idle(self) -> bool:
        """Whether everything that was shown so far is drawn."""
        return self._thread.is_idle

    def start(self, record: SceneRecord | None) -> None:
        """Begin to draw, with the scene on view."""
        self.show(CurrentScene(record))
        self._thread.start()

    def show(self, event: object) -> None:
        """Draw what an event tells, soon; events of other kinds are ignored. Any thread may call."""
        with self._thread.changed:
            if self._store(event):
                self._thread.wake()

    def add_client(self, client: viser.ClientHandle) -> None:
        """A browser has connected."""
        del client  # all browsers see the same

    def remove_client(self, client: viser.ClientHandle) -> None:
        """A browser has disconnected."""
        del client

    def close(self) -> None:
        """End the thread. Calling it again does nothing."""
        self._thread.stop()

    @abstractmethod
    def _store(self, event: object) -> bool:
        """Keep what an event tells; false if nothing changes. Called with `_thread.changed` held."""

    @abstractmethod
    def _draw(self) -> None:
        """Draw the newest state. Called in the thread."""


_STYLE = "margin:0;padding:0.2em 0.75em 0.5em;font-size:0.8em;line-height:1.35"


def status(about: str, text: str) -> str:
    """HTML of a sentence about something, a word; the text may hold names that users choose."""
    return f'<p class="{about}-status" style="{_STYLE}">{escape(text)}</p>'
