"""Requests that wait in a child process: the newest of each key only, the most urgent first."""

from __future__ import annotations

import threading
from dataclasses import dataclass
from typing import Any


@dataclass(frozen=True, eq=False, slots=True)
class Request:
    """A command and the number of its answer; 0 if nobody waits for one.

    A command with an attribute `key` replaces a waiting one of the same key. Among commands with an attribute
    `patience`, smaller values are carried out first; all others count as 0.
    """

    number: int
    command: Any

    @property
    def key(self) -> object:
        """Requests of equal keys replace each other."""
        return getattr(self.command, "key", id(self))


class RequestQueue:
    """Filled by the thread that receives, emptied by the one that works."""

    def __init__(self) -> None:
        self._waiting: dict[object, Request] = {}
        self._changed = threading.Condition()
        self._is_closed = False

    def put(self, request: Request) -> Request | None:
        """Append a request; returns the one that it replaces, if there is one."""
        with self._changed:
            replaced = self._waiting.get(request.key)
            self._waiting[request.key] = request  # keeps its place in line
            self._changed.notify()
            return replaced

    def take(self, timeout_s: float | None = None) -> Request | None:
        """The next request, waited for if need be; None after `timeout_s`, or once the queue is closed."""
        with self._changed:
            self._changed.wait_for(lambda: self._waiting or self._is_closed, timeout_s)
            if self._is_closed or not self._waiting:
                return None
            request = min(self._waiting.values(), key=lambda r: getattr(r.command, "patience", 0))
            return self._waiting.pop(request.key)

    def is_empty(self) -> bool:
        """Whether nothing waits."""
        with self._changed:
            return not self._waiting

    def is_closed(self) -> bool:
        """Whether the sender has gone."""
        with self._changed:
            return self._is_closed

    def is_overtaken(self, request: Request) -> bool:
        """Whether nobody waits for an answer any more: a newer request of its key is there, or the sender has gone."""
        with self._changed:
            return self._is_closed or request.key in self._waiting

    def close(self) -> None:
        """Wake whoever waits; there will be no more requests."""
        with self._changed:
            self._is_closed = True
            self._changed.notify_all()
