"""The service's end of a child process: starts it, sends requests, hands out answers, starts it again when it dies."""

from __future__ import annotations

import asyncio
import contextlib
import errno
import itertools
import logging
import math
import pickle
import queue
import threading
import time
from collections.abc import Callable, Iterable
from concurrent.futures import Future
from multiprocessing.connection import Connection
from multiprocessing.context import SpawnProcess
from typing import Any, Literal

from osfcore.errors import OsfError

from .child_process import end, is_stopped, launch
from .server import Alive, Answer, Logged, Overtaken, Ready, Request, child_main

Status = Literal["starting", "ready", "restarting"]
MAX_PENDING = 64
ANSWER_S = 180.0  # compiling on a busy machine takes longest
WARM_ANSWER_S = 60.0  # once everything is compiled
_RESTART_PAUSES_S = (0.0, 1.0, 2.0, 5.0)  # longer and longer while it keeps dying without answering anything
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


class ProcessFrozen(ProcessUnavailable):
    """A process that shows no sign of life, and is killed."""

    def __init__(self, who: str) -> None:
        super().__init__(who, "was frozen and is being restarted")


class ProcessBusy(OsfError):
    """More requests wait than make sense."""

    def __init__(self, who: str) -> None:
        super().__init__(f"The {who} has too much to do at once; try again in a moment.")


