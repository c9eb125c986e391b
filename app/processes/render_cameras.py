"""Cameras for the renderer: a scene's, a browser's, and bands of one, so that a picture can be given up on the way."""

from __future__ import annotations

from collections.abc import Iterator
from dataclasses import replace
from itertools import pairwise

import numpy as np

from osfcore.errors import check_known
from osfcore.geometry.cameras import MAX_IMAGE_SIDE, MIN_IMAGE_SIDE, Camera, default_cameras, goal_camera, image_side
from osfcore.geometry.poses import Pose

_FARTHEST_M = 100.0
_FOV_RAD = (0.01, 3.0)
_ASPECT = (0.02, 50.0)
BAND_PIXELS = 50_000  # some tenths of a second


def scene_camera(name: str, size: int) -> Camera:
    """One of the cameras that every scene has, "0" to "3" or "goal", with images of a size [px].

    Raises:
        InvalidInput: if there can be no images of this size.
        UnknownName: if there is no such camera.
    """
    cameras = {camera.name: camera for camera in (*default_cameras(image_side(size)), goal_camera(size))}
    check_known("camera", [name], cameras)
    return cameras[name]


def view_camera(position: object, quaternion: object, fov_y_rad: float, aspect: float, rows: int) -> Camera | None:
    """The camera of a browser's view; None if what the browser sent makes no sense.

    Args:
        position: in the world [m].
        quaternion: from OpenCV axes into the world, (w, x, y, z).
        fov_y_rad: vertical field of view [rad].
        aspect: width of the view by its height.
        rows: wanted height of the picture [px]; fewer where the width would get too large.
    """
    where, turn = np.asarray(position, float), np.asarray(quaternion, float)
    numbers = np.concatenate([where.ravel(), turn.ravel(), [fov_y_rad, aspect]])
    if where.shape != (3,) or turn.shape != (4,) or not np.all(np.isfinite(numbers)):
        return None
    is_sane = _FOV_RAD[0] < fov_y_rad < _FOV_RAD[1] and _ASPECT[0] < aspect < _ASPECT[1]
    if not is_sane or np.abs(where).max() > _FARTHEST_M or not np.linalg.norm(turn) > 1e-6:
        return None
    height = _side(min(rows, MAX_IMAGE_SIDE / aspect))
    width = _side(height * aspect)
    # The picture is stretched over the whole view, so its pixels are as wide as they must be, not quite square.
    half = np.tan(fov_y_rad / 2)
    intrinsics = np.array([[width / 2 / (half * aspect), 0, width / 2], [0, height / 2 / half, height / 2], [0, 0, 1]])
    return Camera("view", Pose(where, turn / np.linalg.norm(turn)), intrinsics, width, height)


def bands(camera: Camera, pixels: int = BAND_PIXELS) -> Iterator[Camera]:
    """The same view in bands from top to bottom, each of about so many pixels [px]."""
    count = max(min(round(camera.width * camera.height / pixels), camera.height // MIN_IMAGE_SIDE), 1)
    edges = np.linspace(0, camera.height, count + 1).round().astype(int)
    for top, bottom in pairwise(edges.tolist()):
        intrinsics = camera.intrinsics.copy()
        intrinsics[1, 2] -= top
        yield replace(camera, intrinsics=intrinsics, height=bottom - top)


def _side(pixels: float) -> int:
    return int(np.clip(round(pixels), MIN_IMAGE_SIDE, MAX_IMAGE_SIDE))
