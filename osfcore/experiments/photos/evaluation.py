"""Poses in real photographs: how well objects fit their masks, measured depth and reference poses; and lamps."""

from __future__ import annotations

import zlib
from collections.abc import Iterator
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Literal

import cv2
import numpy as np

from osfcore.errors import InvalidInput, check_ranges, check_seed
from osfcore.experiments.photos.folders import (
    GROUND_TRUTH,
    PhotoFolder,
    lamp_folders,
    read_lamps,
    read_scene,
    scene_folders,
)
from osfcore.experiments.photos.lamp_errors import lamp_errors_deg
from osfcore.experiments.photos.marked_masks import mask_iou, masks_from_boxes
from osfcore.experiments.photos.report import PhotoReport, PhotoScore, report_of
from osfcore.fields.field_library import FieldLibrary
from osfcore.geometry.poses import Pose, quaternion_exp, quaternion_multiply
from osfcore.inspection.photo_sheet import write_sheet
from osfcore.io.files import write_json
from osfcore.metrics.pose_errors import rotation_error
from osfcore.objects.catalogue import CATALOGUE
from osfcore.photo.photograph import Photograph
from osfcore.photo.poses.estimate_photo import PhotoConfig, PhotoModels, estimate_photo
from osfcore.photo.poses.object_window import object_windows
from osfcore.photo.poses.photo_steps import PhotoObject
from osfcore.photo.poses.pose_loss import LossKind
from osfcore.photo.poses.table_plane import table_from_points
from osfcore.random_streams import Stream, stream_rng
from osfcore.render.scene_renderer import SceneRenderer
from osfcore.render.types import SceneBatch

NONE, PERTURBED = "none", "perturbed"
_SHIFT_M, _TURN_DEG = 0.03, 20.0
_MOST_MASK_PX = 10
_MOST_REPEATS = 100


@dataclass(frozen=True, slots=True)
class EvaluatePhotos:
    """What to measure.

    Attributes:
        folder: for report.json and contact sheets.
        data: folder of folders of photographs, see `folders`.
        start: "none"; "perturbed": 3 cm and 20 deg off the ground truth, in random directions; or the name of a source
            of poses. Scenes that lack it are left out.
        plane: "known": fitted to the measured depth around the objects; "free".
        masks: "given"; "boxes": proposed from the given mask's bounding box, a little looser, and a click at the point
            farthest from its border, as a person would mark the object.
        mask_error_px: masks are grown and shrunk by that much in turn.
        repeats: random starts of each object.
        loss: of the search.
        seed: of everything random.
    """

    folder: Path
    data: Path
    start: str = NONE
    plane: Literal["known", "free"] = "free"
    mask_error_px: int = 0
    repeats: int = 1
    loss: LossKind = "all"
    seed: int = 0
    masks: Literal["given", "boxes"] = "given"


@dataclass(frozen=True, slots=True)
class PhotosStep:
    """How far an evaluation is; the last step brings the report."""

    done: int
    total: int
    note: str
    report: PhotoReport | None = None


def evaluate_photos(config: EvaluatePhotos, fields: FieldLibrary) -> Iterator[PhotosStep]:
    """Look for every object of every folder, then for the lamps; report.json and sheets go to `config.folder`.

    Args:
        config: what to measure.
        fields: of the objects; those without one are left out and counted.

    Raises:
        InvalidInput: if there is nothing to measure, or a number is out of range.
        CorruptFile, CannotWrite: as files are.
    """
    check_seed(config.seed)
    check_ranges(
        ("error of masks [px]", config.mask_error_px, 0, _MOST_MASK_PX),
        ("starts of each object", config.repeats, 1, _MOST_REPEATS),
    )
    scenes, lamps = [read_scene(path) for path in scene_folders(config.data)], lamp_folders(config.data)
    known = set(fields.names())
    asked = [(scene, _names(config, scene, known)) for scene in scenes]
    cases = [(scene, names, number) for scene, names in asked if names for number in range(config.repeats)]
    without = sum(name not in known for scene in scenes for name in scene.photo.masks)
    if not cases and not lamps:
        allowed = f"a folder of photographs with photo.json that have poses named {config.start!r}"
        raise InvalidInput("data", config.data, allowed)
    loaded = {name: fields.load(name) for name in sorted({name for _, names in asked for name in names})}
    models, renderer = PhotoModels(loaded), SceneRenderer(loaded, None)
    scores: list[PhotoScore] = []
    for done, (scene, names, number) in enumerate(cases):
        yield PhotosStep(done, len(cases), f"{len(names)} objects in {scene.name}")
        scores += _measure(config, models, renderer, scene, names, number)
    lamp_errors = {subject.name: lamp_errors_deg(subject) for path in lamps for subject in read_lamps(path)}
    report = report_of(scores, lamp_errors, without)
    write_json(config.folder / "report.json", report.to_json())
    yield PhotosStep(len(cases), len(cases), "Everything is measured", report)


