"""The table as rays meet it: where, in light or in shadow, and how bright; the open table without sampling."""

from __future__ import annotations

from dataclasses import dataclass

import cv2
import numpy as np
from jaxtyping import Bool, Float

from osfcore.geometry.workspace import TABLE_SIDE_M
from osfcore.world.imaging.optics import BACKGROUND_RADIANCE, lambert
from osfcore.world.imaging.shot import Shot

_BACKGROUND = -1.0
_UP = np.array([0, 0, 1], np.float32)


@dataclass(frozen=True, eq=False, slots=True)
class TableHits:
    """What rays see of the table, or beside it.

    Attributes:
        kind: background (-1), table in shadow (0) or in light (1).
        colour: radiance.
        depth: along the camera's z axis [m]; infinite beside the table.
    """

    kind: Float[np.ndarray, "S"]
    colour: Float[np.ndarray, "S 3"]
    depth: Float[np.ndarray, "S"]


def see_table(shot: Shot, directions: Float[np.ndarray, "S 3"]) -> TableHits:
    """The table along rays that no body stops."""
    origin = shot.origin
    falling = directions[:, 2] < -1e-9
    depth = np.where(falling, -origin[2] / np.where(falling, directions[:, 2], -1), np.inf).astype(np.float32)
    if origin[2] <= 0:  # a camera below the table sees no table
        depth[:] = np.inf
    reach = np.where(falling, depth, 0) if origin[2] > 0 else np.zeros_like(depth)
    points = origin + reach[:, None] * directions
    half = TABLE_SIDE_M / 2
    on_table = np.isfinite(depth) & (np.abs(points[:, 0]) <= half) & (np.abs(points[:, 1]) <= half)
    kind = np.full(len(depth), _BACKGROUND, np.float32)
    kind[on_table] = shot.lit(points[on_table], None)
    colour = np.empty((len(depth), 3), np.float32)
    colour[:] = BACKGROUND_RADIANCE
    colour[on_table] = _radiance(shot, _albedo(shot, points[on_table, :2]), points[on_table], kind[on_table])
    return TableHits(kind, colour, np.where(on_table, depth, np.inf).astype(np.float32))


def open_table(shot: Shot, near_body: np.ndarray, rgb: np.ndarray, depth: np.ndarray) -> Bool[np.ndarray, "h w"]:
    """Fill pixels without body from their four corners; return those whose corners disagree.

    Light arrives all over a pixel whose corners agree, or nowhere in it; there only what changes from place to place is
    sampled: a texture, and a near lamp's light.
    """
    height, width = near_body.shape
    y, x = np.mgrid[: height + 1, : width + 1]
    seen = see_table(shot, shot.directions(np.stack([x, y], axis=-1).reshape(-1, 2).astype(np.float32)))
    kind = seen.kind.reshape(height + 1, width + 1)
    corners = np.stack([kind[:-1, :-1], kind[:-1, 1:], kind[1:, :-1], kind[1:, 1:]])
    busy = (corners[1] != corners[0]) | (corners[2] != corners[0]) | (corners[3] != corners[0])
    rgb[:] = seen.colour.reshape(height + 1, width + 1, 3)[:-1, :-1]
    distance = seen.depth.reshape(height + 1, width + 1)
    depth[:] = (distance[:-1, :-1] + distance[:-1, 1:] + distance[1:, :-1] + distance[1:, 1:]) / 4
    if shot.spot is not None or (shot.table is not None and shot.table.texture is not None):
        _fill_open(shot, (corners[0] != _BACKGROUND) & ~busy & ~near_body, corners[0], rgb)
    return busy


def _fill_open(shot: Shot, pixels: Bool[np.ndarray, "h w"], kind: np.ndarray, rgb: np.ndarray) -> None:
    """Fill pixels that show nothing but table, each all in light or all in shadow as `kind` tells."""
    for samples in shot.sampled(pixels):
        points = cv2.perspectiveTransform(samples.points[None], _pixels_to_table(shot))[0]
        chosen, albedo = (samples.rows, samples.columns), _albedo(shot, points)
        if shot.spot is None:  # light is the same all over the table
            rgb[chosen] = _radiance(shot, samples.means(albedo), points, kind[chosen])
        else:
            points = np.pad(points, ((0, 0), (0, 1)))
            lit = np.repeat(kind[chosen], shot.samples**2)
            rgb[chosen] = samples.means(_radiance(shot, albedo, points, lit))


def _pixels_to_table(shot: Shot) -> Float[np.ndarray, "3 3"]:
    """Maps homogeneous pixel coordinates to those of the table's plane [m]: where o - d o_z / d_z lies for a ray d."""
    d, o = shot.pixels_to_world, shot.camera.T_world_camera.position
    return np.stack([o[0] * d[2] - o[2] * d[0], o[1] * d[2] - o[2] * d[1], d[2]])


def _albedo(shot: Shot, points: Float[np.ndarray, "S 2"]) -> Float[np.ndarray, "S 3"]:
    """Of points of the table, averaged over what lies between two samples in the middle of the table."""
    assert shot.table is not None
    spacing_m = float(np.linalg.norm(shot.origin)) / float(shot.camera.intrinsics[1, 1]) / shot.samples
    return shot.table.albedo_at(points, 0.0 if shot.sharp else spacing_m)


def _radiance(
    shot: Shot, albedo: Float[np.ndarray, "S 3"], points: Float[np.ndarray, "_ _"], visible: Float[np.ndarray, "S"]
) -> Float[np.ndarray, "S 3"]:
    """Of the table at points of it, which only a near lamp asks for."""
    incidence = np.full(len(albedo), shot.light[2], np.float32) if shot.spot is None else shot.incidence(points, _UP)
    return lambert(albedo, incidence, visible, shot.lamp)
