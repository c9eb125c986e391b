"""The table that the examples share: two objects under a low light, with the pusher beside them."""

import numpy as np

from osfcore import Light, Pose, SceneState

NAMES = ("005_tomato_soup_can", "009_gelatin_box")


def table() -> SceneState:
    """A can that stands and a box that lies flat."""
    positions = np.array([[-0.06, 0.03, 0.051], [0.08, -0.02, 0.015]])
    quaternions = np.array([[1.0, 0, 0, 0], [np.cos(0.3), 0, 0, np.sin(0.3)]])
    light = Light.from_angles(np.deg2rad(200), np.deg2rad(25))
    return SceneState(NAMES, Pose(positions, quaternions), light, np.array([-0.2, -0.1, 0.062]))
