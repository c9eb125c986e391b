"""The job registry: one job runs at a time in a process of its own, the others wait their turn.

A service that stops fails the job it was running; waiting ones go on after the next start.
"""

from __future__ import annotations

import shutil
import threading
import uuid
from collections.abc import Callable
from dataclasses import replace
from pathlib import Path
from typing import Any

from app.jobs.job import Job, JobEvent, JobView, State, WrongJobState, ended
from app.jobs.job_archive import TEMPORARY_PREFIX, JobArchive
from app.jobs.job_process import JobProcess
from app.jobs.outcomes import JobStopped, Outcome, after
from app.processes.messages.job_messages import (
    ChangeJob,
    JobCancelled,
    JobRests,
    JobStep,
    PauseJob,
    ResumeJob,
    SceneCommand,
    StepJob,
)
from app.processes.messages.scene_messages import Command
from app.processes.process_server import Answer
from app.storage.database import CannotStore, Store, now_utc
from app.storage.field_files import clear_workshop
from osfcore.errors import OsfError, UnknownName

_ENDED_AT_ONCE = ("estimate",)  # they leave nothing that needs a grace to tidy up


class QueueFull(OsfError):
    """Too many jobs wait already."""

    def __init__(self, limit: int) -> None:
        super().__init__(f"{limit} jobs are waiting already, which is the most; wait for one or cancel one.")


