"""A robot that speaks HTTP: JSON and picture files, as docs/robots.md describes."""

from __future__ import annotations

import contextlib
import json
import threading
import time
from collections.abc import Iterator, Mapping, Sequence
from dataclasses import dataclass
from typing import Any
from urllib.parse import quote

import cv2
import httpx2
import numpy as np
from jaxtyping import Bool, Float, Float32
from pydantic import Field, FiniteFloat

from osfcore.errors import InvalidInput, OsfError, shown
from osfcore.estimation.camera_response import linear_from_encoded
from osfcore.geometry.cameras import Camera
from osfcore.geometry.poses import Pose
from osfcore.geometry.states import Observation
from osfcore.geometry.workspace import PUSHER_RADIUS_M, STEP_S, check_action
from osfcore.io.json_codec import Entry, Vector4, decode
from osfcore.io.scene_file import CameraJson, PointJson, rigid_pose
from osfcore.photo.read_photograph import KEPT_SIDE as MOST_SIDE
from osfcore.photo.read_photograph import read_photograph
from osfcore.robots.robot import ConnectionLost, RobotDescription, RobotRefused, SafetyLimits

# Pictures as a robot's cameras encode them, made what an `Observation` holds: linear radiance of moderate size.


KEPT_SIDE = 640  # larger pictures are reduced to this; estimates look at less


@dataclass(frozen=True, eq=False, slots=True)
class SentCamera:
    """A camera as a robot describes it: of any image size.

    Attributes:
        name: how it is called.
        T_world_camera: its place over the table.
        intrinsics: K of the pictures that are sent, pixel centres at +0.5 [px].
        width: of these [px].
        height: of these [px].
        distortion: coefficients of OpenCV's model; none where straight lines are straight.
    """

    name: str
    T_world_camera: Pose
    intrinsics: Float[np.ndarray, "3 3"]
    width: int
    height: int
    distortion: tuple[float, ...] = ()

    def kept(self) -> Camera:
        """The camera of the pictures as they are kept.

        Raises:
            InvalidInput: if its values are out of range.
        """
        if not 0 < min(self.width, self.height) <= max(self.width, self.height) <= MOST_SIDE:
            what = f"picture of camera {shown(self.name)} [px]"
            raise InvalidInput(what, f"{self.width} x {self.height}", f"between 1 and {MOST_SIDE} a side")
        scale = min(1.0, KEPT_SIDE / max(self.width, self.height))
        width, height = round(scale * self.width), round(scale * self.height)
        ratio = np.array([[width / self.width], [height / self.height], [1.0]])
        return Camera(self.name, self.T_world_camera, self.intrinsics * ratio, width, height)

    def radiance(self, picture: bytes) -> Float32[np.ndarray, "h w 3"]:
        """A JPEG or PNG file of this camera, sRGB, as linear radiance through `kept`.

        Raises:
            CorruptFile: if it is no such file.
            InvalidInput: if it has another size than was described.
        """
        encoded = read_photograph(picture).encoded
        self._check_size(encoded.shape[:2])
        linear = linear_from_encoded(encoded / np.iinfo(encoded.dtype).max, "srgb").astype(np.float32)
        return self._reduced(self._straight(linear), cv2.INTER_AREA)

    def mask(self, picture: bytes) -> Bool[np.ndarray, "h w"]:
        """A mask of this camera, more than 127 being the object."""
        grey = read_photograph(picture).eight_bit[..., 0].astype(np.float32)
        self._check_size(grey.shape)
        return self._reduced(self._straight(grey), cv2.INTER_AREA) > 127

    def _check_size(self, shape: tuple[int, ...]) -> None:
        if shape != (self.height, self.width):
            what = f"picture of camera {shown(self.name)} [px]"
            raise InvalidInput(what, f"{shape[1]} x {shape[0]}", f"{self.width} x {self.height}, as the robot tells")

    def _straight(self, image: np.ndarray) -> np.ndarray:
        if not any(self.distortion):
            return image
        K = self.intrinsics - np.array([[0, 0, 0.5], [0, 0, 0.5], [0, 0, 0]])  # OpenCV's pixel centres are whole
        return cv2.undistort(image, K, np.array(self.distortion))

    def _reduced(self, image: np.ndarray, how: int) -> np.ndarray:
        size = (self.kept().width, self.kept().height)
        return image if size == (self.width, self.height) else cv2.resize(image, size, interpolation=how)


