"""What the cameras of a robot saw last, whoever looked: an episode, or the service where nobody is disturbed by it."""

from __future__ import annotations

import threading
import time
from collections.abc import Callable
from dataclasses import dataclass
from pathlib import Path

import cv2

from app.episodes.robots.camera_files import CameraPicture, read_picture
from osfcore.contrib.robots.http_robot import KEPT_SIDE
from osfcore.errors import OsfError, UnknownName, shown
from osfcore.geometry.cameras import Camera
from osfcore.io.image_file import encode_jpeg
from osfcore.photo.read_photograph import read_photograph

FRESH_S = 1.0  # nobody looks again before


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
    """A camera, and what it saw last.

    Attributes:
        camera: of the robot, as its pictures are kept.
        picture: None if it has shown nothing yet.
    """

    camera: Camera
    picture: CameraPicture | None


class RobotPictures:
    """The pictures of one robot. Methods block; any thread may call.

    While an episode looks or moves, its own looks are what is shown: pictures besides could hold up the robot. At any
    other time whoever asks has the robot look, if the last attempt is more than a second old.

    Args:
        cameras: tells the robot's; raises OsfError if it has never answered.
        take: takes a picture file with each of them; raises OsfError if it does not answer.
        may_look: whether that disturbs nobody.
        episode: folder of the latest episode, if there is one.
    """

    def __init__(
        self,
        cameras: Callable[[], tuple[Camera, ...]],
        take: Callable[[], tuple[bytes, ...]],
        may_look: Callable[[], bool],
        episode: Callable[[], Path | None],
    ) -> None:
        self._cameras, self._take, self._may_look, self._episode = cameras, take, may_look, episode
        self._looking = threading.Lock()
        self._tried_at = -FRESH_S
        self._problem = ""
        self._own: dict[str, CameraPicture] = {}

    def all(self) -> tuple[CameraNow, ...]:
        """All cameras, and what they saw last.

        Raises:
            NoRobot: if there is none.
            ConnectionLost, RobotRefused: if it has never answered.
        """
        cameras = self._cameras()
        if self._looking.acquire(blocking=not self._own):  # who comes during the first look waits for it
            try:
                if self._may_look() and time.monotonic() - self._tried_at >= FRESH_S:
                    self._look(cameras)
                    self._tried_at = time.monotonic()
            finally:
                self._looking.release()
        own, folder = self._own, self._episode()
        return tuple(CameraNow(camera, _newest(own.get(camera.name), folder, camera.name)) for camera in cameras)

    def one(self, name: str) -> CameraPicture:
        """What one camera saw last.

        Raises:
            UnknownName: if there is no such camera.
            NoPicture: if it has shown nothing yet.
            NoRobot, ConnectionLost, RobotRefused: as above.
        """
        known = {now.camera.name: now.picture for now in self.all()}
        if name not in known:
            raise UnknownName("camera of the robot", name, list(known))
        picture = known[name]
        if picture is None:
            raise NoPicture(name, self._problem)
        return picture

    def _look(self, cameras: tuple[Camera, ...]) -> None:
        """Take pictures; if the robot does not answer, those before are still the last ones."""
        try:
            jpegs = [_small(file) for file in self._take()]
        except OsfError as error:
            self._problem = str(error)
            return
        pictures = [CameraPicture(jpeg, time.time()) for jpeg in jpegs]
        self._problem = ""
        self._own = {camera.name: picture for camera, picture in zip(cameras, pictures, strict=True)}


def _newest(own: CameraPicture | None, episode: Path | None, camera: str) -> CameraPicture | None:
    kept = None if episode is None else read_picture(episode, camera)
    return max((one for one in (kept, own) if one is not None), key=lambda one: one.at_s, default=None)


def _small(file: bytes) -> bytes:
    """A picture as the robot sent it, no larger than estimates look at."""
    image = read_photograph(file).eight_bit
    scale = KEPT_SIDE / max(image.shape[:2])
    if scale < 1:
        size = (round(scale * image.shape[1]), round(scale * image.shape[0]))
        image = cv2.resize(image, size, interpolation=cv2.INTER_AREA)
    return encode_jpeg(image)
