"""Draw axes, light, boxes and masks into the images of sets and observations, to show how they were understood."""

from __future__ import annotations

import colorsys
import math
from collections.abc import Sequence
from itertools import combinations, product

import cv2
import numpy as np
from jaxtyping import Bool, Float, UInt8

from osfcore.geometry.cameras import Camera
from osfcore.geometry.states import Observation
from osfcore.geometry.workspace import WORKSPACE_HALF_M
from osfcore.io.image_file import to_uint8
from osfcore.io.image_set import ImageSet

_COLUMNS = 4  # images of each set, and most images of an observation in a row
_SIDE = 256
_ROUNDING = 1e-9  # share of a point's coordinates at which its depth is none: it lies in the camera itself
_NEAR = 1e-3  # share of a line's distance at which what lies behind the camera is cut off
_BACKGROUND = 96
AXIS_COLOURS = (0, 0, 255), (0, 255, 0), (255, 0, 0)  # x red, y green, z blue, BGR
_RED = AXIS_COLOURS[0]
_YELLOW, _MAGENTA, _WHITE = (0, 255, 255), (255, 0, 255), (255, 255, 255)


def tiled(tiles: Sequence[UInt8[np.ndarray, "h w 3"]]) -> UInt8[np.ndarray, "H W 3"]:
    """Put tiles of one size into rows of at most four, the last one filled up with black."""
    columns = min(_COLUMNS, len(tiles))
    full = [*tiles, *[np.zeros_like(tiles[0])] * (-len(tiles) % columns)]
    return np.vstack([np.hstack(full[i : i + columns]) for i in range(0, len(full), columns)])


def overlay_sheet(sets: Sequence[ImageSet], box: Float[np.ndarray, "2 3"] | None) -> UInt8[np.ndarray, "H W 3"]:
    """Draw a row of tiles for each set, BGR: world axes (x red, y green, z blue), light (yellow), box (magenta).

    Args:
        sets: splits of one set; of each, images from its whole length are shown.
        box: least and greatest corner of the object, or None for the table.
    """
    rows = []
    for images in sets:
        chosen = np.linspace(0, len(images.cameras) - 1, _COLUMNS).astype(int)
        tiles = [_tile(images, i, box) for i in dict.fromkeys(chosen.tolist())]
        rows.append(np.hstack(tiles + [np.zeros_like(tiles[0])] * (_COLUMNS - len(tiles))))
    return np.vstack(rows)


def _tile(images: ImageSet, index: int, box: Float[np.ndarray, "2 3"] | None) -> UInt8[np.ndarray, "h w 3"]:
    rgba = images.rgba[index]
    alpha = rgba[..., 3:].astype(float) / 255
    bgr = (rgba[..., 2::-1] * alpha + _BACKGROUND * (1 - alpha)).astype(np.uint8)
    bgr = cv2.resize(bgr, (_SIDE, _SIDE), interpolation=cv2.INTER_AREA)
    camera = images.cameras[index].resized(_SIDE, _SIDE)
    middle = np.zeros(3) if box is None else box.mean(axis=0)
    if box is not None:
        for a, b in combinations(product((0, 1), repeat=3), 2):
            if sum(i != j for i, j in zip(a, b, strict=True)) == 1:  # corners of one edge
                draw_line(bgr, camera, box[a, (0, 1, 2)], box[b, (0, 1, 2)], _MAGENTA, 1)
    length = 0.25 * float(np.linalg.norm(camera.T_world_camera.position - middle))
    _draw_axes(bgr, camera, length)
    draw_line(bgr, camera, middle, middle + length * images.light_directions[index], _YELLOW, 2, "light")
    draw_text(bgr, camera.name, (6, 16), _WHITE)
    if camera.T_world_camera.inverse().apply(middle)[2] <= 0:
        draw_text(bgr, "object is BEHIND the camera", (6, _SIDE - 10), _RED)
    return bgr


def _draw_axes(bgr: UInt8[np.ndarray, "h w 3"], camera: Camera, length: float) -> None:
    """Draw the world's axes at its origin [m]."""
    for axis, colour, letter in zip(np.eye(3), AXIS_COLOURS, "xyz", strict=True):
        draw_line(bgr, camera, np.zeros(3), length * axis, colour, 2, letter)


def draw_line(
    bgr: UInt8[np.ndarray, "h w 3"],
    camera: Camera,
    a: Float[np.ndarray, "3"],
    b: Float[np.ndarray, "3"],
    colour: tuple[int, int, int],
    width: int,
    label: str = "",
) -> None:
    """Draw the part of a line between world points that lies before the camera, in place.

    Args:
        bgr: the camera's image.
        camera: that took it.
        a: start of the line, world frame [m].
        b: end of the line [m].
        colour: BGR.
        width: of the line [px].
        label: written beside `b`; a labelled line is an arrow to it.
    """
    depth = camera.T_world_camera.inverse().apply(np.stack([a, b]))[:, 2]
    near = _NEAR * float(np.abs(depth).max())
    if depth.max() <= max(near, _ROUNDING * float(np.abs(a).max())):
        return
    if depth.min() < near:
        cut = a + (b - a) * (near - depth[0]) / (depth[1] - depth[0])
        a, b = (cut, b) if depth[0] < near else (a, cut)
    ends = np.clip(np.round(camera.project(np.stack([a, b]))), -10_000, 10_000).astype(int).tolist()
    if not label:
        cv2.line(bgr, ends[0], ends[1], colour, width, cv2.LINE_AA)
        return
    cv2.arrowedLine(bgr, ends[0], ends[1], colour, width, cv2.LINE_AA, tipLength=0.15)
    draw_text(bgr, label, (ends[1][0] + 4, ends[1][1] - 4), colour)


