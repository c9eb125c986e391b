"""The child's end of a pipe: receives requests in a thread, carries them out in order, sends answers and events.

Exceptions cross as themselves: every `OsfError` pickles. Anything else that is raised is logged here and crosses as an
`InternalError` without details.
"""

from __future__ import annotations

import contextlib
import logging
import threading
import time
from collections.abc import Callable
from dataclasses import dataclass
from multiprocessing.connection import Connection
from typing import Any

from osfcore.errors import OsfError

from .child_process import leave_it_to_the_service, silence_stdout

IsOvertaken = Callable[[], bool]
ALIVE_S = 0.5
_log = logging.getLogger(__name__)


class InternalError(OsfError):
    """A defect of this program in a child process; its log has the traceback."""

    def __init__(self, who: str, error: Exception) -> None:
        super().__init__(f"The {who} failed ({type(error).__name__}); the service's log has more.")


class OutOfMemory(OsfError):
    """A child process that could not get the memory it needs."""

    def __init__(self, who: str) -> None:
        super().__init__(f"The {who} ran out of memory; take fewer or smaller images.")


@dataclass(frozen=True, slots=True)
class Ready:
    """The process has loaded its libraries and takes requests."""


@dataclass(frozen=True, slots=True)
class Alive:
    """The process is neither stopped nor stuck; sent every `ALIVE_S`."""


@dataclass(frozen=True, eq=False, slots=True)
class Answer:
    """The outcome of a request: a value or an error."""

    number: int
    value: Any = None
    error: OsfError | None = None


@dataclass(frozen=True, slots=True)
class Logged:
    """What was logged in the child; the service logs it as its own."""

    level: int
    name: str
    text: str


@dataclass(frozen=True, slots=True)
class Overtaken:
    """A request that is left undone because a newer one of its key has come."""

    number: int


class ProcessServer:
    """Serves the requests that come through a pipe.

    Args:
        connection: to the service.
        who: what people call this process.
    """

    def __init__(self, connection: Connection, who: str) -> None:
        self._connection = connection
        self._who = who
        self._lock = threading.RLock()  # what is sent may log while it is pickled
        self._queue = RequestQueue()

    def send(self, message: object) -> None:
        """Send an event; does nothing once the service has gone. Any thread may call it."""
        with self._lock, contextlib.suppress(OSError):
            self._connection.send(message)

    def show_life(self) -> None:
        """Report again and again that this process lives, until the service has gone."""
        while not self._queue.is_closed():
            self.send(Alive())
            time.sleep(ALIVE_S)

    def serve(
        self,
        carry_out: Callable[[Any, IsOvertaken], object],
        *,
        idle: Callable[[bool], float | None] = lambda _: None,
        on_message: Callable[[object], None] = lambda _: None,
        on_lost: Callable[[], None] = lambda: None,
    ) -> None:
        """Carry out requests until the service has gone.

        Args:
            carry_out: returns the answer to a command; raises OsfError to refuse it.
            idle: called between requests with whether one waits; returns after which time without requests it is to be
                called again [s], None for not before the next request.
            on_message: called from the receiving thread with everything that is no request.
            on_lost: called from the receiving thread when the service has gone.
        """
        # Requests are received at once, however long one takes, so that the sender never blocks.
        threading.Thread(target=self._receive, args=(on_message, on_lost), name="receive", daemon=True).start()
        self.send(Ready())
        while not self._queue.is_closed():
            request = self._queue.take(idle(not self._queue.is_empty()))
            if request is not None:
                self.send(self._answer(carry_out, request))

    def _receive(self, on_message: Callable[[object], None], on_lost: Callable[[], None]) -> None:
        with contextlib.suppress(EOFError, OSError):
            while True:
                message = self._connection.recv()
                if not isinstance(message, Request):
                    on_message(message)
                elif (replaced := self._queue.put(message)) is not None:
                    self.send(Overtaken(replaced.number))
        self._queue.close()
        on_lost()

    def _answer(self, carry_out: Callable[[Any, IsOvertaken], object], request: Request) -> Answer:
        try:
            return Answer(request.number, carry_out(request.command, lambda: self._queue.is_overtaken(request)))
        except OsfError as error:
            return Answer(request.number, error=error)
        except MemoryError:
            return Answer(request.number, error=OutOfMemory(self._who))
        except Exception as error:  # a defect must not end the requests of others
            _log.exception("the %s could not carry out %s", self._who, type(request.command).__name__)
            return Answer(request.number, error=InternalError(self._who, error))


class PipeHandler(logging.Handler):
    """Sends what is logged to the service.

    Args:
        server: knows the way.
    """

    def __init__(self, server: ProcessServer) -> None:
        super().__init__()
        self._server = server

    def emit(self, record: logging.LogRecord) -> None:
        """Send one record, with its traceback."""
        try:
            self._server.send(Logged(record.levelno, record.name, self.format(record).rstrip()))
        except Exception:
            self.handleError(record)


def child_main(connection: Connection, target: Callable[..., None], who: str, *arguments: object) -> None:
    """Run `target(server, *arguments)`: what every child process starts with.

    Args:
        connection: to the service.
        target: serves until the service has gone.
        who: what people call this process.
        *arguments: of the target.
    """
    leave_it_to_the_service()
    silence_stdout()
    server = ProcessServer(connection, who)
    logging.basicConfig(level=logging.WARNING, format="%(message)s", handlers=[PipeHandler(server)])
    logging.captureWarnings(True)
    # In a thread of its own, and before the target loads what it needs.
    threading.Thread(target=server.show_life, name="alive", daemon=True).start()
    target(server, *arguments)


# Requests that wait: the newest of each key only, the most urgent first


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
