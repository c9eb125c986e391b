"""How jobs end: what each outcome makes of a job, and what is left of its folder."""

from __future__ import annotations

import shutil
from dataclasses import replace
from pathlib import Path

from app.jobs.job import Job, ended
from app.processes.messages import Failure, JobCancelled, JobDone

STOPPED_NOTE = "The service stopped while this job was running; start it again."
DIED_NOTE = "The job's process ended unexpectedly; it may have run out of memory."
RESUMES_NOTE = "Started again with the same settings, it goes on from its last checkpoint."
INTERRUPTED_NOTE = "The service stopped in the middle; the steps until then are kept."
STOPPED, DIED = Failure(0, "Stopped", STOPPED_NOTE), Failure(0, "Died", DIED_NOTE)
_KEEPING = ("episode",)  # kinds whose finished steps are worth keeping, however the job ends


def after(job: Job, outcome: object, folder: Path) -> Job:
    """The job as its process left it; the folder of one that came to nothing is removed."""
    keeps = job.kind in _KEEPING
    match outcome:
        case JobDone(result):
            then = ended(job, "done", note="Done", result=result)
        case JobCancelled():
            then = ended(job, "cancelled", note="Cancelled")
        case Failure(_, "Stopped", _) if keeps:
            then = ended(job, "interrupted", note="Interrupted", error=INTERRUPTED_NOTE)
        case Failure(_, kind, text):
            text = _with_advice(job, text) if kind in (DIED.kind, STOPPED.kind) else text
            then = ended(job, "failed", note="Failed", error=text)
        case _:
            then = ended(job, "failed", note="Failed", error="The job's process told nonsense.")
    if then.state != "done" and not keeps:
        shutil.rmtree(folder, ignore_errors=True)
        return then
    for left in folder.glob(".*"):  # half-made when it ended
        shutil.rmtree(left, ignore_errors=True) if left.is_dir() else left.unlink(missing_ok=True)
    files = tuple(sorted(path.name for path in folder.glob("[!.]*") if path.is_file()))
    return replace(then, files=files)


def _with_advice(job: Job, text: str) -> str:
    return f"{text} {RESUMES_NOTE}" if job.kind == "train_field" else text
