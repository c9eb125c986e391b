"""All jobs of a data directory: kept in memory, written through to the store, every change published."""

from __future__ import annotations

import time
from bisect import bisect_right
from collections.abc import Callable
from dataclasses import replace
from pathlib import Path
from typing import Any

from osfcore.errors import NotThere

from ..storage.database import Store
from ..storage.paths import without_places
from .job import Job, JobChanged, JobEvent, JobForgotten, JobPage, job_fields, job_from_fields
from .kinds import check_stored

_EVENT_INTERVAL_S = 0.25  # progress is sent to pages no more often than this


class JobTable:
    """Jobs by identifier, oldest first. Callers hold one lock around every call that changes something.

    A new job is stored before anybody hears of it. What becomes of it later is sent in any case, since a full disk must
    not stop work; what could not be stored is stored as soon as the disk takes it.

    Args:
        store: where they are kept.
        data_dir: whose place is left out of what pages see of jobs.
        publish: called with every change; progress is thinned out.
    """

    def __init__(self, store: Store, data_dir: Path, publish: Callable[[JobEvent], None]) -> None:
        self._store = store
        self._data_dir = data_dir
        self._publish = publish
        self._jobs: dict[str, Job] = {}
        self._numbers: dict[str, int] = {}
        self._last_event = 0.0
        self._held_back: Job | None = None  # the latest progress, if it came too soon after the one before

    def load(self) -> None:
        """Take over what the store holds."""
        for number, job in self._store.jobs(_readable):
            self._jobs[job.id], self._numbers[job.id] = job, number

    def __getitem__(self, job: str) -> Job:
        """One job as it is stored."""
        return self._jobs[job]

    def all(self) -> list[Job]:
        """All jobs with their places in the queue, oldest first."""
        waiting = self._waiting()
        return [self._shown(job, waiting) for job in list(self._jobs.values())]

    def page(
        self,
        limit: int,
        before: int | None = None,
        kind: str | None = None,
        fits: Callable[[Job], bool] = lambda _: True,
    ) -> JobPage:
        """Some of the jobs, newest first.

        Args:
            limit: how many at most.
            before: only jobs with smaller numbers; jobs that come or go meanwhile shift nothing.
            kind: only jobs of it.
            fits: only jobs for which it is true.
        """
        numbers = dict(self._numbers)  # read without a lock
        found = [
            job for job in list(self._jobs.values()) if kind in (None, job.kind) and job.id in numbers and fits(job)
        ]
        found.reverse()
        start = 0 if before is None else bisect_right(found, -before, key=lambda job: -numbers[job.id])
        shown, waiting = found[start : start + limit], self._waiting()
        is_last = start + limit >= len(found)
        jobs = tuple(self._shown(job, waiting) for job in shown)
        return JobPage(jobs, len(found), None if is_last else numbers[shown[-1].id])

    def get(self, job: str, kind: str | None = None) -> Job:
        """One job with its place in the queue.

        Raises:
            UnknownName: if there is none of this name and kind.
        """
        found = self._jobs.get(job)
        if found is None or kind not in (None, found.kind):
            raise NotThere(kind or "job")
        return self._shown(found, self._waiting() if found.state == "queued" else [])

    def queue(self) -> list[Job]:
        """Jobs that wait, the next one first."""
        return [job for job in list(self._jobs.values()) if job.state == "queued"]

    def live(self, kind: str | None = None) -> list[Job]:
        """Jobs of a kind, or of any, that wait, run or pause, oldest first."""
        return [job for job in list(self._jobs.values()) if kind in (None, job.kind) and not job.is_finished]

    def add(self, job: Job) -> None:
        """Keep a new job, the last of all.

        Raises:
            CannotStore: if the disk refuses; then there is no such job.
        """
        number = 1 + next(reversed(self._numbers.values()), 0)
        shown = replace(job, position=1 + len(self.queue()))
        event = self._store.save_job(job.id, number, job_fields(job), job_fields(shown))
        self._numbers[job.id], self._jobs[job.id] = number, job
        self._publish(JobChanged(event, shown))

    def forget(self, job: Job) -> None:
        """Keep a job no longer.

        Raises:
            CannotStore: if the disk refuses; then it is kept.
        """
        event = self._store.forget_job(job.id)
        del self._jobs[job.id], self._numbers[job.id]
        self._publish(JobForgotten(event, job))

    def set(self, job: Job) -> None:
        """Keep and publish a job's new state."""
        self._jobs[job.id] = job
        if self._held_back is not None and self._held_back.id == job.id:
            self._held_back = None
        self._keep(job)

    def set_progress(self, job: Job) -> None:
        """Keep a job's progress; held back for a moment if the last one was published just now."""
        self._jobs[job.id] = job
        now = time.monotonic()
        if now - self._last_event < _EVENT_INTERVAL_S:
            self._held_back = job
        else:
            self._last_event = now
            self.set(job)

    def flush_progress(self) -> None:
        """Publish progress that was held back, once its time has come, and write what the disk refused before."""
        self._store.retry()
        if self._held_back is not None:
            self.set_progress(self._held_back)

    def publish_queue(self) -> None:
        """Publish that positions in the queue have changed."""
        for job in self.queue():
            self._keep(job)

    def _waiting(self) -> list[str]:
        return [job.id for job in self.queue()]

    def _shown(self, job: Job, waiting: list[str]) -> Job:
        """A job with its place among those that wait and without the places of this machine."""
        error = None if job.error is None else without_places(job.error, self._data_dir)
        seen = replace(job, note=without_places(job.note, self._data_dir), error=error)
        if job.state != "queued":  # if it is, it may have begun just now: this is read without a lock
            return seen
        return replace(seen, position=1 + waiting.index(job.id)) if job.id in waiting else seen

    def _keep(self, job: Job) -> None:
        shown, number = self._shown(job, self._waiting()), self._numbers[job.id]
        event = self._store.save_job(  # a full disk must not stop the jobs
            job.id, number, job_fields(job), job_fields(shown), can_wait=True
        )
        self._publish(JobChanged(event, shown))


def _readable(fields: dict[str, Any]) -> Job:
    job = job_from_fields(fields)
    check_stored(job)
    return job
