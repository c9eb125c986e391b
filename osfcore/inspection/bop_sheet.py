"""What a scene of BOP holds, whether its parts fit each other, and pictures of how it was understood."""

from __future__ import annotations

from collections.abc import Sequence

import cv2
import numpy as np
from jaxtyping import UInt8

from osfcore.errors import InvalidInput
from osfcore.inspection.image_set_overlay import draw_line, draw_text
from osfcore.inspection.observation_overlay import draw_mask, object_colour
from osfcore.io.image_file import to_uint8
from osfcore.photo.other_programs.bop_images import BopImage

_SHARE = 0.5  # of the objects whose annotated place must fit their masks
_LEAST_PIXELS = 20  # of a mask that counts
_AXIS_M = 0.05
_AXES = ((0, 0, 255), (0, 255, 0), (255, 0, 0))
_MOST_TILES, _COLUMNS, _SIDE = 8, 4, 384


def check_places(images: Sequence[BopImage]) -> None:
    """Refuse a scene in which most objects are annotated elsewhere than their masks are.

    An object's centre must project into the box of its visible pixels, grown by the box's own size to all sides.

    Raises:
        InvalidInput: naming the first that does not fit: K, or a pose, is of other images.
    """
    fits = [(image, name, _fits(image, name)) for image in images for name in image.masks if name in image.poses]
    wrong = [(image, name) for image, name, is_fit in fits if not is_fit]
    if len(wrong) > _SHARE * len(fits):
        image, name = wrong[0]
        u, v = image.camera.project(image.poses[name].position)
        what = f"place of {name} in image {image.number} by cam_K and cam_t_m2c [px]"
        allowed = "where its mask is; cam_K may be of another image size, or the masks of another image"
        raise InvalidInput(what, f"({u:.0f}, {v:.0f})", allowed)


def _fits(image: BopImage, name: str) -> bool:
    rows, columns = np.nonzero(image.masks[name])
    if len(rows) < _LEAST_PIXELS:
        return True
    low, high = np.array([columns.min(), rows.min()]), np.array([columns.max(), rows.max()]) + 1
    place = image.camera.project(image.poses[name].position)
    return bool(np.all((place > 2 * low - high) & (place < 2 * high - low)))


def bop_sheet(images: Sequence[BopImage]) -> UInt8[np.ndarray, "H W 3"]:
    """A tile for each of up to eight images, BGR: outlines of masks, and axes of 5 cm of each annotated object."""
    tiles = [_tile(image) for image in images[:_MOST_TILES]]
    columns = min(_COLUMNS, len(tiles))
    tiles += [np.zeros_like(tiles[0])] * (-len(tiles) % columns)
    return np.vstack([np.hstack(tiles[k : k + columns]) for k in range(0, len(tiles), columns)])


def _tile(image: BopImage) -> UInt8[np.ndarray, "h w 3"]:
    bgr = cv2.resize(to_uint8(image.picture[..., ::-1]), (_SIDE, _SIDE * 3 // 4), interpolation=cv2.INTER_AREA)
    camera = image.camera.resized(bgr.shape[1], bgr.shape[0])
    for number, (name, pose) in enumerate(image.poses.items()):
        if name in image.masks:
            draw_mask(bgr, image.masks[name], name, object_colour(number))
        for axis, colour in zip(np.eye(3), _AXES, strict=True):
            draw_line(bgr, camera, pose.position, pose.apply(_AXIS_M * axis), colour, 2)
    draw_text(bgr, f"image {image.number}", (6, 16), (255, 255, 255))
    return bgr
