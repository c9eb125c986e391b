"""A robot under ROS 2, through rosbridge, without ROS here: compressed images, camera_info, tf in, twists out."""

from __future__ import annotations

import base64
import binascii
import threading
import time
from collections.abc import Mapping
from dataclasses import dataclass
from itertools import chain

import numpy as np
from jaxtyping import Float
from pydantic import Field, FiniteFloat

from osfcore.errors import CorruptFile, InvalidInput, OsfError
from osfcore.geometry.states import Observation
from osfcore.geometry.workspace import STEP_S, check_action
from osfcore.io.json_codec import Entry, decode
from osfcore.robots.camera_pictures import SentCamera, observation_of
from osfcore.robots.robot import RobotDescription, RobotRefused
from osfcore.robots.ros_transforms import TransformTree
from osfcore.robots.rosbridge import Rosbridge
from osfcore.robots.safety_limits import SafetyLimits

_TWIST_EVERY_S = 0.05  # more often than any controller gives up on its commands
_PICTURES_EVERY_MS = 50
_FRESH = 2  # pictures from when they are asked for: the first may have been exposed before
_TRANSFORMS_KEPT = 200
_HALF_PIXEL = np.array([[0, 0, 0.5], [0, 0, 0.5], [0, 0, 0]])  # ROS has pixel centres at whole numbers


@dataclass(frozen=True, slots=True)
class RosNames:
    """Topics and frames of a robot.

    Attributes:
        cameras: namespaces of the cameras.
        image: topic of the pictures below each, sensor_msgs/CompressedImage.
        info: of the calibration, sensor_msgs/CameraInfo.
        twist: topic of the commands, geometry_msgs/TwistStamped in the frame of the table.
        table: frame at the table's centre, z up.
        pusher: frame at the pusher's centre.
    """

    cameras: tuple[str, ...]
    image: str = "image_raw/compressed"
    info: str = "camera_info"
    twist: str = "/pusher/twist"
    table: str = "table"
    pusher: str = "pusher"

    def __post_init__(self) -> None:
        """Check that there is a camera.

        Raises:
            InvalidInput: if there is none.
        """
        if not self.cameras or not all(self.cameras):
            raise InvalidInput(
                "cameras of the robot", ", ".join(self.cameras) or "missing", "names of ROS, one or more"
            )

    def topic(self, camera: str, below: str) -> str:
        """The full name of a camera's topic."""
        return f"/{camera.strip('/')}/{below}"


class _CameraInfo(Entry):
    header: _Header
    width: int
    height: int
    k: list[FiniteFloat] = Field(min_length=9, max_length=9)
    d: list[FiniteFloat] = Field(default=[])


class _Picture(Entry):
    data: str


