"""Messages on their way to a child process: whoever sends one never waits.

The pipe of a process that does not read (it is stopped, or swamped) is full after some hundred kilobytes. Writing to it
then blocks, so a thread of its own writes, and nobody holds a lock meanwhile.
"""

from __future__ import annotations

import contextlib
import pickle
import queue
import threading
from multiprocessing.connection import Connection

MAX_WAITING = 1000


class Outbox:
    """A queue before a pipe, and the thread that empties it.

    Args:
        connection: to write to; may be closed once `stop` has returned.
    """

    def __init__(self, connection: Connection) -> None:
        self._connection = connection
        self._waiting: queue.Queue[bytes | None] = queue.Queue(MAX_WAITING)
        self._is_over = False
        self._thread = threading.Thread(target=self._write, name="outbox", daemon=True)
        self._thread.start()

    def put(self, message: object) -> bool:
        """Send a message when its turn has come; returns False if too many wait already, or the process has gone."""
        data = pickle.dumps(message)
        try:
            self._waiting.put_nowait(data)
        except queue.Full:
            return False
        return not self._is_over

    def stop(self) -> None:
        """End the thread, once the process has ended, so that writing fails; what waits is dropped."""
        self._is_over = True
        with contextlib.suppress(queue.Full):  # then the thread is awake, and sees that it is over
            self._waiting.put_nowait(None)
        self._thread.join()

    def _write(self) -> None:
        try:
            while (data := self._waiting.get()) is not None and not self._is_over:
                self._connection.send_bytes(data)
        except OSError:  # the process has ended, which the listening thread sees as well
            self._is_over = True
