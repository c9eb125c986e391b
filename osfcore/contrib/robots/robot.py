"""A robot as a `World`, and the limits within which its pusher moves."""

from __future__ import annotations

import json
import re
from dataclasses import dataclass
from typing import Any, Protocol, runtime_checkable

import numpy as np
from jaxtyping import Float

from osfcore.control.world import World
from osfcore.errors import InvalidInput, OsfError, check_ranges, check_unique, finite_vector
from osfcore.geometry.cameras import Camera
from osfcore.geometry.workspace import PUSHER_RADIUS_M, PUSHER_REACH_M, STEP_S

# Limits of the pusher, in the table's frame: z up, the origin at the table's centre.

MIN_SPEED_M_S, TOP_SPEED_M_S = 0.005, 5.0  # a robot may be able to do more than any action asks
_BOX = "x0, y0, x1, y1, finite, with x0 < x1 and y0 < y1"


@dataclass(frozen=True, slots=True)
class SafetyLimits:
    """A box that the pusher's centre never leaves, and its top speed.

    Attributes:
        box: x0, y0, x1, y1 [m].
        top_speed_m_s: top speed of the pusher, in any direction [m/s].
    """

    box: tuple[float, float, float, float] = (-PUSHER_REACH_M, -PUSHER_REACH_M, PUSHER_REACH_M, PUSHER_REACH_M)
    top_speed_m_s: float = 0.1

    def __post_init__(self) -> None:
        """Check the ranges.

        Raises:
            InvalidInput: naming what is out of range.
        """
        x0, y0, x1, y1 = finite_vector(self.box, 4, "safety box [m]").tolist()
        if not (x0 < x1 and y0 < y1):
            raise InvalidInput("safety box [m]", self.box, _BOX)
        check_ranges(("top speed [m/s]", self.top_speed_m_s, MIN_SPEED_M_S, TOP_SPEED_M_S))
        object.__setattr__(self, "box", (x0, y0, x1, y1))

    def within(self, other: SafetyLimits) -> SafetyLimits:
        """Return the common part of two boxes, with the lower speed.

        Raises:
            InvalidInput: if the boxes have nothing in common.
        """
        (x0, y0, x1, y1), (a0, b0, a1, b1) = self.box, other.box
        box = max(x0, a0), max(y0, b0), min(x1, a1), min(y1, b1)
        if not (box[0] < box[2] and box[1] < box[3]):
            raise InvalidInput("safety box [m]", self.box, f"partly inside {other.box}, which holds as well")
        return SafetyLimits(box, min(self.top_speed_m_s, other.top_speed_m_s))

    def outside_m(self, where: Whereabouts) -> float:
        """Return how far outside the box the pusher may be [m]; 0 inside."""
        low, high = np.reshape(self.box, (2, 2))
        return float(max(0.0, (low - where.low).max(), (where.high - high).max()))

    def allowed_travel(self, travel: Float[np.ndarray, "2"], where: Whereabouts) -> Float[np.ndarray, "2"]:
        """Clip a travel to the box: it ends at a wall and continues along it.

        Per axis, as the simulated pusher stops at the border of its reach:

            min(t, high - where.high) >= 0 for t > 0, max(t, low - where.low) <= 0 for t < 0.

        Args:
            travel: travel of the pusher [m].
            where: rectangle that holds the pusher.
        """
        low, high = np.reshape(self.box, (2, 2))
        most, least = np.maximum(high - where.high, 0), np.minimum(low - where.low, 0)
        return np.clip(travel, least, most)

    def slow_parts(self, travel: Float[np.ndarray, "2"]) -> list[Float[np.ndarray, "3"]]:
        """Split a travel [m] into allowed velocities (vx, vy, 0) [m/s], each held for `STEP_S`.

        Pushes are quasi-static, so that only the path counts. Predictions of an action also hold for slower parts.
        """
        speed = float(np.linalg.norm(travel)) / STEP_S
        count = max(1, int(np.ceil(speed / self.top_speed_m_s - 1e-9)))
        return [np.array([*(travel / (count * STEP_S)), 0.0])] * count


@dataclass(frozen=True, eq=False, slots=True)
class Whereabouts:
    """A rectangle that holds the pusher's centre, whatever part of its commands it has executed.

    Attributes:
        low: least x and y [m].
        high: largest x and y [m].
    """

    low: Float[np.ndarray, "2"]
    high: Float[np.ndarray, "2"]

    @staticmethod
    def at(position: Float[np.ndarray, "*xyz"]) -> Whereabouts:
        """Return the point at which the pusher was measured; `pusher` is x, y and optionally z [m]."""
        return Whereabouts(position[:2].astype(float), position[:2].astype(float))

    def distance_m(self, place: Float[np.ndarray, "2"]) -> float:
        """Return how far outside the rectangle a place is [m]; 0 inside."""
        return float(np.linalg.norm(np.maximum(0, np.maximum(self.low - place, place - self.high))))

    def with_place(self, place: Float[np.ndarray, "2"]) -> Whereabouts:
        """Extend the rectangle by a place [m]."""
        return Whereabouts(np.minimum(self.low, place), np.maximum(self.high, place))

    def after(self, travel: Float[np.ndarray, "2"]) -> Whereabouts:
        """Extend the rectangle by a travel [m], of which only a part may be done, since objects may hold the pusher."""
        return Whereabouts(self.low + np.minimum(travel, 0), self.high + np.maximum(travel, 0))


