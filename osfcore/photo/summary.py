"""The result of an estimation for files and people: poses, lamp, camera, and sentences."""

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
    Lens,
    locate_board,
    locate_board_through_lens,
)
from osfcore.photo.calibration import KnownCamera
from osfcore.photo.found_scene import FoundLight, FoundObject, FoundPose, FoundScene
from osfcore.photo.lamp import LampFit, NearLampFit, photo_lamp, photo_light
from osfcore.photo.photograph import Photograph
from osfcore.photo.poses import FINE_ACROSS, PhotoModels, PhotoObject, PhotoPose, PhotoStep
from osfcore.photo.read_photograph import RawPhotograph, guessed_intrinsics, intrinsics_from_focal

# The summary of an estimation: poses on the table where one is known, lamp, camera, and sentences for the user.


def summarised(
    photos: Sequence[Photograph], step: PhotoStep, models: PhotoModels, notes: Sequence[str], board: Board
) -> FoundScene:
    """Summarise an estimation.

    Args:
        photos: of one table.
        step: the last one.
        models: of the objects.
        notes: sentences for the user about the photo.
        board: that shows the table, if one is in view.
    """
    T_table_world, table, notes = Pose.identity(), "board" if photos[0].on_table else None, list(notes)
    if step.table is not None:
        T_table_world, table = step.table.T_world_camera, "objects"
        seen = f"{len(step.table.supported)} objects lie, whose verticals differ by {step.table.spread_deg:.1f} degrees"
        notes.append(f"The table was found from how {seen}; it may be off by a few.")
    if step.intrinsics is not None:
        focal = f"{step.intrinsics[0, 0]:.0f} pixels"
        notes.append(
            f"The focal length, {focal}, is that at which the objects stand on one table; it may be off by a fifth."
        )
    light = None
    try:
        light, unknown = _light(photos, step, models, board)
        notes += unknown
    except InvalidInput as error:
        notes.append(f"The light cannot be told: {error}")
    first, *others = [_camera(number, T_table_world, photo) for number, photo in enumerate(photos, 1)]
    objects = [_found(T_table_world, each) for each in step.found]
    return FoundScene(table=table, objects=objects, light=light, camera=first, other_cameras=others, notes=notes)


def _light(
    photos: Sequence[Photograph], step: PhotoStep, models: PhotoModels, board: Board
) -> tuple[FoundLight, list[str]]:
    """Find the lamp in the frame of the table where there is one; also sentences on what is not known of it."""
    surfels, found = [models.surfels(each.name, FINE_ACROSS) for each in step.found], step.found
    if step.table is None and not photos[0].on_table:
        light = _found_light(photo_light(photos[0], found, surfels))
        return light, ["How far away the lamp is, cannot be told without a known table."]
    covered: tuple[float, float] | None = board.sheet_m
    if step.table is not None:
        place, covered = step.table.T_world_camera, None
        photos = [replace(photos[0], T_world_camera=place, on_table=True)]
        found = [replace(each, best=replace(each.best, pose=place @ each.best.pose)) for each in found]
    fit = photo_lamp(photos, found, surfels, covered_m=covered)
    light = _found_light(fit)
    if fit.is_diffuse:
        return light, []
    if not fit.distance_known:
        return light, ["How far away the lamp is, cannot be told: a distant one would look the same."]
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


def _found(T_table_world: Pose, found: PhotoObject) -> FoundObject:
    def entry(pose: PhotoPose) -> FoundPose:
        there = T_table_world @ pose.pose
        position, quaternion = there.position.tolist(), there.quaternion.tolist()
        return FoundPose(position=position, quaternion=quaternion, loss=pose.loss, iou=pose.iou)

    best, rivals = entry(found.best), [entry(pose) for pose in found.rivals]
    return FoundObject(**best.model_dump(), name=found.name, doubt=found.doubt, rivals=rivals)


