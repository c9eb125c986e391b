"""The part of rosbridge's protocol (v2.0, JSON over a websocket) that a robot needs: subscribe, advertise, publish.

roslibpy speaks all of it, but by the reactor of Twisted, of which a process has one that cannot be started twice: a
connection that was lost could not be opened anew, nor closed without the threads that it leaves. What is needed of the
protocol are four kinds of messages.
"""

from __future__ import annotations

import json
import threading
from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from typing import Any

from websockets.exceptions import ConnectionClosed, InvalidURI, WebSocketException
from websockets.sync.client import connect

from osfcore.robots.robot import ConnectionLost

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
