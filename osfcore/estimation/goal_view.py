"""A fast check, without a renderer, whether an image comes from the goal camera or shows another table."""

from __future__ import annotations

import cv2
import numpy as np
from jaxtyping import Float, Float32

from osfcore.fields.table import TableField
from osfcore.geometry.cameras import Camera

_SIDE = 128  # of the picture that is looked at [px]
_PLAIN = 0.01  # standard deviation of the radiance, below which a picture is one plain colour
# Of the border of 24 goal images with one to eight objects, and of these as JPEGs, turned, dimmed, cropped or noisy, at
# most 33 % lay beside the table's colour; of four real photographs of tables 60 % or more, of the sample photo,
# whose wood has nearly the table's hue, 50 %.
_BORDER, _MOST_BESIDE = 1 / 12, 0.42  # of the picture's side; of the border
_BESIDE_TABLE = 0.03  # error of a pixel that the table does not explain [radiance]
_SHADED, _LIT = 0.2, 1.05  # light on the table, as a share of that under a lamp overhead


def is_goal_view(table: TableField, image: Float32[np.ndarray, "h w 3"], camera: Camera) -> bool:
    """Return whether the border of an image shows the table as a camera sees it; also True for a plain image.

    Objects seldom lie at the border.

    Args:
        table: field of the table.
        image: linear radiance in [0, 1].
        camera: camera that may have taken the image.
    """
    scale = min(1.0, _SIDE / max(image.shape[:2]))
    width, height = (max(round(side * scale), 1) for side in (image.shape[1], image.shape[0]))
    seen = cv2.resize(image, (width, height), interpolation=cv2.INTER_AREA)
    if seen.std(axis=(0, 1)).max() < _PLAIN:
        return True
    is_border = np.ones((height, width), bool)
    inset = round(_BORDER * min(height, width))
    is_border[inset : height - inset, inset : width - inset] = False
    rows, columns = np.nonzero(is_border)
    bare = _bare(table, camera.resized(width, height), np.stack([columns, rows], axis=-1) + 0.5)
    light = (seen[is_border] * bare).sum(axis=-1) / np.maximum((bare * bare).sum(axis=-1), 1e-6)
    beside = seen[is_border] - bare * np.clip(light, _SHADED, _LIT)[:, None]
    return bool((np.linalg.norm(beside, axis=-1) > _BESIDE_TABLE).mean() < _MOST_BESIDE)


def _bare(table: TableField, camera: Camera, pixels: Float[np.ndarray, "P 2"]) -> Float[np.ndarray, "P 3"]:
    """Return the radiance of the empty table under a lamp overhead, at pixels of a camera above it."""
    rays, origin = camera.ray_directions(pixels), camera.T_world_camera.position
    down = np.maximum(-rays[:, 2:], 1e-9)
    places = (origin + rays * origin[2] / down)[:, :2] / table.half_side  # -1 to 1 on the table
    cells = np.clip(np.rint((places + 1) / 2 * (len(table.albedo) - 1)), 0, len(table.albedo) - 1).astype(int)
    lit = table.albedo[cells[:, 0], cells[:, 1]] * (table.ambient + table.direct(np.array([[0.0, 0.0, 1.0]])))
    return np.where((np.abs(places) <= 1).all(axis=-1, keepdims=True), lit, table.background)
