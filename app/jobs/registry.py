"""The job registry: one job runs at a time in a process of its own, the others wait their turn.

A service that stops fails the job it was running; waiting ones go on after the next start.
"""

from __future__ import annotations

import contextlib
import shutil
import threading
import uuid
from collections.abc import Callable
from dataclasses import replace
from pathlib import Path
from typing import Any

from osfcore.errors import OsfError

from ..processes.messages.scene_messages import JobCommand
from ..storage.database import CannotStore, Store
from .context import ChangeJob, PauseJob, ResumeJob, StepJob
from .folders import JobFolders
from .job import Job, JobEvent, JobPage, State, ended
from .kinds import KINDS, in_words
from .loop import JobLoop, StartProcess, after, clear_cancelled
from .process import JobProcess, JobStopped
from .table import JobTable


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


class QueueFull(OsfError):
    """Too many jobs wait already."""

    def __init__(self, limit: int) -> None:
        super().__init__(f"{limit} jobs are waiting already, which is the most; wait for one or cancel one.")


class Jobs:
    """All jobs of one data directory.

    Args:
        store: where they are kept.
        data_dir: objects are read from it, outputs go to `collections/JOB` in it.
        publish: called with every change, and with what running jobs let the live view draw.
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
        serve: Callable[[JobCommand], Any] | None = None,
        start_process: StartProcess = JobProcess,
    ) -> None:
        self._data_dir = data_dir
        self._folders = JobFolders(data_dir)
        self._max_queued = max_queued
        self._cancel_grace_s = cancel_grace_s
        self._changed = threading.Condition(threading.RLock())
        self._table = JobTable(store, data_dir, publish)
        self._loop = JobLoop(self._changed, self._table, data_dir, publish, serve, start_process)

    def start(self) -> None:
        """Take over what the store holds, remove what was left half done, and begin to work."""
        self._folders.sweep()
        self._table.load()
        for job in self._table.all():
            if job.state in ("running", "paused"):
                self._table.set(after(job, JobStopped(), self.folder(job.id)))
        self._loop.start()

    def stop(self) -> None:
        """End the running job, which counts as failed. Calling it again does nothing."""
        self._loop.stop()

    @property
    def problem(self) -> str | None:
        """Why no job goes on, for people; None if all is well."""
        return self._loop.problem

    # What pages and programs ask for

    # (reading takes no lock: whoever writes to the disk holds it, and the event loop must not wait for that)

    def all(self) -> tuple[Job, ...]:
        """All jobs, newest first."""
        return tuple(reversed(self._table.all()))

    def page(
        self,
        limit: int,
        before: int | None = None,
        kind: str | None = None,
        fits: Callable[[Job], bool] = lambda _: True,
    ) -> JobPage:
        """Some of the jobs, newest first, see `JobTable.page`."""
        return self._table.page(limit, before, kind, fits)

    def rename(self, job: str, title: str) -> Job:
        """Call a job something else, whatever its state.

        Raises:
            UnknownName: if there is no such job.
        """
        with self._changed:
            params = {**self.get(job).params, "title": title}
            self._table.set(replace(self._table[job], params=params))
            return self.get(job)

    def get(self, job: str, kind: str | None = None) -> Job:
        """One job.

        Raises:
            UnknownName: if there is none of this name and kind.
        """
        return self._table.get(job, kind)

    def live(self, kind: str | None = None) -> tuple[Job, ...]:
        """Jobs of a kind, or of any, that wait, run or pause."""
        return tuple(self._table.live(kind))

    def folder(self, job: str) -> Path:
        """Where a job's outputs are."""
        return self._folders.folder(job)

    def holder(self, scene: str) -> Job | None:
        """The job that drives a scene now, if one does: its parameters name it as "scene"."""
        return next((job for job in self.live() if job.scene == scene and job.state == "running"), None)

    def needs(self, scene: str) -> Job | None:
        """A job that waits, runs or pauses and drives a scene, if there is one."""
        return next((job for job in self.live() if job.scene == scene), None)

    def inputs(self, job: str) -> Path:
        """Where a job's inputs are, if it was given any."""
        return self._folders.inputs(job)

    def new_inputs(self) -> contextlib.AbstractContextManager[Path]:
        """Where a folder of inputs may be made for `submit`; what no job has taken is removed."""
        return self._folders.new_inputs()

    def submit(self, kind: str, params: dict[str, Any], inputs: Path | None = None) -> Job:
        """Put a job into the queue.

        Args:
            kind: what to do.
            params: with what.
            inputs: a folder from `new_inputs`; becomes the job's and goes with it.

        Raises:
            QueueFull: if too many wait already.
            CannotStore: if the disk refuses the job or its inputs; then nothing of it is left.
        """
        with self._changed:
            if len(self._table.queue()) >= self._max_queued:
                raise QueueFull(self._max_queued)
            job = Job(uuid.uuid4().hex[:12], kind, params)
            try:
                if inputs is not None:
                    self._folders.take(job.id, inputs)
                self._table.add(job)
            except OsfError:
                shutil.rmtree(self.folder(job.id), ignore_errors=True)
                raise
            self._changed.notify_all()
            return self.get(job.id)

    def cancel(self, job: str, wait_s: float = 3.0, why: str | None = None) -> Job:
        """Take a job out of the queue or end it; waits until it has ended.

        Args:
            job: identifier.
            wait_s: for how long at most [s].
            why: a sentence that the job shows from then on, where that is not clear.

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
                clear_cancelled(self._data_dir, self._table, known)
                self._table.set(ended(self._table[job], "cancelled", note="Cancelled", error=why))
                self._table.publish_queue()
                return self.get(job)
            if self._loop.run is not None:
                self._loop.run.cancel(0.0 if KINDS[known.kind].ends_at_once else self._cancel_grace_s)
            if known.error is None and why is not None:
                self._table.set(replace(self._table[job], error=why))
            self._changed.wait_for(lambda: self._table[job].is_finished, wait_s)
            return self.get(job)

    def forget(self, job: str) -> None:
        """Remove a finished job for good, with all its files.

        Raises:
            UnknownName: if there is no such job.
            WrongJobState: if it has not finished.
            CannotStore: if the disk refuses; then it is still listed, perhaps without files.
        """
        with self._changed:
            known = self.get(job)
            if not known.is_finished:
                raise WrongJobState(known, "removed; cancel it first")
            aside = self._folders.put_aside(job)
            try:
                self._table.forget(known)
            except CannotStore:  # on a full disk the files must go first, to make room for saying so
                shutil.rmtree(aside, ignore_errors=True)
                self._table.forget(known)
        shutil.rmtree(aside, ignore_errors=True)

    def pause(self, job: str) -> Job:
        """Let a running job rest after its current step.

        Raises:
            UnknownName: if there is no such job.
            WrongJobState: if it is not running, or is just ending.
        """
        return self._switch(job, "running", "paused", PauseJob())

    def resume(self, job: str) -> Job:
        """Let a paused job go on.

        Raises:
            UnknownName: if there is no such job.
            WrongJobState: if it is not paused, or is just ending.
        """
        return self._switch(job, "paused", "running", ResumeJob())

    def step(self, job: str) -> Job:
        """Let a paused job go on to the end of its round, and rest again.

        Raises:
            UnknownName: if there is no such job.
            WrongJobState: if it is not paused, or is just ending.
        """
        return self._switch(job, "paused", "running", StepJob())

    def change(self, job: str, params: dict[str, Any]) -> Job:
        """Let a running or paused job work with other parameters from now on.

        Raises:
            UnknownName: if there is no such job.
            WrongJobState: if it neither runs nor pauses, or is just ending.
        """
        with self._changed:
            self._order(job, ("running", "paused"), ChangeJob(params), "changed")
            known = self._table[job]
            self._table.set(replace(known, params={**known.params, **params}))
            return self.get(job)

    def _switch(self, job: str, before: State, after: State, order: PauseJob | ResumeJob | StepJob) -> Job:
        with self._changed:
            run = self._order(job, (before,), order, "paused" if after == "paused" else "resumed")
            run.clock.switch(is_running=after == "running")
            self._table.set(replace(self._table[job], state=after, eta_s=None))
            return self.get(job)

    def _order(self, job: str, states: tuple[State, ...], order: object, wanted: str) -> JobProcess:
        """Give an order to a job that must be in one of these states; returns its process."""
        known, run = self.get(job), self._loop.run
        if known.state not in states or run is None or run.is_cancelled:
            raise WrongJobState(known, wanted)
        if not run.order(order):
            raise WrongJobState(known, wanted, is_over=True)
        return run
