"""The summary of an estimation: poses on the table where one is known, lamp, camera, and sentences for the user."""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np

from osfcore.errors import InvalidInput
from osfcore.geometry.poses import Pose, rotate
from osfcore.io.scene_file import CameraJson
from osfcore.photo.found_scene import FoundLight, FoundObject, FoundPose, FoundScene
from osfcore.photo.light.photo_light import photo_light
from osfcore.photo.photograph import Photograph
from osfcore.photo.poses.estimate_photo import FINE_ACROSS, PhotoModels
from osfcore.photo.poses.photo_steps import PhotoObject, PhotoPose, PhotoStep


def summarised(photos: Sequence[Photograph], step: PhotoStep, models: PhotoModels, notes: Sequence[str]) -> FoundScene:
    """The result of an estimation.

    Args:
        photos: of one table; the light is that of the one with most masks.
        step: the last one.
        models: of the objects.
        notes: sentences for the user about the photo.
    """
    T_table_world, table, notes = Pose.identity(), "board" if photos[0].on_table else None, list(notes)
    if step.table is not None:
        T_table_world, table = step.table.T_world_camera, "objects"
        seen = f"{len(step.table.supported)} objects lie, whose verticals differ by {step.table.spread_deg:.1f} degrees"
        notes.append(f"The table was found from how {seen}; it may be off by a few.")
    light = None
    try:
        shown = max(photos, key=lambda photo: len(photo.masks))
        fit = photo_light(shown, step.found, [models.surfels(o.name, FINE_ACROSS) for o in step.found])
        toward = rotate(T_table_world.quaternion, fit.direction)
        light = FoundLight(direction=toward.tolist(), std_deg=float(np.rad2deg(fit.std)), diffuse=fit.is_diffuse)
    except InvalidInput as error:
        notes.append(f"The light cannot be told: {error}")
    first, *others = [_camera(number, T_table_world, photo) for number, photo in enumerate(photos, 1)]
    objects = [_found(T_table_world, each) for each in step.found]
    return FoundScene(table=table, objects=objects, light=light, camera=first, other_cameras=others, notes=notes)


def _camera(number: int, T_table_world: Pose, photo: Photograph) -> CameraJson:
    """The camera of a photograph, which may have more pixels than one of the simulation."""
    T_table_camera = (T_table_world @ photo.T_world_camera).matrix().tolist()
    K, size = photo.intrinsics.tolist(), {"width": photo.width, "height": photo.height}
    return CameraJson(name=f"photo {number}", T_world_camera=T_table_camera, K=K, **size)


def _found(T_table_world: Pose, found: PhotoObject) -> FoundObject:
    def entry(pose: PhotoPose) -> FoundPose:
        there = T_table_world @ pose.pose
        return FoundPose(
            position=there.position.tolist(), quaternion=there.quaternion.tolist(), loss=pose.loss, iou=pose.iou
        )

    best, rivals = entry(found.best), [entry(pose) for pose in found.rivals]
    return FoundObject(**best.model_dump(), name=found.name, doubt=found.doubt, rivals=rivals)
