"""What programs of LeRobot are told of a table, and under which keys.

    action                           (2,) the pusher's velocity (vx, vy) [m/s], each within 0.3, held for 0.2 s
    observation.state                (2,) the pusher's place [m]
    observation.environment_state    (14 N,) poses of the N objects, then those of their goals; each is position [m] and
                                     quaternion (w, x, y, z) with w >= 0, T_world_object
    observation.images.camera_0 .. 3 what the cameras see, linear RGB of 8 bits; of the goal: observation.images.goal
    task                             what shall be done, in words

LeRobot's policies take `environment_state` for the truth that only a simulator knows: a data set for policies that look
leaves it out.
"""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np
from jaxtyping import Float

ACTION, STATE, ENVIRONMENT, IMAGES = (
    "action",
    "observation.state",
    "observation.environment_state",
    "observation.images",
)
STATE_NAMES, ACTION_NAMES = ("pusher_x", "pusher_y"), ("vx", "vy")
GOAL_IMAGE = "goal"
_POSE_NAMES = ("x", "y", "z", "qw", "qx", "qy", "qz")


def environment_state(poses: Float[np.ndarray, "N 7"], goal: Float[np.ndarray, "N 7"]) -> Float[np.ndarray, "D"]:
    """Rows of poses (`pose_rows`) of N objects and of their goals as one of D = 14 N numbers."""
    return np.concatenate([poses, goal]).reshape(-1)


def environment_names(objects: int) -> tuple[str, ...]:
    """What each number of an environment state is."""
    whose = [f"{what}_{number}" for what in ("object", "goal") for number in range(objects)]
    return tuple(f"{one}_{name}" for one in whose for name in _POSE_NAMES)


def image_name(camera: str) -> str:
    """What images of a camera "0" to "3" are called."""
    return f"camera_{camera}"


def instruction(names: Sequence[str], moved: Sequence[str]) -> str:
    """A task in words, such as "Push the gelatin box to its goal and leave the mug where it is.".

    Args:
        names: of the objects, such as "009_gelatin_box".
        moved: those that shall lie elsewhere; none if nobody knows.
    """
    if not moved:
        return f"Push {_listed(names)} to where the goal shows {'it' if len(names) == 1 else 'them'}."
    still = [name for name in names if name not in moved]
    told = f"Push {_listed(moved)} to {'its goal' if len(moved) == 1 else 'their goals'}"
    if still:
        told += f" and leave {_listed(still)} where {'it is' if len(still) == 1 else 'they are'}"
    return f"{told}."


def _listed(names: Sequence[str]) -> str:
    plain = [f"the {name.lstrip('0123456789_-').replace('_', ' ') or name}" for name in names]
    return " and ".join([", ".join(plain[:-1]), plain[-1]] if len(plain) > 1 else plain)
