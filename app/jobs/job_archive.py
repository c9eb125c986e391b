"""Looking jobs up, and removing those that have finished."""

from __future__ import annotations

import contextlib
import shutil
import threading
import uuid
from collections.abc import Callable, Iterator
from pathlib import Path

from app.jobs.job import INPUTS, Job, JobEvent, JobPage, WrongJobState
from app.jobs.job_table import JobTable
from app.storage.database import CannotStore, Store

TEMPORARY_PREFIX = ".new-"  # folders beside the jobs' own that nobody needs after a restart


class JobArchive:
    """The jobs of one data directory and their folders.

    Args:
        store: where they are kept.
        root: the folder that holds one of each job.
        publish: told of every change.
    """

    def __init__(self, store: Store, root: Path, publish: Callable[[JobEvent], None]) -> None:
        self._root = root
        self._publish = publish
        self._changed = threading.Condition(threading.RLock())
        self._table = JobTable(store, publish)

    def all(self) -> tuple[Job, ...]:
        """All jobs, newest first."""
        with self._changed:
            return tuple(reversed(self._table.all()))

    def page(self, limit: int, before: int | None = None, kind: str | None = None) -> JobPage:
        """Some of the jobs, newest first, see `JobTable.page`."""
        with self._changed:
            return self._table.page(limit, before, kind)

    def get(self, job: str, kind: str | None = None) -> Job:
        """One job.

        Raises:
            UnknownName: if there is none of this name and kind.
        """
        with self._changed:
            return self._table.get(job, kind)

    def live(self, kind: str | None = None) -> tuple[Job, ...]:
        """Jobs of a kind, or of any, that wait, run or pause."""
        return tuple(job for job in self.all() if kind in (None, job.kind) and not job.is_finished)

    def forget(self, job: str) -> None:
        """Remove a finished job for good, with all its files.

        Raises:
            UnknownName: if there is none of this name.
            WrongJobState: if it has not finished.
            CannotStore: if the disk refuses; then it stays.
        """
        aside = self._root / f"{TEMPORARY_PREFIX}{uuid.uuid4().hex[:12]}"
        with self._changed:
            known = self.get(job)
            if not known.is_finished:
                raise WrongJobState(known, "removed; cancel it first")
            try:
                has_files = self.folder(job).is_dir()
                if has_files:
                    self.folder(job).rename(aside)
            except OSError as error:
                raise CannotStore(Path(self._root.name, job), error.strerror or str(error)) from error
            try:
                self._table.forget(known)
            except CannotStore:
                if has_files:
                    aside.rename(self.folder(job))
                raise
        shutil.rmtree(aside, ignore_errors=True)

    def folder(self, job: str) -> Path:
        """Where a job's outputs are."""
        return self._root / job

    def inputs(self, job: str) -> Path:
        """Where a job's inputs are, if it was given any."""
        return self.folder(job) / INPUTS

    @contextlib.contextmanager
    def new_inputs(self) -> Iterator[Path]:
        """Where a folder of inputs may be made for `submit`; what no job has taken is removed."""
        folder = self._root / f"{TEMPORARY_PREFIX}{uuid.uuid4().hex[:12]}"
        try:
            yield folder
        finally:
            shutil.rmtree(folder, ignore_errors=True)
