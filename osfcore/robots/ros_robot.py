"""A robot under ROS 2, through rosbridge, without ROS here: compressed images, camera_info, tf in, twists out."""

from __future__ import annotations

import base64
import binascii
import json
import threading
import time
from collections.abc import Iterable, Mapping, Sequence
from dataclasses import dataclass
from itertools import chain
from typing import Any

import numpy as np
from jaxtyping import Float
from pydantic import Field, FiniteFloat
from websockets.exceptions import ConnectionClosed, InvalidURI, WebSocketException
from websockets.sync.client import connect

from osfcore.errors import CorruptFile, InvalidInput, OsfError, UnknownName
from osfcore.geometry.poses import Pose, unit_quaternion
from osfcore.geometry.states import Observation
from osfcore.geometry.workspace import STEP_S, check_action
from osfcore.io.json_codec import Entry, decode
from osfcore.robots.http_robot import SentCamera, observation_of
from osfcore.robots.robot import ConnectionLost, RobotDescription, RobotRefused, SafetyLimits

# Poses of frames from ROS's transforms (tf2_msgs/TFMessage).


class _Vector(Entry):
    x: FiniteFloat
    y: FiniteFloat
    z: FiniteFloat


class _Quaternion(_Vector):
    w: FiniteFloat


class _Transform(Entry):
    translation: _Vector
    rotation: _Quaternion


class _Header(Entry):
    frame_id: str


class _Stamped(Entry):
    header: _Header
    child_frame_id: str
    transform: _Transform


class _Message(Entry):
    transforms: list[_Stamped] = Field(default=[])


class TransformTree:
    """`T_parent_child` of each frame; later messages replace what earlier ones told.

    Args:
        messages: of /tf and /tf_static, the older first.

    Raises:
        InvalidInput: if one is no such message.
    """

    def __init__(self, messages: Iterable[Mapping[str, Any]]) -> None:
        self._parents: dict[str, tuple[str, Pose]] = {}
        for message in messages:
            for each in decode(_Message, message, "transforms").transforms:
                at, q = each.transform.translation, each.transform.rotation
                child = _plain(each.child_frame_id)
                quaternion = np.array([q.w, q.x, q.y, q.z])
                pose = Pose(np.array([at.x, at.y, at.z]), unit_quaternion(quaternion, f"rotation of frame {child}"))
                self._parents[child] = _plain(each.header.frame_id), pose

    def pose(self, frame: str, within: str) -> Pose:
        """`T_within_frame`, along the parents that both have.

        Raises:
            UnknownName: if nothing leads from one to the other.
        """
        one, other = self._ways(_plain(frame)), self._ways(_plain(within))
        for ancestor, T_ancestor_frame in one.items():
            if ancestor in other:
                return other[ancestor].inverse() @ T_ancestor_frame
        raise UnknownName(f"frame that leads to {within}", frame, self._parents)

    def _ways(self, frame: str) -> dict[str, Pose]:
        """`T_ancestor_frame` of a frame's ancestors, itself included, the nearest first."""
        ways, pose = {frame: Pose.identity()}, Pose.identity()
        while frame in self._parents:
            frame, T_parent_child = self._parents[frame]
            if frame in ways:  # a circle, which tells nothing
                break
            pose = T_parent_child @ pose
            ways[frame] = pose
        return ways


def _plain(frame: str) -> str:
    return frame.removeprefix("/")


# The part of rosbridge's protocol (v2.0, JSON over a websocket) that a robot needs: subscribe, advertise, publish.
#
# roslibpy speaks all of it, but by the reactor of Twisted, of which a process has one that cannot be started twice:
# a connection that was lost could not be opened anew, nor closed without the threads that it leaves. What is needed
# of the protocol are four kinds of messages.


_MOST_BYTES = 64_000_000  # of a message: a large picture is some megabytes in base64


@dataclass(frozen=True, slots=True)
class Received:
    """The last message of a topic.

    Attributes:
        message: as rosbridge makes JSON of it.
        count: of messages of this topic so far.
    """

    message: Mapping[str, Any]
    count: int