# The camera of a decoded photograph: over a printed board if it shows one, else from the file.


FocalSource = Literal["board", "given", "file", "assumed"]
_MOST_APART = 1.3  # between the focal length that is given and the one in the file


@dataclass(frozen=True, eq=False, slots=True)
class Located:
    """A photograph with what is known of its camera.

    Attributes:
        raw: free of distortion.
        intrinsics: K of `raw` [px].
        lens: that was found.
        source: of the focal length.
        T_world_camera: pose over the board; None if there is none.
        notes: sentences for the user about photo and camera.
        missing: why no board was found; "" where one was.
    """

    raw: RawPhotograph
    intrinsics: Intrinsics
    lens: Lens
    source: FocalSource
    T_world_camera: Pose | None
    notes: tuple[str, ...]
    missing: str = ""

    def straightened(self, mask: Bool[np.ndarray, "h w"]) -> Bool[np.ndarray, "h w"]:
        """Straighten a mask of the photograph as it was read."""
        return self.lens.straightened(mask.astype(np.float32)) > 0.5


def locate(raw: RawPhotograph, focal_px: float | None, board: Board) -> Located:
    """Find the camera.

    Args:
        raw: the decoded photo.
        focal_px: focal length in pixels of the photo as it was sent; None where nobody knows.
        board: that may be in view.

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
            notes.append(f"The focal length {focal_px:g} is not what the camera wrote into the photo, {written:.0f}.")
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
        notes.append("No printed board was found, so that the table is found from how objects stand on it.")
        notes.append(f"If a board is in view: {error}")
        return Located(raw, K, Lens(K, 0.0), source, None, tuple(notes), str(error))
    if lens.radial:
        bend = f"k1 = {lens.radial:.3f}, as the board shows"
        notes.append(f"The lens bends straight lines ({bend}); the photo was straightened.")
    straight = replace(raw, encoded=lens.straightened(raw.encoded))
    return Located(straight, view.intrinsics, lens, source, view.T_world_camera, tuple(notes))


def locate_calibrated(raw: RawPhotograph, camera: KnownCamera, board: Board) -> Located:
    """Place the photograph of a calibrated camera: it stands where the calibration says, else over a board in view.

    Args:
        raw: the decoded photo.
        camera: that took it.
        board: that may be in view.

    Raises:
        InvalidInput: if the photo has another shape than those that the camera was calibrated with.
    """
    camera.lens_at(raw.sent_size)  # refuses it in the user's own pixels
    lens = camera.lens_at((raw.encoded.shape[1], raw.encoded.shape[0]))
    straight = replace(raw, encoded=lens.straightened(raw.encoded))
    notes, pose, missing = [*raw.notes, "The camera is the one that was calibrated."], camera.T_world_camera, ""
    if pose is None:
        try:
            pose = locate_board(straight.eight_bit, board, lens.intrinsics).T_world_camera
        except InvalidInput as error:
            missing = str(error)
            notes.append(f"The calibration does not say where the camera stands, and no board was found. {error}")
    return Located(straight, lens.intrinsics, lens, "given", pose, tuple(notes), missing)


def _over_board(
    raw: RawPhotograph, board: Board, given: Intrinsics | None, notes: list[str]
) -> tuple[BoardView, Lens, FocalSource]:
    """Find camera, lens and source of the focal length; one that the board leaves open is guessed, and noted."""
    try:
        return *locate_board_through_lens(raw.eight_bit, board, given), "board" if given is None else "given"
    except InvalidInput as error:
        if error.what != UNKNOWN_FOCAL:
            raise
        guess, note = guessed_intrinsics(raw)
        found = locate_board_through_lens(raw.eight_bit, board, guess)
        notes.append(f"The board is seen so that it does not show the focal length. {note}")
        return *found, _guess_source(raw)


def _guess_source(raw: RawPhotograph) -> FocalSource:
    return "assumed" if raw.focal_px is None else "file"
