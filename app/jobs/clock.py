"""How fast a job goes, and how long it will take."""

from __future__ import annotations

import time
from collections.abc import Callable


class JobClock:
    """Estimate the time left of a job, pauses left out.

    Args:
        now_s: the time that counts [s].
    """

    def __init__(self, now_s: Callable[[], float] = time.monotonic) -> None:
        self._now_s = now_s
        self._first: tuple[int, float] | None = None
        self._paused_at: float | None = None
        self._paused_s = 0.0

    def switch(self, *, is_running: bool) -> None:
        """The job pauses, or goes on."""
        now = self._now_s()
        if not is_running:
            self._paused_at = now
        elif self._paused_at is not None:
            self._paused_s += now - self._paused_at
            self._paused_at = None

    def left_s(self, done: int, total: int) -> float | None:
        """Time left [s], once there is something to go by; it counts from when the total is known."""
        if total == 0:
            return None
        now = self._now_s() - self._paused_s
        if self._first is None:
            self._first = (done, now)
        first_done, start = self._first
        if done <= first_done:
            return None
        return round((now - start) / (done - first_done) * (total - done), 1)
