"""A job process that is ready before anybody asks: loading code takes longer than the first push of an example."""

from __future__ import annotations

import logging
import math
import threading
from collections.abc import Callable
from pathlib import Path

from app.jobs.job import Job
from app.jobs.job_process import WHO, JobProcess
from app.jobs.worker import job_main
from app.processes.process_client import ProcessClient

_KINDS = ("episode", "estimate", "photo")  # what it has loaded the code of
_log = logging.getLogger(__name__)


class _Spare:
    """A process without a job."""

    def __init__(self) -> None:
        self.on_event: Callable[[object], None] | None = None
        self.client = ProcessClient(job_main, (True,), WHO, answer_s=math.inf, on_event=self._pass_on)
        self.client.start()

    @property
    def is_alive(self) -> bool:
        return self.client.status in ("starting", "ready")

    def _pass_on(self, event: object) -> None:
        if self.on_event is not None:
            self.on_event(event)


class Standby:
    """Starts the processes of jobs, and keeps one in reserve while no job runs. Any thread may call.

    Args:
        after_s: how long after the start, and after the end of a job, the next one is prepared [s]: whoever waits for
            the page or for a result comes first.
    """

    def __init__(self, after_s: float = 3.0) -> None:
        self._after_s = after_s
        self._lock = threading.Lock()
        self._spare: _Spare | None = None
        self._timer: threading.Timer | None = None
        self._is_stopped = False

    def prepare(self) -> None:
        """Have a process ready soon."""
        with self._lock:
            if self._is_stopped:
                return
            if self._timer is not None:
                self._timer.cancel()
            self._timer = threading.Timer(self._after_s, self._start)
            self._timer.daemon = True
            self._timer.start()

    def stop(self) -> None:
        """End the process in reserve. Calling it again does nothing."""
        with self._lock:
            self._is_stopped = True
            timer, spare, self._spare = self._timer, self._spare, None
        if timer is not None:
            timer.cancel()
        if spare is not None:
            spare.client.stop()

    def process(self, job: Job, data_dir: Path, folder: Path, on_event: Callable[[object], None]) -> JobProcess:
        """The process of a job, see `JobProcess`.

        Args:
            job: what to do.
            data_dir: of the service.
            folder: the job's own; exists.
            on_event: called from another thread with everything that the job tells.

        Raises:
            OSError: if there can be no more processes.
        """
        with self._lock:
            if self._timer is not None:
                self._timer.cancel()
            spare = self._spare if job.kind in _KINDS else None
            if spare is not None:
                self._spare = None
        if spare is not None and not spare.is_alive:
            spare.client.stop()
            spare = None
        if spare is not None:
            spare.on_event = on_event
        client = None if spare is None else spare.client
        return JobProcess(job, data_dir, folder, on_event, client=client, on_end=self.prepare)

    def _start(self) -> None:
        with self._lock:
            if self._is_stopped or (self._spare is not None and self._spare.is_alive):
                return
            try:
                self._spare = _Spare()
            except OSError as error:  # jobs start without it, only later
                _log.warning("no process could be prepared: %s", error.strerror)
