"""The job that drives a robot toward a goal photo.

It looks and draws a first plan, and then rests until it is told that the robot may move: nothing has moved before, and
nothing moves without. Its goal photo lies in its inputs as `goal.png`. It leaves what `osf robot drive` leaves.
"""

from __future__ import annotations

import contextlib
import threading
from collections.abc import Iterator
from dataclasses import dataclass, replace
from pathlib import Path
from typing import TYPE_CHECKING, Any, Literal

from app.episodes.file_names import GOAL_FILE
from app.episodes.robots.stopped_report import STOPPED as REPORT_STOPPED
from app.episodes.robots.stopped_report import tell_stopped
from app.jobs.job import INPUTS, Job
from app.jobs.kind import JobKind
from app.jobs.kinds.episodes import settings_of, use_one_thread
from osfcore.contrib.robots.robot import ConnectionLost, SafetyLimits

if TYPE_CHECKING:
    from app.episodes.robots.robot_drive import DriveOrder, RobotDrive
    from app.jobs.context import JobContext
    from osfcore.control.events import Event

Drives = Literal["looking", "asked", "driving", "over", "lost"]
STOPPED = "somebody stopped it"


@dataclass(frozen=True, slots=True)
class RobotProgress:
    """How far an episode with a robot is.

    Attributes:
        done: actions executed.
        total: actions at most.
        note: what is being done, for a person.
        drives: "looking" before anything may move, "asked" while a person is waited for, "driving", or how it ended.
        outcome: how it ended; only at the end.
        text: the same in a sentence.
        doubts: what a person should know before the robot moves.
    """

    done: int
    total: int
    note: str
    drives: Drives = "looking"
    outcome: str | None = None
    text: str | None = None
    doubts: tuple[str, ...] = ()

    @property
    def must_be_told(self) -> bool:
        """Whether whoever misses this would not know what the robot waits for."""
        return self.drives in ("asked", "lost")


def robot_job(params: dict[str, Any], place: JobContext) -> Iterator[RobotProgress]:
    """Run an episode.

    Raises:
        OsfError: if the order cannot be met, the robot does not answer or was stopped, or the disk refuses.
    """
    from app.episodes.robots.robot_drive import RobotDrive

    assert place.orders is not None, "the job's process sets it"
    use_one_thread()
    order, may_move = _order(params, place), threading.Event()
    progress = RobotProgress(0, order.settings.steps, "Loading fields, half a minute the first time")
    yield progress
    try:
        with contextlib.closing(RobotDrive(order, may_move.is_set)) as drive:
            place.orders.on_cancel(lambda: drive.stop(STOPPED))
            for step in _driven(drive, progress, may_move, place):
                progress = step
                yield step
            yield replace(progress, note="Writing video")
            drive.finish()
    except ConnectionLost as error:
        yield replace(progress, drives="lost", note=str(error), text=str(error))
        raise
    yield replace(progress, note=progress.text or progress.note)


def _driven(
    drive: RobotDrive, progress: RobotProgress, may_move: threading.Event, place: JobContext
) -> Iterator[RobotProgress]:
    from app.episodes.robots.camera_files import write_pictures
    from osfcore.control.events import Observed, Planning

    assert place.orders is not None
    progress = replace(progress, doubts=drive.doubts)
    for event in drive.run():
        progress = _after(progress, event)
        if isinstance(event, Observed):
            write_pictures(place.folder, event.observation)
        yield progress
        if isinstance(event, Planning) and not may_move.is_set():
            while not may_move.is_set():
                yield replace(
                    progress, drives="asked", note="Waiting for permission to move"
                )  # cancelled, it ends here
                change = place.orders.next_change() or {}
                if change.get("allowed") is True:  # other parameters may change, too
                    may_move.set()
            progress = replace(progress, drives="driving")
            yield progress


def _after(progress: RobotProgress, event: Event) -> RobotProgress:
    from app.episodes.event_notes import note_of
    from osfcore.control.events import ActionExecuted, Finished, Stepped

    progress = replace(progress, note=note_of(event) or progress.note)
    match event:
        case ActionExecuted(number):
            return replace(progress, done=number)
        case Stepped():
            return replace(progress, total=event.steps)
        case Finished(_, outcome, text):
            return replace(progress, drives="over", outcome=outcome, text=text, note=text)
        case _:
            return progress


def _order(params: dict[str, Any], place: JobContext) -> DriveOrder:
    from app.episodes.robots.robot_drive import DriveOrder

    goal: Path = place.folder / INPUTS / GOAL_FILE
    limits = SafetyLimits((*params["box"],), params["top_speed_m_s"])  # pyright: ignore[reportArgumentType]
    return DriveOrder(
        params["url"], tuple(params["names"]), goal, place.folder, place.data_dir, params["goal_camera"],
        boxes=params["boxes"], limits=limits, seed=params["seed"], settings=settings_of(params["settings"]),
    )  # fmt: skip


_WITHOUT_A_WORD = "The robot was stopped: its job was cancelled."


def _stopped(job: Job, folder: Path) -> Job:
    """Return the job of a robot that was broken off with the reason in it and, in the same words, in its report."""
    result = dict(job.result or {})
    if result.get("outcome") is None:
        why = job.error or _WITHOUT_A_WORD
        tell_stopped(folder, why)
        result |= {"outcome": REPORT_STOPPED, "text": why}
    return replace(job, result=result)


ROBOT = JobKind("robot", "episode with the robot", robot_job, keeps_steps=True, on_broken_off=_stopped)
