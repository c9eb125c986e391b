"""Pictures of how a set was understood: axes, light and the object's box, drawn into some of its images."""

from __future__ import annotations

from collections.abc import Sequence
from itertools import combinations, product

import cv2
import numpy as np
from jaxtyping import Float, UInt8

from osfcore.geometry.cameras import Camera
from osfcore.io.image_set import ImageSet

_COLUMNS = 4  # images of each set
_SIDE = 256
_NEAR = 1e-3  # share of a line's distance at which what lies behind the camera is cut off
_BACKGROUND = 96
_RED, _GREEN, _BLUE = (0, 0, 255), (0, 255, 0), (255, 0, 0)
_YELLOW, _MAGENTA, _WHITE = (0, 255, 255), (255, 0, 255), (255, 255, 255)


def overlay_sheet(sets: Sequence[ImageSet], box: Float[np.ndarray, "2 3"] | None) -> UInt8[np.ndarray, "H W 3"]:
    """A row of tiles for each set, BGR: world axes (x red, y green, z blue), light (yellow), box (magenta).

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
        for a, b in _edges(box):
            draw_line(bgr, camera, a, b, _MAGENTA, 1)
    length = 0.25 * float(np.linalg.norm(camera.T_world_camera.position - middle))
    for axis, colour, letter in zip(np.eye(3), (_RED, _GREEN, _BLUE), "xyz", strict=True):
        draw_line(bgr, camera, np.zeros(3), length * axis, colour, 2, letter)
    draw_line(bgr, camera, middle, middle + length * images.light_directions[index], _YELLOW, 2, "light")
    draw_text(bgr, camera.name, (6, 16), _WHITE)
    if camera.T_world_camera.inverse().apply(middle)[2] <= 0:
        draw_text(bgr, "object is BEHIND the camera", (6, _SIDE - 10), _RED)
    return bgr


def _edges(box: Float[np.ndarray, "2 3"]) -> list[tuple[np.ndarray, np.ndarray]]:
    """The twelve edges: pairs of corners that differ in one coordinate."""
    corners = list(product((0, 1), repeat=3))
    pairs = [(a, b) for a, b in combinations(corners, 2) if sum(i != j for i, j in zip(a, b, strict=True)) == 1]
    return [(box[a, (0, 1, 2)], box[b, (0, 1, 2)]) for a, b in pairs]


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
    if depth.max() <= near:
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
