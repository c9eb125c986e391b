"""A robot over HTTP, with JSON and image files as docs/how-to/robots.md describes."""

from __future__ import annotations

import asyncio
import threading
import time
from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from typing import Any
from urllib.parse import quote

import cv2
import httpx2
import numpy as np
from jaxtyping import Bool, Float, Float32
from pydantic import Field, FiniteFloat

from osfcore.contrib.robots.robot import (
    ANSWER_S,
    MOST_JSON_BYTES,
    MOST_PICTURE_BYTES,
    ConnectionLost,
    RobotDescription,
    RobotRefused,
    SafetyLimits,
    parse_json,
)
from osfcore.errors import InvalidInput, OsfError, shown
from osfcore.estimation.camera_response import linear_from_encoded
from osfcore.geometry.cameras import Camera
from osfcore.geometry.poses import Pose
from osfcore.geometry.states import Observation
from osfcore.geometry.workspace import PUSHER_RADIUS_M, STEP_S, check_action
from osfcore.io.json_codec import Entry, Vector4, decode
from osfcore.io.scene_file import CameraJson, PointJson, rigid_pose
from osfcore.photo.lens import Lens
from osfcore.photo.read_photograph import KEPT_SIDE as MOST_SIDE
from osfcore.photo.read_photograph import read_photograph

# Encoded images of a robot's cameras become linear radiance of moderate size, as in an `Observation`.

KEPT_SIDE = 640  # larger pictures are reduced to this; estimates look at less
_DETAIL_CHARACTERS = 300  # of a robot's reason for a refusal


@dataclass(frozen=True, eq=False, slots=True)
class SentCamera:
    """A camera as a robot describes it, with images of any size.

    Attributes:
        name: name of the camera.
        T_world_camera: pose of the camera over the table.
        lens: intrinsics and distortion of the pictures that are sent.
        width: width of the pictures that are sent [px].
        height: height of the pictures that are sent [px].
    """

    name: str
    T_world_camera: Pose
    lens: Lens
    width: int
    height: int

    def kept(self) -> Camera:
        """Return the camera of the pictures as they are kept.

        Raises:
            InvalidInput: if its values are out of range.
        """
        if not 0 < min(self.width, self.height) <= max(self.width, self.height) <= MOST_SIDE:
            what = f"picture of camera {shown(self.name)} [px]"
            raise InvalidInput(what, f"{self.width} x {self.height}", f"between 1 and {MOST_SIDE} a side")
        scale = min(1.0, KEPT_SIDE / max(self.width, self.height))
        width, height = round(scale * self.width), round(scale * self.height)
        lens = self.lens.scaled((width / self.width, height / self.height))
        return Camera(self.name, self.T_world_camera, lens.intrinsics, width, height)

    def radiance(self, picture: bytes) -> Float32[np.ndarray, "h w 3"]:
        """Decode a JPEG or PNG file of this camera, sRGB, into linear radiance as `kept` sees it.

        Raises:
            CorruptFile: if it is no such file, or has more pixels than any camera may have.
            InvalidInput: if it has another size than was described.
        """
        encoded = read_photograph(picture, most_pixels=MOST_SIDE**2).encoded
        linear = linear_from_encoded(encoded / np.iinfo(encoded.dtype).max, "srgb").astype(np.float32)
        return self._resample(linear).clip(0, 1)  # straightening overshoots a little

    def mask(self, picture: bytes) -> Bool[np.ndarray, "h w"]:
        """Decode a mask of this camera; values above 127 are the object.

        Raises:
            CorruptFile, InvalidInput: as `radiance`.
        """
        values = read_photograph(picture, most_pixels=MOST_SIDE**2).eight_bit[..., 0]
        return self._resample(values.astype(np.float32)) > 127

    def _resample(self, image: np.ndarray) -> np.ndarray:
        """Undistort an image and reduce it to the size of `kept`."""
        if image.shape[:2] != (self.height, self.width):
            what = f"picture of camera {shown(self.name)} [px]"
            given = f"{image.shape[1]} x {image.shape[0]}"
            raise InvalidInput(what, given, f"{self.width} x {self.height}, as the robot describes it")
        image, kept = self.lens.straightened(image), self.kept()
        size = (kept.width, kept.height)
        return image if size == (self.width, self.height) else cv2.resize(image, size, interpolation=cv2.INTER_AREA)


