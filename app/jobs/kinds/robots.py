"""The job that drives a robot toward a goal photo.

It looks and draws a first plan, and then rests until somebody permits the robot to move: nothing has moved before, and
nothing moves without. Its goal photo lies in its inputs as `goal.png`. It leaves what `osf robot drive` leaves, and as
cameras/NAME.jpg what the cameras saw last, rewritten with every look.
"""

from __future__ import annotations

import contextlib
import threading
from collections.abc import Iterator
from dataclasses import dataclass, replace
from pathlib import Path
from typing import TYPE_CHECKING, Literal
from urllib.parse import quote

from osfcore.contrib.robots.robot import ConnectionLost, SafetyLimits
from osfcore.control.events import Finished, Observed, Planning
from osfcore.errors import OsfError
from osfcore.estimation.camera_response import srgb_of_linear
from osfcore.geometry.states import Observation
from osfcore.io.files import as_mapping, read_json, write_atomically, write_json
from osfcore.io.image_file import encode_jpeg, to_uint8

from ...episodes.file_names import CAMERAS_FOLDER, GOAL_FILE, REPORT_FILE, STOPPED
from ...episodes.progress import EpisodeProgress
from ...episodes.settings import StoredSettings
from ..job import INPUTS, Job
from ..kind import JobKind
from ..params import JobParams

if TYPE_CHECKING:
    from ...episodes.robot import RobotDrive
    from ..context import JobContext

Drives = Literal["looking", "asked", "driving", "over", "lost"]
_CANCELLED = "somebody stopped it"
_CANCELLED_SENTENCE = "The robot was stopped: its job was cancelled."


@dataclass(frozen=True, eq=False, slots=True)
class RobotProgress(EpisodeProgress):
    """How far an episode with a robot is.

    Attributes:
        drives: "looking" before anything may move, "asked" while a person is waited for, "driving", or how it ended.
        doubts: what a person should know before the robot moves.
    """

    drives: Drives = "looking"
    doubts: tuple[str, ...] = ()

    @property
    def must_be_reported(self) -> bool:
        """Whether whoever misses this would not know what the robot waits for."""
        return self.drives in ("asked", "lost")


class RobotParams(JobParams):
    """A robot, what it shall do, and how far and fast it may go.

    Attributes:
        url: of the robot.
        title: what the goal is called; None in jobs of earlier versions.
        names: of the objects.
        goal_camera: the name of the robot's camera that took the goal photo.
        boxes: by camera and object, its bounding box in the first images [px].
        seed: of the searches.
        settings: of the episode.
        box: least x, least y, greatest x and greatest y of the pusher [m].
        top_speed_m_s: of the pusher along each axis.
    """

    url: str
    title: str | None = None
    names: tuple[str, ...]
    goal_camera: str
    boxes: dict[str, dict[str, tuple[float, float, float, float]]]
    seed: int
    settings: StoredSettings
    box: tuple[float, float, float, float]
    top_speed_m_s: float


def robot_job(params: RobotParams, place: JobContext) -> Iterator[RobotProgress]:
    """Run an episode.

    Raises:
        OsfError: if the order cannot be met, the robot does not answer or was stopped, or the disk refuses.
    """
    from osfcore.fields.devices import use_one_thread

    from ...episodes.robot import DriveOrder, RobotDrive

    assert place.orders is not None, "the job's process sets it"
    use_one_thread()
    limits = SafetyLimits(params.box, params.top_speed_m_s)
    order = DriveOrder(
        params.url, params.names, place.folder / INPUTS / GOAL_FILE, place.folder, place.data_dir, params.goal_camera,
        boxes=params.boxes, limits=limits, seed=params.seed, settings=params.settings.of_loop(),
    )  # fmt: skip
    may_move = threading.Event()
    progress = RobotProgress(0, order.settings.steps, "Loading fields, half a minute the first time")
    yield progress
    try:
        with contextlib.closing(RobotDrive(order, may_move.is_set)) as drive:
            place.orders.on_cancel(lambda: drive.stop(_CANCELLED))
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
    assert place.orders is not None
    for event in drive.run():
        progress = replace(progress.after(event), doubts=drive.doubts)
        if isinstance(event, Finished):
            progress = replace(progress, drives="over")
        if isinstance(event, Observed):
            write_pictures(place.folder, event.observation)
        yield progress
        if isinstance(event, Planning) and not may_move.is_set():
            while not may_move.is_set():  # a job that was cancelled ends with the next line
                yield replace(progress, drives="asked", note="Waiting for permission to move")
                change = place.orders.next_change() or {}
                if change.get("allowed") is True:  # other parameters may change, too
                    may_move.set()
            progress = replace(progress, drives="driving")
            yield progress


def _stopped(job: Job, folder: Path) -> Job:
    """Write why the robot was stopped into a job that was broken off and its report, if that says of no other end.

    The job's process may have had no time for it, or may not have known the reason.
    """
    result = dict(job.result or {})
    if result.get("outcome") is None:
        why = job.error or _CANCELLED_SENTENCE
        path = folder / REPORT_FILE
        with contextlib.suppress(OsfError):  # whatever has become of the file, the job has the reason
            report = read_json(path, as_mapping)
            if report.get("outcome") in (None, STOPPED):
                write_json(path, {**report, "outcome": STOPPED, "text": why})
        result |= {"outcome": STOPPED, "text": why}
    return replace(job, result=result)


ROBOT = JobKind("robot", "episode with the robot", robot_job, RobotParams, keeps_steps=True, on_broken_off=_stopped)


# What the robot's cameras saw last, in the job's folder.


@dataclass(frozen=True, slots=True)
class CameraPicture:
    """What a camera saw.

    Attributes:
        jpeg: the picture.
        at_s: when it had been taken, since the epoch [s].
    """

    jpeg: bytes
    at_s: float


def write_pictures(folder: Path, seen: Observation) -> None:
    """Keep what all cameras see, as cameras encode it, in place of what they saw before.

    Raises:
        CannotWrite: if the disk refuses.
    """
    for camera, image in zip(seen.cameras, seen.images, strict=True):
        write_atomically(_picture_path(folder, camera.name), encode_jpeg(to_uint8(srgb_of_linear(image))))


def read_picture(folder: Path, camera: str) -> CameraPicture | None:
    """Return what a camera saw last; None if nothing was kept.

    Args:
        folder: of the job.
        camera: its name.
    """
    path = _picture_path(folder, camera)
    try:
        return CameraPicture(path.read_bytes(), path.stat().st_mtime)
    except OSError:
        return None


def _picture_path(folder: Path, camera: str) -> Path:
    return folder / CAMERAS_FOLDER / f"{quote(camera, safe='')}.jpg"  # names of ROS have slashes
