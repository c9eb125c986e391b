"""The robot of a service: what its cameras see, episodes on its table, permission for the first motion, and a stop."""

from __future__ import annotations

import contextlib
import threading
import time
from collections.abc import Callable, Mapping
from dataclasses import dataclass, field
from pathlib import Path
from typing import Literal
from urllib.parse import urlsplit

import cv2
import numpy as np
from jaxtyping import UInt8

from osfcore.contrib.robots.connect import check_address, connect
from osfcore.contrib.robots.http_robot import KEPT_SIDE, HttpRobot
from osfcore.contrib.robots.robot import RobotDescription, SafetyLimits
from osfcore.errors import OsfError, check_known, check_unique, shown
from osfcore.geometry.cameras import Camera
from osfcore.io.image_file import encode_jpeg

from ..episodes.file_names import GOAL_FILE
from ..episodes.settings import ChosenSettings
from ..jobs.job import Job, JobChanged
from ..jobs.kinds.robots import CameraPicture, RobotParams, read_picture
from ..storage.photos import PhotoReader
from .event_hub import Notice
from .fields import FieldCatalogue
from .goals import Goals
from .runner import Runner, fill_inputs
from .service_settings import Settings

FRESH_S = 1.0  # the robot is not asked again before: for pictures, or whether it answers by now
KIND = "robot"
LEASE_S = 3.0  # without a word from the page that let the robot move
_STOP_WAIT_S = 0.5  # for the robot to confirm a stop, before the answer
_GONE = "the page that let it move was closed, or has lost its connection"

State = Literal["idle", "looking", "asked", "driving", "stopped", "lost"]
Boxes = Mapping[str, Mapping[str, tuple[float, float, float, float]]]


class NoRobot(OsfError):
    """The service was started without a robot."""

    def __init__(self) -> None:
        super().__init__("This service has no robot; whoever starts it can name one: osf serve --robot URL.")


class NoPicture(OsfError):
    """A camera that has shown nothing yet.

    Args:
        camera: its name.
        reason: why, a sentence; "" if nothing went wrong.
    """

    def __init__(self, camera: str, reason: str) -> None:
        why = reason or "It comes with the first look of the episode."
        super().__init__(f"There is no picture of the robot's camera {shown(camera)} yet. {why}")


@dataclass(frozen=True, eq=False, slots=True)
class CameraNow:
    """A camera and what it saw last.

    Attributes:
        camera: of the robot, as its pictures are kept.
        picture: None if it has shown nothing yet.
    """

    camera: Camera
    picture: CameraPicture | None


class RobotPictures:
    """The last pictures of a robot's cameras, whoever took them. Methods block; any thread may call.

    While an episode looks or moves, its own looks are what is shown: pictures besides could hold up the robot. At any
    other time whoever asks has the robot look, if the last attempt is more than a second old.

    Args:
        cameras: returns those of the robot; raises OsfError if it has never answered.
        take: takes a picture file with each of them; raises OsfError if it does not answer.
        read: decodes such a file; raises OsfError if it cannot be used.
        may_look: returns whether that disturbs nobody.
        episode: returns the folder of the latest episode, if there is one.
        fresh_s: age from which on a new picture is taken [s].
    """

    def __init__(
        self,
        cameras: Callable[[], tuple[Camera, ...]],
        take: Callable[[], tuple[bytes, ...]],
        read: Callable[[bytes], UInt8[np.ndarray, "h w 3"]],
        may_look: Callable[[], bool],
        episode: Callable[[], Path | None],
        fresh_s: float = FRESH_S,
    ) -> None:
        self._cameras, self._take, self._read = cameras, take, read
        self._may_look, self._episode, self._fresh_s = may_look, episode, fresh_s
        self._looking = threading.Lock()
        self._tried_at = -fresh_s
        self._problem = ""
        self._own: dict[str, CameraPicture] = {}

    def all(self) -> tuple[CameraNow, ...]:
        """Return all cameras with what they saw last.

        Raises:
            NoRobot: if there is none.
            ConnectionLost, RobotRefused: if it has never answered.
        """
        cameras = self._cameras()
        is_first = not self._own and not self._problem  # who comes during the first look waits for it
        if self._looking.acquire(blocking=is_first):
            try:
                if self._may_look() and time.monotonic() - self._tried_at >= self._fresh_s:
                    self._look(cameras)
                    self._tried_at = time.monotonic()
            finally:
                self._looking.release()
        own, folder = self._own, self._episode()
        seen = []
        for camera in cameras:
            kept = None if folder is None else read_picture(folder, camera.name)
            known = [picture for picture in (kept, own.get(camera.name)) if picture is not None]
            seen.append(CameraNow(camera, max(known, key=lambda picture: picture.at_s, default=None)))
        return tuple(seen)

    def one(self, name: str) -> CameraPicture:
        """Return what one camera saw last.

        Raises:
            UnknownName: if there is no such camera.
            NoPicture: if it has shown nothing yet.
            NoRobot, ConnectionLost, RobotRefused: as above.
        """
        known = {now.camera.name: now.picture for now in self.all()}
        check_known("camera of the robot", [name], known)
        picture = known[name]
        if picture is None:
            raise NoPicture(name, self._problem)
        return picture

    def _look(self, cameras: tuple[Camera, ...]) -> None:
        """Take pictures; if the robot does not answer, those before are still the last ones."""
        try:
            jpegs = [_small_jpeg(self._read(file)) for file in self._take()]
        except OsfError as error:
            self._problem = str(error)
            return
        pictures = [CameraPicture(jpeg, time.time()) for jpeg in jpegs]
        self._problem = ""
        self._own = {camera.name: picture for camera, picture in zip(cameras, pictures, strict=True)}


