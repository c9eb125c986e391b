"""Pictures of how an observation was understood: axes, workspace and masks, drawn into its images."""

from __future__ import annotations

import colorsys
import math

import cv2
import numpy as np
from jaxtyping import Bool, UInt8

from osfcore.geometry.cameras import Camera
from osfcore.geometry.states import Observation
from osfcore.geometry.workspace import WORKSPACE_HALF_M
from osfcore.inspection.image_set_overlay import draw_line, draw_text
from osfcore.io.image_file import to_uint8

_MOST_COLUMNS = 4
_SIDE = 384  # longer side of a tile: outlines and names need more pixels than most images have
_AXIS_M = 0.1
_HUES = (0.5, 0.83, 0.08, 0.42, 0.92, 0.58, 0.22, 0.75)  # of the objects; far from each other one after the other


def observation_sheet(observation: Observation) -> UInt8[np.ndarray, "H W 3"]:
    """A tile for each camera, BGR.

    Each shows the world's axes at the table's centre, 10 cm long (x red, y green, z blue), the workspace's square of
    44 cm (white), the pusher's centre (yellow) and the outline of each mask in a colour of its object, with its name.
    """
    tiles = [_tile(observation, view) for view in range(len(observation.cameras))]
    columns = min(_MOST_COLUMNS, len(tiles))
    tiles += [np.zeros_like(tiles[0])] * (-len(tiles) % columns)
    return np.vstack([np.hstack(tiles[i : i + columns]) for i in range(0, len(tiles), columns)])


def object_colour(number: int) -> tuple[int, int, int]:
    """The colour (BGR) of the outlines of an object, by its number in the observation."""
    red, green, blue = colorsys.hsv_to_rgb(_HUES[number % len(_HUES)], 0.9, 1.0)
    return round(255 * blue), round(255 * green), round(255 * red)


def _tile(observation: Observation, view: int) -> UInt8[np.ndarray, "h w 3"]:
    height, width = observation.images.shape[1:3]
    scale = _SIDE / max(height, width)
    size = (max(16, round(width * scale)), max(16, round(height * scale)))
    pixels = to_uint8(observation.images[view, ..., ::-1])
    bgr = cv2.resize(pixels, size, interpolation=cv2.INTER_AREA if scale < 1 else cv2.INTER_NEAREST)
    camera = observation.cameras[view].resized(*size)
    _draw_workspace(bgr, camera)
    if observation.masks is not None:
        for number, name in enumerate(observation.names):
            draw_mask(bgr, observation.masks[view, number], name, object_colour(number))
    for axis, colour, letter in zip(np.eye(3), (_RED, _GREEN, _BLUE), "xyz", strict=True):
        draw_line(bgr, camera, np.zeros(3), _AXIS_M * axis, colour, 2, letter)
    if observation.pusher is not None:
        up = np.array([0, 0, 0.02])
        draw_line(bgr, camera, observation.pusher - up, observation.pusher + up, _YELLOW, 2)
    draw_text(bgr, f"camera {_plain(camera.name)}", (6, 16), _WHITE)
    if camera.T_world_camera.inverse().apply(np.zeros(3))[2] <= 0:
        draw_text(bgr, "the table is BEHIND the camera", (6, size[1] - 10), _RED)
    return bgr


def _draw_workspace(bgr: UInt8[np.ndarray, "h w 3"], camera: Camera) -> None:
    angles = math.pi / 4 + math.pi / 2 * np.arange(4)
    corners = math.sqrt(2) * WORKSPACE_HALF_M * np.stack([np.cos(angles), np.sin(angles), np.zeros(4)], axis=1)
    for a, b in zip(corners, np.roll(corners, -1, axis=0), strict=True):
        draw_line(bgr, camera, a, b, _WHITE, 1)


def draw_mask(
    bgr: UInt8[np.ndarray, "h w 3"], mask: Bool[np.ndarray, "H W"], name: str, colour: tuple[int, int, int]
) -> None:
    """The outline of a mask, and its name beside its top."""
    large = cv2.resize(mask.astype(np.uint8), bgr.shape[1::-1], interpolation=cv2.INTER_NEAREST)
    if not large.any():
        return
    outlines, _ = cv2.findContours(large, cv2.RETR_LIST, cv2.CHAIN_APPROX_NONE)
    cv2.drawContours(bgr, outlines, -1, colour, 1)
    rows, columns = np.nonzero(large)
    text = _plain(name)
    wide = cv2.getTextSize(text, cv2.FONT_HERSHEY_SIMPLEX, 0.4, 1)[0][0]
    left = max(2, min(int(columns[rows.argmin()]) - wide // 2, bgr.shape[1] - wide - 2))
    draw_text(bgr, text, (left, max(28, int(rows.min()) - 4)), colour)


def _plain(name: str) -> str:
    """What OpenCV's letters can write."""
    return name[:40].encode("ascii", "replace").decode()