# Checks of a robot's answers, over HTTP and rosbridge. Answers are not trusted: they may come from a broken robot or
# none.

ANSWER_S = 5.0  # from a question to the last byte of its answer
MOST_PICTURE_BYTES = 32_000_000  # a PNG of 2048 x 2048 pixels of 16 bits has 25 million
MOST_JSON_BYTES = 1_000_000  # without texts: pictures may come as such
MOST_CAMERAS = 16
_MOST_NESTED = 32
_TEXT = re.compile(r'"[^"\\]*+(?:\\.[^"\\]*+)*+"', re.DOTALL)


def parse_json(content: str | bytes) -> Any:  # noqa: ANN401
    """Parse JSON with limits on its size and depth.

    Raises:
        ValueError: if it is malformed, too large or nested too deeply.
    """
    text = content if isinstance(content, str) else content.decode()
    marks = _TEXT.sub("", text)
    if len(marks) > MOST_JSON_BYTES:
        raise ValueError("too large")
    depth = 0
    for bracket in re.finditer(r"[\[\]{}]", marks):
        depth += 1 if bracket[0] in "[{" else -1
        if depth > _MOST_NESTED:
            raise ValueError("nested too deeply")
    return json.loads(text)


# Parts of a robot in addition to a `World`: start and stop, a description, errors.

LONGEST_DEADMAN_S = 1.0


class RobotStopped(OsfError):
    """The robot was stopped and does not move any more.

    Args:
        reason: why, as the end of a sentence.
    """

    def __init__(self, reason: str) -> None:
        super().__init__(f"The robot was stopped: {reason.rstrip('.')}.")
        self.reason = reason


class ConnectionLost(OsfError):
    """The robot does not answer any more. It halts by itself.

    Args:
        url: address of the robot.
        reason: what happened.
    """

    def __init__(self, url: str, reason: str) -> None:
        lost = f"The robot at {url} does not answer ({reason.rstrip('.')})"
        super().__init__(f"{lost}; if it moved, it halts by itself. Check whether it runs and is on the network.")
        self.url, self.reason = url, reason


class RobotRefused(OsfError):
    """The robot refused a request, or its answer cannot be used.

    Args:
        url: address of the robot.
        reason: why, as the end of a sentence.
    """

    def __init__(self, url: str, reason: str) -> None:
        super().__init__(f"The robot at {url} refused or failed: {reason.rstrip('.')}.")
        self.url, self.reason = url, reason


@dataclass(frozen=True, eq=False, slots=True)
class RobotDescription:
    """A robot's description of itself.

    Attributes:
        cameras: cameras with their poses over the table.
        limits: limits that it enforces itself.
        pusher_radius_m: radius of its pusher, a vertical cylinder [m].
        deadman_s: time without a new command after which it halts [s].
        masks: names of the objects whose masks it can send.
    """

    cameras: tuple[Camera, ...]
    limits: SafetyLimits
    pusher_radius_m: float = PUSHER_RADIUS_M
    deadman_s: float = STEP_S
    masks: frozenset[str] = frozenset()

    def __post_init__(self) -> None:
        """Check the ranges, and that the cameras can be told apart.

        Raises:
            InvalidInput: naming what is out of range.
        """
        check_unique("cameras of the robot", [camera.name for camera in self.cameras], "each of another name")
        check_ranges(
            ("number of the robot's cameras", len(self.cameras), 1, MOST_CAMERAS),
            ("radius of the robot's pusher [m]", self.pusher_radius_m, 0.002, 0.05),
            ("time after which the robot halts without a command [s]", self.deadman_s, STEP_S, LONGEST_DEADMAN_S),
        )


@runtime_checkable
class Stoppable(Protocol):
    """Something that moves by itself and can be stopped."""

    def start(self) -> None:
        """Prepare to move, for the first time or after a stop. Nothing moves yet."""
        ...

    def stop(self) -> None:
        """Halt at once until `start`. Any thread may call this, even while another one waits in `act`."""
        ...


class Robot(World, Stoppable, Protocol):
    """A real world. Its `reset` only observes, because a person arranges the table."""

    @property
    def description(self) -> RobotDescription:
        """The robot's description of itself."""
        ...

    def pictures(self) -> tuple[bytes, ...]:
        """Return an image file of each camera, for `read_photograph`. Another thread may use the robot meanwhile."""
        ...