def observation_of(
    cameras: Sequence[SentCamera],
    pictures: Sequence[bytes],
    names: tuple[str, ...],
    pusher: Float[np.ndarray, "3"],
    time_s: float,
    masks: Mapping[tuple[str, str], bytes] | None = None,
) -> Observation:
    """Everything that was sent, as an observation.

    Args:
        cameras: that took the pictures.
        pictures: one of each, as files.
        names: of the objects, which the owner tells.
        pusher: its centre [m].
        time_s: since the first one [s].
        masks: files by names of camera and object, where the robot has them; what is left out is not visible.

    Raises:
        CorruptFile: if one is no picture.
        InvalidInput: if one has another size than was described, or the cameras differ in size.
    """
    kept = tuple(camera.kept() for camera in cameras)
    sizes = sorted({f"{camera.width} x {camera.height}" for camera in kept})
    if len(sizes) != 1:
        raise InvalidInput("sizes of the robot's cameras [px]", ", ".join(sizes) or "none", "one size for all of them")
    images = np.stack([camera.radiance(picture) for camera, picture in zip(cameras, pictures, strict=True)])
    outlines = None
    if masks is not None:
        outlines = np.zeros((len(kept), len(names), *images.shape[1:3]), bool)
        for view, camera in enumerate(cameras):
            for number, name in enumerate(names):
                if (camera.name, name) in masks:
                    outlines[view, number] = camera.mask(masks[camera.name, name])
    return Observation(kept, images, names, outlines, pusher, time_s)


class LimitsJson(Entry):
    """Limits that a robot keeps itself."""

    box: Vector4 = Field(description="x0, y0, x1, y1 of the pusher's centre [m].")
    top_speed_m_s: FiniteFloat


class RobotJson(Entry):
    """What GET /robot answers."""

    cameras: list[CameraJson] = Field(min_length=1)
    limits: LimitsJson
    pusher_radius_m: FiniteFloat = PUSHER_RADIUS_M
    deadman_s: FiniteFloat = STEP_S
    masks: list[str] = Field(default=[], description="Objects whose masks it delivers.")