def observation_of(
    cameras: Sequence[SentCamera],
    pictures: Sequence[bytes],
    names: tuple[str, ...],
    pusher: Float[np.ndarray, "3"],
    time_s: float,
    masks: Mapping[tuple[str, str], bytes] | None = None,
) -> Observation:
    """Decode all that a robot sent into an observation.

    Args:
        cameras: cameras that took the images.
        pictures: one image file of each camera.
        names: names of the objects, given by the owner.
        pusher: centre of the pusher in the world [m].
        time_s: time since the robot was connected [s].
        masks: mask files by names of camera and object; an object without a file is not visible. None for no masks.

    Raises:
        CorruptFile: if a file is no picture.
        InvalidInput: if a picture has another size than was described, or the cameras differ in size.
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
    """Limits that a robot enforces itself."""

    box: Vector4 = Field(description="x0, y0, x1, y1 of the pusher's centre [m].")
    top_speed_m_s: FiniteFloat


class RobotJson(Entry):
    """Answer of GET /robot."""

    cameras: list[CameraJson] = Field(min_length=1)
    limits: LimitsJson
    pusher_radius_m: FiniteFloat = PUSHER_RADIUS_M
    deadman_s: FiniteFloat = STEP_S
    masks: list[str] = Field(default=[], description="Objects whose masks it delivers.")


class HttpRobot:
    """A `Robot` over HTTP. `description` is its own description.

    Args:
        url: address of the robot, such as http://192.168.0.7:8080.
        names: names of the objects on the table, given by a person.
        timeout_s: longest time for a complete answer, in addition to the time of a motion [s].

    Raises:
        ConnectionLost: if there is no answer.
        RobotRefused: if the answer does not come from a robot.
        InvalidInput: if its description is out of range.
    """

    def __init__(self, url: str, names: tuple[str, ...], timeout_s: float = ANSWER_S) -> None:
        self._url, self._names, self._timeout_s = url.rstrip("/"), names, timeout_s
        # Timeouts of a synchronous client restart with every byte, so that a slow sender could hold it for ever.
        # Requests run in an event loop instead, which limits the time of each request as a whole.
        self._loop = asyncio.new_event_loop()
        self._thread = threading.Thread(target=self._loop.run_forever, name="robot over HTTP", daemon=True)
        self._thread.start()
        # Names of proxies in the environment are not for a robot beside the computer. What is not compressed is no
        # larger than it seems. A connection is given up before a robot would close it just as a motion is sent.
        self._http = httpx2.AsyncClient(
            timeout=None, trust_env=False, headers={"Accept-Encoding": "identity"},
            limits=httpx2.Limits(keepalive_expiry=2.0),
        )  # fmt: skip
        self._idle, self._under_way, self._is_closed = threading.Condition(), 0, False
        try:
            answer = decode(RobotJson, self._json("robot"), f"answer of {self._url}/robot")
            self._cameras = tuple(
                SentCamera(c.name, rigid_pose(c.T_world_camera, c.name), Lens(np.array(c.K)), c.width, c.height)
                for c in answer.cameras
            )
            limits = SafetyLimits((*answer.limits.box,), answer.limits.top_speed_m_s)  # pyright: ignore[reportArgumentType]
            cameras = tuple(camera.kept() for camera in self._cameras)
            masks = frozenset(answer.masks)
            self.description = RobotDescription(cameras, limits, answer.pusher_radius_m, answer.deadman_s, masks)
        except OsfError:
            self.close()
            raise
        self._began = time.monotonic()

    def reset(self, seed: int) -> Observation:
        """Only observe, because a person arranges the table."""
        return self.observe()

    def observe(self, *, masks: bool = False) -> Observation:
        """Take a picture with every camera; masks of all objects if the robot has them.

        Raises:
            ConnectionLost: if nobody answers.
            RobotRefused: if the robot refuses.
            CorruptFile, InvalidInput: if an answer is malformed.
        """
        pusher = decode(PointJson, self._json("pusher"), f"answer of {self._url}/pusher").position
        pictures = self.pictures()
        sent = None
        if masks and self.description.masks.issuperset(self._names):
            keys = [(camera.name, name) for camera in self._cameras for name in self._names]
            paths = {(camera, name): f"masks/{_quoted(camera)}/{_quoted(name)}" for camera, name in keys}
            sent = {key: self._answer("GET", path, most=MOST_PICTURE_BYTES) for key, path in paths.items()}
        seconds = time.monotonic() - self._began
        return observation_of(self._cameras, pictures, self._names, np.array(pusher), seconds, sent)

    def pictures(self) -> tuple[bytes, ...]:
        """Return a picture file of every camera, as the robot sends it.

        Raises:
            ConnectionLost: if nobody answers.
            RobotRefused: if the robot refuses.
        """
        paths = [f"images/{_quoted(camera.name)}" for camera in self._cameras]
        return tuple(self._answer("GET", path, most=MOST_PICTURE_BYTES) for path in paths)

    def act(self, action: Float[np.ndarray, "3"]) -> None:
        """Hold a velocity for 0.2 s. The robot answers when the motion is over.

        Raises:
            InvalidInput: if it is no action.
            ConnectionLost: if nobody answers.
            RobotRefused: if the robot refuses, such as after a stop.
        """
        velocity = check_action(action)[:2].tolist()
        self._answer("POST", "act", {"velocity": velocity, "duration_s": STEP_S}, takes_s=STEP_S)

    def start(self) -> None:
        """Prepare the robot to move."""
        self._answer("POST", "start")

    def stop(self) -> None:
        """Halt at once. Any thread may call this."""
        self._answer("POST", "stop")

    def close(self) -> None:
        """Wait for requests under way, such as a stop from another thread, then release the sockets.

        Timeouts bound the wait. Closing at once would abort a stop. Calling it again does nothing.
        """
        with self._idle:
            self._idle.wait_for(lambda: not self._under_way)
            if self._is_closed:
                return
            self._is_closed = True
        asyncio.run_coroutine_threadsafe(self._http.aclose(), self._loop).result()
        self._loop.call_soon_threadsafe(self._loop.stop)
        self._thread.join()
        self._loop.close()

    def _json(self, path: str) -> Any:  # noqa: ANN401
        try:
            return parse_json(self._answer("GET", path))
        except OsfError:  # a ValueError itself
            raise
        except ValueError:
            raise RobotRefused(self._url, f"its answer to GET /{path} is not JSON") from None

    def _answer(
        self, method: str, path: str, body: object = None, *, most: int = MOST_JSON_BYTES, takes_s: float = 0.0
    ) -> bytes:
        """Send a request and wait for the answer.

        Args:
            method: HTTP method.
            path: path below the robot's address.
            body: body of the request, sent as JSON.
            most: largest size of the answer [bytes].
            takes_s: time that the robot needs for the requested motion [s].

        Raises:
            ConnectionLost: if there is no complete answer in time.
            RobotRefused: if the robot refuses, or its answer is too large.
        """
        with self._idle:
            if self._is_closed:
                raise ConnectionLost(self._url, "the connection was closed")
            self._under_way += 1
        seconds = self._timeout_s + takes_s
        asked = asyncio.run_coroutine_threadsafe(self._ask(method, path, body, most, seconds), self._loop)
        try:
            status, content = asked.result()
        except OsfError:  # a ValueError itself
            raise
        except TimeoutError:
            raise ConnectionLost(self._url, f"no whole answer to {method} /{path} within {seconds:g} s") from None
        except (httpx2.HTTPError, httpx2.InvalidURL, OSError, ValueError) as error:
            raise ConnectionLost(self._url, str(error) or type(error).__name__) from error
        finally:
            asked.cancel()  # on an interruption by the keyboard
            with self._idle:
                self._under_way -= 1
                self._idle.notify_all()
        if not 200 <= status < 300:
            raise RobotRefused(self._url, _detail(content) or f"status {status} in answer to {method} /{path}")
        return content

    async def _ask(self, method: str, path: str, body: object, most: int, seconds: float) -> tuple[int, bytes]:
        """Return the status and the raw content of an answer."""
        url, content = f"{self._url}/{path}", bytearray()
        async with asyncio.timeout(seconds), self._http.stream(method, url, json=body) as answer:
            if answer.headers.get("Content-Encoding", "identity") != "identity":
                raise RobotRefused(self._url, f"its answer to {method} /{path} is compressed; send it uncompressed")
            async for chunk in answer.aiter_raw():
                content += chunk
                if len(content) > most:
                    raise RobotRefused(self._url, f"its answer to {method} /{path} exceeds {most // 1_000_000} MB")
            return answer.status_code, bytes(content)


def _quoted(name: str) -> str:
    return quote(name, safe="")


def _detail(content: bytes) -> str:
    """Return the reason that an answer gives for a failure, or nothing."""
    try:
        detail = parse_json(content)["detail"]
    except (ValueError, KeyError, TypeError):
        return ""
    return shown(detail, _DETAIL_CHARACTERS) if isinstance(detail, str) else ""
