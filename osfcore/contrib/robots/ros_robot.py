"""A robot under ROS 2 through rosbridge, without ROS here: it sends images, camera_info and tf, and receives twists."""

from __future__ import annotations

import base64
import contextlib
import json
import threading
import time
from collections import Counter, deque
from collections.abc import Callable, Iterable, Mapping, Sequence
from dataclasses import dataclass
from itertools import chain
from typing import Any

import numpy as np
from jaxtyping import Float
from pydantic import Field, FiniteFloat
from websockets.exceptions import ConnectionClosed, InvalidURI, WebSocketException
from websockets.sync.client import connect

from osfcore.contrib.robots.http_robot import SentCamera, observation_of
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
from osfcore.errors import CorruptFile, InvalidInput, OsfError, UnknownName, check_unique
from osfcore.geometry.poses import Pose, unit_quaternion
from osfcore.geometry.states import Observation
from osfcore.geometry.workspace import STEP_S, check_action
from osfcore.io.json_codec import Entry, decode
from osfcore.photo.lens import lens_of

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
    """The frames of ROS by `T_parent_child`; later messages replace earlier ones.

    Args:
        messages: messages of /tf and /tf_static, the older first.

    Raises:
        InvalidInput: if a message is malformed.
    """

    def __init__(self, messages: Iterable[Mapping[str, Any]]) -> None:
        self._parents: dict[str, tuple[str, Pose]] = {}
        for message in messages:
            for each in decode(_Message, message, "transforms").transforms:
                t, q = each.transform.translation, each.transform.rotation
                child = _plain(each.child_frame_id)
                quaternion = unit_quaternion(np.array([q.w, q.x, q.y, q.z]), f"rotation of frame {child}")
                self._parents[child] = _plain(each.header.frame_id), Pose(np.array([t.x, t.y, t.z]), quaternion)

    def pose(self, frame: str, within: str) -> Pose:
        """Return `T_within_frame`, through a common ancestor.

        Raises:
            UnknownName: if there is none.
        """
        T_ancestors_within = self._ancestors(_plain(within))
        for ancestor, T_ancestor_frame in self._ancestors(_plain(frame)).items():
            if ancestor in T_ancestors_within:
                return T_ancestors_within[ancestor].inverse() @ T_ancestor_frame
        raise UnknownName(f"frame that leads to {within}", frame, self._parents)

    def _ancestors(self, frame: str) -> dict[str, Pose]:
        """Return `T_ancestor_frame` of a frame's ancestors, itself included, the nearest first."""
        pose = Pose.identity()
        ancestors = {frame: pose}
        while frame in self._parents:
            frame, T_parent_child = self._parents[frame]
            if frame in ancestors:  # a circle
                break
            pose = T_parent_child @ pose
            ancestors[frame] = pose
        return ancestors


def _plain(frame: str) -> str:
    return frame.removeprefix("/")


# The part of rosbridge's protocol (v2.0, JSON over a websocket) that a robot needs: subscribe, advertise, publish.
#
# roslibpy speaks all of it, but through the reactor of Twisted, of which a process has one that cannot be started
# twice: a lost connection could not be reopened, nor closed without leaving its threads.

_MOST_BYTES = MOST_PICTURE_BYTES * 4 // 3 + MOST_JSON_BYTES  # of a message: pictures come in base64


