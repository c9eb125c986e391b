"""The service's end of a child process: starts it, sends requests, hands out answers, starts it again when it dies."""

from __future__ import annotations

import asyncio
import itertools
import logging
import threading
import time
from collections.abc import Callable, Iterable
from concurrent.futures import Future
from multiprocessing.connection import Connection
from multiprocessing.context import SpawnProcess
from typing import Any, Literal

from app.processes.child_process import end, launch
from app.processes.process_server import Answer, Logged, Overtaken, Ready, child_main
from app.processes.request_queue import Request
from osfcore.errors import OsfError

Status = Literal["starting", "ready", "restarting"]
MAX_PENDING = 64
ANSWER_S = 180.0  # compiling on a busy machine takes longest
_CHECK_S = 1.0  # how often it is checked that the process still answers
_RESTART_PAUSES_S = (0.0, 1.0, 5.0, 30.0)  # longer and longer while it keeps dying without answering anything
_log = logging.getLogger(__name__)


class ProcessUnavailable(OsfError):
    """A process that has died, or does not answer."""

    def __init__(self, who: str, what: str) -> None:
        super().__init__(f"The {who} {what}; try again in a moment.")
        self.who = who


class ProcessHangs(ProcessUnavailable):
    """A process that has not answered for too long, and is killed."""

    def __init__(self, who: str, answer_s: float) -> None:
        super().__init__(who, f"did not answer within {answer_s:g} s and is being restarted")


class ProcessBusy(OsfError):
    """More requests wait than make sense."""

    def __init__(self, who: str) -> None:
        super().__init__(f"The {who} has too much to do at once; try again in a moment.")


def _ignore(_: object = None) -> None:
    pass


