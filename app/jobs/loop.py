"""The job loop: a thread that takes the next job from the queue and follows its process to the end."""

from __future__ import annotations

import contextlib
import logging
import shutil
import threading
import time
from collections.abc import Callable
from concurrent.futures import ThreadPoolExecutor
from dataclasses import replace
from pathlib import Path
from typing import Any

from osfcore.errors import OsfError, UnknownName
from osfcore.io.files import sync_tree

from ..processes.messages.scene_messages import JobCommand
from ..processes.server import Answer, InternalError
from ..storage.database import now_utc
from .context import JobCancelled, JobRests, JobStep, SceneCommand
from .folders import JobFolders, remove_half_made
from .job import Job, JobChanged, JobView, ended
from .kinds import KINDS
from .process import JobDied, JobProcess, JobStopped, Outcome
from .table import JobTable

StartProcess = Callable[[Job, Path, Path, Callable[[object], None]], JobProcess]
_RETRY_S = 1.0  # after a failure of the loop itself, and of writing what the disk has refused
_log = logging.getLogger(__name__)


class JobLoop:
    """Does one job at a time, each in a process of its own.

    Args:
        changed: guards the table; notified when a job is added or has ended.
        table: of all jobs.
        data_dir: of the service.
        publish: called with what the running job lets the live view draw.
        serve: carries out what a job asks for with the scene that it drives.
        start_process: of a job, its data directory, its folder and what takes its events.
    """

    def __init__(
        self,
        changed: threading.Condition,
        table: JobTable,
        data_dir: Path,
        publish: Callable[[JobChanged | JobView], None],
        serve: Callable[[JobCommand], Any] | None,
        start_process: StartProcess,
    ) -> None:
        self._changed, self._table = changed, table
        self._data_dir, self._folders = data_dir, JobFolders(data_dir)
        self._publish, self._serve, self._start_process = publish, serve, start_process
        self._is_stopping = False
        self._thread: threading.Thread | None = None
        self._serving = ThreadPoolExecutor(1, thread_name_prefix="jobs-scene")
        self.run: JobProcess | None = None  # the job at work
        self.problem: str | None = None  # why no job goes on, for people; None if all is well

    def start(self) -> None:
        """Begin to work."""
        self._thread = threading.Thread(target=self._work, name="jobs", daemon=True)
        self._thread.start()

    def stop(self) -> None:
        """End the running job, which counts as failed. Calling it again does nothing."""
        with self._changed:
            self._is_stopping = True
            self._changed.notify_all()
        if self._thread is not None:
            self._thread.join()
            self._thread = None
        self._serving.shutdown(wait=False)

    def _work(self) -> None:
        while not self._is_stopping:
            try:
                self._work_once()
            except Exception as error:  # whatever it is, jobs must go on once its cause is gone
                _log.exception("the job loop failed")
                self.problem = f"Jobs cannot go on ({type(error).__name__}); it is tried again."
                time.sleep(_RETRY_S)
        if self.run is not None:
            self.run.end()

    def _work_once(self) -> None:
        """Wait for a job and do it; one that an earlier failure has left is brought to its end."""
        if self.run is None:
            with self._changed:
                self._changed.wait_for(lambda: self._is_stopping or bool(self._table.queue()), _RETRY_S)
                self._table.flush_progress()
                if self._is_stopping or not self._table.queue():
                    return
                job = self._table.queue()[0]
                try:
                    self._begin(job)
                except OSError as error:
                    self._table.set(ended(job, "failed", error=f"The job could not be started ({error.strerror})."))
                    return
        self.problem = None
        self._attend()

    def _begin(self, job: Job) -> None:
        folder = self._folders.folder(job.id)
        if KINDS[job.kind].has_folder:
            folder.mkdir(parents=True, exist_ok=True)
        self.run = self._start_process(job, self._data_dir, folder, self._on_event)
        self._table.set(replace(job, state="running", started_at=now_utc(), note="Starting"))
        self._table.publish_queue()

    def _attend(self) -> None:
        """Follow the running job until its process has ended, and note what has become of it."""
        run = self.run
        assert run is not None
        while (outcome := run.wait()) is None:
            with self._changed:
                self._table.flush_progress()
                if self._is_stopping:
                    outcome = JobStopped()
                    break
        run.end()
        with self._changed:  # until whoever has cancelled it has said why
            job = self._table[run.id]
        if run.is_cancelled and not isinstance(outcome, dict):
            outcome = JobCancelled()  # whatever ended it first, it was asked to
        then = after(job, outcome, self._folders.folder(job.id))
        if then.state == "cancelled":
            clear_cancelled(self._data_dir, self._table, job)
        if then.state == "done":
            with contextlib.suppress(OSError):
                sync_tree(self._folders.folder(job.id))  # before anybody hears that it is there
        with self._changed:
            self.run = None
            self._table.set(replace(then, params=self._table[run.id].params))  # which may have changed meanwhile
            self._changed.notify_all()

    def _on_event(self, event: object) -> None:
        """Take what the running job reports, in the thread that listens to it."""
        with self._changed:  # until it has been noted which job that is
            run = self.run
        assert run is not None
        match event:
            case JobStep():
                self._progress(run, event)
            case SceneCommand():
                self._serving.submit(self._answer, run, event)
            case JobRests():
                with self._changed:
                    run.clock.switch(is_running=False)
                    self._table.set(replace(self._table[run.id], state="paused", eta_s=None))

    def _progress(self, run: JobProcess, step: JobStep) -> None:
        with self._changed:
            job = self._table[run.id]
            result = step.result or None
            own_s = step.result.get("left_s")  # by jobs whose parts take their time in different ways
            eta_s = run.clock.left_s(step.done, step.total) if own_s is None else own_s
            job = replace(job, done=step.done, total=step.total, note=step.note, eta_s=eta_s, result=result)
            self._table.set_progress(job)
        if step.view is not None:
            self._publish(JobView(job, step.view))

    def _answer(self, run: JobProcess, asked: SceneCommand) -> None:
        """Carry out what a job asks for, with the scene that it drives and no other.

        In a thread of its own: the simulation may hang, and the job must be heard, and cancelled, meanwhile.
        """
        try:
            scene = self._table[run.id].scene
            if self._serve is None or asked.command.id != scene:
                raise UnknownName("scene of this job", asked.command.id, [str(scene)])
            was_sent = run.order(Answer(asked.number, self._serve(asked.command)))
        except OsfError as error:
            was_sent = run.order(Answer(asked.number, error=error))
        except Exception as error:  # whatever it is, the job must not wait for ever
            _log.exception("%s that a job asked for could not be done", type(asked.command).__name__)
            was_sent = run.order(Answer(asked.number, error=InternalError("service's answer to this job", error)))
        if not was_sent and not run.is_cancelled:
            _log.warning("a job that takes no orders any more did not get what it had asked for")


