"""How jobs end: what each outcome makes of a job, and what is left of its folder."""

from __future__ import annotations

import shutil
from dataclasses import replace
from pathlib import Path
from typing import Any

from app.episodes.robots.stopped_report import STOPPED, tell_stopped
from app.jobs.job import Job, ended
from app.jobs.job_folders import remove_half_made
from app.processes.messages.job_messages import JobCancelled
from osfcore.errors import OsfError

RESUMES_NOTE = "Started again with the same settings, it goes on from its last checkpoint."
INTERRUPTED_NOTE = "The service stopped in the middle; the steps until then are kept."
_WITHOUT_A_WORD = "The robot was stopped: its job was cancelled."
_KEEPING = ("episode", "robot")  # kinds whose finished steps are worth keeping, however the job ends
Outcome = dict[str, Any] | JobCancelled | OsfError  # a result, or why there is none


class JobStopped(OsfError):
    """The service stopped before the job had finished."""

    def __init__(self) -> None:
        super().__init__("The service stopped while this job was running; start it again.")


class JobDied(OsfError):
    """The job's process ended without a word, or was frozen and ended."""

    def __init__(self, what: str = "ended unexpectedly; it may have run out of memory or time") -> None:
        super().__init__(f"The job's process {what}.")


def after(job: Job, outcome: Outcome, folder: Path) -> Job:
    """The job as its process left it; the folder of one that came to nothing is removed.

    Args:
        job: as it was while it ran.
        outcome: its result, or why there is none.
        folder: of the job; of what stays, half-made files go and the others are listed.
    """
    keeps = job.kind in _KEEPING
    if isinstance(outcome, dict):
        then = ended(job, "done", note="Done", result=outcome)
    elif isinstance(outcome, JobCancelled):
        then = ended(job, "cancelled", note="Cancelled")
    elif isinstance(outcome, JobStopped) and keeps:
        then = ended(job, "interrupted", note="Interrupted", error=INTERRUPTED_NOTE)
    else:
        can_resume = job.kind == "train_field" and isinstance(outcome, JobStopped | JobDied)
        then = ended(job, "failed", note="Failed", error=f"{outcome} {RESUMES_NOTE}" if can_resume else str(outcome))
    if then.state != "done" and job.kind == "robot":
        then = _robot_stopped(then, folder)
    if then.state != "done" and not keeps:
        shutil.rmtree(folder, ignore_errors=True)
        return then
    remove_half_made(folder)
    files = tuple(sorted(path.name for path in folder.glob("[!.]*") if path.is_file()))
    return replace(then, files=files)


def _robot_stopped(then: Job, folder: Path) -> Job:
    """The job of a robot that was broken off: it and its report tell so, and why, in the same words."""
    result = dict(then.result or {})
    if result.get("outcome") is None:
        why = then.error or _WITHOUT_A_WORD
        tell_stopped(folder, why)
        result |= {"outcome": STOPPED, "text": why}
    return replace(then, result=result)
