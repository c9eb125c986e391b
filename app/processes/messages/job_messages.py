"""Messages between the service and the process of a job."""

from __future__ import annotations

from dataclasses import dataclass
from pathlib import Path
from typing import Any

from app.processes.messages.scene_messages import Act, ObserveScene, TakeView


@dataclass(frozen=True, slots=True)
class RunJob:
    """Do a job. Answered by what its last step told, or by JobCancelled.

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
        result: what its kind tells besides.
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

    command: Act | ObserveScene | TakeView
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