class RosRobot:
    """One robot; a `Robot`. `description` has cameras as ROS tells them, and the limits that were given.

    Args:
        url: of rosbridge's websocket, ws://host:9090.
        topics: and frames.
        names: of the objects on the table, which a person tells.
        limits: that hold for this robot, which ROS has no message for.
        timeout_s: how long pictures and calibration may take [s].

    Raises:
        ConnectionLost: if nobody answers.
        RobotRefused: if something that is needed is not published.
        InvalidInput, UnknownName: if calibration or transforms are not as they must be.
    """

    def __init__(
        self, url: str, topics: RosNames, names: tuple[str, ...], limits: SafetyLimits, timeout_s: float = 5.0
    ) -> None:
        self._url, self._topics, self._names, self._timeout_s = url, topics, names, timeout_s
        self._halted = threading.Event()
        self._halted.set()  # until it is started
        self._sending = threading.Lock()
        self._bridge = Rosbridge(url, timeout_s)
        try:
            self._ask()
            self._cameras = self._described()
            cameras = tuple(camera.kept() for camera in self._cameras)
        except OsfError:
            self._bridge.close()
            raise
        self.description = RobotDescription(cameras, limits)
        self._began = time.monotonic()

    def reset(self, seed: int) -> Observation:
        """Only look: what lies on the table is a person's business."""
        return self.observe()

    def observe(self, *, masks: bool = False) -> Observation:
        """A picture of every camera, taken after this was asked; never masks.

        Raises:
            ConnectionLost: if the connection broke.
            RobotRefused: if pictures or transforms do not come.
            CorruptFile, InvalidInput: if they are not what they should be.
        """
        pictures = self.pictures()
        pusher = self._tree().pose(self._topics.pusher, self._topics.table).position
        return observation_of(self._cameras, pictures, self._names, pusher, time.monotonic() - self._began)

    def pictures(self) -> tuple[bytes, ...]:
        """A picture of every camera, taken after this was asked.

        Raises:
            ConnectionLost: if the connection broke.
            RobotRefused: if pictures do not come.
            CorruptFile: if they are not what they should be.
        """
        topics = [self._topics.topic(camera.name, self._topics.image) for camera in self._cameras]
        self._wait({topic: self._bridge.count(topic) + _FRESH for topic in topics})
        return tuple(_picture(self._bridge.received(topic)[-1].message, topic) for topic in topics)

    def act(self, action: Float[np.ndarray, "3"]) -> None:
        """Send a velocity again and again for 0.2 s, then zero.

        Raises:
            InvalidInput: if it is no action.
            RobotRefused: if it was not started, or was stopped meanwhile.
            ConnectionLost: if the connection broke.
        """
        velocity = check_action(action)
        end = time.monotonic() + STEP_S
        while (left := end - time.monotonic()) > 0:
            self._send_unless_halted(velocity)
            self._halted.wait(min(left, _TWIST_EVERY_S))
        self._send_unless_halted(np.zeros(3))
        self._bridge.wait({}, 0.0)  # a connection that broke is told

    def start(self) -> None:
        """Let velocities be sent."""
        self._halted.clear()

    def stop(self) -> None:
        """Send zero, and no other velocity after it until `start`; from any thread."""
        self._halted.set()
        with self._sending:
            self._publish(np.zeros(3))

    def close(self) -> None:
        """Close the connection."""
        self._bridge.close()

    def _ask(self) -> None:
        bridge, topics = self._bridge, self._topics
        for camera in topics.cameras:
            bridge.subscribe(topics.topic(camera, topics.info), "sensor_msgs/msg/CameraInfo", every_ms=1000)
            image = topics.topic(camera, topics.image)
            bridge.subscribe(image, "sensor_msgs/msg/CompressedImage", every_ms=_PICTURES_EVERY_MS)
        for topic in ("/tf_static", "/tf"):
            bridge.subscribe(topic, "tf2_msgs/msg/TFMessage", kept=_TRANSFORMS_KEPT)
        bridge.advertise(topics.twist, "geometry_msgs/msg/TwistStamped")

    def _described(self) -> tuple[SentCamera, ...]:
        topics = {camera: self._topics.topic(camera, self._topics.info) for camera in self._topics.cameras}
        self._wait(dict.fromkeys(topics.values(), 1))
        infos = {
            camera: decode(_CameraInfo, self._bridge.received(topic)[-1].message, f"camera_info of {camera}")
            for camera, topic in topics.items()
        }
        frames = [*(info.header.frame_id for info in infos.values()), self._topics.pusher]
        tree = self._complete_tree(frames)
        return tuple(
            SentCamera(
                camera, tree.pose(info.header.frame_id, self._topics.table), np.reshape(info.k, (3, 3)) + _HALF_PIXEL,
                info.width, info.height, tuple(info.d),
            )
            for camera, info in infos.items()
        )  # fmt: skip

    def _complete_tree(self, frames: list[str]) -> TransformTree:
        """Transforms, once they lead from the table to all frames; else the error of the first that they do not."""
        end = time.monotonic() + self._timeout_s
        while True:
            count = self._bridge.count("/tf") + self._bridge.count("/tf_static")
            tree = self._tree()
            try:
                for frame in frames:
                    tree.pose(frame, self._topics.table)
                return tree
            except OsfError:
                if time.monotonic() > end:
                    raise
            self._bridge.wait_for_more(("/tf", "/tf_static"), count, end - time.monotonic())

    def _tree(self) -> TransformTree:
        received = chain(self._bridge.received("/tf_static"), self._bridge.received("/tf"))
        return TransformTree(one.message for one in received)

    def _wait(self, counts: Mapping[str, int]) -> None:
        missing = self._bridge.wait(counts, self._timeout_s)
        if missing is not None:
            raise RobotRefused(self._url, f"nothing on {missing} for {self._timeout_s:g} s; is it published?")

    def _send_unless_halted(self, velocity: Float[np.ndarray, "3"]) -> None:
        with self._sending:  # so that nothing follows the zero of a stop
            if self._halted.is_set():
                raise RobotRefused(self._url, "it was stopped, or not started")
            self._publish(velocity)

    def _publish(self, velocity: Float[np.ndarray, "3"]) -> None:
        x, y, z = velocity.tolist()
        still = {"x": 0.0, "y": 0.0, "z": 0.0}
        twist = {"linear": {"x": x, "y": y, "z": z}, "angular": still}
        # Without a stamp rosbridge takes the time of the robot's clock.
        self._bridge.publish(self._topics.twist, {"header": {"frame_id": self._topics.table}, "twist": twist})


def _picture(message: Mapping[str, object], topic: str) -> bytes:
    try:
        return base64.b64decode(decode(_Picture, message, f"message of {topic}").data, validate=True)
    except binascii.Error:
        raise CorruptFile(topic, "its data are no base64") from None
