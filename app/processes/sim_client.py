"""The web process's end of the stage: sends commands, hands out answers and events, restarts a stage that died."""

from __future__ import annotations

import asyncio
import contextlib
import itertools
import logging
import threading
import time
from collections.abc import Callable, Iterable
from concurrent.futures import Future
from concurrent.futures import TimeoutError as FutureTimeoutError
from multiprocessing.connection import Connection
from multiprocessing.context import SpawnProcess
from pathlib import Path
from typing import Any, Literal

from app.processes.child_process import end, launch
from app.processes.messages import (
    Command,
    Failure,
    FramesTaken,
    Leave,
    Reply,
    Request,
    SceneChanged,
    StageEvent,
    StageReady,
)
from app.processes.sim_process import stage_main
from osfcore.errors import OsfError

Status = Literal["starting", "ready", "restarting"]
MAX_PENDING = 64
_LOOK_S = 1.0  # how often a waiting caller looks whether the stage still answers anybody
_LEAVE_GRACE_S = 1.0
_RESTART_PAUSES_S = (0.0, 1.0, 5.0, 30.0)  # longer and longer while it keeps dying without answering anything
_log = logging.getLogger(__name__)


class StageError(OsfError):
    """What the stage refused, told in its own words.

    Args:
        kind: class name of the error there.
        text: the sentence.
    """

    def __init__(self, kind: str, text: str) -> None:
        super().__init__(text)
        self.kind = kind


class StageUnavailable(OsfError):
    """The stage died or did not answer; it is being restarted."""

    def __init__(self, what: str) -> None:
        super().__init__(f"The simulation {what} and is being restarted; try again in a moment.")


class StageBusy(OsfError):
    """More commands wait than make sense."""

    def __init__(self) -> None:
        super().__init__("The simulation has too much to do at once; try again in a moment.")


