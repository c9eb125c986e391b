"""The page with the calibration board, to print."""

from __future__ import annotations

import io

import numpy as np
from jaxtyping import Bool
from PIL import Image, ImageDraw, ImageFont

from osfcore.photo.board import PAGE_M, SQUARE_PIXELS, Board

RULER_M = 0.1
INSTRUCTION = "Print at 100 %, check that this line is 100 mm long, and lay the sheet flat on the table."
_PRINT_DPI = 600
_INCH_M = 0.0254


def page_image(board: Board, pixels_per_m: float) -> Bool[np.ndarray, "h w"]:
    """The page to print: the board in its middle, and below it a ruler and an instruction. True is paper.

    Args:
        board: to print.
        pixels_per_m: resolution; edges are right within half a pixel.
    """
    width, height = (round(side * pixels_per_m) for side in PAGE_M)
    paper = board.image()
    column, row = (
        np.floor(((np.arange(count) + 0.5) / pixels_per_m - (page - side) / 2) * SQUARE_PIXELS / board.square_m)
        for count, page, side in zip((width, height), PAGE_M, board.size_m, strict=True)
    )
    inside = ((row >= 0) & (row < paper.shape[0]))[:, None] & ((column >= 0) & (column < paper.shape[1]))
    nearest = np.ix_(*(np.clip(i, 0, n - 1).astype(int) for i, n in zip((row, column), paper.shape, strict=True)))
    page = np.where(inside, paper[nearest], True)
    return page & _ruler_image(board, (width, height), pixels_per_m)


def _ruler_image(board: Board, size: tuple[int, int], pixels_per_m: float) -> Bool[np.ndarray, "h w"]:
    image = Image.new("1", size, 1)
    draw = ImageDraw.Draw(image)
    left = (PAGE_M[0] - board.size_m[0]) / 2
    middle = PAGE_M[1] - (PAGE_M[1] - board.size_m[1]) / 4
    tick, line = 0.0015, max(round(0.0002 * pixels_per_m), 1)
    marks = [(0.0, 0.0, RULER_M, 0.0), (0.0, -tick, 0.0, tick), (RULER_M, -tick, RULER_M, tick)]
    for mark in marks:
        ends = [round(v * pixels_per_m) for v in np.add(mark, (left, middle, left, middle))]
        draw.line(ends, fill=0, width=line)
    font = ImageFont.load_default(0.0032 * pixels_per_m)
    place = ((left + RULER_M + 0.005) * pixels_per_m, middle * pixels_per_m)
    draw.text(place, INSTRUCTION, fill=0, font=font, anchor="lm")
    return np.array(image)


def board_pdf(board: Board) -> bytes:
    """The page to print as PDF: A4, 600 dots an inch."""
    out = io.BytesIO()
    page = Image.fromarray(page_image(board, _PRINT_DPI / _INCH_M))
    page.save(out, "PDF", resolution=_PRINT_DPI, title="Calibration board", subject=f"{board}")
    return out.getvalue()