class Jobs(JobArchive):
    """All jobs of one data directory.

    Args:
        store: where they are kept.
        data_dir: objects are read from it, outputs go to `collections/JOB` in it.
        publish: told of every change, and of what running jobs let the live view draw.
        max_queued: how many may wait.
        cancel_grace_s: how long a cancelled job may take to stop by itself.
        serve: carries out what a job asks for with the scene that it drives.
        start_process: of a job, its data directory, its folder and what takes its events.
    """

    def __init__(
        self,
        store: Store,
        data_dir: Path,
        publish: Callable[[JobEvent], None],
        max_queued: int = 20,
        cancel_grace_s: float = 0.7,
        serve: Callable[[Command], Any] | None = None,
        start_process: Callable[[Job, Path, Path, Callable[[object], None]], JobProcess] = JobProcess,
    ) -> None:
        super().__init__(store, data_dir / "collections", publish)
        self._data_dir = data_dir
        self._max_queued = max_queued
        self._cancel_grace_s = cancel_grace_s
        self._serve = serve
        self._start_process = start_process
        self._run: JobProcess | None = None
        self._is_stopping = False
        self._thread: threading.Thread | None = None

    def start(self) -> None:
        """Take over what the store holds, remove what was left half done, and begin to work."""
        for folder in self._root.glob(f"{TEMPORARY_PREFIX}*"):
            shutil.rmtree(folder, ignore_errors=True)
        self._table.load()
        for job in self._table.all():
            if job.state in ("running", "paused"):
                self._table.set(after(job, JobStopped(), self.folder(job.id)))
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

    # What pages and programs ask for

    def holder(self, scene: str) -> str | None:
        """The job that drives a scene now, if one does: its parameters name it as "scene"."""
        with self._changed:
            job = self._table[self._run.id] if self._run else None
            return job.id if job and job.state == "running" and job.params.get("scene") == scene else None

    def submit(self, kind: str, params: dict[str, Any], inputs: Path | None = None) -> Job:
        """Put a job into the queue.

        Args:
            kind: what to do.
            params: with what.
            inputs: a folder from `new_inputs`; becomes the job's and goes with it.

        Raises:
            QueueFull: if too many wait already.
            CannotStore: if the inputs cannot be put in place.
        """
        with self._changed:
            if len(self._table.queue()) >= self._max_queued:
                raise QueueFull(self._max_queued)
            job = Job(uuid.uuid4().hex[:12], kind, params)
            if inputs is not None:
                self._take(job, inputs)
            self._table.add(job)
            self._changed.notify_all()
            return self.get(job.id)

    def cancel(self, job: str, wait_s: float = 3.0) -> Job:
        """Take a job out of the queue or end it; waits until it has ended.

        Raises:
            UnknownName: if there is no such job.
            WrongJobState: if it has finished.
        """
        with self._changed:
            known = self.get(job)
            if known.is_finished:
                raise WrongJobState(known, "cancelled")
            if known.state == "queued":
                shutil.rmtree(self.folder(job), ignore_errors=True)
                self._forget_workshop(known)
                self._table.set(ended(self._table[job], "cancelled", note="Cancelled"))
                self._table.publish_queue()
                return self.get(job)
            if self._run is not None:
                self._run.cancel(0.0 if known.kind in _ENDED_AT_ONCE else self._cancel_grace_s)
            self._changed.wait_for(lambda: self._table[job].is_finished, wait_s)
            return self.get(job)

    def pause(self, job: str) -> Job:
        """Let a running job rest after its current step.

        Raises:
            UnknownName: if there is no such job.
            WrongJobState: if it is not running.
        """
        return self._switch(job, "running", "paused", PauseJob())

    def resume(self, job: str) -> Job:
        """Let a paused job go on.

        Raises:
            UnknownName: if there is no such job.
            WrongJobState: if it is not paused.
        """
        return self._switch(job, "paused", "running", ResumeJob())

    def step(self, job: str) -> Job:
        """Let a paused job go on to the end of its round, and rest again.

        Raises:
            UnknownName: if there is no such job.
            WrongJobState: if it is not paused.
        """
        return self._switch(job, "paused", "running", StepJob())

    def change(self, job: str, params: dict[str, Any]) -> Job:
        """Let a running or paused job work with other parameters from now on.

        Raises:
            UnknownName: if there is no such job.
            WrongJobState: if it neither runs nor pauses.
        """
        with self._changed:
            known = self.get(job)
            if known.state not in ("running", "paused") or self._run is None or self._run.is_cancelled:
                raise WrongJobState(known, "changed")
            self._run.order(ChangeJob(params))
            self._table.set(replace(self._table[job], params={**known.params, **params}))
            return self.get(job)

    def _switch(self, job: str, before: State, after: State, order: PauseJob | ResumeJob | StepJob) -> Job:
        with self._changed:
            known = self.get(job)
            if known.state != before or self._run is None or self._run.is_cancelled:
                raise WrongJobState(known, "paused" if after == "paused" else "resumed")
            self._run.order(order)
            self._run.clock.switch(is_running=after == "running")
            self._table.set(replace(self._table[job], state=after, eta_s=None))
            return self.get(job)

    # The working thread

    def _work(self) -> None:
        while True:
            with self._changed:
                self._changed.wait_for(lambda: self._is_stopping or bool(self._table.queue()))
                if self._is_stopping:
                    return
                job = self._table.queue()[0]
                try:
                    self._begin(job)
                except OSError as error:
                    self._table.set(ended(job, "failed", error=f"The job could not be started ({error.strerror})."))
                    continue
            self._attend()

    def _begin(self, job: Job) -> None:
        folder = self.folder(job.id)
        if job.kind != "fetch_assets":
            folder.mkdir(parents=True, exist_ok=True)
        self._run = self._start_process(job, self._data_dir, folder, self._on_event)
        self._table.set(replace(job, state="running", started_at=now_utc(), note="Starting"))
        self._table.publish_queue()

    def _attend(self) -> None:
        """Follow the running job until its process has ended."""
        run = self._run
        assert run is not None
        outcome: Outcome | None = None
        while outcome is None:
            outcome = run.wait()
            with self._changed:
                if outcome is None:
                    self._table.flush_progress()
                if outcome is None and self._is_stopping:
                    outcome = JobStopped()
        run.end()
        self._finish(run, outcome)

    def _finish(self, run: JobProcess, outcome: Outcome) -> None:
        job = self._table[run.id]
        if run.is_cancelled and not isinstance(outcome, dict):
            outcome = JobCancelled()  # whatever ended it first, it was asked to
        then = after(job, outcome, self.folder(job.id))
        if then.state == "cancelled":
            self._forget_workshop(job)
        with self._changed:
            self._run = None
            self._table.set(then)
            self._changed.notify_all()

    def _on_event(self, event: object) -> None:
        """Take what the running job tells, in the thread that listens to it."""
        with self._changed:  # until it has been noted which job that is
            run = self._run
        assert run is not None
        match event:
            case JobStep():
                self._progress(run, event)
            case SceneCommand():
                self._answer(run, event)
            case JobRests():
                self._rest(run)

    def _progress(self, run: JobProcess, step: JobStep) -> None:
        with self._changed:
            eta_s = run.clock.left_s(step.done, step.total)
            job = self._table[run.id]
            result = step.result or None
            job = replace(job, done=step.done, total=step.total, note=step.note, eta_s=eta_s, result=result)
            self._table.set_progress(job)
        if step.view is not None:
            self._publish(JobView(job, step.view))

    def _answer(self, run: JobProcess, asked: SceneCommand) -> None:
        """Carry out what a job asks for, with the scene that it drives and no other."""
        scene = self._table[run.id].params.get("scene")
        try:
            if self._serve is None or asked.command.id != scene:
                raise UnknownName("scene of this job", asked.command.id, [str(scene)])
            answer = Answer(0, self._serve(asked.command))
        except OsfError as error:
            answer = Answer(0, error=error)
        run.order(answer)

    def _rest(self, run: JobProcess) -> None:
        """The job has come to the end of a round, and waits."""
        with self._changed:
            run.clock.switch(is_running=False)
            self._table.set(replace(self._table[run.id], state="paused", eta_s=None))

    # Folders

    def _take(self, job: Job, inputs: Path) -> None:
        place = self.inputs(job.id)
        try:
            place.parent.mkdir(parents=True)
            inputs.rename(place)
        except OSError as error:
            raise CannotStore(place, error.strerror or str(error)) from error

    def _forget_workshop(self, job: Job) -> None:
        """Remove what a cancelled training would find at its next try, unless another works there."""
        if job.kind != "train_field":
            return
        name = job.params["name"]
        if not any(other.id != job.id and other.params["name"] == name for other in self.live("train_field")):
            clear_workshop(self._data_dir, name)