class Rosbridge:
    """One connection, with a thread that receives messages.

    Args:
        url: address of rosbridge's websocket, ws://host:port.
        timeout_s: how long opening and closing may take [s].

    Raises:
        ConnectionLost: if nobody answers.
    """

    def __init__(self, url: str, timeout_s: float) -> None:
        self._url = url
        try:
            # A robot is beside the computer: no proxy. Pings notice in time that it has gone.
            self._socket = connect(
                url, proxy=None, compression=None, max_size=_MOST_BYTES, open_timeout=timeout_s,
                close_timeout=timeout_s, ping_interval=timeout_s, ping_timeout=timeout_s,
            )  # fmt: skip
        except (OSError, TimeoutError, WebSocketException, InvalidURI) as error:
            raise ConnectionLost(url, str(error) or type(error).__name__) from error
        self._news = threading.Condition()
        self._messages: dict[str, deque[tuple[int, Mapping[str, Any]]]] = {}  # each with its size [bytes]
        self._counts: Counter[str] = Counter()
        self._lost = ""
        self._reader = threading.Thread(target=self._read, name="rosbridge", daemon=True)
        self._reader.start()

    def subscribe(self, topic: str, kind: str, *, every_ms: int = 0, kept: int = 1) -> None:
        """Ask for a topic.

        Args:
            topic: its name.
            kind: type of its messages, such as sensor_msgs/msg/CameraInfo.
            every_ms: least time between two messages [ms].
            kept: how many of the last messages are kept, if they are not too large together.
        """
        self._messages[topic] = deque(maxlen=kept)
        # A queue of one holds the newest of what comes between two messages; without one (0) nothing is held.
        queue = 0 if kept > 1 else 1
        self.send(op="subscribe", topic=topic, type=kind, throttle_rate=every_ms, queue_length=queue)

    def send(self, **message: object) -> None:
        """Send a message of the protocol; from any thread.

        Raises:
            ConnectionLost: if the connection broke.
        """
        try:
            self._socket.send(json.dumps(message))
        except (ConnectionClosed, OSError) as error:
            raise ConnectionLost(self._url, str(error) or type(error).__name__) from error

    def received(self, topic: str) -> tuple[Mapping[str, Any], ...]:
        """Return the kept messages of a topic, as rosbridge makes JSON of them, the newest last."""
        with self._news:
            return tuple(message for _, message in self._messages[topic])

    def count(self, *topics: str) -> int:
        """Return how many messages of some topics have come so far."""
        with self._news:
            return sum(self._counts[topic] for topic in topics)

    def wait(self, counts: Mapping[str, int], timeout_s: float) -> str | None:
        """Wait until so many messages have come of each topic.

        Args:
            counts: by topic.
            timeout_s: for all of them [s].

        Returns:
            A topic of which too few came, or None.

        Raises:
            ConnectionLost: if the connection broke.
        """

        def missing() -> list[str]:
            return [topic for topic, count in counts.items() if self._counts[topic] < count]

        self._wait_until(lambda: not missing(), timeout_s)
        return next(iter(missing()), None)

    def wait_for_more(self, topics: Sequence[str], count: int, timeout_s: float) -> None:
        """Wait until more than so many messages have come of some topics together, or the time is over.

        Raises:
            ConnectionLost: if the connection broke.
        """
        self._wait_until(lambda: self.count(*topics) > count, max(timeout_s, 0.0))

    def close(self) -> None:
        """Close the connection; calling it again does nothing."""
        self._socket.close()
        self._reader.join()

    def _wait_until(self, holds: Callable[[], bool], timeout_s: float) -> None:
        with self._news:
            self._news.wait_for(lambda: self._lost or holds(), timeout_s)
            if self._lost:
                raise ConnectionLost(self._url, self._lost)

    def _read(self) -> None:
        """Receive messages until the connection ends, then note why."""
        reason = "it closed the connection"
        try:
            for text in self._socket:
                self._take(text)
        except Exception as error:  # whatever it stumbles over, those who wait are not to wait in vain
            reason = str(error) or type(error).__name__
        with self._news:
            self._lost = reason
            self._news.notify_all()

    def _take(self, text: str | bytes) -> None:
        """Keep a published message; others, such as a status, are not needed, nor what is no JSON of a usual size."""
        content = None
        with contextlib.suppress(ValueError):
            content = parse_json(text)
        match content:
            case {"op": "publish", "topic": str(topic), "msg": dict(message)} if topic in self._messages:
                with self._news:
                    kept = self._messages[topic]
                    kept.append((len(text), message))
                    while len(kept) > 1 and sum(size for size, _ in kept) > MOST_JSON_BYTES:
                        kept.popleft()
                    self._counts[topic] += 1
                    self._news.notify_all()


_TWIST_EVERY_S = 0.05  # more often than any controller gives up on its commands
_PICTURES_EVERY_MS = 50
_FRESH = 2  # pictures to wait for: the first may have been exposed before it was asked for
_MOVING, _TRANSFORMS_KEPT = "/tf", 200
_TRANSFORMS = ("/tf_static", _MOVING)


@dataclass(frozen=True, slots=True)
class RosNames:
    """Topics and frames of a robot.

    Attributes:
        cameras: namespaces of the cameras.
        image: topic of the pictures below each, sensor_msgs/CompressedImage.
        info: topic of the calibration below each, sensor_msgs/CameraInfo.
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
        """Check that there are cameras with different names.

        Raises:
            InvalidInput: if there are none, or two have the same name.
        """
        if not self.cameras or not all(self.cameras):
            given = ", ".join(self.cameras) or "missing"
            raise InvalidInput("cameras of the robot", given, "names of ROS, one or more")
        check_unique("cameras of the robot", self.cameras, "each of another name")

    def topic(self, camera: str, below: str) -> str:
        """Return the full name of a camera's topic."""
        return f"/{camera.strip('/')}/{below}"


class _CameraInfo(Entry):
    header: _Header
    width: int
    height: int
    k: list[FiniteFloat] = Field(min_length=9, max_length=9)
    d: list[FiniteFloat] = Field(default=[])
    distortion_model: str = ""


class _Picture(Entry):
    data: str