class StageLink:
    """A stage process and the thread that listens to it.

    Args:
        objects_root: folder of the object library.
        max_live_worlds: scenes whose simulation stays in memory.
        timeout_s: how long one command may take.
        greeting: commands for a stage that has just started; asked for at every start.
        on_event: called from the listening thread with everything that is no answer; must be quick.
        on_lost: called when a stage died, before it is started again.
    """

    def __init__(
        self,
        objects_root: Path,
        max_live_worlds: int,
        timeout_s: float,
        greeting: Callable[[], Iterable[Command]],
        on_event: Callable[[StageEvent], None],
        on_lost: Callable[[], None],
    ) -> None:
        self._arguments = (objects_root, max_live_worlds)
        self._timeout_s = timeout_s
        self._greeting = greeting
        self._on_event = on_event
        self._on_lost = on_lost
        self._lock = threading.Lock()  # never held while sending: the listener needs it to take answers
        self._send_lock = threading.Lock()
        self._numbers = itertools.count(1)
        self._pending: dict[int, Future[Any]] = {}
        self._process: SpawnProcess | None = None
        self._connection: Connection | None = None
        self._stopping = threading.Event()
        self._deaths = 0
        self._answered_at = time.monotonic()
        self._thread: threading.Thread | None = None
        self.status: Status = "starting"

    @property
    def process(self) -> SpawnProcess | None:
        """The process that runs now."""
        return self._process

    def start(self) -> None:
        """Start the stage; commands may be sent at once."""
        self._launch()
        self._thread = threading.Thread(target=self._listen, name="stage-link", daemon=True)
        self._thread.start()

    def stop(self) -> None:
        """End the stage. Calling it again does nothing."""
        self._stopping.set()
        with self._lock:
            connection, process = self._connection, self._process
        if connection is not None:
            self._send(connection, Request(0, Leave()))
        if process is not None:
            end(process, _LEAVE_GRACE_S)
        if self._thread is not None:
            self._thread.join()
            self._thread = None
        self._fail_pending("was stopped")

    def submit(self, command: Command) -> Future[Any]:
        """Send a command; the future raises StageError or StageUnavailable where it could not be done."""
        future: Future[Any] = Future()
        with self._lock:
            connection = self._connection
            if connection is None or self._stopping.is_set():
                future.set_exception(StageUnavailable("is not running"))
                return future
            if len(self._pending) >= MAX_PENDING:
                future.set_exception(StageBusy())
                return future
            number = next(self._numbers)
            self._pending[number] = future
        if not self._send(connection, Request(number, command)):
            self._settle(number, lambda lost: lost.set_exception(StageUnavailable("has stopped")))
        return future

    def call(self, command: Command) -> Any:  # noqa: ANN401  each command says what answers it
        """Send a command and wait for its result.

        Raises:
            StageError: if the stage refused it.
            StageUnavailable: if the stage died or took too long.
        """
        future, asked = self.submit(command), time.monotonic()
        while True:
            try:
                return future.result(min(_LOOK_S, self._timeout_s))
            except FutureTimeoutError:
                self._refuse_to_wait_longer(asked)

    async def call_async(self, command: Command) -> Any:  # noqa: ANN401
        """The same without blocking the event loop."""
        future, asked = await asyncio.to_thread(self.submit, command), time.monotonic()
        answer = asyncio.wrap_future(future)
        while not answer.done():
            await asyncio.wait({answer}, timeout=min(_LOOK_S, self._timeout_s))
            if not answer.done():
                self._refuse_to_wait_longer(asked)
        return answer.result()

    def _refuse_to_wait_longer(self, asked: float) -> None:
        """End the stage if it has not answered anybody for too long; waiting behind others is no sign of that."""
        if time.monotonic() - max(asked, self._answered_at) > self._timeout_s:
            self.kill()
            raise StageUnavailable(f"did not answer within {self._timeout_s:g} s")

    def kill(self) -> None:
        """End a stage that hangs; it is restarted."""
        if self._process is not None:
            self._process.kill()

    def _launch(self) -> None:
        process, connection = launch(stage_main, "osf-stage", *self._arguments)
        greeting = [Request(0, command) for command in self._greeting()]
        with self._send_lock:  # whatever is sent from now on comes after the greeting
            with self._lock:
                self._process, self._connection = process, connection
            with contextlib.suppress(OSError):  # the listening thread will see that it died
                for request in greeting:
                    connection.send(request)

    def _send(self, connection: Connection, request: Request) -> bool:
        try:
            with self._send_lock:
                connection.send(request)
        except OSError:  # the listening thread sees the end as well and restarts
            return False
        return True

    def _listen(self) -> None:
        while not self._stopping.is_set():
            connection = self._connection
            try:
                while connection is not None:
                    self._take(connection.recv())
            except (EOFError, OSError):
                pass
            if self._stopping.is_set():
                break
            self._restart()
        with self._lock:
            if self._connection is not None:
                self._connection.close()
                self._connection = None

    def _take(self, message: object) -> None:
        match message:
            case StageReady():
                self.status = "ready"
            case Reply(number, value):
                self._answered_at = time.monotonic()
                self._deaths = 0
                self._settle(number, lambda future: future.set_result(value))
            case Failure(number, kind, text):
                self._answered_at = time.monotonic()
                self._settle(number, lambda future: future.set_exception(StageError(kind, text)))
            case SceneChanged() | FramesTaken():
                self._on_event(message)

    def _settle(self, number: int, settle: Callable[[Future[Any]], None]) -> None:
        with self._lock:
            future = self._pending.pop(number, None)
        if future is not None and future.set_running_or_notify_cancel():
            settle(future)

    def _restart(self) -> None:
        process = self._process
        if process is not None:
            end(process)
            _log.error("the stage process ended unexpectedly (exit code %s)", process.exitcode)
        self.status = "restarting"
        with self._lock:
            if self._connection is not None:
                self._connection.close()
                self._connection = None
        self._fail_pending("stopped unexpectedly")
        self._on_lost()
        pause_s = _RESTART_PAUSES_S[min(self._deaths, len(_RESTART_PAUSES_S) - 1)]
        self._deaths += 1
        if not self._stopping.wait(pause_s):
            self._launch()

    def _fail_pending(self, what: str) -> None:
        with self._lock:
            pending, self._pending = list(self._pending.values()), {}
        for future in pending:
            if future.set_running_or_notify_cancel():
                future.set_exception(StageUnavailable(what))
