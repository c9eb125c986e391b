"""The light of a photograph whose objects are known: surfels give normals and albedo of the pixels that show them."""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np

from osfcore.geometry.poses import Pose, rotate
from osfcore.photo.light.lamp import LampFit, ShadedPixels, fit_lamp
from osfcore.photo.photograph import Photograph
from osfcore.photo.poses.object_window import object_windows
from osfcore.photo.poses.photo_steps import PhotoObject
from osfcore.photo.poses.pose_loss import draw
from osfcore.photo.poses.surfels import Surfels

_SIDE = 60  # of masks [px]: shading is smooth


def photo_light(photo: Photograph, objects: Sequence[PhotoObject], surfels: Sequence[Surfels]) -> LampFit:
    """Direction toward the lamp in the world, from all objects of one photograph.

    Args:
        photo: with masks of the objects.
        objects: what was found in it.
        surfels: of each object.

    Raises:
        InvalidInput: if too few pixels show objects that are trusted.
    """
    radiance, albedo, normals = [np.zeros((0, 3))], [np.zeros((0, 3))], [np.zeros((0, 3))]
    for found, points in zip(objects, surfels, strict=True):
        if found.name not in photo.masks:
            continue
        window = object_windows([photo], found.name, _SIDE)[0]
        pose = found.best.pose
        index, _ = draw(points, window, Pose(pose.position[None], pose.quaternion[None]))
        shown = (index[0] >= 0) & window.plain
        seen = index[0][shown]
        radiance.append(window.image[shown])
        albedo.append(points.albedo[seen])
        normals.append(rotate(pose.quaternion, points.normals[seen]))
    return fit_lamp(ShadedPixels(np.concatenate(radiance), np.concatenate(albedo), np.concatenate(normals)))
