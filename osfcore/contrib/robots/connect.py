"""Connections to robots by address."""

from __future__ import annotations

from urllib.parse import SplitResult, parse_qsl, urlsplit

from osfcore.contrib.robots.http_robot import HttpRobot
from osfcore.contrib.robots.robot import Robot, SafetyLimits
from osfcore.errors import InvalidInput, check_known
from osfcore.extras import need

FORMS = "http://HOST:PORT, https://HOST:PORT or ros://HOST:9090?cameras=NAME,NAME"
_ROS_PORT = 9090
_ROS_NAMES = ("cameras", "image", "info", "twist", "table", "pusher")


def connect(url: str, names: tuple[str, ...] = (), limits: SafetyLimits | None = None) -> Robot:
    """Connect to the robot at an address.

    Args:
        url: address of a robot over HTTP, or of rosbridge with the names of ROS in its query (`RosNames`).
        names: names of the objects on the table.
        limits: limits of a robot under ROS, which has no message for them; the usual ones if None.

    Raises:
        InvalidInput, UnknownName: if the address is malformed.
        MissingExtra: if a package for ROS is not installed.
        ConnectionLost: if there is no answer.
        RobotRefused: if the answer does not come from a robot.
    """
    parts = check_address(url)
    host, port = parts.hostname or "", parts.port
    if parts.scheme != "ros":
        return HttpRobot(url, names)
    need("ros", "A robot under ROS")
    from osfcore.contrib.robots.ros_robot import RosNames, RosRobot

    asked = dict(parse_qsl(parts.query))
    check_known("part of a robot's address", asked, _ROS_NAMES)
    cameras = tuple(filter(None, asked.pop("cameras", "").split(",")))
    address = f"ws://{f'[{host}]' if ':' in host else host}:{port or _ROS_PORT}"
    return RosRobot(address, RosNames(cameras, **asked), names, limits or SafetyLimits())


def check_address(url: str) -> SplitResult:
    """Split a robot's address into its parts.

    Raises:
        InvalidInput: if the address is malformed.
    """
    try:
        parts = urlsplit(url)
        host, _ = parts.hostname, parts.port
    except ValueError:
        raise InvalidInput("address of the robot", url, FORMS) from None
    if not host or parts.scheme not in ("http", "https", "ros"):
        raise InvalidInput("address of the robot", url, FORMS)
    return parts
