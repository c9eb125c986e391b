"""How often something may happen."""

from __future__ import annotations

import time
from collections.abc import Callable


class RateLimit:
    """A token bucket.

    Args:
        rate: tokens that come back [1/s].
        burst: tokens at most.
        clock: tells the time [s].
    """

    def __init__(self, rate: float, burst: float, clock: Callable[[], float] = time.monotonic) -> None:
        self._rate, self._burst, self._clock = rate, burst, clock
        self._left, self._then = burst, clock()

    @property
    def is_empty(self) -> bool:
        """Whether there is no token now."""
        now = self._clock()
        self._left = min(self._burst, self._left + (now - self._then) * self._rate)
        self._then = now
        return self._left < 1

    def take(self) -> bool:
        """Take a token; False if there is none."""
        if self.is_empty:
            return False
        self._left -= 1
        return True
