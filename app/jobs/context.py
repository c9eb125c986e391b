"""What crosses between the service and the process of a job: messages, a place to work in, and orders meanwhile."""

from __future__ import annotations

import contextlib
import itertools
import queue
import threading
import time
from collections.abc import Callable
from dataclasses import dataclass
from pathlib import Path
from typing import Any

from osfcore.errors import OsfError
from osfcore.objects.asset_library import AssetLibrary

from ..processes.client import ProcessUnavailable
from ..processes.messages.scene_messages import JobCommand
from ..processes.server import Answer

_LOOKS_EVERY_S = 0.05
_ANSWER_S = 300.0  # the service gives its simulation three minutes, and others may be served first


@dataclass(frozen=True, slots=True)
class RunJob:
    """Do a job. Answered by what its last step reported, or by JobCancelled.

    Attributes:
        kind: what to do.
        params: with what.
        data_dir: of the service.
        folder: the job's own, for what it makes; exists.
    """

    kind: str
    params: dict[str, Any]
    data_dir: Path
    folder: Path


@dataclass(frozen=True, eq=False, slots=True)
class JobStep:
    """How far a job is.

    Attributes:
        done: units finished.
        total: units in all.
        note: what is being done, for a person.
        result: what its kind reports besides.
        view: what the live view draws of it, and nobody keeps; None for most kinds.
    """

    done: int
    total: int
    note: str
    result: dict[str, Any]
    view: object = None


@dataclass(frozen=True, eq=False, slots=True)
class SceneCommand:
    """Something to be done with the scene that a job drives. Answered by an Answer of the same number."""

    command: JobCommand
    number: int = 0


@dataclass(frozen=True, slots=True)
class JobRests:
    """A job has come to the end of the round after which it was to rest."""


@dataclass(frozen=True, slots=True)
class JobCancelled:
    """A job has stopped because it was asked to."""


@dataclass(frozen=True, slots=True)
class PauseJob:
    """Stop after the current step, until resumed."""


@dataclass(frozen=True, slots=True)
class ResumeJob:
    """Go on."""


@dataclass(frozen=True, slots=True)
class StepJob:
    """Go on to the end of the current round, then rest; for kinds of jobs that have rounds."""


@dataclass(frozen=True, eq=False, slots=True)
class ChangeJob:
    """From now on, work with these parameters; for kinds of jobs that look at changes."""

    params: dict[str, Any]


@dataclass(frozen=True, slots=True)
class CancelJob:
    """Stop after the current step."""


@dataclass(frozen=True, slots=True)
class JobContext:
    """Where a job reads and writes.

    Attributes:
        data_dir: of the service.
        folder: the job's own, for what it makes; exists.
        orders: what the service asks of the job; set in the job's own process.
    """

    data_dir: Path
    folder: Path
    orders: JobControl | None = None

    @property
    def library(self) -> AssetLibrary:
        """The objects on this machine."""
        return AssetLibrary(self.data_dir / "objects")


class JobControl:
    """Orders that come while a job works, taken from the receiving thread so that they count even in a long step.

    Args:
        send: takes messages to the service.
        answer_s: how long the service may take to answer `ask` [s].
    """

    def __init__(self, send: Callable[[object], None], answer_s: float = _ANSWER_S) -> None:
        self._send, self._answer_s = send, answer_s
        self._numbers = itertools.count()
        self._may_run = threading.Event()
        self._may_run.set()
        self._is_cancelled = threading.Event()
        self._rests_after_round = threading.Event()
        self._answers: queue.SimpleQueue[Answer] = queue.SimpleQueue()
        self._changes: queue.SimpleQueue[dict[str, Any]] = queue.SimpleQueue()
        self._at_cancel: list[Callable[[], None]] = []

    @property
    def is_paused(self) -> bool:
        """Whether the job rests after its current step."""
        return not self._may_run.is_set()

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
        return [self._changes.get() for _ in range(self._changes.qsize())]  # nobody else takes any

    def next_change(self) -> dict[str, Any] | None:
        """Wait for parameters that are sent; None if the job is cancelled first."""
        while not self._is_cancelled.is_set():
            with contextlib.suppress(queue.Empty):
                return self._changes.get(timeout=_LOOKS_EVERY_S)
        return None

    def on_cancel(self, call: Callable[[], None]) -> None:
        """Have something called as soon as the job is cancelled, in whatever long step it is."""
        self._at_cancel.append(call)
        if self._is_cancelled.is_set():
            call()

    def ask(self, command: JobCommand) -> Any:  # noqa: ANN401  each command says what answers it
        """Have something done with the scene that this job drives, and wait for the answer.

        Raises:
            ProcessUnavailable: if the simulation is not there now, or the service does not answer in time.
            OsfError: what the simulation raised, or because the job was cancelled meanwhile.
        """
        number, latest = next(self._numbers), time.monotonic() + self._answer_s
        self._send(SceneCommand(command, number))
        while True:
            try:
                answer = self._answers.get(timeout=_LOOKS_EVERY_S)
            except queue.Empty:
                if self._is_cancelled.is_set():
                    raise OsfError("This job was cancelled while it waited for the simulation.") from None
                if time.monotonic() > latest:
                    what = f"did not answer this job within {self._answer_s:g} s"
                    raise ProcessUnavailable("service", what) from None
                continue
            if answer.number == number:  # else it came too late for its own question
                if answer.error is not None:
                    raise answer.error
                return answer.value

    def take(self, order: object) -> None:
        """Take an order, or the answer to `ask`."""
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
            case CancelJob():
                self._is_cancelled.set()
                self._may_run.set()
                for call in self._at_cancel:
                    call()
            case Answer():
                self._answers.put(order)