def draw_text(bgr: UInt8[np.ndarray, "h w 3"], text: str, place: tuple[int, int], colour: tuple[int, int, int]) -> None:
    """Write small letters with a shadow into an image, in place.

    Args:
        bgr: the image.
        text: ASCII; OpenCV's font has nothing else.
        place: (x, y) of the lower left corner of the text [px].
        colour: BGR.
    """
    for x, y, shade in ((place[0] + 1, place[1] + 1, (0, 0, 0)), (*place, colour)):
        cv2.putText(bgr, text, (x, y), cv2.FONT_HERSHEY_SIMPLEX, 0.4, shade, 1, cv2.LINE_AA)


MASK_COLOURS = np.array([
    [230, 85, 60], [60, 140, 230], [70, 180, 90], [235, 180, 50],
    [160, 95, 210], [40, 190, 190], [235, 110, 170], [140, 120, 90],
], np.uint8)  # fmt: skip


def tint_masks(pixels: UInt8[np.ndarray, "h w 3"], masks: Bool[np.ndarray, "N h w"]) -> UInt8[np.ndarray, "h w 3"]:
    """Return an image with the masks of N objects laid over it, half transparent, one colour each."""
    drawn = pixels.copy()
    for number, mask in enumerate(masks):
        colour = MASK_COLOURS[number % len(MASK_COLOURS)]
        drawn[mask] = (pixels[mask].astype(np.uint16) + colour) // 2
    return drawn


_VIEW_SIDE = 384  # longer side of a tile: outlines and names need more pixels than most images have
_AXIS_M = 0.1
_HUES = (0.5, 0.83, 0.08, 0.42, 0.92, 0.58, 0.22, 0.75)  # of the objects; far from each other one after the other


def observation_sheet(observation: Observation) -> UInt8[np.ndarray, "H W 3"]:
    """Draw a tile for each camera, BGR.

    Each shows the world's axes at the table's centre, 10 cm long (x red, y green, z blue), the workspace's square of
    44 cm (white), the pusher's centre (yellow) and the outline of each mask in a colour of its object, with its name.
    """
    return tiled([_view_tile(observation, view) for view in range(len(observation.cameras))])


def object_colour(number: int) -> tuple[int, int, int]:
    """Return the colour (BGR) of the outlines of an object, by its number in the observation."""
    red, green, blue = colorsys.hsv_to_rgb(_HUES[number % len(_HUES)], 0.9, 1.0)
    return round(255 * blue), round(255 * green), round(255 * red)


def _view_tile(observation: Observation, view: int) -> UInt8[np.ndarray, "h w 3"]:
    height, width = observation.images.shape[1:3]
    scale = _VIEW_SIDE / max(height, width)
    size = (max(16, round(width * scale)), max(16, round(height * scale)))
    pixels = to_uint8(observation.images[view, ..., ::-1])
    bgr = cv2.resize(pixels, size, interpolation=cv2.INTER_AREA if scale < 1 else cv2.INTER_NEAREST)
    camera = observation.cameras[view].resized(*size)
    angles = math.pi / 4 + math.pi / 2 * np.arange(4)
    corners = math.sqrt(2) * WORKSPACE_HALF_M * np.stack([np.cos(angles), np.sin(angles), np.zeros(4)], axis=1)
    for a, b in zip(corners, np.roll(corners, -1, axis=0), strict=True):
        draw_line(bgr, camera, a, b, _WHITE, 1)
    if observation.masks is not None:
        for number, name in enumerate(observation.names):
            draw_mask(bgr, observation.masks[view, number], name, object_colour(number))
    _draw_axes(bgr, camera, _AXIS_M)
    if observation.pusher is not None:
        up = np.array([0, 0, 0.02])
        draw_line(bgr, camera, observation.pusher - up, observation.pusher + up, _YELLOW, 2)
    draw_text(bgr, f"camera {_plain(camera.name)}", (6, 16), _WHITE)
    if camera.T_world_camera.inverse().apply(np.zeros(3))[2] <= 0:
        draw_text(bgr, "the table is BEHIND the camera", (6, size[1] - 10), _RED)
    return bgr


def draw_mask(
    bgr: UInt8[np.ndarray, "h w 3"], mask: Bool[np.ndarray, "H W"], name: str, colour: tuple[int, int, int]
) -> None:
    """Draw the outline of a mask and its name beside its top, in place."""
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
    """Return at most 40 characters, in the letters that OpenCV can write."""
    return name[:40].encode("ascii", "replace").decode()