class Rosbridge:
    """One connection, with a thread that takes what comes.

    Args:
        url: of rosbridge's websocket, ws://host:port.
        timeout_s: how long opening and closing may take [s].

    Raises:
        ConnectionLost: if nobody answers.
    """

    def __init__(self, url: str, timeout_s: float) -> None:
        self._url = url
        try:
            # A robot is beside the computer: no proxy. Pings tell in time that it has gone.
            self._socket = connect(
                url, proxy=None, compression=None, max_size=_MOST_BYTES, open_timeout=timeout_s,
                close_timeout=timeout_s, ping_interval=timeout_s, ping_timeout=timeout_s,
            )  # fmt: skip
        except (OSError, TimeoutError, WebSocketException, InvalidURI) as error:
            raise ConnectionLost(url, str(error) or type(error).__name__) from error
        self._news = threading.Condition()
        self._received: dict[str, list[Received]] = {}
        self._kept: dict[str, int] = {}
        self._lost = ""
        self._reader = threading.Thread(target=self._read, name="rosbridge", daemon=True)
        self._reader.start()

    def subscribe(self, topic: str, kind: str, *, every_ms: int = 0, kept: int = 1) -> None:
        """Ask for a topic.

        Args:
            topic: its name.
            kind: of its messages, such as sensor_msgs/msg/CameraInfo.
            every_ms: least time between two messages [ms].
            kept: how many of the last messages are kept.
        """
        self._kept[topic] = kept
        # A queue of one holds the newest of what comes between two messages; without one (0) nothing is held.
        queue = 0 if kept > 1 else 1
        self._send(op="subscribe", topic=topic, type=kind, throttle_rate=every_ms, queue_length=queue)

    def advertise(self, topic: str, kind: str) -> None:
        """Tell that messages of a topic will come."""
        self._send(op="advertise", topic=topic, type=kind)

    def publish(self, topic: str, message: Mapping[str, Any]) -> None:
        """Send a message; from any thread."""
        self._send(op="publish", topic=topic, msg=message)

    def received(self, topic: str) -> tuple[Received, ...]:
        """The last messages of a topic, the newest last."""
        with self._news:
            return tuple(self._received.get(topic, ()))

    def count(self, topic: str) -> int:
        """Messages of a topic so far."""
        with self._news:
            return self._counted(topic)

    def wait(self, counts: Mapping[str, int], timeout_s: float) -> str | None:
        """Wait until so many messages have come of each topic.

        Args:
            counts: by topic.
            timeout_s: for all of them [s].

        Returns:
            A topic that did not come, or None.

        Raises:
            ConnectionLost: if the connection broke.
        """
        with self._news:
            self._news.wait_for(lambda: self._lost or not self._missing(counts), timeout_s)
            self._check()
            return next(iter(self._missing(counts)), None)

    def wait_for_more(self, topics: Sequence[str], count: int, timeout_s: float) -> None:
        """Wait until more than so many messages have come of some topics together, or the time is over.

        Raises:
            ConnectionLost: if the connection broke.
        """
        with self._news:
            self._news.wait_for(lambda: self._lost or sum(map(self._counted, topics)) > count, max(timeout_s, 0.0))
            self._check()

    def close(self) -> None:
        """Close the connection; calling it again does nothing."""
        self._socket.close()
        self._reader.join()

    def _missing(self, counts: Mapping[str, int]) -> list[str]:
        return [topic for topic, count in counts.items() if self._counted(topic) < count]

    def _counted(self, topic: str) -> int:
        received = self._received.get(topic)
        return received[-1].count if received else 0

    def _check(self) -> None:
        if self._lost:
            raise ConnectionLost(self._url, self._lost)

    def _send(self, **message: object) -> None:
        try:
            self._socket.send(json.dumps(message))
        except (ConnectionClosed, OSError) as error:
            raise ConnectionLost(self._url, str(error) or type(error).__name__) from error

    def _read(self) -> None:
        try:
            for text in self._socket:
                self._take(text)
            self._end("it closed the connection")
        except (ConnectionClosed, OSError) as error:
            self._end(str(error) or type(error).__name__)

    def _take(self, text: str | bytes) -> None:
        try:
            content = json.loads(text)
        except ValueError:
            return
        if not isinstance(content, dict) or content.get("op") != "publish" or not isinstance(content.get("msg"), dict):
            return  # such as a status, which tells nothing that is needed
        topic = str(content.get("topic"))
        with self._news:
            before = self._received.setdefault(topic, [])
            before.append(Received(content["msg"], self._counted(topic) + 1))
            del before[: -self._kept.get(topic, 1)]
            self._news.notify_all()

    def _end(self, reason: str) -> None:
        with self._news:
            self._lost = reason
            self._news.notify_all()


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
