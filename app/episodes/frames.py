"""Episodes as pictures: the goal, the table now, what the estimate looks like, and what the cameras see."""

from __future__ import annotations

from collections.abc import Iterable, Iterator
from pathlib import Path
from typing import Literal

import cv2
import numpy as np
from jaxtyping import Float, UInt8

from osfcore.errors import CorruptFile
from osfcore.geometry.workspace import STEP_S
from osfcore.io.image_file import to_uint8

TILE_PX, _BAR_PX = 192, 16
COLUMNS = 4
WIDTH, HEIGHT = COLUMNS * TILE_PX, 2 * (TILE_PX + _BAR_PX)  # multiples of 16, as H.264 wants them
Part = Literal["all", "goal", "now", "estimate", "difference"]
_TOP = ("goal", "now", "estimate", "difference")
_DIFFERENCE = 3.0  # by which differences are magnified
_PAPER, _INK = 24, (230, 230, 230)


def frame(
    goal: Float[np.ndarray, "h w 3"],
    now: Float[np.ndarray, "h w 3"],
    rendered: Float[np.ndarray, "h w 3"],
    views: Float[np.ndarray, "V h w 3"],
    title: str,
    photo: Float[np.ndarray, "h w 3"] | None = None,
) -> UInt8[np.ndarray, "H W 3"]:
    """One picture of an episode.

    Args:
        goal: the goal image.
        now: the table now, as the goal camera sees it.
        rendered: the estimate, rendered as the goal image would show it.
        views: the cameras' images; the first four are shown.
        title: a few words over the whole.
        photo: shown in the place of the goal image, which differences are from all the same.
    """
    difference = np.clip(_DIFFERENCE * np.abs(rendered - goal), 0, 1)
    top = {
        "goal": goal if photo is None else photo,
        f"now: {title}": now,
        "estimate, rendered": rendered,
        f"difference x {_DIFFERENCE:g}": difference,
    }
    below = {f"camera {number}": view for number, view in enumerate(views[:COLUMNS])}
    return np.vstack([_row(top), _row(below)])


def _row(tiles: dict[str, np.ndarray]) -> UInt8[np.ndarray, "H W 3"]:
    row = np.full((TILE_PX + _BAR_PX, WIDTH, 3), _PAPER, np.uint8)
    for column, (label, image) in enumerate(tiles.items()):
        left = column * TILE_PX
        height, width = (round(TILE_PX * side / max(image.shape[:2])) for side in image.shape[:2])
        row[_BAR_PX : _BAR_PX + height, left : left + width] = cv2.resize(to_uint8(image), (width, height))
        place = (left + 4, _BAR_PX - 4)
        cv2.putText(row, label, place, cv2.FONT_HERSHEY_SIMPLEX, 0.36, _INK, 1, cv2.LINE_AA)
    return row


def read_frames(folder: Path) -> Iterator[UInt8[np.ndarray, "H W 3"]]:
    """The frames in a folder, by number.

    Raises:
        CorruptFile: if one is no picture.
    """
    yield from map(read_frame, sorted(folder.glob("[0-9]*.png"), key=lambda path: int(path.stem)))


def read_frame(path: Path) -> UInt8[np.ndarray, "H W 3"]:
    """One frame.

    Raises:
        CorruptFile: if it is no picture of a frame's size.
    """
    picture = cv2.imread(str(path), cv2.IMREAD_COLOR)
    if picture is None or picture.shape != (HEIGHT, WIDTH, 3):
        raise CorruptFile(path, "it is no readable frame")
    return picture[..., ::-1]


def part_of(picture: UInt8[np.ndarray, "H W 3"], part: Part) -> UInt8[np.ndarray, "h w 3"]:
    """One picture of a frame, without its caption; "all" for the whole."""
    if part == "all":
        return picture
    left = TILE_PX * _TOP.index(part)
    return picture[_BAR_PX : _BAR_PX + TILE_PX, left : left + TILE_PX]


def write_video(path: Path, frames: Iterable[UInt8[np.ndarray, "H W 3"]]) -> None:
    """An MP4 that every browser plays, five frames a second: real time, if there is one for every action.

    Raises:
        CannotWrite: if it cannot be encoded or written.
    """
    from osfcore.io.video_file import mp4_at_once  # here: frames are drawn without ffmpeg

    with mp4_at_once(path, WIDTH, HEIGHT, 1 / STEP_S, "-crf", "15") as put:
        for picture in frames:
            put(picture)
