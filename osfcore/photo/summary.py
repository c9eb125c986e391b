"""The result of an estimation in a form for files and people: poses, lamp, camera, and notes."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, replace
from typing import Literal

import numpy as np
from jaxtyping import Bool

from osfcore.errors import InvalidInput
from osfcore.geometry.poses import Pose
from osfcore.io.scene_file import CameraJson
from osfcore.photo.board import (
    CONTRADICTED,
    UNKNOWN_FOCAL,
    Board,
    BoardView,
    Intrinsics,
    locate_board,
    locate_board_through_lens,
)
from osfcore.photo.camera_files import KnownCamera
from osfcore.photo.found_scene import FoundLight, FoundObject, FoundPose, FoundScene
from osfcore.photo.lamp import LampFit, NearLampFit, photo_lamp, photo_light
from osfcore.photo.lens import Lens
from osfcore.photo.photograph import Box, Photograph, mask_box
from osfcore.photo.poses import FINE_ACROSS, PhotoModels, PhotoObject, PhotoStep
from osfcore.photo.read_photograph import RawPhotograph, guessed_intrinsics, intrinsics_from_focal
from osfcore.photo.segmentation import outline_of

# The summary of an estimation: poses on the table if it is known, lamp, camera, and notes for the user.


def summarised(step: PhotoStep, models: PhotoModels, notes: Sequence[str], board: Board) -> FoundScene:
    """Summarise an estimation.

    Args:
        step: the last step of the estimation.
        models: models of the objects.
        notes: sentences for the user about the photo.
        board: that shows the table, if one is in view.
    """
    T_table_world, table, notes = Pose.identity(), "board" if step.photos[0].on_table else None, list(notes)
    if step.table is not None:
        T_table_world, table = step.table.T_world_camera, "objects"
        seen = f"{len(step.table.supported)} objects, whose vertical axes differ by {step.table.spread_deg:.1f} degrees"
        notes.append(f"The table was found from {seen}; its tilt may be off by a few degrees.")
    if step.focal_factor is not None:
        focal = f"{step.photos[0].intrinsics[0, 0]:.0f} pixels"
        notes.append(f"The focal length, {focal}, was found from how the objects stand; it may be off by a fifth.")
    used = [(number, photo) for number, photo in enumerate(step.photos, 1) if photo.masks]
    if len(used) < len(step.photos):
        unused = ", ".join(str(number) for number, photo in enumerate(step.photos, 1) if not photo.masks)
        notes.append(
            f"Not used: photo {unused}. Too few objects look alike in it and in the others; mark more of them."
        )
    light = None
    try:
        light, unknown = _light([photo for _, photo in used], step, models, board)
        notes += unknown
    except InvalidInput as error:
        notes.append(f"The light could not be determined: {error}")
    first, *others = [_camera(number, T_table_world, photo) for number, photo in used]
    objects = [_found(T_table_world, each, step.photos[0]) for each in step.found]
    return FoundScene(table=table, objects=objects, light=light, camera=first, other_cameras=others, notes=notes)


def _light(
    photos: Sequence[Photograph], step: PhotoStep, models: PhotoModels, board: Board
) -> tuple[FoundLight, list[str]]:
    """Return the lamp, in the frame of the table if there is one, and notes on what is unknown about it."""
    surfels, found = [models.surfels(each.name, FINE_ACROSS) for each in step.found], step.found
    if step.table is None and not photos[0].on_table:
        light = _found_light(photo_light(photos[0], found, surfels))
        return light, ["The distance of the lamp cannot be determined without a known table."]
    covered: tuple[float, float] | None = board.sheet_m
    if step.table is not None:
        place, covered = step.table.T_world_camera, None
        photos = [replace(photo, T_world_camera=place @ photo.T_world_camera, on_table=True) for photo in photos]
        found = [replace(each, best=replace(each.best, pose=place @ each.best.pose)) for each in found]
    fit = photo_lamp(photos, found, surfels, covered_m=covered)
    light = _found_light(fit)
    if fit.is_diffuse:
        return light, []
    if not fit.distance_known:
        return light, ["The distance of the lamp is unknown, because a distant lamp would look the same."]
    far = {"distance_m": float(fit.distance), "distance_std_m": float(fit.distance * fit.log_distance_std)}
    return light.model_copy(update=far), []


def _found_light(fit: LampFit | NearLampFit) -> FoundLight:
    facts = {"std_deg": float(np.rad2deg(fit.std)), "distance_m": None, "distance_std_m": None}
    return FoundLight(direction=fit.direction.tolist(), diffuse=fit.is_diffuse, **facts)


def _camera(number: int, T_table_world: Pose, photo: Photograph) -> CameraJson:
    """Return the camera of a photograph, which may have more pixels than one of the simulation."""
    T_table_camera = (T_table_world @ photo.T_world_camera).matrix().tolist()
    K, size = photo.intrinsics.tolist(), {"width": photo.width, "height": photo.height}
    return CameraJson(name=f"photo {number}", T_world_camera=T_table_camera, K=K, **size)


def _found(T_table_world: Pose, found: PhotoObject, photo: Photograph) -> FoundObject:
    best, *rivals = (
        FoundPose(
            position=(there := T_table_world @ pose.pose).position.tolist(),
            quaternion=there.quaternion.tolist(),
            loss=pose.loss,
            iou=pose.iou,
            probability=probability,
        )
        for pose, probability in zip((found.best, *found.rivals), found.probabilities.tolist(), strict=True)
    )
    polygons = outline_of(photo.masks[found.name]) if found.name in photo.masks else ()
    outline = [[list(point) for point in polygon] for polygon in polygons]
    return FoundObject(**best.model_dump(), name=found.name, doubt=found.doubt, rivals=rivals, outline=outline)


# The camera of a decoded photograph: over a printed board if it shows one, else from the file.


FocalSource = Literal["board", "given", "file", "assumed"]
_MOST_APART = 1.3  # between the focal length that is given and the one in the file


@dataclass(frozen=True, eq=False, slots=True)
class Located:
    """A photograph with what is known of its camera.

    Attributes:
        raw: photo without lens distortion.
        intrinsics: K of `raw` [px].
        lens: the lens that was found.
        source: source of the focal length.
        T_world_camera: pose over the board; None if there is none.
        notes: sentences for the user about photo and camera.
    """

    raw: RawPhotograph
    intrinsics: Intrinsics
    lens: Lens
    source: FocalSource
    T_world_camera: Pose | None
    notes: tuple[str, ...]

    def straightened(self, mask: Bool[np.ndarray, "h w"]) -> Bool[np.ndarray, "h w"]:
        """Return a mask of the original photo without lens distortion."""
        return self.lens.straightened(mask.astype(np.float32)) > 0.5

    def straight_box(self, box: Box) -> Box:
        """Return the box around what a box of the original photo holds, without lens distortion."""
        if not self.lens.bends:
            return box
        filled = np.zeros(self.raw.encoded.shape[:2], bool)
        left, top, right, bottom = np.round(np.maximum(box, 0)).astype(int)
        filled[top:bottom, left:right] = True
        x0, y0, x1, y1 = mask_box(self.straightened(filled))
        return float(x0), float(y0), float(x1), float(y1)


def locate(raw: RawPhotograph, focal_px: float | None, board: Board) -> Located:
    """Find the camera.

    Args:
        raw: the decoded photo.
        focal_px: focal length in pixels of the photo as it was sent; None if it is unknown.
        board: board that may be in view.

    Raises:
        InvalidInput: if the focal length makes no sense, or the board contradicts it.
    """
    height, width = raw.encoded.shape[:2]
    scale = max(height, width) / max(raw.sent_size)
    given = None
    if focal_px is not None:
        intrinsics_from_focal(*raw.sent_size, focal_px)  # refuses it in the user's own pixels
        given = intrinsics_from_focal(width, height, scale * focal_px)
    notes = list(raw.notes)
    if focal_px is not None and raw.focal_px is not None:
        written = raw.focal_px / scale
        if not 1 / _MOST_APART < focal_px / written < _MOST_APART:
            notes.append(f"The focal length {focal_px:g} differs from the one in the photo's EXIF data, {written:.0f}.")
    try:
        view, lens, source = _over_board(raw, board, given, notes)
    except InvalidInput as error:
        if error.what == CONTRADICTED:
            raise
        K, source = given, "given"
        if K is None:
            K, note = guessed_intrinsics(raw)
            notes.append(note)
            source = _guess_source(raw)
        notes.append("No printed board was found; the table is found from how the objects stand on it.")
        notes.append(f"If a board is in view: {error}")
        return Located(raw, K, Lens(K), source, None, tuple(notes))
    if lens.radial:
        bend = f"k1 = {lens.radial:.3f}, as the board shows"
        notes.append(f"The lens bends straight lines ({bend}); the photo was straightened.")
    straight = replace(raw, encoded=lens.straightened(raw.encoded))
    return Located(straight, view.intrinsics, lens, source, view.T_world_camera, tuple(notes))


def locate_calibrated(raw: RawPhotograph, camera: KnownCamera, board: Board) -> Located:
    """Return the pose of a calibrated camera: from the calibration, or else from a board in view.

    Args:
        raw: the decoded photo.
        camera: the calibrated camera.
        board: board that may be in view.

    Raises:
        InvalidInput: if the photo has another shape than those that the camera was calibrated with.
    """
    lens = camera.lens_at(raw.sent_size).scaled(np.divide(raw.encoded.shape[1::-1], raw.sent_size))
    straight = replace(raw, encoded=lens.straightened(raw.encoded))
    notes, pose = [*raw.notes, "The camera is the one that was calibrated."], camera.T_world_camera
    if pose is None:
        try:
            pose = locate_board(straight.eight_bit, board, lens.intrinsics).T_world_camera
        except InvalidInput as error:
            notes.append(f"The calibration does not hold the camera's pose, and no board was found. {error}")
    return Located(straight, lens.intrinsics, lens, "given", pose, tuple(notes))


def _over_board(
    raw: RawPhotograph, board: Board, given: Intrinsics | None, notes: list[str]
) -> tuple[BoardView, Lens, FocalSource]:
    """Return camera, lens and source of the focal length. A focal length that the board does not show is guessed."""
    try:
        return *locate_board_through_lens(raw.eight_bit, board, given), "board" if given is None else "given"
    except InvalidInput as error:
        if error.what != UNKNOWN_FOCAL:
            raise
        guess, note = guessed_intrinsics(raw)
        found = locate_board_through_lens(raw.eight_bit, board, guess)
        notes.append(f"From this angle the board does not show the focal length. {note}")
        return *found, _guess_source(raw)


def _guess_source(raw: RawPhotograph) -> FocalSource:
    return "assumed" if raw.focal_px is None else "file"