def _small_jpeg(image: UInt8[np.ndarray, "h w 3"]) -> bytes:
    """Encode a picture, no larger than estimates look at."""
    scale = KEPT_SIDE / max(image.shape[:2])
    if scale < 1:
        size = (round(scale * image.shape[1]), round(scale * image.shape[0]))
        image = cv2.resize(image, size, interpolation=cv2.INTER_AREA)
    return encode_jpeg(image)


# Episodes on its table, and their stop.


class RobotBusy(OsfError):
    """A robot does one thing at a time."""

    def __init__(self) -> None:
        super().__init__("The robot has an episode already; stop it first.")


class NothingAsked(OsfError):
    """A permission that nothing waits for."""

    def __init__(self) -> None:
        super().__init__("No episode of this name waits for permission to move the robot.")


@dataclass(frozen=True, eq=False, slots=True)
class AskedDrive:
    """An episode that is asked for.

    Attributes:
        goal: identifier of a goal image that one of its cameras took.
        names: of the objects on its table.
        boxes: around the objects, by camera and name, if the robot delivers no masks [px].
        seed: of the searches.
        settings: how it goes.
    """

    goal: str
    names: tuple[str, ...]
    boxes: Boxes = field(default_factory=dict)
    seed: int = 0
    settings: ChosenSettings = field(default_factory=ChosenSettings.defaults)


@dataclass(frozen=True, eq=False, slots=True)
class RobotNow:
    """The state of the robot.

    Attributes:
        host: where it is; None if there is none.
        state: what it does.
        text: the same for a person, or what went wrong.
        episode: job that drives it, or did last.
        limits: of its pusher: the service's, and within them the robot's own once it has answered.
        description: of itself; None while it has not answered.
    """

    host: str | None
    state: State = "idle"
    text: str = ""
    episode: Job | None = None
    limits: SafetyLimits | None = None
    description: RobotDescription | None = None


