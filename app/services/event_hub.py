"""Fan-out of events within the web process: the runner publishes, viewer and event streams subscribe."""

from __future__ import annotations

import logging
import threading
from collections.abc import Callable
from dataclasses import dataclass

from ..processes.messages.scene_messages import SceneRecord

_log = logging.getLogger(__name__)
Listener = Callable[[object], None]


@dataclass(frozen=True, slots=True)
class CurrentScene:
    """Another scene is shown now, or none."""

    record: SceneRecord | None


@dataclass(frozen=True, slots=True)
class Notice:
    """A sentence for whoever watches; `level` is "info", "warning" or "error"."""

    level: str
    text: str


class Hub:
    """Hands every event to every subscriber, in the publishing thread; subscribers must only take note."""

    def __init__(self) -> None:
        self._lock = threading.Lock()
        self._listeners: tuple[Listener, ...] = ()

    def subscribe(self, listener: Listener) -> Callable[[], None]:
        """Add a listener; returns what removes it again."""
        with self._lock:
            self._listeners = (*self._listeners, listener)

        def leave() -> None:
            with self._lock:
                self._listeners = tuple(other for other in self._listeners if other is not listener)

        return leave

    @property
    def subscribers(self) -> int:
        """How many listen now."""
        return len(self._listeners)

    def publish(self, event: object) -> None:
        """Call every listener. A listener that fails is logged and does not keep the others from hearing."""
        for listener in self._listeners:
            try:
                listener(event)
            except Exception:
                _log.exception("a listener failed on %s", type(event).__name__)
