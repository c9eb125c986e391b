"""The thread in which a part of the 3D view is drawn.

What is to be drawn comes from viser's loop, from jobs and from the simulation, none of which may wait for drawing: they
note it, and the thread draws the newest of what was noted, not more often than eyes need.
"""

from __future__ import annotations

import logging
import math
import threading
import time
from collections.abc import Callable

_log = logging.getLogger(__name__)


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
