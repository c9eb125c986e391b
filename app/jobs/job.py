"""A job: what is known of it, how it is written as JSON, what it refuses."""

from __future__ import annotations

from collections.abc import Callable, Mapping
from dataclasses import asdict, dataclass, field, replace
from typing import Any, Literal, get_args

from app.storage.database import now_utc
from osfcore.errors import InvalidInput, OsfError, UnknownName, shown
from osfcore.io.json_codec import decode

Kind = Literal[
    "collect_pushes",
    "collect_object",
    "collect_table",
    "fetch_assets",
    "add_object",
    "train_field",
    "estimate",
    "episode",
    "clip",
    "photo",
    "robot",
]
State = Literal["queued", "running", "paused", "done", "failed", "cancelled", "interrupted"]
INPUTS = "inputs"  # in the folder of a job that was given files
WORDS: Mapping[str, str] = {  # for people
    "collect_pushes": "data collection", "collect_object": "data collection", "collect_table": "data collection",
    "fetch_assets": "download of objects", "add_object": "new object", "train_field": "training",
    "estimate": "estimate", "episode": "episode", "clip": "clip", "photo": "look at a photo",
    "robot": "episode with the robot",
}  # fmt: skip
FINISHED: tuple[State, ...] = ("done", "failed", "cancelled", "interrupted")


def in_words(job: Job) -> str:
    """What a job is, for people."""
    return WORDS.get(job.kind, "job")


class WrongJobState(OsfError):
    """An order that does not fit the state that a job is in.

    Args:
        job: as it is.
        wanted: what it was to be, as in "cancelled".
        is_over: whether its process takes no orders any more, although what has become of the job is not known yet.
    """

    def __init__(self, job: Job, wanted: str, *, is_over: bool = False) -> None:
        state = "no longer takes orders because it is ending" if is_over else f"is {job.state}"
        super().__init__(f"This {in_words(job)} {state}, so it cannot be {wanted}.")


class TrainingAlready(OsfError):
    """A second order for a field that is being trained."""

    def __init__(self, name: str) -> None:
        super().__init__(f"A field of {name} is being trained already; wait for it, cancel it or take another name.")


class SetInUse(OsfError):
    """An image set that a job needs."""

    def __init__(self, job: Job) -> None:
        super().__init__(f"A training of {job.params['name']} needs these images; wait for it or cancel it first.")


class SceneNeeded(OsfError):
    """A scene that a job needs to go on, or to begin."""

    def __init__(self, job: Job) -> None:
        super().__init__(f"This table is needed by the {in_words(job)} that is {job.state}; cancel that first.")


class WorkshopInUse(OsfError):
    """Files of a training that goes on, or waits."""

    def __init__(self, name: str, job: Job) -> None:
        super().__init__(f"The training of {name} that is {job.state} needs these files; cancel it first.")


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
        result: what its kind tells at the end.
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
    """What a running job lets the live view draw; it is neither kept nor told to pages."""

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
    job = decode(Job, fields, "job")
    if job.kind not in get_args(Kind):
        raise InvalidInput("kind of job", shown(job.kind), f"one of {', '.join(get_args(Kind))}")
    return job


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


def check_params(kind: str, params: dict[str, Any], known: Callable[[str], object], available: int) -> None:
    """Refuse at once what the job would refuse later.

    Args:
        kind: of the job.
        params: what it is to be done with.
        known: raises an OsfError for the name of an object that the job cannot use.
        available: how many objects have been fetched.

    Raises:
        OsfError: if an object is unknown or there are too few.
    """
    if kind == "collect_object":
        known(params["name"])
    for name in params.get("names", ()):
        known(name)
    if kind == "collect_pushes" and params["objects"] > available:
        allowed = f"at most {available}, as many as were fetched" if available else "0 until some have been fetched"
        raise InvalidInput("number of objects", params["objects"], allowed)