class ProcessClient:
    """A child process, and threads that listen to it, write to it and watch it. Nobody who sends waits for it.

    A process that does not answer anybody for `answer_s` while requests wait is killed, as is one that shows no sign of
    life (see `Watchdog`). One that has died is started again, after a pause that grows while it keeps dying: at once if
    `keeps_running`, else with the next request.

    Args:
        target: what the process runs: `target(server, *arguments)`, a function of a module.
        arguments: of the target, besides its `ProcessServer`.
        who: what people call the process.
        answer_s: how long it may answer nobody while requests wait [s]; at most a minute once it has answered.
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
        on_event: Callable[[Any], None] = lambda _: None,
        on_lost: Callable[[], None] = lambda: None,
    ) -> None:
        self._child = (target, who, *arguments)
        self._who = who
        self._answer_s = answer_s
        self._keeps_running = keeps_running
        self._greeting, self.on_event, self._on_lost = greeting, on_event, on_lost
        self._launch_lock = threading.RLock()  # taken before the other
        self._lock = threading.Lock()
        self._numbers = itertools.count(1)
        self._pending: dict[int, Future[Any]] = {}
        self._outbox: Outbox | None = None  # of the process that runs now
        self._watchdog: Watchdog | None = None
        self._verdict: ProcessUnavailable | None = None  # why it was killed
        self._listener: threading.Thread | None = None
        self._stopping = threading.Event()
        self._deaths, self._died_at = 0, 0.0
        self._is_loading = True
        self.process: SpawnProcess | None = None  # that runs now, or ran last
        self.is_warm = False  # whether it has answered: the first answer waits for code to be loaded or compiled
        self.status: Status = "starting"

    def start(self) -> None:
        """Start the process now; requests may be sent at once.

        Raises:
            OSError: if there can be no more processes.
        """
        with self._launch_lock:
            if self._outbox is None and not self._stopping.is_set():
                self._launch()

    def stop(self, grace_s: float = 0.0) -> None:
        """End the process, `grace_s` after it was to end by itself. Calling it again does nothing."""
        with self._launch_lock:
            self._stopping.set()
            process, listener = self.process, self._listener
        if process is not None:
            end(process, grace_s)
        if listener is not None and listener is not threading.current_thread():
            listener.join()
        self._fail(list(self._pending), self._unavailable("was stopped"))

    def submit(self, command: object) -> Future[Any]:
        """Send a command; the future raises what the process raised, ProcessUnavailable or ProcessBusy."""
        future: Future[Any] = Future()
        try:
            outbox, number = self._register(future)
        except OsfError as refusal:
            future.set_exception(refusal)
            return future
        if not outbox.put(Request(number, command)):
            self._settle(number, error=self._unavailable("stopped unexpectedly"))
        return future

    def notify(self, message: object) -> bool:
        """Send a message that has no answer; returns whether the process was there."""
        outbox = self._outbox
        return outbox is not None and outbox.put(message)

    def call(self, command: object) -> Any:  # noqa: ANN401  each command says what answers it
        """Send a command and wait for its answer.

        Raises:
            ProcessUnavailable: if the process died or took too long.
            OsfError: what the process raised.
        """
        return self.submit(command).result()

    async def call_async(self, command: object) -> Any:  # noqa: ANN401
        """The same without blocking the event loop."""
        is_there = self._keeps_running or self._outbox is not None  # else starting it takes a while
        return await asyncio.wrap_future(
            self.submit(command) if is_there else await asyncio.to_thread(self.submit, command)
        )

    # Requests

    def _register(self, future: Future[Any]) -> tuple[Outbox, int]:
        """Where to send a command, and the number of its answer."""
        if self._stopping.is_set():
            raise ProcessUnavailable(self._who, "was stopped")
        if len(self._pending) >= MAX_PENDING:
            raise ProcessBusy(self._who)
        if not self._keeps_running and self._outbox is None:
            with self._launch_lock:
                if time.monotonic() - self._died_at < self._pause_s():
                    raise ProcessUnavailable(self._who, "keeps stopping")
                try:
                    self.start()
                except OSError as error:
                    raise ProcessUnavailable(self._who, f"cannot be started ({error.strerror})") from error
        with self._lock:
            if self._outbox is None:
                raise self._unavailable("is not running")
            number = next(self._numbers)
            self._pending[number] = future
            return self._outbox, number

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
        self.process, self._is_loading, self.is_warm, self._verdict = process, True, False, None
        try:
            outbox = Outbox(connection)
            for request in greeting:  # whatever is sent from now on comes after it
                outbox.put(request)
            self._outbox = outbox
            self._watchdog = Watchdog(process.pid or 0, self._patience_s, lambda: bool(self._pending), self._kill)
            self._listener = threading.Thread(target=self._listen, args=(process, connection), daemon=True)
            self._listener.start()
        except RuntimeError as error:  # no more threads
            self._fail(self._forget(process, connection), self._unavailable("could not be started"))
            raise OSError(errno.EAGAIN, str(error)) from error

    def _patience_s(self) -> float:
        """How long it may answer nobody now: loading comes first, and compiling with the first answer."""
        if self._is_loading:
            return max(self._answer_s, ANSWER_S)
        return min(self._answer_s, WARM_ANSWER_S) if self.is_warm and math.isfinite(self._answer_s) else self._answer_s

    def _kill(self, is_frozen: bool) -> None:
        """End a process that shows no sign of life; the listening thread does the rest."""
        process = self.process
        if process is not None:
            self._verdict = ProcessFrozen(self._who) if is_frozen else ProcessHangs(self._who, self._patience_s())
            _log.error("%s", self._verdict)
            end(process)

    def _forget(self, process: SpawnProcess, connection: Connection) -> list[int]:
        """Take note that the process has ended; returns the requests that it has not answered."""
        with self._lock:
            outbox, watchdog, lost = self._outbox, self._watchdog, list(self._pending)
            self._outbox = self._watchdog = None
            self._deaths += 1
            self._died_at = time.monotonic()
        if watchdog is not None:
            watchdog.stop()
        end(process)
        if outbox is not None:
            outbox.stop()
        connection.close()
        return lost

    def _listen(self, process: SpawnProcess, connection: Connection) -> None:
        try:
            while True:
                self._take(connection.recv())
        except (EOFError, OSError):
            pass
        except Exception:  # this thread must not end before it has brought the process to its end
            _log.exception("a message of the %s could not be read", self._who)
        lost = self._forget(process, connection)
        if self._stopping.is_set():
            return
        self.status = "restarting"
        _log.error("the %s ended unexpectedly (exit code %s)", self._who, process.exitcode)
        self._fail(lost, self._verdict or self._unavailable("stopped unexpectedly"))
        self._on_lost()
        while self._keeps_running and not self._stopping.wait(self._pause_s()):
            try:
                return self.start()
            except Exception as error:  # descriptors, threads or memory that are short now may be there again soon
                _log.error("the %s could not be started: %s", self._who, error)
                self._deaths += 1

    def _take(self, message: object) -> None:
        watchdog = self._watchdog
        if watchdog is not None:
            watchdog.heard(is_answer=isinstance(message, Ready | Answer))
        match message:
            case Alive():
                pass
            case Ready():
                self.status, self._is_loading = "ready", False
            case Answer(number, value, error):
                self._deaths, self.is_warm = 0, True
                self._settle(number, value, error)
            case Logged(level, name, text):
                logging.getLogger(name).log(level, "%s", text)
            case Overtaken(number):
                self._settle(number)
            case _:
                try:
                    self.on_event(message)
                except Exception:
                    _log.exception("what the %s sent could not be used", self._who)


# Messages on their way to a child process


MAX_WAITING = 1000


class Outbox:
    """A queue before a pipe, and the thread that empties it: whoever sends a message never waits.

    The pipe of a process that does not read (it is stopped, or swamped) is full after some hundred kilobytes. Writing
    to it then blocks, so a thread of its own writes, and nobody holds a lock meanwhile.

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


