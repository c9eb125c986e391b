"""Pixels of photographs of which the place and the normal are known: of objects, and of the table around them."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass

import cv2
import numpy as np
from jaxtyping import Bool, Float, Int

from osfcore.errors import InvalidInput
from osfcore.geometry.poses import Pose, quaternion_to_matrix, rotate
from osfcore.photo.light.shadows import Shadows
from osfcore.photo.photograph import Photograph
from osfcore.photo.poses.object_window import object_windows
from osfcore.photo.poses.pose_loss import draw
from osfcore.photo.poses.surfels import Surfels

FEWEST = 50
TABLE = -1
_MASK_SIDE, _TABLE_SIDE = 60, 320  # of masks and photographs, as they are looked at [px]
_OBJECT_PIXELS, _TABLE_PIXELS = 600, 1800  # of one object, and of the table, in one photograph
_AROUND_M = 0.4  # of the table, around the objects
_MARGIN, _BESIDE = 3, 41  # masks grow by half of it on each side: what the table loses; where shadows often lie [px]
_SEEN = 0.25  # least cosine of the angle at which a surface is seen


@dataclass(frozen=True, eq=False, slots=True)
class LitPixels:
    """Pixels of one scene.

    Attributes:
        radiance: linear, well exposed.
        albedo: linear; 1 on the table, whose own is unknown.
        points: on the surface [m].
        normals: unit, outward.
        owner: number of the object; -1 on the table.
        view: number of the photograph; exposure and white balance are those of the view.
        shadows: what objects hide from lamps.
    """

    radiance: Float[np.ndarray, "P 3"]
    albedo: Float[np.ndarray, "P 3"]
    points: Float[np.ndarray, "P 3"]
    normals: Float[np.ndarray, "P 3"]
    owner: Int[np.ndarray, "P"]
    view: Int[np.ndarray, "P"]
    shadows: Shadows

    def __post_init__(self) -> None:
        """Check the number of pixels.

        Raises:
            InvalidInput: if there are fewer than 50.
        """
        if len(self.radiance) < FEWEST:
            raise InvalidInput("number of shaded pixels", len(self.radiance), f"{FEWEST} or more")

    @property
    def on_table(self) -> Bool[np.ndarray, "P"]:
        """Which show the table."""
        return self.owner == TABLE

    def lifted(self) -> Float[np.ndarray, "P 3"]:
        """Points from which a lamp may be seen: off the surface where it could shade itself [m]."""
        return np.where(self.on_table[:, None], self.points, self.shadows.lifted(self.points, self.normals))

    def every(self, step: int) -> LitPixels:
        """Every so many of them."""
        some = slice(None, None, step)
        return LitPixels(self.radiance[some], self.albedo[some], self.points[some], self.normals[some],
                         self.owner[some], self.view[some], self.shadows)  # fmt: skip


def lit_pixels(
    photos: Sequence[Photograph],
    poses: Mapping[str, Pose],
    surfels: Mapping[str, Surfels],
    *,
    covered_m: tuple[float, float] | None = None,
) -> LitPixels:
    """Pixels that show objects, and where the table's plane is known, the table.

    Args:
        photos: of one scene, with masks.
        poses: of the objects in the world.
        surfels: of each object.
        covered_m: sides of a print that lies around the world's origin and hides the table, along x and y [m].

    Raises:
        InvalidInput: if too few pixels show anything known.
    """
    shadows = Shadows([surfels[name] for name in poses], list(poses.values()))
    parts = []
    for view, photo in enumerate(photos):
        for owner, (name, pose) in enumerate(poses.items()):
            if name in photo.masks:
                parts.append((*_object_pixels(photo, name, pose, surfels[name]), owner, view))
        if photo.on_table:
            parts.append((*_table_pixels(photo, shadows.centre, covered_m), TABLE, view))
    columns = [np.concatenate([np.zeros((0, 3)), *(part[k] for part in parts)]) for k in range(4)]
    owner, view = (np.repeat([p[k] for p in parts], [len(p[0]) for p in parts]).astype(int) for k in (4, 5))
    return LitPixels(columns[0], columns[1], columns[2], columns[3], owner, view, shadows)


def object_pixels(
    photo: Photograph, name: str, pose: Pose, surfels: Surfels
) -> tuple[np.ndarray, np.ndarray, np.ndarray, np.ndarray]:
    """Radiance, albedo, points in the world [m] and normals of well exposed pixels that show an object.

    Args:
        photo: with a mask of the object.
        name: of the object.
        pose: `T_world_object`.
        surfels: of the object.
    """
    window = object_windows([photo], name, _MASK_SIDE)[0]
    index, _ = draw(surfels, window, Pose(pose.position[None], pose.quaternion[None]))
    shown = (index[0] >= 0) & window.plain
    seen = index[0][shown]
    normals, points = rotate(pose.quaternion, surfels.normals[seen]), pose.apply(surfels.points[seen])
    return window.image[shown], surfels.albedo[seen], points, normals


def _object_pixels(
    photo: Photograph, name: str, pose: Pose, surfels: Surfels
) -> tuple[np.ndarray, np.ndarray, np.ndarray, np.ndarray]:
    """Some of `object_pixels`, none of which is seen at a grazing angle."""
    try:
        radiance, albedo, points, normals = object_pixels(photo, name, pose, surfels)
    except InvalidInput:  # a tiny mask in one of several views
        nothing = np.zeros((0, 3))
        return nothing, nothing, nothing, nothing
    to_camera = photo.T_world_camera.position - points
    cosine = np.sum(normals * to_camera, axis=1) / np.linalg.norm(to_camera, axis=1)
    kept = np.flatnonzero(cosine > _SEEN)
    kept = kept[:: max(-(-len(kept) // _OBJECT_PIXELS), 1)]
    return radiance[kept], albedo[kept], points[kept], normals[kept]


def _table_pixels(
    photo: Photograph, centre: np.ndarray, covered_m: tuple[float, float] | None
) -> tuple[np.ndarray, np.ndarray, np.ndarray, np.ndarray]:
    """Radiance, ones, points in the world [m] and normals of well exposed pixels of the table near the objects."""
    full, photo = photo, photo.with_masks({}).resized(_TABLE_SIDE)
    objects = np.zeros((full.height, full.width), np.uint8)
    for mask in full.masks.values():
        objects |= mask.view(np.uint8)
    whole = cv2.resize(objects.astype(np.float32), (photo.width, photo.height), interpolation=cv2.INTER_AREA)
    covered, beside = (
        cv2.dilate((whole > 0).astype(np.uint8), np.ones((k, k), np.uint8)) > 0 for k in (_MARGIN, _BESIDE)
    )
    rows, columns = np.nonzero(photo.well_exposed & ~covered)
    pixels = np.stack([columns + 0.5, rows + 0.5, np.ones(len(rows))], axis=1)
    matrix = quaternion_to_matrix(photo.T_world_camera.quaternion) @ np.linalg.inv(photo.intrinsics)
    rays, origin = pixels @ matrix.T, photo.T_world_camera.position
    down = rays[:, 2] < -1e-6
    points = origin - rays * (origin[2] / np.where(down, rays[:, 2], 1.0))[:, None]
    near = down & (np.linalg.norm(points[:, :2] - centre[:2], axis=1) < _AROUND_M)
    if covered_m is not None:
        near &= np.any(np.abs(points[:, :2]) > np.array(covered_m) / 2, axis=1)
    groups = [np.flatnonzero(near & (beside[rows, columns] == flag)) for flag in (True, False)]
    kept = np.concatenate([group[:: max(-(-2 * len(group) // _TABLE_PIXELS), 1)] for group in groups])
    normals = np.tile([0.0, 0.0, 1.0], (len(kept), 1))
    flat = points[kept] * (1.0, 1.0, 0.0)
    return photo.image[rows[kept], columns[kept]], np.ones((len(kept), 3)), flat, normals
