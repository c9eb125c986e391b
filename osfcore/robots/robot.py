"""What a robot must offer besides a `World`: that it can be started and stopped; what it says of itself; its errors."""

from __future__ import annotations

from dataclasses import dataclass
from typing import Protocol, runtime_checkable

from osfcore.control.world_protocol import World
from osfcore.errors import OsfError, check_ranges
from osfcore.geometry.cameras import Camera
from osfcore.geometry.workspace import PUSHER_RADIUS_M, STEP_S
from osfcore.robots.safety_limits import SafetyLimits

LONGEST_DEADMAN_S = 1.0


class RobotStopped(OsfError):
    """The robot was stopped; it moves no more.

    Args:
        reason: why, as the end of a sentence.
    """

    def __init__(self, reason: str) -> None:
        super().__init__(f"The robot was stopped: {reason.rstrip('.')}.")


class ConnectionLost(OsfError):
    """A robot that no longer answers; it halts by itself.

    Args:
        url: of the robot.
        reason: what happened.
    """

    def __init__(self, url: str, reason: str) -> None:
        told = f"The robot at {url} does not answer ({reason.rstrip('.')})"
        super().__init__(f"{told}; if it moved, it halts by itself. See whether it runs and is on the network.")


class RobotRefused(OsfError):
    """What a robot answers to something that it does not do, or an answer that nobody understands.

    Args:
        url: of the robot.
        reason: a sentence.
    """

    def __init__(self, url: str, reason: str) -> None:
        super().__init__(f"The robot at {url} says: {reason.rstrip('.')}.")


@dataclass(frozen=True, eq=False, slots=True)
class RobotDescription:
    """What a robot says of itself.

    Attributes:
        cameras: that it has, with their places over the table.
        limits: that it keeps itself.
        pusher_radius_m: of its hand, a vertical cylinder [m].
        deadman_s: without a new command it halts after this time [s].
        masks: objects whose masks it delivers.
    """

    cameras: tuple[Camera, ...]
    limits: SafetyLimits
    pusher_radius_m: float = PUSHER_RADIUS_M
    deadman_s: float = STEP_S
    masks: frozenset[str] = frozenset()

    def __post_init__(self) -> None:
        """Check the ranges.

        Raises:
            InvalidInput: naming what is out of range.
        """
        check_ranges(
            ("radius of the robot's pusher [m]", self.pusher_radius_m, 0.002, 0.05),
            ("time after which the robot halts without a command [s]", self.deadman_s, STEP_S, LONGEST_DEADMAN_S),
        )


@runtime_checkable
class Stoppable(Protocol):
    """What moves by itself and can be told not to."""

    def start(self) -> None:
        """Make ready to move, after a stop or for the first time; nothing moves yet."""
        ...

    def stop(self) -> None:
        """Halt at once and stay so until `start`; from any thread, also while another one waits in `act`."""
        ...


class Robot(World, Stoppable, Protocol):
    """A world of motors: `reset` only looks, for what lies on the table is a person's business."""

    @property
    def description(self) -> RobotDescription:
        """What the robot says of itself."""
        ...

    def pictures(self) -> tuple[bytes, ...]:
        """A new picture of each camera, as files that `read_photograph` takes; also while another thread does more."""
        ...
