"""A job process: runs the generator of one job, step by step, and listens for pause, resume and cancel."""

from __future__ import annotations

import contextlib
import dataclasses
import time
from collections.abc import Callable
from typing import Any

from osfcore.errors import OsfError

from ..processes.child_process import end_with_children, import_quietly
from ..processes.server import ProcessServer
from .context import JobCancelled, JobContext, JobControl, JobRests, JobStep, RunJob
from .kinds import KINDS

STEP_INTERVAL_S = 0.1
_NOT_EXTRA = ("done", "total", "note", "view")  # fields of a step that are no part of the result


def _prepare() -> None:
    """Load code, and use it once."""
    for module in dict.fromkeys(module for kind in KINDS.values() for module in kind.preloads):
        import_quietly(module)
    from .kinds.rehearsal import rehearse

    with contextlib.suppress(OsfError):  # a job that lacks what this lacks says so
        rehearse()


def job_main(server: ProcessServer, is_in_reserve: bool = False) -> None:
    """Do the job that is asked for; a process in reserve loads code until then."""
    control, must_prepare = JobControl(server.send), is_in_reserve

    def prepare(is_asked: bool) -> None:
        nonlocal must_prepare
        if must_prepare and not is_asked:
            _prepare()
        must_prepare = False

    # A service that died leaves nobody who wants the result, and what is half-written counts as never begun.
    server.serve(
        lambda job, _: run_job(job, control, server.send),
        idle=prepare,
        on_message=control.take,
        on_lost=end_with_children,
    )


def run_job(
    job: RunJob, control: JobControl, send: Callable[[object], None], step_interval_s: float = STEP_INTERVAL_S
) -> dict[str, Any] | JobCancelled:
    """Do a job and report its steps.

    Args:
        job: what to do.
        control: orders that come meanwhile.
        send: takes JobStep and JobRests.
        step_interval_s: steps that come faster are not reported one by one [s].

    Returns:
        What the last step reported, or that the job was cancelled.

    Raises:
        OsfError: if the job cannot be done.
    """
    kind = KINDS[job.kind]
    if kind.uses_physics:
        import_quietly("osfcore.world.tabletop")
    result: dict[str, Any] = {}
    last = 0.0
    context = JobContext(job.data_dir, job.folder, control)
    with contextlib.closing(kind.run(kind.params.from_json(job.params), context)) as steps:  # pyright: ignore[reportArgumentType]
        for step in steps:
            extras = [field.name for field in dataclasses.fields(step) if field.name not in _NOT_EXTRA]
            result = {name: getattr(step, name) for name in extras}
            now = time.monotonic()
            if now - last >= step_interval_s or step.done == step.total or getattr(step, "must_be_reported", False):
                send(JobStep(step.done, step.total, step.note, result, getattr(step, "view", None)))
                last = now
            if getattr(step, "ends_round", False) and control.rests_now():
                send(JobRests())
            if control.must_stop():
                return JobCancelled()
    return result
