"""All jobs of a data directory: kept in memory, written through to the store, every change published."""

from __future__ import annotations

import logging
import time
from bisect import bisect_right
from collections.abc import Callable, Iterable
from dataclasses import replace
from itertools import islice

from app.jobs.job import Job, JobChanged, JobEvent, JobForgotten, JobPage, job_fields, job_from_fields
from app.storage.database import Store
from osfcore.errors import OsfError, UnknownName

_EVENT_INTERVAL_S = 0.25  # progress is told to pages no more often than this
_log = logging.getLogger(__name__)


class JobTable:
    """Jobs by identifier, oldest first. Callers hold one lock around every call.

    Args:
        store: where they are kept.
        publish: told of every change; progress is thinned out.
    """

    def __init__(self, store: Store, publish: Callable[[JobEvent], None]) -> None:
        self._store = store
        self._publish = publish
        self._jobs: dict[str, Job] = {}
        self._numbers: dict[str, int] = {}
        self._last_event = 0.0
        self._held_back: Job | None = None  # the latest progress, if it came too soon after the one before

    def load(self) -> None:
        """Take over what the store holds."""
        for number, fields in self._store.jobs():
            job = job_from_fields(fields)
            self._jobs[job.id], self._numbers[job.id] = job, number

    def __getitem__(self, job: str) -> Job:
        """One job as it is stored."""
        return self._jobs[job]

    def all(self) -> list[Job]:
        """All jobs with their places in the queue, oldest first."""
        return self._with_positions(self._jobs.values())

    def page(self, limit: int, before: int | None = None, kind: str | None = None) -> JobPage:
        """Some of the jobs, newest first.

        Args:
            limit: how many at most.
            before: only jobs with smaller numbers; jobs that come or go meanwhile shift nothing.
            kind: only jobs of it.
        """
        found = [job for job in reversed(self._jobs.values()) if kind in (None, job.kind)]
        start = 0 if before is None else bisect_right(found, -before, key=lambda job: -self._numbers[job.id])
        shown = found[start : start + limit]
        is_last = start + limit >= len(found)
        return JobPage(tuple(self._with_positions(shown)), len(found), None if is_last else self._numbers[shown[-1].id])

    def get(self, job: str, kind: str | None = None) -> Job:
        """One job with its place in the queue.

        Raises:
            UnknownName: if there is none of this name and kind.
        """
        found = self._jobs.get(job)
        if found is None or kind not in (None, found.kind):
            known = (other.id for other in reversed(self._jobs.values()) if kind in (None, other.kind))
            raise UnknownName(kind or "job", job[:80], islice(known, 5))
        return self._with_position(found)

    def queue(self) -> list[Job]:
        """Jobs that wait, the next one first."""
        return [job for job in self._jobs.values() if job.state == "queued"]

    def add(self, job: Job) -> None:
        """Keep a new job, the last of all."""
        self._numbers[job.id] = 1 + next(reversed(self._numbers.values()), 0)
        self.set(job)

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
        """Publish progress that was held back, once its time has come."""
        if self._held_back is not None:
            self.set_progress(self._held_back)

    def publish_queue(self) -> None:
        """Tell that positions in the queue have changed."""
        for job in self.queue():
            self._keep(job)

    def _with_position(self, job: Job) -> Job:
        if job.state != "queued":
            return job
        return replace(job, position=1 + [other.id for other in self.queue()].index(job.id))

    def _with_positions(self, jobs: Iterable[Job]) -> list[Job]:
        places = {job.id: place for place, job in enumerate(self.queue(), 1)}
        return [replace(job, position=places[job.id]) if job.id in places else job for job in jobs]

    def _keep(self, job: Job) -> None:
        shown = self._with_position(job)
        number = 0
        try:
            self._store.save_job(job.id, self._numbers[job.id], job_fields(job))
            number = self._store.add_event(job_fields(shown))
        except OsfError as error:  # a full disk must not stop the jobs
            _log.error("job %s: %s", job.id, error)
        self._publish(JobChanged(number, shown))