class HttpRobot:
    """One robot; a `Robot`. `description` is what it says of itself.

    Args:
        url: where it is, such as http://192.168.0.7:8080.
        names: of the objects on the table, which a person tells.
        timeout_s: how long an answer may take beyond the time that a motion takes [s].

    Raises:
        ConnectionLost: if nobody answers.
        RobotRefused: if something else than a robot answers.
        InvalidInput: if what it says of itself is out of range.
    """

    def __init__(self, url: str, names: tuple[str, ...], timeout_s: float = 5.0) -> None:
        self._url, self._names = url.rstrip("/"), names
        # Names of proxies in the environment are not for a robot beside the computer.
        self._http = httpx2.Client(timeout=timeout_s, trust_env=False)
        self._idle, self._under_way = threading.Condition(), 0
        try:
            told = decode(RobotJson, self._json("GET", "robot"), f"answer of {self._url}/robot")
            self._cameras = tuple(_camera(entry) for entry in told.cameras)
            limits = SafetyLimits((*told.limits.box,), told.limits.top_speed_m_s)  # pyright: ignore[reportArgumentType]
            cameras = tuple(camera.kept() for camera in self._cameras)
            masks = frozenset(told.masks)
            self.description = RobotDescription(cameras, limits, told.pusher_radius_m, told.deadman_s, masks)
        except OsfError:
            self.close()
            raise
        self._began = time.monotonic()

    def reset(self, seed: int) -> Observation:
        """Only look: what lies on the table is a person's business."""
        return self.observe()

    def observe(self, *, masks: bool = False) -> Observation:
        """A picture of every camera; masks of all objects if the robot has them.

        Raises:
            ConnectionLost: if nobody answers.
            RobotRefused: if it does not want to.
            CorruptFile, InvalidInput: if what it sends is not what it should be.
        """
        pusher = decode(PointJson, self._json("GET", "pusher"), f"answer of {self._url}/pusher").position
        pictures = self.pictures()
        sent = self._masks() if masks and self.description.masks.issuperset(self._names) else None
        seconds = time.monotonic() - self._began
        return observation_of(self._cameras, pictures, self._names, np.array(pusher), seconds, sent)

    def pictures(self) -> tuple[bytes, ...]:
        """A picture of every camera, as the robot sends it.

        Raises:
            ConnectionLost: if nobody answers.
            RobotRefused: if it does not want to.
        """
        return tuple(self._bytes(f"images/{quote(camera.name, safe='')}") for camera in self._cameras)

    def act(self, action: Float[np.ndarray, "3"]) -> None:
        """Hold a velocity for 0.2 s; the robot answers when that is over.

        Raises:
            InvalidInput: if it is no action.
            ConnectionLost: if nobody answers.
            RobotRefused: if it does not want to, such as after a stop.
        """
        velocity = check_action(action)[:2].tolist()
        self._json("POST", "act", {"velocity": velocity, "duration_s": STEP_S})

    def start(self) -> None:
        """Make ready to move."""
        self._json("POST", "start")

    def stop(self) -> None:
        """Halt at once; from any thread, for a client has as many connections as it needs."""
        self._json("POST", "stop")

    def close(self) -> None:
        """Wait for requests under way, such as a stop from another thread, then release the sockets.

        Timeouts bound the wait. Closing at once would abort a stop, and leak the socket of one that still connects.
        """
        with self._idle:
            self._idle.wait_for(lambda: not self._under_way)
            self._http.close()

    def _masks(self) -> dict[tuple[str, str], bytes]:
        keys = [(camera.name, name) for camera in self._cameras for name in self._names]
        return {key: self._bytes("masks/" + "/".join(quote(part, safe="") for part in key)) for key in keys}

    def _json(self, method: str, path: str, body: object = None) -> Any:  # noqa: ANN401
        content = self._answer(method, path, body)
        try:
            return json.loads(content or b"null")
        except ValueError:
            raise RobotRefused(self._url, f"something that is no JSON to {method} /{path}") from None

    def _bytes(self, path: str) -> bytes:
        return self._answer("GET", path)

    def _answer(self, method: str, path: str, body: object = None) -> bytes:
        try:
            with self._one_more_under_way():
                answer = self._http.request(method, f"{self._url}/{path}", json=body)
        except (httpx2.TransportError, httpx2.InvalidURL, RuntimeError) as error:  # RuntimeError once it is closed
            raise ConnectionLost(self._url, str(error) or type(error).__name__) from error
        if not answer.is_success:
            raise RobotRefused(self._url, _detail(answer) or f"{answer.status_code} to {method} /{path}")
        return answer.content

    @contextlib.contextmanager
    def _one_more_under_way(self) -> Iterator[None]:
        with self._idle:
            self._under_way += 1
        try:
            yield
        finally:
            with self._idle:
                self._under_way -= 1
                self._idle.notify_all()


def _camera(entry: CameraJson) -> SentCamera:
    pose: Pose = rigid_pose(entry.T_world_camera, entry.name)
    return SentCamera(entry.name, pose, np.array(entry.K), entry.width, entry.height)


def _detail(answer: httpx2.Response) -> str:
    try:
        detail = answer.json()["detail"]
    except (ValueError, KeyError, TypeError):
        return ""
    return detail if isinstance(detail, str) else ""
