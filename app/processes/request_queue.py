"""Orders that wait to be carried out: of one visitor only the newest, quick ones first."""

from __future__ import annotations

import threading

from app.processes.neural_messages import CompareView, DrawView, NumberedOrder


class Inbox:
    """Filled by the thread that listens, emptied by the one that carries out."""

    def __init__(self) -> None:
        self._waiting: dict[str, NumberedOrder] = {}
        self._changed = threading.Condition()
        self._is_closed = False

    def put(self, order: NumberedOrder) -> NumberedOrder | None:
        """Let an order wait; returns the one that it overtakes, if there is one."""
        with self._changed:
            overtaken = self._waiting.get(order.order.key)
            self._waiting[order.order.key] = order  # keeps its place in line
            self._changed.notify()
            return overtaken

    def take(self) -> NumberedOrder | None:
        """The next order, waiting for one if need be; None once the inbox is closed."""
        with self._changed:
            self._changed.wait_for(lambda: self._waiting or self._is_closed)
            if self._is_closed:
                return None
            order = min(self._waiting.values(), key=_patience)  # the first of the least patient
            return self._waiting.pop(order.order.key)

    def is_overtaken(self, order: NumberedOrder) -> bool:
        """Whether nobody waits for an order any more: a newer one of its key is there, or the inbox was closed."""
        with self._changed:
            return self._is_closed or order.order.key in self._waiting

    def close(self) -> None:
        """Let whoever waits go."""
        with self._changed:
            self._is_closed = True
            self._changed.notify_all()


def _patience(order: NumberedOrder) -> int:
    """How long an order can wait: views that move are the least patient, those that rest the most."""
    if isinstance(order.order, CompareView):
        return 1
    return 2 if isinstance(order.order, DrawView) and order.order.is_sharp else 0
