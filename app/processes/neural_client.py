"""The web process's end of a process with neural models: starts it on first use, hands out answers, starts it again."""

from __future__ import annotations

import itertools
import logging
import threading
import time
from collections.abc import Callable
from concurrent.futures import Future
from multiprocessing.connection import Connection
from multiprocessing.context import SpawnProcess
from pathlib import Path

from app.processes.child_process import end, launch
from app.processes.messages import Failure, Reply
from app.processes.neural_messages import Comparison, DrawnView, NumberedOrder, Order, Predicted
from app.processes.render_process import renderer_main
from osfcore.errors import OsfError

MAX_PENDING = 64
ANSWER_S = 180.0  # compiling on a busy machine takes longest; after that the process counts as hung
_PAUSES_S = (0.0, 2.0, 10.0, 60.0)  # longer and longer while it keeps dying without answering anything
_log = logging.getLogger(__name__)
Answer = DrawnView | Comparison | Predicted | None


class NeuralError(OsfError):
    """What the process refused, told in its own words."""

    def __init__(self, kind: str, text: str) -> None:
        super().__init__(text)
        self.kind = kind


class NeuralUnavailable(OsfError):
    """The process is not there now."""

    def __init__(self, who: str, what: str) -> None:
        super().__init__(f"The {who} {what}; try again in a moment.")


class NeuralBusy(OsfError):
    """More orders wait than make sense."""

    def __init__(self, who: str) -> None:
        super().__init__(f"The {who} has too much to do at once; try again in a moment.")


class NeuralLink:
    """A process that carries out orders and the thread that listens to it; neither is there before the first order.

    Args:
        data_dir: where trained fields are.
        main: what the process runs: `main(connection, data_dir)`.
        who: what people call it.
    """

    def __init__(
        self,
        data_dir: Path,
        main: Callable[[Connection, Path], None] = renderer_main,
        who: str = "neural renderer",
    ) -> None:
        self._data_dir = data_dir
        self._main = main
        self._who = who
        self._lock = threading.Lock()  # never held while sending: the listener needs it to take answers
        self._send_lock = threading.Lock()
        self._numbers = itertools.count(1)
        self._pending: dict[int, Future[Answer]] = {}
        self._process: SpawnProcess | None = None
        self._connection: Connection | None = None
        self._is_stopped = False
        self._deaths = 0
        self._died_at = 0.0
        self._heard_at = 0.0  # when it last answered, or was asked after all had been answered
        self._is_warm = False

    @property
    def process(self) -> SpawnProcess | None:
        """The process that runs now."""
        return self._process

    @property
    def is_warm(self) -> bool:
        """Whether the process that runs now has answered: the first answer waits for code to be loaded or compiled."""
        return self._is_warm

    def stop(self) -> None:
        """End the process. Calling it again does nothing."""
        with self._lock:
            self._is_stopped = True
            process, self._connection, lost = self._process, None, list(self._pending)
        if process is not None:
            end(process)
        self._fail(lost, "was stopped")

    def submit(self, order: Order) -> Future[Answer]:
        """Send an order; the future raises NeuralError, NeuralUnavailable or NeuralBusy."""
        future: Future[Answer] = Future()
        try:
            connection, number = self._note(future)
        except OsfError as refusal:
            future.set_exception(refusal)
            return future
        try:
            with self._send_lock:
                connection.send(NumberedOrder(number, order))
        except OSError:  # the listening thread sees the end as well
            self._settle(number, NeuralUnavailable(self._who, "stopped unexpectedly"))
        return future

    def _note(self, future: Future[Answer]) -> tuple[Connection, int]:
        """Where to send an order, and the number under which it will be answered."""
        with self._lock:
            self._check_ready()
            connection = self._connection or self._launch()
            number = next(self._numbers)
            if not self._pending:
                self._heard_at = time.monotonic()
            self._pending[number] = future
            return connection, number

    def _check_ready(self) -> None:
        """Refuse orders that could not be answered soon."""
        if self._is_stopped:
            raise NeuralUnavailable(self._who, "was stopped")
        now = time.monotonic()
        if self._pending and now - self._heard_at > ANSWER_S and self._process is not None:
            self._process.kill()  # the listening thread tells all who wait
            raise NeuralUnavailable(self._who, "hangs and is being restarted")
        if len(self._pending) >= MAX_PENDING:
            raise NeuralBusy(self._who)
        pause_s = _PAUSES_S[min(max(self._deaths - 1, 0), len(_PAUSES_S) - 1)]
        if self._connection is None and now - self._died_at < pause_s:
            raise NeuralUnavailable(self._who, "keeps stopping")

    def _launch(self) -> Connection:
        process, connection = launch(self._main, f"osf-{self._who.replace(' ', '-')}", self._data_dir)
        self._process, self._connection, self._is_warm = process, connection, False
        threading.Thread(target=self._listen, args=(process, connection), name="neural-link", daemon=True).start()
        return connection

    def _listen(self, process: SpawnProcess, connection: Connection) -> None:
        try:
            while True:
                self._take(connection.recv())
        except (EOFError, OSError):
            pass
        with self._lock:
            if self._connection is connection:
                self._connection = None
            self._deaths += 1
            self._died_at = time.monotonic()
            is_expected, lost = self._is_stopped, list(self._pending)
        end(process)
        connection.close()
        if not is_expected:
            _log.error("the %s ended unexpectedly (exit code %s)", self._who, process.exitcode)
        self._fail(lost, "stopped unexpectedly")

    def _take(self, message: object) -> None:
        match message:
            case Reply(number, value):
                if value is not None:  # those that were overtaken are answered even while the renderer hangs
                    self._note_life()
                self._settle(number, value)
            case Failure(number, kind, text):
                self._note_life()
                self._settle(number, NeuralError(kind, text))

    def _note_life(self) -> None:
        with self._lock:
            self._heard_at, self._deaths, self._is_warm = time.monotonic(), 0, True

    def _settle(self, number: int, outcome: Answer | OsfError) -> None:
        with self._lock:
            future = self._pending.pop(number, None)
        if future is None or not future.set_running_or_notify_cancel():
            return
        if isinstance(outcome, OsfError):
            future.set_exception(outcome)
        else:
            future.set_result(outcome)

    def _fail(self, numbers: list[int], what: str) -> None:
        for number in numbers:
            self._settle(number, NeuralUnavailable(self._who, what))
