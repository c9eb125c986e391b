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
    """

    name: str
    x: Float[np.ndarray, "n"]
    y: Float[np.ndarray, "n"]
    dots: bool = False


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
            panel.plot(curve.x, curve.y, marker="o" if curve.dots else None, label=curve.name)
        panel.set(title=chart.title, xlabel=chart.x.label, ylabel=chart.y.label)
        panel.set_xlim(chart.x.low, chart.x.high)
        panel.set_ylim(chart.y.low, chart.y.high)
        panel.grid(alpha=0.3)
        if chart.curves:
            panel.legend(fontsize="small")
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
