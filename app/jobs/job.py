"""A job: what is known of it, and how it is written as JSON."""

from __future__ import annotations

from dataclasses import asdict, dataclass, field, replace
from typing import Any, Literal

from osfcore.errors import UnknownName
from osfcore.io.json_codec import decode

from ..storage.database import now_utc

State = Literal["queued", "running", "paused", "done", "failed", "cancelled", "interrupted"]
INPUTS = "inputs"  # in the folder of a job that was given files
FINISHED: tuple[State, ...] = ("done", "failed", "cancelled", "interrupted")


@dataclass(frozen=True, slots=True)
class Job:
    """A job as it is now.

    Attributes:
        id: identifier.
        kind: what is done.
        params: with what.
        state: where it is in its life.
        done: units finished.
        total: units in all; 0 before it is known.
        note: what is being done, for a person.
        created_at: UTC, ISO 8601.
        started_at: when it left the queue.
        finished_at: when it ended, in whatever way.
        eta_s: time left, estimated [s].
        error: why it failed, one sentence.
        result: what its kind reports at the end.
        files: names that can be downloaded.
        position: in the queue, the next one has 1.
    """

    id: str
    kind: str
    params: dict[str, Any]
    state: State = "queued"
    done: int = 0
    total: int = 0
    note: str = "Waiting"
    created_at: str = field(default_factory=now_utc)
    started_at: str | None = None
    finished_at: str | None = None
    eta_s: float | None = None
    error: str | None = None
    result: dict[str, Any] | None = None
    files: tuple[str, ...] = ()
    position: int | None = None

    @property
    def scene(self) -> str | None:
        """The scene that it drives, which is among the parameters of some kinds."""
        return self.params.get("scene")

    @property
    def is_finished(self) -> bool:
        """Whether nothing will change any more."""
        return self.state in FINISHED


@dataclass(frozen=True, slots=True)
class JobChanged:
    """A job is now like this; `event` is the number under which a page can ask for what came later."""

    event: int
    job: Job


@dataclass(frozen=True, slots=True)
class JobForgotten:
    """A job is gone, with all its files; `event` as in `JobChanged`."""

    event: int
    job: Job


@dataclass(frozen=True, eq=False, slots=True)
class JobView:
    """What a running job lets the live view draw; it is neither kept nor sent to pages."""

    job: Job
    view: object


JobEvent = JobChanged | JobForgotten | JobView


@dataclass(frozen=True, slots=True)
class JobPage:
    """Some of the jobs.

    Attributes:
        jobs: newest first.
        total: how many there are in all.
        next: where the next page begins, see `JobTable.page`; None at the end.
    """

    jobs: tuple[Job, ...]
    total: int
    next: int | None


def job_fields(job: Job) -> dict[str, Any]:
    """A job as JSON."""
    return {**asdict(job), "files": list(job.files)}


def job_from_fields(fields: dict[str, Any]) -> Job:
    """The inverse of `job_fields`; what another version has added is left out, and what it lacks has its default.

    Raises:
        InvalidInput: if it makes no sense.
    """
    return decode(Job, fields, "job")


def ended(job: Job, state: State, **changes: Any) -> Job:  # noqa: ANN401  any field of Job
    """The job as it is once it has ended, in whatever way."""
    return replace(job, state=state, finished_at=now_utc(), eta_s=None, position=None, **changes)


def check_file_name(job: Job, name: str) -> str:
    """The name of one of a job's files.

    Raises:
        UnknownName: if it has none of this name.
    """
    if name not in job.files:
        raise UnknownName("file of this job", name, job.files)
    return name
