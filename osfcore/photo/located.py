"""The camera of a decoded photograph: over a printed board if it shows one, else as far as its file tells."""

from __future__ import annotations

from dataclasses import dataclass
from typing import Literal

import numpy as np
from jaxtyping import Float

from osfcore.errors import InvalidInput
from osfcore.geometry.poses import Pose
from osfcore.photo.board import Board, locate_board
from osfcore.photo.read_photograph import RawPhotograph, guessed_intrinsics, intrinsics_from_focal

FocalSource = Literal["board", "given", "file", "assumed"]


@dataclass(frozen=True, eq=False, slots=True)
class Located:
    """What is known of a camera.

    Attributes:
        intrinsics: K [px of the decoded photo].
        source: who tells the focal length.
        T_world_camera: pose over the board; None if there is none.
        notes: sentences for the user about photo and camera.
    """

    intrinsics: Float[np.ndarray, "3 3"]
    source: FocalSource
    T_world_camera: Pose | None
    notes: tuple[str, ...]


def locate(raw: RawPhotograph, focal_px: float | None = None, board: Board | None = None) -> Located:
    """Find the camera.

    Args:
        raw: the decoded photo.
        focal_px: focal length in pixels of the photo as it was sent; None where nobody knows.
        board: that may lie on the table; ours by default.

    Raises:
        InvalidInput: if the focal length makes no sense.
    """
    height, width = raw.encoded.shape[:2]
    scale = max(height, width) / max(raw.sent_size)
    given = None if focal_px is None else intrinsics_from_focal(width, height, scale * focal_px)
    try:
        view = locate_board(raw.eight_bit, board or Board(), given)
    except InvalidInput as error:
        unknown = f"No board tells where the table is ({error})"
        if given is not None:
            return Located(given, "given", None, (*raw.notes, unknown))
        K, note = guessed_intrinsics(raw)
        return Located(K, "assumed" if raw.focal_px is None else "file", None, (*raw.notes, note, unknown))
    source = "given" if given is not None else "board"
    return Located(view.intrinsics, source, view.T_world_camera, raw.notes)
