"""Small line charts as images: axes, a grid, a few curves with their names."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from typing import Literal

import cv2
import numpy as np
from jaxtyping import Float, UInt8

from osfcore.errors import InvalidInput

COLOURS = ((31, 119, 180), (214, 39, 40), (44, 160, 44), (148, 103, 189), (255, 127, 14), (90, 90, 90))
_WIDTH, _HEIGHT = 460, 320
_LEFT, _RIGHT, _TOP, _BOTTOM = 56, 14, 30, 44
_TICKS = 5
_PAPER, _INK, _GRID = 255, (30, 30, 30), (225, 225, 225)
_FONT, _SCALE = cv2.FONT_HERSHEY_SIMPLEX, 0.4
_FINE = 4  # fractional bits of drawn coordinates


@dataclass(frozen=True, eq=False, slots=True)
class Curve:
    """One line of a chart.

    Attributes:
        name: in the legend.
        x: where.
        y: what; gaps where it is NaN.
        dots: also mark the points.
    """

    name: str
    x: Float[np.ndarray, "n"]
    y: Float[np.ndarray, "n"]
    dots: bool = False


@dataclass(frozen=True, slots=True)
class Axis:
    """One axis.

    Attributes:
        label: with the unit.
        low: value at its beginning.
        high: value at its end; more than `low`.
    """

    label: str
    low: float
    high: float

    def __post_init__(self) -> None:
        """Check the range."""
        if not self.high > self.low:
            raise InvalidInput(f"range of axis {self.label}", (self.low, self.high), "increasing")


def chart(
    title: str, x: Axis, y: Axis, curves: Sequence[Curve], *, legend: Literal["top", "bottom"] = "bottom"
) -> UInt8[np.ndarray, "h w 3"]:
    """Curves over a grid; what lies outside the axes is cut off. Without any curve, empty axes."""
    sheet = np.full((_HEIGHT, _WIDTH, 3), _PAPER, np.uint8)
    _axes(sheet, title, x, y)
    inside = sheet[_TOP : _HEIGHT - _BOTTOM, _LEFT : _WIDTH - _RIGHT]
    inside_part = np.ascontiguousarray(inside)
    for number, curve in enumerate(curves):
        _draw(inside_part, curve, x, y, COLOURS[number % len(COLOURS)])
    inside[:] = inside_part
    for number, curve in enumerate(curves):
        last = _HEIGHT - _BOTTOM - 10 if legend == "bottom" else _TOP + 4 + 16 * len(curves)
        place = (_WIDTH - _RIGHT - 190, last - 16 * (len(curves) - 1 - number))
        colour = COLOURS[number % len(COLOURS)]
        cv2.line(sheet, (place[0] - 24, place[1] - 4), (place[0] - 6, place[1] - 4), colour, 2, cv2.LINE_AA)
        _text(sheet, curve.name, place)
    return sheet


def side_by_side(charts: Sequence[UInt8[np.ndarray, "h w 3"]]) -> UInt8[np.ndarray, "h W 3"]:
    """Charts in a row."""
    return np.hstack(charts)


def round_limit(most: float) -> float:
    """The first of 1, 2, 2.5, 5, 10 times a power of ten that is not below a positive number."""
    power = 10.0 ** np.floor(np.log10(most))
    return float(next(step * power for step in (1, 2, 2.5, 5, 10) if step * power >= most * (1 - 1e-9)))


def cumulative(name: str, values: Sequence[float], axis: Axis, total: int | None = None) -> Curve:
    """The share of values up to each place on an axis.

    Args:
        name: in the legend.
        values: any numbers.
        axis: over which it is drawn.
        total: what is 1; the number of values if None. More where some have no value.
    """
    places = np.linspace(axis.low, axis.high, 200)
    below = np.searchsorted(np.sort(np.asarray(values, float)), places, side="right")
    return Curve(name, places, below / max(len(values) if total is None else total, 1))


def _axes(sheet: np.ndarray, title: str, x: Axis, y: Axis) -> None:
    left, right, top, bottom = _LEFT, _WIDTH - _RIGHT, _TOP, _HEIGHT - _BOTTOM
    for step in range(_TICKS + 1):
        share = step / _TICKS
        column, row = round(left + share * (right - 1 - left)), round(bottom - 1 - share * (bottom - 1 - top))
        cv2.line(sheet, (column, top), (column, bottom - 1), _GRID, 1)
        cv2.line(sheet, (left, row), (right - 1, row), _GRID, 1)
        _text(sheet, f"{x.low + share * (x.high - x.low):.3g}", (column, bottom + 14), align="middle")
        _text(sheet, f"{y.low + share * (y.high - y.low):.3g}", (left - 6, row + 4), align="right")
    cv2.rectangle(sheet, (left, top), (right - 1, bottom - 1), _INK, 1)
    _text(sheet, title, (left, 14))
    _text(sheet, y.label, (4, 26))
    _text(sheet, x.label, ((left + right) // 2, _HEIGHT - 8), align="middle")


def _draw(area: np.ndarray, curve: Curve, x: Axis, y: Axis, colour: tuple[int, int, int]) -> None:
    height, width = area.shape[:2]
    columns = (np.asarray(curve.x, float) - x.low) / (x.high - x.low) * (width - 1)
    rows = (height - 1) * (1 - (np.asarray(curve.y, float) - y.low) / (y.high - y.low))
    rows = np.clip(rows, -height, 2 * height)  # far outside, yet within what can be drawn; NaN stays
    points = np.stack([np.clip(columns, -width, 2 * width), rows], axis=1)
    known = np.isfinite(points.sum(axis=1))
    for piece in np.split(np.arange(len(points)), np.flatnonzero(~known)):
        run = points[piece[known[piece]]]
        if len(run):
            drawn = np.round(run * 2**_FINE).astype(np.int32)
            cv2.polylines(area, [drawn.reshape(-1, 1, 2)], False, colour, 2, cv2.LINE_AA, _FINE)
            for point in drawn if curve.dots else ():
                cv2.circle(area, (int(point[0]), int(point[1])), 4 * 2**_FINE, colour, -1, cv2.LINE_AA, _FINE)


def _text(sheet: np.ndarray, text: str, place: tuple[int, int], *, align: str = "left") -> None:
    width = cv2.getTextSize(text, _FONT, _SCALE, 1)[0][0]
    shift = {"left": 0, "middle": width // 2, "right": width}[align]
    cv2.putText(sheet, text, (place[0] - shift, place[1]), _FONT, _SCALE, _INK, 1, cv2.LINE_AA)
