"""The board in one photograph, as the calibration of a camera takes it."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from jaxtyping import Float

from osfcore.errors import CorruptFile, InvalidInput, shown
from osfcore.photo.board import Board
from osfcore.photo.lens import board_points_through_lens
from osfcore.photo.read_photograph import RawPhotograph


@dataclass(frozen=True, eq=False, slots=True)
class Sighting:
    """Corners of the board's squares in a photograph.

    Attributes:
        name: of the photograph, for people.
        size: width and height of the photograph as it was sent [px].
        points_m: on the board, whose centre is the origin [m].
        points_px: where they were found, in pixels of the photograph as it was sent, distortion included.
    """

    name: str
    size: tuple[int, int]
    points_m: Float[np.ndarray, "N 2"]
    points_px: Float[np.ndarray, "N 2"]


def sight(raw: RawPhotograph, name: str, board: Board | None = None) -> Sighting:
    """Look for the board in a photograph.

    Args:
        raw: the decoded photograph.
        name: of the photograph, for people.
        board: that was printed; the default one if not given.

    Raises:
        CorruptFile: naming the photograph, if no board or too little of it is found, and why.
    """
    try:
        found, lens = board_points_through_lens(raw.eight_bit, board or Board())
    except InvalidInput as error:
        raise CorruptFile(shown(name), str(error).rstrip(".")) from None
    points = found.points_px if lens is None else lens.bent(found.points_px)
    scale = np.divide(raw.sent_size, raw.encoded.shape[1::-1])
    return Sighting(name, raw.sent_size, found.points_m, points * scale)
