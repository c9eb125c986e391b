"""The summary of an estimation: poses on the table where one is known, lamp, camera, and sentences for the user."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import replace

import numpy as np
from jaxtyping import Float

from osfcore.errors import InvalidInput
from osfcore.geometry.poses import Pose
from osfcore.io.scene_file import CameraJson
from osfcore.photo.board import PAGE_M
from osfcore.photo.found_scene import FoundLight, FoundObject, FoundPose, FoundScene
from osfcore.photo.light.photo_light import photo_lamp, photo_light
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
        light, unknown = _light(photos, step, models)
        notes += unknown
    except InvalidInput as error:
        notes.append(f"The light cannot be told: {error}")
    first, *others = [_camera(number, T_table_world, photo) for number, photo in enumerate(photos, 1)]
    objects = [_found(T_table_world, each) for each in step.found]
    return FoundScene(table=table, objects=objects, light=light, camera=first, other_cameras=others, notes=notes)


def _light(photos: Sequence[Photograph], step: PhotoStep, models: PhotoModels) -> tuple[FoundLight, list[str]]:
    """The lamp in the frame of the table where there is one, and what is not known of it, in sentences."""
    surfels, found = [models.surfels(each.name, FINE_ACROSS) for each in step.found], step.found
    if step.table is None and not photos[0].on_table:
        fit = photo_light(photos[0], found, surfels)
        light = _told(fit.direction, fit.std, is_diffuse=fit.is_diffuse)
        return light, ["How far away the lamp is, cannot be told without a known table."]
    covered: tuple[float, float] | None = PAGE_M
    if step.table is not None:
        place, covered = step.table.T_world_camera, None
        photos = [replace(photos[0], T_world_camera=place, on_table=True)]
        found = [replace(each, best=replace(each.best, pose=place @ each.best.pose)) for each in found]
    fit = photo_lamp(photos, found, surfels, covered_m=covered)
    light = _told(fit.direction, fit.std, is_diffuse=fit.is_diffuse)
    if fit.is_diffuse:
        return light, []
    if not fit.distance_known:
        return light, ["How far away the lamp is, cannot be told: a distant one would look the same."]
    far = {"distance_m": float(fit.distance), "distance_std_m": float(fit.distance * fit.log_distance_std)}
    return light.model_copy(update=far), []


def _told(direction: Float[np.ndarray, "3"], std: float, *, is_diffuse: bool) -> FoundLight:
    facts = {"std_deg": float(np.rad2deg(std)), "distance_m": None, "distance_std_m": None}
    return FoundLight(direction=direction.tolist(), diffuse=is_diffuse, **facts)


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
