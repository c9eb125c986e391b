"""Where a photographed layout lies on our own table: seen from the goal camera's side, its middle in the middle."""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np

from osfcore.errors import InvalidInput
from osfcore.geometry.poses import Pose, quaternion_exp, rotate
from osfcore.geometry.workspace import WORKSPACE_HALF_M

_LEAST_HORIZONTAL = 1e-3  # of a viewing direction: a camera that looks straight down has its image's top ahead


def place_on_table(T_photo_camera: Pose, objects: Sequence[Pose]) -> Pose:
    """`T_table_photo`, a turn about the vertical and a horizontal shift.

    The camera then looks along +y, as the goal camera does, and the bounding rectangle of the objects' centres has its
    middle above the table's. Photographs that share a frame (of a printed board) should share this pose, too.

    Args:
        T_photo_camera: pose of the camera in the photograph's table frame.
        objects: poses in that frame, at least one.

    Raises:
        InvalidInput: if the objects lie farther apart than the workspace is wide.
    """
    ahead = rotate(T_photo_camera.quaternion, np.array([[0.0, 0.0, 1.0], [0.0, -1.0, 0.0]]))
    x, y = ahead[0, :2] if np.linalg.norm(ahead[0, :2]) > _LEAST_HORIZONTAL else ahead[1, :2]
    turn = quaternion_exp(np.array([0.0, 0.0, np.pi / 2 - np.arctan2(y, x)]))
    turned = rotate(turn, np.array([pose.position for pose in objects]))[:, :2]
    low, high = turned.min(axis=0), turned.max(axis=0)
    refuse_wide(high - low)
    return Pose(np.array([*-(low + high) / 2, 0.0]), turn)


def refuse_wide(extent: np.ndarray) -> None:
    """Refuse a layout that does not fit into the workspace.

    Args:
        extent: of the centres along x and y [m].

    Raises:
        InvalidInput: if so.
    """
    width = 2 * WORKSPACE_HALF_M
    if extent.max() > width:
        allowed = f"at most {100 * width:.0f} cm: the pusher reaches no farther; photograph objects that lie closer"
        raise InvalidInput("distance between the objects in the photo", f"{100 * extent.max():.0f} cm", allowed)
