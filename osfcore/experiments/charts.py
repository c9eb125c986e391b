"""Charts of evaluations, drawn as SVG by matplotlib."""

from __future__ import annotations

import html
import io
import re
from collections.abc import Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np
from jaxtyping import Float

from osfcore.extras import need
from osfcore.io.files import write_atomically

_WIDTH_IN = 3.7  # of a chart: two stand side by side on the site, and a phone shows one almost in its full size
_CURVES_IN, _LEGEND_IN = 2.9, 0.19  # heights: of axes with their labels, and of a row of the legend below them
_LEGEND_COLUMNS, _LEGEND_AT = 2, (0.5, -0.19)
_BARS_IN, _BAR_IN = 1.0, 0.28  # heights: of what is around the bars, and of a bar
_SHADE = 0.1
# Each has a contrast of 3 or more to white and to the dark page of the site.
_BLUE, _ORANGE, _GREEN, _RED, _PURPLE = "#1f77b4", "#d9600a", "#2a962a", "#d62728", "#9467bd"
_PINK, _TEAL, _OLIVE, _BROWN, _GREY = "#d0559b", "#0e8a9a", "#8f8a10", "#9c6050", "#7f7f7f"
_COLOURS = (_BLUE, _ORANGE, _GREEN, _RED, _PURPLE, _PINK, _TEAL, _OLIVE, _BROWN, _GREY)
_KNOWN = {  # what stands in several charts has one colour in all of them
    "ours": _BLUE,
    "as published": _ORANGE,
    **dict.fromkeys(("NeRF", "compositional NeRF"), _GREEN),
    **dict.fromkeys(("FitVid", "visual foresight"), _RED),
    "light overhead": _PURPLE,
    "light known": _PINK,
    "told the truth": _TEAL,
    "NeRF, brightness fitted": _OLIVE,
    "quasi-static": _BROWN,
    **dict.fromkeys(("no action", "no motion", "last frame"), _GREY),
}
_INK = "#010203"  # stands for the colour of the text around a chart; nothing else is drawn in it
_STYLE: dict[Any, Any] = {  # of matplotlib, whose keys are literals
    "axes.facecolor": "none",
    "legend.fontsize": "small",
    "legend.frameon": False,
    "svg.fonttype": "none",  # text stays text
    **dict.fromkeys(("text.color", "axes.edgecolor", "axes.labelcolor", "xtick.color", "ytick.color"), _INK),
    "grid.color": _INK,
}
_NO_METADATA = dict.fromkeys(("Date", "Creator", "Format", "Type"))
_CHANGES = (  # that make a drawing small, and fit to stand in a page with others
    (r"^.*?(?=<svg )", ""),  # what an SVG file begins with
    (r"<style.*?</style>", ""),  # would hold for the whole page
    (r' id="[\w.]+_\d+"', ""),  # of groups, which would stand in a page several times; those that are used have no _
    (r" font-family: [^;]*;", ""),
    (r' transform="rotate\(-0 [^)]*\)"', ""),
    (r"<[^>]*>", lambda tag: re.sub(r"(\.\d\d)\d+", r"\1", tag[0])),  # not what is written at the axes
    (r"\s+", " "),
    ("> <", "><"),
    (_INK, "currentColor"),
)


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


@dataclass(frozen=True, slots=True)
class Bars:
    """Horizontal bars with their intervals, the first one on top."""

    title: str
    x: Axis
    bars: Sequence[Bar]


def write_charts(path: Path, charts: Sequence[Chart | Bars]) -> None:
    """Draw charts in a row as an SVG file, on white.

    Raises:
        CannotWrite: if the disk refuses.
        MissingExtra: if matplotlib is not installed.
    """
    write_atomically(path, svg(charts, "white").encode())


def svg(charts: Sequence[Chart | Bars], paper: str = "none") -> str:
    """Draw charts in a row as SVG that can stand in a page, where text and axes take the colour of the text around.

    Equal charts give equal SVGs.

    Args:
        charts: from left to right.
        paper: colour behind them.

    Raises:
        MissingExtra: if matplotlib is not installed.
    """
    need("experiments", "A chart")
    from matplotlib import rc_context
    from matplotlib.figure import Figure

    name = "; ".join(f"{chart.title}: {_axes_in_words(chart)}".removeprefix(": ") for chart in charts)
    drawing = io.StringIO()
    with rc_context({**_STYLE, "svg.hashsalt": name}):
        size = _WIDTH_IN * len(charts), max(map(_height_in, charts))
        figure = Figure(size, layout="constrained", facecolor=paper)
        for panel, chart in zip(np.atleast_1d(figure.subplots(1, len(charts))), charts, strict=True):
            if isinstance(chart, Bars):
                _draw_bars(panel, chart)
            else:
                _draw_curves(panel, chart)
        figure.savefig(drawing, format="svg", metadata=_NO_METADATA)
    text = drawing.getvalue()
    for pattern, replacement in _CHANGES:
        text = re.sub(pattern, replacement, text, flags=re.DOTALL)
    about = f'role="img" aria-label="{html.escape(name)}" font-family="system-ui, sans-serif" stroke-linejoin="round"'
    return text.replace("<svg ", f"<svg {about} ", 1).strip()


def _axes_in_words(chart: Chart | Bars) -> str:
    return chart.x.label if isinstance(chart, Bars) else f"{chart.y.label} over {chart.x.label}"


def _height_in(chart: Chart | Bars) -> float:
    if isinstance(chart, Bars):
        return _BARS_IN + _BAR_IN * len(chart.bars)
    return _CURVES_IN + _LEGEND_IN * -(-len(chart.curves) // _LEGEND_COLUMNS)


def _draw_curves(panel: Any, chart: Chart) -> None:  # noqa: ANN401 - of matplotlib, an extra
    for number, curve in enumerate(chart.curves):
        colour = _KNOWN.get(curve.name, _COLOURS[number % len(_COLOURS)])
        panel.plot(curve.x, curve.y, marker="." if curve.dots else None, label=curve.name, color=colour)
        if curve.band is not None:
            panel.fill_between(curve.x, *curve.band, color=colour, alpha=_SHADE, linewidth=0)
    panel.set(title=chart.title, xlabel=chart.x.label, ylabel=chart.y.label)
    panel.set_xlim(chart.x.low, chart.x.high)
    panel.set_ylim(chart.y.low, chart.y.high)
    panel.grid(alpha=0.3)
    if chart.curves:
        panel.legend(loc="upper center", bbox_to_anchor=_LEGEND_AT, ncols=_LEGEND_COLUMNS)


def _draw_bars(panel: Any, chart: Bars) -> None:  # noqa: ANN401
    bars, rows = chart.bars, np.arange(len(chart.bars))
    ends = np.array([[bar.value - bar.low, bar.high - bar.value] for bar in bars]).reshape(-1, 2).T.clip(min=0)
    lengths = [bar.value for bar in bars]
    panel.barh(rows, lengths, xerr=ends, capsize=2, height=0.7, color=_BLUE, ecolor=_INK)
    panel.set_yticks(rows, [bar.label for bar in bars])
    panel.invert_yaxis()
    panel.set(title=chart.title, xlabel=chart.x.label)
    panel.set_xlim(chart.x.low, chart.x.high)
    panel.grid(axis="x", alpha=0.3)


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
