"""The light of photographs whose objects are known: surfels give normals and albedo of the pixels that show them."""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np
from jaxtyping import Float

from osfcore.photo.light.lamp import LampFit, ShadedPixels, fit_lamp
from osfcore.photo.light.lit_pixels import lit_pixels, object_pixels
from osfcore.photo.light.near_lamp import NearLampFit, fit_near_lamp
from osfcore.photo.light.shadows import Shadows
from osfcore.photo.photograph import Photograph
from osfcore.photo.poses.photo_steps import PhotoObject
from osfcore.photo.poses.surfels import Surfels


def photo_light(photo: Photograph, objects: Sequence[PhotoObject], surfels: Sequence[Surfels]) -> LampFit:
    """Direction toward a distant lamp in the world, from the shading of all objects and the shadows between them.

    Args:
        photo: with masks of the objects.
        objects: what was found in it.
        surfels: of each object.

    Raises:
        InvalidInput: if too few pixels show objects that are trusted.
    """
    columns = [[np.zeros((0, 3))] for _ in range(4)]
    for found, points in zip(objects, surfels, strict=True):
        if found.name in photo.masks:
            for column, values in zip(columns, object_pixels(photo, found.name, found.best.pose, points), strict=True):
                column.append(values)
    radiance, albedo, points, normals = (np.concatenate(column) for column in columns)
    shadows = Shadows(surfels, [found.best.pose for found in objects])
    lifted = shadows.lifted(points, normals)

    def visible(direction: Float[np.ndarray, "3"]) -> Float[np.ndarray, "P"]:
        return shadows.from_direction(direction, lifted)

    return fit_lamp(ShadedPixels(radiance, albedo, normals), visible)


def photo_lamp(
    photos: Sequence[Photograph],
    objects: Sequence[PhotoObject],
    surfels: Sequence[Surfels],
    *,
    covered_m: tuple[float, float] | None = None,
) -> NearLampFit:
    """The lamp and its place, from objects, the shadows that they cast and the table where that is known.

    Its direction and distance are told from the world's origin on a known table, else from the objects' centre.

    Args:
        photos: of one scene, with masks of the objects.
        objects: what was found in them.
        surfels: of each object.
        covered_m: sides of a print that lies around the world's origin and hides the table, along x and y [m].

    Raises:
        InvalidInput: if too few pixels show anything known.
    """
    poses = {found.name: found.best.pose for found in objects}
    known = dict(zip(poses, surfels, strict=True))
    pixels = lit_pixels(photos, poses, known, covered_m=covered_m)
    return fit_near_lamp(pixels, np.zeros(3) if all(p.on_table for p in photos) else pixels.shadows.centre)
