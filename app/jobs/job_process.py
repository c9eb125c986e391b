"""The process of the one job that runs: its orders, its outcome, how long it is waited for."""

from __future__ import annotations

import math
import time
from collections.abc import Callable
from concurrent.futures import TimeoutError as FutureTimeoutError
from pathlib import Path

from app.jobs.clock import JobClock
from app.jobs.job import Job
from app.jobs.outcomes import JobDied, Outcome
from app.jobs.worker import job_main
from app.processes.messages.job_messages import CancelJob, JobCancelled, RunJob
from app.processes.process_client import ProcessClient, ProcessFrozen, ProcessUnavailable
from osfcore.errors import OsfError

WHO = "job"
_CHECK_S, _CANCELLED_CHECK_S = 0.2, 0.05


class JobProcess:
    """A job at work.

    Args:
        job: what to do.
        data_dir: of the service.
        folder: the job's own; exists.
        on_event: called from another thread with everything that the job tells.
        client: a process that runs already, and passes on what it tells; started here if None.
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
        self._client = client or ProcessClient(job_main, (), WHO, answer_s=math.inf, on_event=on_event)
        self._client.start()  # does nothing where it runs
        self._answer = self._client.submit(RunJob(job.kind, job.params, data_dir, folder))

    @property
    def pid(self) -> int | None:
        """Of the process that runs."""
        return self._client.process.pid if self._client.process else None

    @property
    def is_cancelled(self) -> bool:
        """Whether it was told to stop."""
        return self._cancel_at < math.inf

    def order(self, message: object) -> bool:
        """Send an order or an answer; returns False if the process has ended or does not listen."""
        return self._client.notify(message)

    def cancel(self, grace_s: float) -> None:
        """Tell it to stop, and to wait no longer than `grace_s` until it has. Calling it again does nothing."""
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
