"""The process of the one job that runs: its orders, its outcome, how long it is waited for."""

from __future__ import annotations

import logging
import math
import threading
import time
from collections.abc import Callable
from concurrent.futures import TimeoutError as FutureTimeoutError
from pathlib import Path
from typing import Any

from osfcore.errors import OsfError

from ..processes.client import ProcessClient, ProcessFrozen, ProcessUnavailable
from .context import CancelJob, JobCancelled, RunJob
from .job import Job
from .kinds import KINDS
from .worker import job_main

WHO = "job"
_CHECK_S, _CANCELLED_CHECK_S = 0.2, 0.05


class JobStopped(OsfError):
    """The service stopped before the job had finished."""

    def __init__(self) -> None:
        super().__init__("The service stopped while this job was running; start it again.")


class JobDied(OsfError):
    """The job's process ended without a word, or was frozen and ended."""

    def __init__(self, what: str = "ended unexpectedly; it may have run out of memory or time") -> None:
        super().__init__(f"The job's process {what}.")


Outcome = dict[str, Any] | JobCancelled | OsfError  # a result, or why there is none


class JobProcess:
    """A job at work.

    Args:
        job: what to do.
        data_dir: of the service.
        folder: the job's own; exists.
        on_event: called from another thread with everything that the job reports.
        client: a process that runs already; started here if None.
        on_end: called once the process has ended.

    Raises:
        OSError: if there can be no more processes.
    """

    def __init__(
        self,
        job: Job,
        data_dir: Path,
        folder: Path,
        on_event: Callable[[object], None],
        *,
        client: ProcessClient | None = None,
        on_end: Callable[[], None] = lambda: None,
    ) -> None:
        self.id = job.id
        self.clock = JobClock()
        self._cancel_at = math.inf  # when patience with a cancelled job ends
        self._on_end = on_end
        self._client = client or ProcessClient(job_main, (), WHO, answer_s=math.inf)
        self._client.on_event = on_event
        self._client.start()  # does nothing where it runs
        self._answer = self._client.submit(RunJob(job.kind, job.params, data_dir, folder))

    @property
    def pid(self) -> int | None:
        """Of the process that runs."""
        return self._client.process.pid if self._client.process else None

    @property
    def is_cancelled(self) -> bool:
        """Whether it was asked to stop."""
        return self._cancel_at < math.inf

    def order(self, message: object) -> bool:
        """Send an order or an answer; returns False if the process has ended or does not listen."""
        return self._client.notify(message)

    def cancel(self, grace_s: float) -> None:
        """Ask it to stop, and to wait no longer than `grace_s` until it has. Calling it again does nothing."""
        if not self.is_cancelled:
            self._cancel_at = time.monotonic() + grace_s
            self.order(CancelJob())

    def wait(self) -> Outcome | None:
        """What has become of the job; None if after a moment it still works."""
        try:
            return self._answer.result(_CANCELLED_CHECK_S if self.is_cancelled else _CHECK_S)
        except FutureTimeoutError:
            return JobCancelled() if time.monotonic() > self._cancel_at else None
        except ProcessUnavailable as error:
            if error.who != WHO:
                return error
            return JobDied("was frozen and had to be ended") if isinstance(error, ProcessFrozen) else JobDied()
        except OsfError as error:
            return error

    def end(self) -> None:
        """End the process and its children."""
        self._client.stop()
        self._on_end()


# How fast a job goes, and how long it will take.


class JobClock:
    """Estimate the time left of a job, pauses left out.

    Args:
        now_s: the time that counts [s].
    """

    def __init__(self, now_s: Callable[[], float] = time.monotonic) -> None:
        self._now_s = now_s
        self._first: tuple[int, float] | None = None
        self._paused_at: float | None = None
        self._paused_s = 0.0

    def switch(self, *, is_running: bool) -> None:
        """The job pauses, or goes on."""
        now = self._now_s()
        if not is_running:
            self._paused_at = now
        elif self._paused_at is not None:
            self._paused_s += now - self._paused_at
            self._paused_at = None

    def left_s(self, done: int, total: int) -> float | None:
        """Time left [s], once there is something to go by; it counts from when the total is known."""
        if total == 0:
            return None
        now = self._now_s() - self._paused_s
        if self._first is None:
            self._first = (done, now)
        first_done, start = self._first
        if done <= first_done:
            return None
        return round((now - start) / (done - first_done) * (total - done), 1)


# A job process that is ready before anybody asks: loading code takes longer than the first push of an example.


_log = logging.getLogger(__name__)


class Standby:
    """Starts the processes of jobs, and keeps one in reserve while no job runs. Any thread may call.

    Args:
        after_s: how long after the start, and after the end of a job, the next one is prepared [s]: whoever waits for
            the page or for a result comes first.
    """

    def __init__(self, after_s: float = 3.0) -> None:
        self._after_s = after_s
        self._lock = threading.Lock()
        self._spare: ProcessClient | None = None
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
            spare.stop()

    def process(self, job: Job, data_dir: Path, folder: Path, on_event: Callable[[object], None]) -> JobProcess:
        """The process of a job, see `JobProcess`.

        Args:
            job: what to do.
            data_dir: of the service.
            folder: the job's own; exists.
            on_event: called from another thread with everything that the job reports.

        Raises:
            OSError: if there can be no more processes.
        """
        with self._lock:
            if self._timer is not None:
                self._timer.cancel()
            spare = None
            if KINDS[job.kind].preloads:
                spare, self._spare = self._spare, None
        if spare is not None and spare.status == "restarting":  # it has died
            spare.stop()
            spare = None
        return JobProcess(job, data_dir, folder, on_event, client=spare, on_end=self.prepare)

    def _start(self) -> None:
        with self._lock:
            if self._is_stopped or (self._spare is not None and self._spare.status != "restarting"):
                return
            spare = ProcessClient(job_main, (True,), WHO, answer_s=math.inf)
            try:
                spare.start()
                self._spare = spare
            except OSError as error:  # jobs start without it, only later
                _log.warning("no process could be prepared: %s", error.strerror)