class ProcessClient:
    """A child process and the thread that listens to it.

    A process that does not answer anybody for `answer_s` while requests wait is killed. One that has died is started
    again, after a pause that grows while it keeps dying: at once if `keeps_running`, else with the next request.

    Args:
        target: what the process runs: `target(server, *arguments)`, a function of a module.
        arguments: of the target, besides its `ProcessServer`.
        who: what people call the process.
        answer_s: how long it may answer nobody while requests wait [s].
        keeps_running: whether it is to run from `start` to `stop`; otherwise from the first request on.
        greeting: commands that come before all others whenever it has been started.
        on_event: called from the listening thread with everything that is no answer; must be quick.
        on_lost: called from the listening thread when it has died unexpectedly.
    """

    def __init__(
        self,
        target: Callable[..., None],
        arguments: tuple[object, ...],
        who: str,
        *,
        answer_s: float = ANSWER_S,
        keeps_running: bool = False,
        greeting: Callable[[], Iterable[object]] = tuple,
        on_event: Callable[[Any], None] = _ignore,
        on_lost: Callable[[], None] = _ignore,
    ) -> None:
        self._child = (target, who, *arguments)
        self._who = who
        self._answer_s = answer_s
        self._keeps_running = keeps_running
        self._greeting, self._on_event, self._on_lost = greeting, on_event, on_lost
        self._launch_lock = threading.RLock()  # taken before the others
        self._send_lock = threading.Lock()
        self._lock = threading.Lock()  # never held while sending: the listener needs it to take answers
        self._numbers = itertools.count(1)
        self._pending: dict[int, Future[Any]] = {}
        self._process: SpawnProcess | None = None
        self._connection: Connection | None = None
        self._listener: threading.Thread | None = None
        self._stopping = threading.Event()
        self._deaths, self._died_at = 0, 0.0
        self._heard_at = 0.0  # when it last answered, or was asked after all had been answered
        self._is_warm = False
        self.status: Status = "starting"

    @property
    def process(self) -> SpawnProcess | None:
        """The process that runs now, or ran last."""
        return self._process

    @property
    def is_warm(self) -> bool:
        """Whether the process that runs now has answered: the first answer waits for code to be loaded or compiled."""
        return self._is_warm

    def start(self) -> None:
        """Start the process now; requests may be sent at once.

        Raises:
            OSError: if there can be no more processes.
        """
        with self._launch_lock:
            if self._connection is None and not self._stopping.is_set():
                self._launch()

    def stop(self, grace_s: float = 0.0) -> None:
        """End the process, `grace_s` after it was to end by itself. Calling it again does nothing."""
        with self._launch_lock:
            self._stopping.set()
            process, listener = self._process, self._listener
        if process is not None:
            end(process, grace_s)
        if listener is not None and listener is not threading.current_thread():
            listener.join()
        self._fail(list(self._pending), self._unavailable("was stopped"))

    def submit(self, command: object) -> Future[Any]:
        """Send a command; the future raises what the process raised, ProcessUnavailable or ProcessBusy."""
        future: Future[Any] = Future()
        try:
            connection, number = self._register(future)
        except OsfError as refusal:
            future.set_exception(refusal)
            return future
        if not self._send(connection, Request(number, command)):
            self._settle(number, error=self._unavailable("stopped unexpectedly"))
        return future

    def notify(self, message: object) -> bool:
        """Send a message that has no answer; returns whether the process was there."""
        connection = self._connection
        return connection is not None and self._send(connection, message)

    def call(self, command: object) -> Any:  # noqa: ANN401  each command says what answers it
        """Send a command and wait for its answer.

        Raises:
            ProcessUnavailable: if the process died or took too long.
            OsfError: what the process raised.
        """
        return self.submit(command).result()

    async def call_async(self, command: object) -> Any:  # noqa: ANN401
        """The same without blocking the event loop."""
        return await asyncio.wrap_future(await asyncio.to_thread(self.submit, command))

    # Requests

    def _register(self, future: Future[Any]) -> tuple[Connection, int]:
        """Where to send a command, and the number of its answer."""
        if self._stopping.is_set():
            raise ProcessUnavailable(self._who, "was stopped")
        if len(self._pending) >= MAX_PENDING:
            raise ProcessBusy(self._who)
        if not self._keeps_running and self._connection is None:
            with self._launch_lock:
                if time.monotonic() - self._died_at < self._pause_s():
                    raise ProcessUnavailable(self._who, "keeps stopping")
                self.start()
        with self._lock:
            if self._connection is None:
                raise self._unavailable("is not running")
            number = next(self._numbers)
            if not self._pending:
                self._heard_at = time.monotonic()
            self._pending[number] = future
            return self._connection, number

    def _send(self, connection: Connection, message: object) -> bool:
        try:
            with self._send_lock:
                connection.send(message)
        except OSError:  # the listening thread sees the end as well
            return False
        return True

    def _settle(self, number: int, value: object = None, error: OsfError | None = None) -> None:
        with self._lock:
            future = self._pending.pop(number, None)
        if future is None or not future.set_running_or_notify_cancel():
            return
        if error is None:
            future.set_result(value)
        else:
            future.set_exception(error)

    def _fail(self, numbers: list[int], error: OsfError) -> None:
        for number in numbers:
            self._settle(number, error=error)

    def _unavailable(self, what: str) -> ProcessUnavailable:
        return ProcessUnavailable(self._who, f"{what} and is being restarted" if self._keeps_running else what)

    # The process

    def _pause_s(self) -> float:
        return _RESTART_PAUSES_S[min(max(self._deaths - 1, 0), len(_RESTART_PAUSES_S) - 1)]

    def _launch(self) -> None:
        greeting = [Request(0, command) for command in self._greeting()]
        process, connection = launch(child_main, f"osf-{self._who.replace(' ', '-')}", *self._child)
        with self._send_lock:  # whatever is sent from now on comes after the greeting
            with self._lock:
                self._process, self._connection, self._is_warm = process, connection, False
            try:
                for request in greeting:
                    connection.send(request)
            except OSError:
                pass  # the listening thread sees the end as well
        self._listener = threading.Thread(target=self._listen, args=(process, connection), daemon=True)
        self._listener.start()

    def _listen(self, process: SpawnProcess, connection: Connection) -> None:
        hangs = False
        try:
            while not hangs:
                if connection.poll(min(_CHECK_S, self._answer_s)):
                    self._take(connection.recv())
                else:  # waiting behind others is no sign of hanging, so any answer counts
                    hangs = bool(self._pending) and time.monotonic() - self._heard_at > self._answer_s
        except (EOFError, OSError):
            pass
        with self._lock:
            self._connection, lost = None, list(self._pending)
            self._deaths += 1
            self._died_at = time.monotonic()
        end(process)
        connection.close()
        if self._stopping.is_set():
            return
        self.status = "restarting"
        _log.error("the %s ended unexpectedly (exit code %s)", self._who, process.exitcode)
        self._fail(
            lost, ProcessHangs(self._who, self._answer_s) if hangs else self._unavailable("stopped unexpectedly")
        )
        self._on_lost()
        while self._keeps_running and not self._stopping.wait(self._pause_s()):
            try:
                return self.start()
            except OSError as error:
                _log.error("the %s could not be started: %s", self._who, error)
                self._deaths += 1

    def _take(self, message: object) -> None:
        match message:
            case Ready():
                self.status = "ready"
            case Answer(number, value, error):
                self._heard_at, self._deaths, self._is_warm = time.monotonic(), 0, True
                self._settle(number, value, error)
            case Logged(level, name, text):
                logging.getLogger(name).log(level, "%s", text)
            case Overtaken(number):
                self._settle(number)
            case _:
                self._on_event(message)
