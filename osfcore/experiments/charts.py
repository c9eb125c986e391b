"""Line charts of evaluations, drawn by matplotlib."""

from __future__ import annotations

import io
from collections.abc import Sequence
from dataclasses import dataclass
from pathlib import Path

import numpy as np
from jaxtyping import Float

from osfcore.errors import OsfError
from osfcore.io.files import write_atomically

_PANEL_IN = (4.6, 3.4)  # width and height
_BARS_IN = (6.4, 0.28)  # width, and height of each bar
_SHADE = 0.15


class MissingMatplotlib(OsfError):
    """Charts cannot be drawn."""

    def __init__(self) -> None:
        super().__init__("Charts need matplotlib; install it with: pip install 'osf-manipulation[experiments]'.")


@dataclass(frozen=True, eq=False, slots=True)
class Curve:
    """One line of a chart.

    Attributes:
        name: in the legend.
        x: where.
        y: what; gaps where it is NaN.
        dots: also mark the points.
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


def check_matplotlib() -> None:
    """Check that charts can be drawn.

    Raises:
        MissingMatplotlib: if they cannot.
    """
    try:
        import matplotlib  # noqa: F401  an extra, not among what every installation has
    except ImportError:
        raise MissingMatplotlib from None


def write_charts(path: Path, charts: Sequence[Chart]) -> None:
    """Draw charts in a row as PNG.

    Raises:
        CannotWrite: if the disk refuses.
        MissingMatplotlib: if it is not installed.
    """
    check_matplotlib()
    from matplotlib.figure import Figure

    figure = Figure((_PANEL_IN[0] * len(charts), _PANEL_IN[1]), layout="constrained")
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
    picture = io.BytesIO()
    figure.savefig(picture)
    write_atomically(path, picture.getvalue())


def write_bars(path: Path, title: str, axis: Axis, bars: Sequence[Bar]) -> None:
    """Draw horizontal bars with their intervals as PNG, the first one on top.

    Raises:
        CannotWrite: if the disk refuses.
        MissingMatplotlib: if it is not installed.
    """
    check_matplotlib()
    from matplotlib.figure import Figure

    figure = Figure((_BARS_IN[0], 1.0 + _BARS_IN[1] * len(bars)), layout="constrained")
    panel = figure.subplots()
    values = np.array([bar.value for bar in bars])
    ends = np.array([[bar.value - bar.low, bar.high - bar.value] for bar in bars]).reshape(-1, 2).T.clip(min=0)
    panel.barh(np.arange(len(bars)), values, xerr=ends, capsize=2, height=0.7)
    panel.set_yticks(np.arange(len(bars)), [bar.label for bar in bars])
    panel.invert_yaxis()
    panel.set(title=title, xlabel=axis.label)
    panel.set_xlim(axis.low, axis.high)
    panel.grid(axis="x", alpha=0.3)
    picture = io.BytesIO()
    figure.savefig(picture)
    write_atomically(path, picture.getvalue())


def cumulative(name: str, values: Sequence[float], axis: Axis, total: int | None = None) -> Curve:
    """The share of values up to each place on an axis.

    Args:
        name: in the legend.
        values: any numbers.
        axis: over which it is drawn; has both ends.
        total: what is 1; the number of values if None. More where some have no value.
    """
    places = np.linspace(axis.low, axis.high or 0.0, 200)
    below = np.searchsorted(np.sort(np.asarray(values, float)), places, side="right")
    return Curve(name, places, below / max(len(values) if total is None else total, 1))
