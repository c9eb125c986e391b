"""What the viewer asks of each of its panels, and the base of those that draw in a thread of their own."""

from __future__ import annotations

from abc import ABC, abstractmethod
from collections.abc import Callable
from typing import Protocol

import viser

from app.processes.messages import CurrentScene, SceneRecord
from app.viewer.drawing_thread import DrawingThread
from app.viewer.nodes.scene_nodes import Client

RunCommand = Callable[[Callable[[], object], Client], None]


class Panel(Protocol):
    """One part of the view: its controls, and the nodes that it draws."""

    def start(self, record: SceneRecord | None) -> None:
        """Begin to draw, with the scene on view."""
        ...

    def show(self, event: object) -> None:
        """Draw what an event tells, soon; events of other kinds are ignored. Any thread may call."""
        ...

    def add_client(self, client: viser.ClientHandle) -> None:
        """A browser has connected."""
        ...

    def remove_client(self, client: viser.ClientHandle) -> None:
        """A browser has disconnected."""
        ...

    def close(self) -> None:
        """Draw no more. Calling it again does nothing."""
        ...


class ThreadedPanel(ABC):
    """A panel that stores events as they come and draws the newest state in a thread.

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
