"""What the service must know of a kind of job, in one record."""

from __future__ import annotations

from collections.abc import Callable, Iterator, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import TYPE_CHECKING, Any

from .params import JobParams

if TYPE_CHECKING:
    from .context import JobContext
    from .job import Job


@dataclass(frozen=True, slots=True)
class JobKind:
    """A kind of job.

    Attributes:
        name: as it is asked for over REST and stored.
        words: what it is called for people.
        run: does it in the job's process, step by step: each step has `done`, `total` and `note`, and its other fields
            are the job's result. A step may also have `view`, what the live view draws of it; `must_be_reported`, if it
            must reach the service however soon it comes; and `ends_round`, where a job that goes on by single steps
            rests.
        params: of such a job, as REST takes them, as they are stored, and as `run` gets them.
        check: refuses parameters at once that `run` would refuse later, given a function that raises an OsfError for
            the name of an object that cannot be used, and how many objects there are.
        preloads: modules that a process in reserve has loaded before it is asked for such a job; none if no process
            is kept in reserve for it.
        uses_physics: whether its process loads the simulator first.
        has_folder: whether it has a folder of its own for what it makes.
        keeps_steps: whether the steps that it has finished are kept when it is broken off.
        goes_on: whether the same order goes on from a checkpoint after it was broken off.
        ends_at_once: whether it leaves nothing that it must tidy up when it is cancelled.
        on_cancelled: removes what it has left outside its folder when it is cancelled, given the data directory, the
            job, and the other jobs of this kind that wait, run or pause.
        on_broken_off: returns the job as it is when it has ended in any way but well, given its folder.
    """

    name: str
    words: str
    run: Callable[[Any, JobContext], Iterator[Any]]
    params: type[JobParams]
    check: Callable[[Any, Callable[[str], object], int], None] = lambda *_: None
    preloads: tuple[str, ...] = ()
    uses_physics: bool = False
    has_folder: bool = True
    keeps_steps: bool = False
    goes_on: bool = False
    ends_at_once: bool = False
    on_cancelled: Callable[[Path, Job, Sequence[Job]], None] = lambda *_: None
    on_broken_off: Callable[[Job, Path], Job] = lambda job, _: job