def _names(config: EvaluatePhotos, scene: PhotoFolder, known: set[str]) -> list[str]:
    """Objects of a scene that are looked for."""
    source = GROUND_TRUTH if config.start == PERTURBED else config.start
    return [n for n in scene.photo.masks if n in known and (config.start == NONE or n in scene.poses.get(source, {}))]


def _measure(
    config: EvaluatePhotos,
    models: PhotoModels,
    renderer: SceneRenderer,
    scene: PhotoFolder,
    names: list[str],
    number: int,
) -> list[PhotoScore]:
    """Look for the objects of one scene, all together."""
    rng = stream_rng(config.seed, Stream.PHOTO_SEARCH, zlib.crc32(scene.name.encode()), number)
    photo = _photo(config, scene)
    starts = {name: _start(config, scene, name, rng) for name in names}
    placed = {name: photo.T_world_camera @ start for name, start in starts.items() if start is not None}
    *_, last = estimate_photo(models, [photo], names, rng, PhotoConfig(placed, config.loss))
    scores = []
    for found in last.found:
        moved = replace(found, best=replace(found.best, pose=photo.T_world_camera.inverse() @ found.best.pose))
        write_sheet(config.folder / f"{scene.name}-{found.name}-{number}.png", models, scene.photo, moved)
        scores.append(_score(renderer, scene, moved, mask_iou(photo, scene.photo, found.name)))
    return scores


def _score(renderer: SceneRenderer, scene: PhotoFolder, found: PhotoObject, mask_iou: float) -> PhotoScore:
    """Compare an object, its pose in the camera's frame, with all that is known."""
    name, pose = found.name, found.best.pose
    iou, depth_mm = _fit(renderer, scene, name, pose)
    position_mm = rotation_deg = None
    if (reference := scene.reference.get(name)) is not None:
        symmetry = CATALOGUE[name].symmetry
        rotation_deg = float(np.rad2deg(rotation_error(symmetry, pose.quaternion, reference.quaternion)))
        position_mm = 1e3 * float(np.linalg.norm(pose.position - reference.position))
    is_true = GROUND_TRUTH in scene.poses
    return PhotoScore(scene.name, name, is_true, iou, depth_mm, position_mm, rotation_deg, found.doubt,
                      min(found.ratio, 99.0), found.coarse_s, found.refine_s, mask_iou)  # fmt: skip


def _photo(config: EvaluatePhotos, scene: PhotoFolder) -> Photograph:
    photo = scene.photo
    if config.masks == "boxes":
        photo = photo.with_masks(masks_from_boxes(scene))
    if config.mask_error_px:
        kernel = np.ones((2 * config.mask_error_px + 1,) * 2, np.uint8)
        change = (cv2.dilate, cv2.erode)
        masks = {name: change[k % 2](m.astype(np.uint8), kernel) > 0 for k, (name, m) in enumerate(photo.masks.items())}
        photo = replace(photo, masks=masks)
    if config.plane == "known" and scene.depth is not None:
        T_world_camera = table_from_points(scene.table_points(), stream_rng(config.seed, Stream.PHOTO_PLANE))
        photo = replace(photo, T_world_camera=T_world_camera, on_table=True)
    return photo


def _start(config: EvaluatePhotos, scene: PhotoFolder, name: str, rng: np.random.Generator) -> Pose | None:
    if config.start == NONE:
        return None
    if config.start != PERTURBED:
        return scene.poses[config.start][name]
    true = scene.poses[GROUND_TRUTH][name]
    shift, axis = rng.standard_normal((2, 3))
    shift, axis = shift / np.linalg.norm(shift), axis / np.linalg.norm(axis)
    turn = quaternion_exp(np.deg2rad(_TURN_DEG) * axis)
    return Pose(true.position + _SHIFT_M * shift, quaternion_multiply(turn, true.quaternion))


def _fit(renderer: SceneRenderer, scene: PhotoFolder, name: str, pose: Pose) -> tuple[float, float | None]:
    """IoU of the field's silhouette with the mask, where that is known, and median depth error within both [mm]."""
    window = object_windows([scene.photo], name, max(scene.photo.image.shape))[0]
    camera = window.camera(name)
    batch = SceneBatch((name,), pose.position[None, None], pose.quaternion[None, None], -pose.position[None] /
                       np.linalg.norm(pose.position), None)  # fmt: skip
    drawn = renderer.render(batch, [camera], outputs={"rgb", "masks", "depth"})
    assert drawn.masks is not None
    assert drawn.depth is not None
    shown = drawn.masks[0, 0, 0]
    both, either = shown & window.mask & window.known, (shown | window.mask) & window.known
    if scene.depth is None:
        return float(both.sum() / either.sum()), None
    measured = window.frame.cut(scene.depth.astype(np.float32))
    common = shown & window.mask & (measured > 0)
    error = 1e3 * np.median(drawn.depth[0, 0][common] - measured[common]) if common.any() else None
    return float(both.sum() / either.sum()), None if error is None else float(error)
