"""Line charts of evaluations, drawn by matplotlib."""

from __future__ import annotations

import io
from collections.abc import Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np
from jaxtyping import Float

from osfcore.extras import need
from osfcore.io.files import write_atomically

_PANEL_IN = (4.6, 3.4)  # width and height
_BARS_IN = (6.4, 0.28)  # width, and height of each bar
_SHADE = 0.15


@dataclass(frozen=True, eq=False, slots=True)
class Curve:
    """One line of a chart.

    Attributes:
        name: in the legend.
        x: places.
        y: values; the line has gaps where they are NaN.
        dots: whether the points are marked.
        band: lower and upper end of an interval around each y, drawn as a shade.
    """

    name: str
    x: Float[np.ndarray, "n"]
    y: Float[np.ndarray, "n"]
    dots: bool = False
    band: Float[np.ndarray, "2 n"] | None = None


@dataclass(frozen=True, slots=True)
class Axis:
    """One axis: its label with the unit and where it begins and ends; None for an end that shows all values."""

    label: str
    low: float
    high: float | None = None


@dataclass(frozen=True, eq=False, slots=True)
class Chart:
    """Curves over one pair of axes; what lies outside the axes is cut off."""

    title: str
    x: Axis
    y: Axis
    curves: Sequence[Curve]


@dataclass(frozen=True, slots=True)
class Bar:
    """One bar: its label, its length, and the ends of an interval."""

    label: str
    value: float
    low: float
    high: float


def write_charts(path: Path, charts: Sequence[Chart]) -> None:
    """Draw charts in a row as PNG.

    Raises:
        CannotWrite: if the disk refuses.
        MissingExtra: if matplotlib is not installed.
    """
    figure = _figure(_PANEL_IN[0] * len(charts), _PANEL_IN[1])
    panels = np.atleast_1d(figure.subplots(1, len(charts)))
    for panel, chart in zip(panels, charts, strict=True):
        for curve in chart.curves:
            (line,) = panel.plot(curve.x, curve.y, marker="o" if curve.dots else None, label=curve.name)
            if curve.band is not None:
                panel.fill_between(curve.x, *curve.band, color=line.get_color(), alpha=_SHADE, linewidth=0)
        panel.set(title=chart.title, xlabel=chart.x.label, ylabel=chart.y.label)
        panel.set_xlim(chart.x.low, chart.x.high)
        panel.set_ylim(chart.y.low, chart.y.high)
        panel.grid(alpha=0.3)
        if chart.curves:
            panel.legend(fontsize="small")
    _write(path, figure)


def write_bars(path: Path, title: str, axis: Axis, bars: Sequence[Bar]) -> None:
    """Draw horizontal bars with their intervals as PNG, the first one on top.

    Raises:
        CannotWrite: if the disk refuses.
        MissingExtra: if matplotlib is not installed.
    """
    figure = _figure(_BARS_IN[0], 1.0 + _BARS_IN[1] * len(bars))
    panel = figure.subplots()
    values = np.array([bar.value for bar in bars])
    ends = np.array([[bar.value - bar.low, bar.high - bar.value] for bar in bars]).reshape(-1, 2).T.clip(min=0)
    panel.barh(np.arange(len(bars)), values, xerr=ends, capsize=2, height=0.7)
    panel.set_yticks(np.arange(len(bars)), [bar.label for bar in bars])
    panel.invert_yaxis()
    panel.set(title=title, xlabel=axis.label)
    panel.set_xlim(axis.low, axis.high)
    panel.grid(axis="x", alpha=0.3)
    _write(path, figure)


def _figure(width: float, height: float) -> Any:  # noqa: ANN401 - of matplotlib, an extra
    """Return an empty figure of a size [inch]."""
    need("experiments", "A chart")
    from matplotlib.figure import Figure

    return Figure((width, height), layout="constrained")


def _write(path: Path, figure: Any) -> None:  # noqa: ANN401
    picture = io.BytesIO()
    figure.savefig(picture)
    write_atomically(path, picture.getvalue())


def cumulative(name: str, values: Sequence[float], axis: Axis, total: int | None = None) -> Curve:
    """Return the share of values up to each place on an axis.

    Args:
        name: in the legend.
        values: any numbers.
        axis: over which it is drawn; has both ends.
        total: count that is a share of 1; the number of values if None. It is more where some have no value.
    """
    places = np.linspace(axis.low, axis.high or 0.0, 200)
    below = np.searchsorted(np.sort(np.asarray(values, float)), places, side="right")
    return Curve(name, places, below / max(len(values) if total is None else total, 1))
