"""Contact sheets: truth, ours and the difference, below each other; and grids of images with names."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass

import cv2
import numpy as np
from jaxtyping import UInt8

from osfcore.errors import InvalidInput

DIFFERENCE_GAIN = 4
_LABEL_PX = 16
_ROW_LABEL_PX = 40
_NAME_PX = 76  # of a row of a grid
_PAPER = 255


@dataclass(frozen=True, eq=False, slots=True)
class Comparison:
    """One column of a contact sheet.

    Attributes:
        label: a few letters above it.
        truth: what it should look like.
        ours: what it looks like.
    """

    label: str
    truth: UInt8[np.ndarray, "h w 3"]
    ours: UInt8[np.ndarray, "h w 3"]


def contact_sheet(
    columns: Sequence[Comparison], *, per_row: int = 8, truth: str = "truth"
) -> UInt8[np.ndarray, "H W 3"]:
    """Columns side by side, in blocks of `per_row`: truth, ours and the absolute difference x 4, below each other.

    Args:
        columns: what to show.
        per_row: columns in a block.
        truth: what to call the first row, in a few letters.

    Raises:
        InvalidInput: if there is nothing to show, or sizes differ.
    """
    if len({c.truth.shape for c in columns} | {c.ours.shape for c in columns}) != 1:
        raise InvalidInput("images of a contact sheet", f"{len(columns)} pairs", "at least one, all of one size")
    blocks = [_block(columns[i : i + per_row], truth) for i in range(0, len(columns), per_row)]
    width = max(block.shape[1] for block in blocks)
    padded = [np.pad(b, ((0, 0), (0, width - b.shape[1]), (0, 0)), constant_values=_PAPER) for b in blocks]
    return np.vstack(padded)


def _block(columns: Sequence[Comparison], first: str) -> UInt8[np.ndarray, "H W 3"]:
    """Three rows with a line of labels above and a margin of row names on the left."""
    height, width = columns[0].truth.shape[:2]
    sheet = np.full((_LABEL_PX + 3 * height, _ROW_LABEL_PX + len(columns) * width, 3), _PAPER, np.uint8)
    for row, name in enumerate((first, "ours", f"diff x{DIFFERENCE_GAIN}")):
        put_text(sheet, name, (1, _LABEL_PX + row * height + height // 2), _ROW_LABEL_PX)
    for number, column in enumerate(columns):
        left = _ROW_LABEL_PX + number * width
        put_text(sheet, column.label, (left + 2, _LABEL_PX - 5), width - 4)
        difference = np.abs(column.truth.astype(int) - column.ours)
        shown = np.clip(DIFFERENCE_GAIN * difference, 0, 255).astype(np.uint8)
        for row, image in enumerate((column.truth, column.ours, shown)):
            top = _LABEL_PX + row * height
            sheet[top : top + height, left : left + width] = image
    return sheet


def image_grid(
    rows: Mapping[str, Sequence[UInt8[np.ndarray, "h w 3"]]], columns: Sequence[str]
) -> UInt8[np.ndarray, "H W 3"]:
    """Images in rows and columns, with the columns' names above and the rows' on the left.

    Args:
        rows: by name.
        columns: names, as many as each row has images.

    Raises:
        InvalidInput: if there is nothing to show, rows differ in length, or images in size.
    """
    shapes = {image.shape for row in rows.values() for image in row}
    if len(shapes) != 1 or {len(row) for row in rows.values()} != {len(columns)}:
        raise InvalidInput("images of a grid", f"{len(rows)} rows", "full rows of images, all of one size")
    height, width = shapes.pop()[:2]
    sheet = np.full((_LABEL_PX + len(rows) * height, _NAME_PX + len(columns) * width, 3), _PAPER, np.uint8)
    for number, name in enumerate(columns):
        put_text(sheet, name, (_NAME_PX + number * width + 2, _LABEL_PX - 5), width - 4)
    for number, (name, images) in enumerate(rows.items()):
        top = _LABEL_PX + number * height
        put_text(sheet, name, (1, top + height // 2), _NAME_PX)
        sheet[top : top + height, _NAME_PX:] = np.hstack(images)
    return sheet


def put_text(sheet: UInt8[np.ndarray, "H W 3"], text: str, place: tuple[int, int], width: int) -> None:
    """Write small black letters into an image, in place.

    Args:
        sheet: the image.
        text: letters that do not fit are left out at its end.
        place: (x, y) of the lower left corner of the text [px].
        width: room for the text [px].
    """
    font, scale = cv2.FONT_HERSHEY_SIMPLEX, 0.32
    while text and cv2.getTextSize(text, font, scale, 1)[0][0] > width:
        text = text[:-1]
    cv2.putText(sheet, text, place, font, scale, (0, 0, 0), 1, cv2.LINE_AA)
