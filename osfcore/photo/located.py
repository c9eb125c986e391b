"""The camera of a decoded photograph: over a printed board if it shows one, else as far as its file tells."""

from __future__ import annotations

from dataclasses import dataclass, replace
from typing import Literal

import numpy as np
from jaxtyping import Bool, Float

from osfcore.errors import InvalidInput
from osfcore.geometry.poses import Pose
from osfcore.photo.board import Board, BoardView, locate_board
from osfcore.photo.calibration.camera_file import KnownCamera
from osfcore.photo.lens import CONTRADICTED, Lens, locate_board_through_lens
from osfcore.photo.planar_pose import UNTOLD
from osfcore.photo.read_photograph import RawPhotograph, guessed_intrinsics, intrinsics_from_focal

FocalSource = Literal["board", "given", "file", "assumed"]
_MOST_APART = 1.3  # between the focal length that is given and the one in the file


@dataclass(frozen=True, eq=False, slots=True)
class Located:
    """A photograph with what is known of its camera.

    Attributes:
        raw: free of distortion.
        intrinsics: K of `raw` [px].
        lens: that was found.
        source: who tells the focal length.
        T_world_camera: pose over the board; None if there is none.
        notes: sentences for the user about photo and camera.
        missing: why no board was found; "" where one was.
    """

    raw: RawPhotograph
    intrinsics: Float[np.ndarray, "3 3"]
    lens: Lens
    source: FocalSource
    T_world_camera: Pose | None
    notes: tuple[str, ...]
    missing: str = ""

    def straightened(self, mask: Bool[np.ndarray, "h w"]) -> Bool[np.ndarray, "h w"]:
        """A mask of the photograph as it was read, in the one that is free of distortion."""
        return self.lens.straightened(mask.astype(np.float32)) > 0.5


def locate(raw: RawPhotograph, focal_px: float | None = None) -> Located:
    """Find the camera.

    Args:
        raw: the decoded photo.
        focal_px: focal length in pixels of the photo as it was sent; None where nobody knows.

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
        view, lens, source = _over_board(raw, given, notes)
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


def locate_calibrated(raw: RawPhotograph, camera: KnownCamera) -> Located:
    """The photograph of a calibrated camera: it stands where the calibration says, else over the board in view, if any.

    Args:
        raw: the decoded photo.
        camera: that took it.

    Raises:
        InvalidInput: if the photo has another shape than those that the camera was calibrated with.
    """
    camera.lens_at(raw.sent_size)  # refuses it in the user's own pixels
    lens = camera.lens_at((raw.encoded.shape[1], raw.encoded.shape[0]))
    straight = replace(raw, encoded=lens.straightened(raw.encoded))
    notes, pose, missing = [*raw.notes, "The camera is the one that was calibrated."], camera.T_world_camera, ""
    if pose is None:
        try:
            pose = locate_board(straight.eight_bit, Board(), lens.intrinsics).T_world_camera
        except InvalidInput as error:
            missing = str(error)
            notes.append(f"The calibration does not say where the camera stands, and no board was found. {error}")
    return Located(straight, lens.intrinsics, lens, "given", pose, tuple(notes), missing)


def _over_board(
    raw: RawPhotograph, given: Float[np.ndarray, "3 3"] | None, notes: list[str]
) -> tuple[BoardView, Lens, FocalSource]:
    """The camera, its lens, and who tells the focal length; one that the board does not tell is guessed, and noted."""
    source: FocalSource = "board" if given is None else "given"
    try:
        view, lens = locate_board_through_lens(raw.eight_bit, Board(), given)
    except InvalidInput as error:
        if error.what != UNTOLD:
            raise
        guess, note = guessed_intrinsics(raw)
        view, lens = locate_board_through_lens(raw.eight_bit, Board(), guess)
        notes.append(f"The board is seen so that it does not tell the focal length. {note}")
        source = _guess_source(raw)
    return view, lens, source


def _guess_source(raw: RawPhotograph) -> FocalSource:
    return "assumed" if raw.focal_px is None else "file"