class RobotTable:
    """The robot of a service; `pictures` has what its cameras saw last. Any thread may call; all but `here` block.

    Args:
        settings: of the service: which robot, and its limits. No request can name another one.
        runner: has the jobs.
        fields: what can be recognised.
        goals: goal images.
        lease_s: for how long a page that let it move may be silent [s].

    Raises:
        InvalidInput, UnknownName: if it is no address of a robot, or a limit makes no sense.
    """

    def __init__(
        self, settings: Settings, runner: Runner, fields: FieldCatalogue, goals: Goals, lease_s: float = LEASE_S
    ) -> None:
        self._url, self._runner, self._fields, self._goals = settings.robot, runner, fields, goals
        self._lease_s = lease_s
        self._limits = limits_of(settings)
        self._host = None if self._url is None else host_of(self._url)
        self._about: RobotDescription | None = None
        self._line: HttpRobot | None = None  # of its own, for stops and pictures; a stop waits for no picture
        self._connecting, self._ordering = threading.Lock(), threading.Lock()
        self._lost: OsfError | None = None  # why it did not answer when it was last asked what it is
        self._tried_at = 0.0  # when that was
        self._stopped: dict[str, str] = {}  # why the job was stopped that was stopped last
        self._watched: tuple[str, float] | None = None  # the page that let it move, and when it was last heard of
        self._leave: Callable[[], None] = lambda: None
        self._reader = PhotoReader()  # of its own: what a robot sends holds up nobody's photos
        self.pictures = RobotPictures(
            lambda: self._described().cameras, self._take, lambda file: self._reader.read(file).pixels,
            self._may_look, self._latest_folder,
        )  # fmt: skip

    def start(self) -> None:
        """Cancel what an earlier service was asked for: perhaps it had another robot."""
        for job in self._runner.jobs.live(KIND):
            with contextlib.suppress(OsfError):
                self._runner.jobs.cancel(job.id)
        self._leave = self._runner.hub.subscribe(self._hear)

    def close(self) -> None:
        """Stop the robot and let it go."""
        live = self._live()
        if live is not None:
            self.stop("the service was ended")
            self._cancel(live.id)  # again, until it has ended: what comes next would not let it
        self._leave()
        if self._line is not None:
            self._line.close()
        self._reader.stop()

    def now(self) -> RobotNow:
        """Return the state of the robot; connect to it if that has not come about yet."""
        if self._url is None:
            return RobotNow(None)
        try:
            self._described()
        except OsfError as error:
            return RobotNow(self._host, "lost", str(error), self._latest(), self._limits)
        return self._now()

    def begin(self, asked: AskedDrive) -> RobotNow:
        """Queue an episode, which looks and plans, and then asks.

        Raises:
            NoRobot: if there is none.
            ConnectionLost, RobotRefused: if it does not answer.
            UnknownName: if there is no such goal, or no camera of the robot took it.
            MissingFields, InvalidInput: if an object cannot be recognised.
            RobotBusy: if it has one.
            QueueFull, StorageFull, CannotStore: if nothing more can be taken.
        """
        cameras = [camera.name for camera in self._described().cameras]
        assert self._url is not None, "or it had not been described"
        goal = self._goals.get(asked.goal)
        check_known("camera of the robot", [goal.camera.name], cameras)
        check_unique("objects", asked.names, "each named once")
        self._fields.require(asked.names, "ours")
        params = RobotParams(
            url=self._url, title=goal.name, names=asked.names, goal_camera=goal.camera.name,
            boxes={camera: dict(boxes) for camera, boxes in asked.boxes.items()}, seed=asked.seed,
            settings=asked.settings, box=self._limits.box, top_speed_m_s=self._limits.top_speed_m_s,
        )  # fmt: skip
        with self._ordering, self._runner.jobs.new_inputs() as folder:
            if self._live() is not None:
                raise RobotBusy
            fill_inputs(folder, {GOAL_FILE: self._goals.image(goal.id)})
            self._runner.submit_with_inputs(KIND, params, folder)
        return self._now()

    def allow(self, episode: str, page: str | None) -> RobotNow:
        """Let the robot move.

        Args:
            episode: that asks.
            page: that says so; soon after it was last heard of, the robot is stopped. None for programs: nobody
                watches them.

        Raises:
            NothingAsked: if no such episode waits for it.
        """
        job = self._live()
        if job is None or job.id != episode or self._state_of(job)[0] != "asked":
            raise NothingAsked
        if page is not None:
            self._watched = page, time.monotonic()
            threading.Thread(target=self._watch, args=(job.id,), name="robot lease", daemon=True).start()
        self._runner.jobs.change(job.id, {"allowed": True})
        return self._now()

    def here(self, page: str) -> None:
        """Note that a page is there; does not block."""
        if self._watched is not None and self._watched[0] == page:
            self._watched = page, time.monotonic()

    def stop(self, reason: str) -> RobotNow:
        """Stop the robot, whatever it does, and as often as one likes.

        The service and the process that drives it stop it at the same time: neither waits for the other.

        Args:
            reason: why, as the end of the sentence "The robot was stopped: ...".
        """
        sent = threading.Thread(target=self._send_stop, name="robot stop", daemon=True)
        sent.start()
        job = self._live()
        if job is not None:
            if job.id not in self._stopped:
                why = f"The robot was stopped: {reason}."
                self._stopped = {job.id: why}
                self._runner.hub.publish(Notice("warning", why))
            threading.Thread(target=self._cancel, args=(job.id,), name="robot cancel", daemon=True).start()
        sent.join(_STOP_WAIT_S)
        return self._now()

    def _cancel(self, job: str) -> None:
        with contextlib.suppress(OsfError):  # it may be over meanwhile
            self._runner.jobs.cancel(job, why=self._stopped.get(job))

    def _now(self) -> RobotNow:
        job, about = self._latest(), self._about
        limits = self._limits if about is None else self._limits.within(about.limits)
        return RobotNow(self._host, *self._state_of(job), job, limits, about)

    def _described(self) -> RobotDescription:
        """Return what the robot says of itself.

        One thread at a time asks for it. Others wait only if nobody has asked before, or a robot that does not answer
        would soon have all of them wait.

        Raises:
            NoRobot: if there is none.
            ConnectionLost, RobotRefused: if it does not answer.
            InvalidInput: if what it says is out of range.
        """
        if self._url is None:
            raise NoRobot
        if self._about is None and self._connecting.acquire(blocking=self._lost is None):
            try:
                if self._about is None and (self._lost is None or time.monotonic() - self._tried_at >= FRESH_S):
                    self._about = self._connect(self._url)
            except OsfError as error:
                self._lost, self._tried_at = error, time.monotonic()
            finally:
                self._connecting.release()
        if self._about is None:
            assert self._lost is not None
            raise self._lost.with_traceback(None)
        return self._about

    def _connect(self, url: str) -> RobotDescription:
        robot = connect(url, (), self._limits)
        with contextlib.ExitStack() as opened:
            opened.callback(robot.close)
            self._limits.within(robot.description.limits)
            if isinstance(robot, HttpRobot):  # rosbridge would go on sending pictures
                self._line = robot
                opened.pop_all()
        return robot.description

    def _send_stop(self) -> None:
        if self._line is not None:
            with contextlib.suppress(OsfError):  # one that cannot be reached halts by itself
                self._line.stop()

    def _watch(self, job: str) -> None:
        """Stop the robot once the page that let it move is silent."""
        while (live := self._live()) is not None and live.id == job and self._watched is not None:
            if time.monotonic() - self._watched[1] > self._lease_s:
                self.stop(_GONE)
                return
            time.sleep(self._lease_s / 10)

    def _hear(self, event: object) -> None:
        """Stop the robot when an episode ends in whatever way, even by the death of its process."""
        if isinstance(event, JobChanged) and event.job.kind == KIND and event.job.is_finished:
            threading.Thread(target=self._send_stop, name="robot stop", daemon=True).start()

    def _take(self) -> tuple[bytes, ...]:
        assert self._url is not None
        if self._line is not None:
            return self._line.pictures()
        with contextlib.closing(connect(self._url, (), self._limits)) as robot:
            return robot.pictures()

    def _may_look(self) -> bool:
        live = self._live()
        return live is None or live.state == "queued" or self._state_of(live)[0] not in ("looking", "driving")

    def _latest_folder(self) -> Path | None:
        latest = self._latest()
        return None if latest is None else self._runner.jobs.folder(latest.id)

    def _live(self) -> Job | None:
        return next(iter(self._runner.jobs.live(KIND)), None)

    def _latest(self) -> Job | None:
        return next(iter(self._runner.jobs.page(1, kind=KIND).jobs), None)

    def _state_of(self, job: Job | None) -> tuple[State, str]:
        if job is None:
            return "idle", ""
        drives = (job.result or {}).get("drives", "looking")
        if (why := self._stopped.get(job.id)) is not None:
            return "stopped", why
        if not job.is_finished:
            return ("driving" if drives == "over" else drives), job.note
        if job.state == "done":
            return "idle", (job.result or {}).get("text") or ""
        if drives == "lost":
            return "lost", job.error or ""
        if job.state == "failed" and drives in ("looking", "asked"):  # nothing has moved
            return "idle", job.error or ""
        return "stopped", job.error or "The episode was cancelled; the robot stands."


def limits_of(settings: Settings) -> SafetyLimits:
    """Return what the service lets a robot do.

    Raises:
        InvalidInput: if a limit makes no sense.
    """
    box = {} if settings.robot_box is None else {"box": settings.robot_box}
    return SafetyLimits(top_speed_m_s=settings.robot_top_speed_m_s, **box)


def host_of(url: str) -> str:
    """Return where a robot is, for people: without names of topics and passwords.

    Raises:
        InvalidInput: if it is no address of a robot.
    """
    check_address(url)
    return urlsplit(url).netloc.rpartition("@")[2]
