"""What a job is given in its process: where it reads and writes, and the orders that reach it while it works."""

from __future__ import annotations

import contextlib
import dataclasses
import queue
import threading
from collections.abc import Callable
from multiprocessing.connection import Connection
from pathlib import Path
from typing import Any

from app.processes.messages import (
    Act,
    AskStage,
    CancelJob,
    ChangeJob,
    Failure,
    ObserveScene,
    PauseJob,
    Reply,
    ResumeJob,
    StepJob,
    TakeView,
)
from osfcore.objects.asset_library import AssetLibrary


@dataclasses.dataclass(frozen=True, slots=True)
class JobContext:
    """Where a job reads and writes.

    Attributes:
        data_dir: of the service.
        folder: the job's own, for what it makes; exists.
        orders: what the service tells the job; set in the job's own process.
    """

    data_dir: Path
    folder: Path
    orders: JobControl | None = None

    @property
    def library(self) -> AssetLibrary:
        """The objects on this machine."""
        return AssetLibrary(self.data_dir / "objects")


class JobControl:
    """Listens on the pipe in a thread of its own, so that an order counts even during a long step."""

    def __init__(self, connection: Connection, on_lost: Callable[[], None]) -> None:
        self._connection = connection
        self._on_lost = on_lost
        self._may_run = threading.Event()
        self._may_run.set()
        self._is_cancelled = threading.Event()
        self._rests_after_round = threading.Event()
        self._answers: queue.SimpleQueue[Reply | Failure] = queue.SimpleQueue()
        self._changes: queue.SimpleQueue[dict[str, Any]] = queue.SimpleQueue()
        threading.Thread(target=self._listen, name="orders", daemon=True).start()

    def must_stop(self) -> bool:
        """Whether the job was cancelled; waits here while it is paused."""
        self._may_run.wait()
        return self._is_cancelled.is_set()

    def rests_now(self) -> bool:
        """Whether the job was to rest after a round; then it is paused from now on."""
        if not self._rests_after_round.is_set():
            return False
        self._rests_after_round.clear()
        self._may_run.clear()
        return True

    def changes(self) -> list[dict[str, Any]]:
        """Parameters that were sent since the last call, the latest last."""
        found = []
        with contextlib.suppress(queue.Empty):
            while True:
                found.append(self._changes.get_nowait())
        return found

    def ask(self, command: Act | ObserveScene | TakeView) -> Any:  # noqa: ANN401  each command says what answers it
        """Have something done with the scene that this job drives, and wait for the answer.

        Raises:
            StageError: if the stage refused it, or is not there.
        """
        from app.processes.sim_client import StageError

        self._connection.send(AskStage(command))
        answer = self._answers.get()
        if isinstance(answer, Failure):
            raise StageError(answer.kind, answer.text)
        return answer.value

    def _listen(self) -> None:
        while True:
            try:
                order = self._connection.recv()
            except (EOFError, OSError):
                # The service died: nobody wants the result, and what is half-written counts as never begun.
                self._on_lost()
                return
            match order:
                case PauseJob():
                    self._may_run.clear()
                case ResumeJob():
                    self._rests_after_round.clear()
                    self._may_run.set()
                case StepJob():
                    self._rests_after_round.set()
                    self._may_run.set()
                case ChangeJob(params):
                    self._changes.put(params)
                case Reply() | Failure():
                    self._answers.put(order)
                case CancelJob():
                    self._is_cancelled.set()
                    self._may_run.set()