class RosRobot:
    """A `Robot` under ROS; `description` has the cameras that ROS publishes, and the limits that were given.

    Args:
        url: address of rosbridge's websocket, ws://host:9090.
        topics: names of topics and frames.
        names: names of the objects on the table, given by a person.
        limits: limits of this robot, for which ROS has no message.
        timeout_s: how long pictures and calibration may take [s].

    Raises:
        ConnectionLost: if nobody answers.
        RobotRefused: if a topic that is needed is not published.
        InvalidInput, UnknownName: if calibration or transforms are malformed.
    """

    def __init__(
        self, url: str, topics: RosNames, names: tuple[str, ...], limits: SafetyLimits, timeout_s: float = ANSWER_S
    ) -> None:
        self._url, self._topics, self._names, self._timeout_s = url, topics, names, timeout_s
        self._halted = threading.Event()
        self._halted.set()  # until it is started
        self._sending = threading.Lock()
        self._bridge = Rosbridge(url, timeout_s)
        try:
            for camera in topics.cameras:
                info, image = topics.topic(camera, topics.info), topics.topic(camera, topics.image)
                self._bridge.subscribe(info, "sensor_msgs/msg/CameraInfo", every_ms=1000)
                self._bridge.subscribe(image, "sensor_msgs/msg/CompressedImage", every_ms=_PICTURES_EVERY_MS)
            for topic in _TRANSFORMS:
                self._bridge.subscribe(topic, "tf2_msgs/msg/TFMessage", kept=_TRANSFORMS_KEPT)
            self._bridge.send(op="advertise", topic=topics.twist, type="geometry_msgs/msg/TwistStamped")
            self._cameras = self._described_cameras()
            self.description = RobotDescription(tuple(camera.kept() for camera in self._cameras), limits)
        except OsfError:
            self._bridge.close()
            raise
        self._began = time.monotonic()

    def reset(self, seed: int) -> Observation:
        """Only observe, because a person arranges the table."""
        return self.observe()

    def observe(self, *, masks: bool = False) -> Observation:
        """Take a new image with every camera. There are never masks.

        Raises:
            ConnectionLost: if the connection broke.
            RobotRefused: if pictures or transforms do not come.
            CorruptFile, InvalidInput: if they are malformed.
        """
        pictures = self.pictures()
        self._wait({_MOVING: self._bridge.count(_MOVING) + 1})  # the pusher's place is no older than the pictures
        pusher = self._tree().pose(self._topics.pusher, self._topics.table).position
        return observation_of(self._cameras, pictures, self._names, pusher, time.monotonic() - self._began)

    def pictures(self) -> tuple[bytes, ...]:
        """Take a new picture with every camera.

        Raises:
            ConnectionLost: if the connection broke.
            RobotRefused: if pictures do not come.
            CorruptFile: if they are malformed.
        """
        topics = [self._topics.topic(camera.name, self._topics.image) for camera in self._cameras]
        self._wait({topic: self._bridge.count(topic) + _FRESH for topic in topics})
        return tuple(_picture(self._bridge.received(topic)[-1], topic) for topic in topics)

    def act(self, action: Float[np.ndarray, "3"]) -> None:
        """Send a velocity repeatedly for 0.2 s, then zero.

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
        self._bridge.wait({}, 0.0)  # raises if the connection broke

    def start(self) -> None:
        """Allow velocities to be sent."""
        self._halted.clear()

    def stop(self) -> None:
        """Send zero, and no other velocity until `start`. Any thread may call this."""
        self._halted.set()
        with self._sending:
            self._publish(np.zeros(3))

    def close(self) -> None:
        """Close the connection."""
        self._bridge.close()

    def _described_cameras(self) -> tuple[SentCamera, ...]:
        topics = {camera: self._topics.topic(camera, self._topics.info) for camera in self._topics.cameras}
        self._wait(dict.fromkeys(topics.values(), 1))
        infos = {
            camera: decode(_CameraInfo, self._bridge.received(topic)[-1], f"camera_info of {camera}")
            for camera, topic in topics.items()
        }
        tree = self._complete_tree([*(info.header.frame_id for info in infos.values()), self._topics.pusher])
        described = []
        for camera, info in infos.items():
            pose, K = tree.pose(info.header.frame_id, self._topics.table), np.reshape(info.k, (3, 3))
            lens = lens_of(K, info.distortion_model, info.d, f"camera {camera}")
            described.append(SentCamera(camera, pose, lens, info.width, info.height))
        return tuple(described)

    def _complete_tree(self, frames: list[str]) -> TransformTree:
        """Wait for transforms from the table to all frames; raise the error of the first frame without one."""
        end = time.monotonic() + self._timeout_s
        while True:
            count = self._bridge.count(*_TRANSFORMS)
            tree = self._tree()
            try:
                for frame in frames:
                    tree.pose(frame, self._topics.table)
                return tree
            except OsfError:
                if time.monotonic() > end:
                    raise
            self._bridge.wait_for_more(_TRANSFORMS, count, end - time.monotonic())

    def _tree(self) -> TransformTree:
        return TransformTree(chain.from_iterable(map(self._bridge.received, _TRANSFORMS)))

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
        stamped = {"header": {"frame_id": self._topics.table}, "twist": twist}
        self._bridge.send(op="publish", topic=self._topics.twist, msg=stamped)


def _picture(message: Mapping[str, object], topic: str) -> bytes:
    data = decode(_Picture, message, f"message of {topic}").data
    try:
        return base64.b64decode(data, validate=True)
    except ValueError:
        raise CorruptFile(topic, "its data are no base64") from None