def clear_cancelled(data_dir: Path, table: JobTable, job: Job) -> None:
    """Remove what a cancelled job has left outside its folder."""
    others = [other for other in table.live(job.kind) if other.id != job.id]
    KINDS[job.kind].on_cancelled(data_dir, job, others)


# How jobs end: what each outcome makes of a job, and what is left of its folder.


RESUMES_NOTE = "Started again with the same settings, it goes on from its last checkpoint."
INTERRUPTED_NOTE = "The service stopped in the middle; the steps until then are kept."


def after(job: Job, outcome: Outcome, folder: Path) -> Job:
    """The job as its process left it; the folder of one that came to nothing is removed.

    Args:
        job: as it was while it ran.
        outcome: its result, or why there is none.
        folder: of the job; of what stays, half-made files go and the others are listed.
    """
    kind = KINDS[job.kind]
    if isinstance(outcome, dict):
        then = ended(job, "done", note="Done", result=outcome)
    elif isinstance(outcome, JobCancelled):
        then = ended(job, "cancelled", note="Cancelled")
    elif isinstance(outcome, JobStopped) and kind.keeps_steps:
        then = ended(job, "interrupted", note="Interrupted", error=INTERRUPTED_NOTE)
    else:
        can_resume = kind.goes_on and isinstance(outcome, JobStopped | JobDied)
        then = ended(job, "failed", note="Failed", error=f"{outcome} {RESUMES_NOTE}" if can_resume else str(outcome))
    if then.state != "done":
        then = kind.on_broken_off(then, folder)
    if then.state != "done" and not kind.keeps_steps:
        shutil.rmtree(folder, ignore_errors=True)
        return then
    remove_half_made(folder)
    files = tuple(sorted(path.name for path in folder.glob("[!.]*") if path.is_file()))
    return replace(then, files=files)