# Ending a process that shows no sign of life


LOOK_S = 0.25  # between two looks
STOPPED_S = 1.0  # a process that the system has stopped may be silent
SILENT_S = 30.0  # any other: compiling and loading on a busy machine keep even a thread of its own from speaking


class Watchdog:
    """Watches one process, in a thread of its own, and ends it if it shows no sign of life.

    Every child sends `Alive` twice a second from a thread of its own. A child that is silent and stopped (SIGSTOP) is
    frozen; one that is silent for long is, too; one that lives but answers nobody hangs.

    Time is counted in looks, not by the clock: what passes while the service itself is stopped (Ctrl-Z) is no silence.

    Args:
        pid: of the process.
        answer_s: how long it may answer nobody while requests wait [s].
        is_asked: whether requests wait.
        bark: called once, with whether the process is frozen rather than hanging; ends it.
    """

    def __init__(
        self, pid: int, answer_s: Callable[[], float], is_asked: Callable[[], bool], bark: Callable[[bool], None]
    ) -> None:
        self._pid, self._answer_s, self._is_asked, self._bark = pid, answer_s, is_asked, bark
        self._is_over = threading.Event()
        self._has_spoken = self._has_answered = True
        self._silent_s = self._waited_s = 0.0
        threading.Thread(target=self._watch, name=f"watchdog-{pid}", daemon=True).start()

    def heard(self, *, is_answer: bool) -> None:
        """The process has sent something, which may answer somebody."""
        self._has_spoken = True
        if is_answer:
            self._has_answered = True

    def stop(self) -> None:
        """Watch no more."""
        self._is_over.set()

    def _watch(self) -> None:
        while not self._is_over.wait(LOOK_S):
            self._silent_s = 0.0 if self._has_spoken else self._silent_s + LOOK_S
            # Waiting behind others is no sign of hanging, so an answer to anybody counts.
            self._waited_s = self._waited_s + LOOK_S if self._is_asked() and not self._has_answered else 0.0
            self._has_spoken = self._has_answered = False
            is_frozen = self._silent_s >= SILENT_S or (self._silent_s >= STOPPED_S and is_stopped(self._pid))
            if is_frozen or self._waited_s > self._answer_s():
                self._bark(is_frozen)
                return
