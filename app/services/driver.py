"""Who drives: several people may watch the same page, and one of them at a time has the controls.

This keeps visitors from getting into each other's way by accident. It is no protection: programs are never asked.
"""

from __future__ import annotations

import threading
from collections import Counter
from collections.abc import Callable
from dataclasses import dataclass

from osfcore.errors import OsfError

GRACE_S = 5.0  # how long a page takes at most to load again


@dataclass(frozen=True, slots=True)
class DriverChanged:
    """Who drives now, and among how many.

    Attributes:
        driver: identifier of a page; None while there is none.
        visitors: pages that are open.
    """

    driver: str | None
    visitors: int


class NotDriving(OsfError):
    """A page wants to change something while another one drives."""

    def __init__(self) -> None:
        super().__init__("Someone else is driving; take over first.")


class Driver:
    """The pages that are open. Any thread may call.

    Args:
        publish: called with every change.
        grace_s: how long the wheel is kept for a driver whose page is gone [s].
    """

    def __init__(self, publish: Callable[[DriverChanged], None], grace_s: float = 0.0) -> None:
        self._publish, self._grace_s = publish, grace_s
        self._lock = threading.Lock()
        self._streams: Counter[str] = Counter()  # a page that reconnects has two for a moment
        self._absent: set[str] = set()  # drivers who are waited for
        self._driver: str | None = None

    def now(self) -> DriverChanged:
        """Who drives."""
        with self._lock:
            return DriverChanged(self._driver, len(self._streams))

    def check(self, visitor: str | None) -> None:
        """Refuse a page that only watches; programs, which have no name, may do what they like.

        Raises:
            NotDriving: if another page drives.
        """
        if not self.may_drive(visitor):
            raise NotDriving

    def may_drive(self, visitor: str | None) -> bool:
        """Whether a page drives, or no page is open that could; programs, which have no name, always may."""
        with self._lock:
            return visitor is None or self._driver in (None, visitor) or not self._streams

    def arrive(self, visitor: str) -> None:
        """A page has opened its stream; the first one drives."""
        with self._lock:
            is_waited_for = self._driver in self._absent and bool(self._streams)
            self._streams[visitor] += 1
            if self._driver not in self._streams and not is_waited_for:  # nobody, or somebody who never opened a page
                self._driver = visitor
            self._absent.discard(visitor)
        self._publish(self.now())

    def leave(self, visitor: str) -> None:
        """A stream of a page has ended; if it was the driver's last one, the page that came next drives.

        Not at once: a page that is loaded again, or lost its connection, is back in a moment.
        """
        with self._lock:
            self._streams[visitor] -= 1
            if self._streams[visitor] <= 0:
                del self._streams[visitor]
            waits = visitor == self._driver and visitor not in self._streams and self._grace_s > 0
            if waits:
                self._absent.add(visitor)
        if waits:
            timer = threading.Timer(self._grace_s, self._hand_over, (visitor,))
            timer.daemon = True
            timer.start()
            self._publish(self.now())
        else:
            self._hand_over()

    def _hand_over(self, absent: str | None = None) -> None:
        """Let the page that came first drive if the driver has none; one that was waited for no longer is."""
        with self._lock:
            self._absent.discard(absent or "")
            if self._driver not in self._streams and self._driver not in self._absent:
                self._driver = next(iter(self._streams), None)
        self._publish(self.now())

    def take(self, visitor: str) -> DriverChanged:
        """A page wants to drive from now on."""
        with self._lock:
            self._driver = visitor
        now = self.now()
        self._publish(now)
        return now
