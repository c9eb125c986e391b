"""Episodes of pushes made by hand, for tests of what scores predictions."""

import numpy as np

from osfcore.dynamics.rollout import load_shapes
from osfcore.fields.field_library import FieldLibrary
from osfcore.geometry.poses import quaternion_exp
from osfcore.io.push_file import PushEpisode

NAMES = ("005_tomato_soup_can", "009_gelatin_box")
STEPS = 34


def shapes():
    library = FieldLibrary(None)
    return load_shapes(None, library, NAMES)


def episode(*, speed: float = 0.0, turn: float = 0.0, names: tuple[str, ...] = NAMES) -> PushEpisode:
    """The first object slides along x [m a step] and turns about z [rad a step]; the pusher is far away."""
    count, times = len(names), np.arange(STEPS + 1)
    positions = np.zeros((STEPS + 1, count, 3))
    positions[:, :, 1] = 0.2 * np.arange(count)
    positions[:, :, 2] = 0.05
    positions[:, 0, 0] = -0.1 + speed * times
    turned = quaternion_exp(np.stack([0 * times, 0 * times, turn * times], axis=1))
    quaternions = np.tile([1.0, 0, 0, 0], (STEPS + 1, count, 1))
    quaternions[:, 0] = turned
    pusher = np.tile([0.3, -0.3, 0.062], (STEPS + 1, 1))
    return PushEpisode(names, 0, positions, quaternions, pusher, np.zeros((STEPS, 3)), np.zeros((STEPS, count), bool))
