"""Charts of a report's sections."""

from __future__ import annotations

from collections.abc import Sequence
from pathlib import Path

import numpy as np

from osfcore.experiments.charts import Axis, Bar, Chart, Curve, write_bars, write_charts
from osfcore.experiments.reproduction.measured_cells import MeasuredCell, MeasuredSection
from osfcore.experiments.reproduction.sections import objects_in_words
from osfcore.experiments.statistics import share_interval
from osfcore.metrics.success import RearrangementScore

_POINTS = 61
_SHARE = Axis("share of tasks", 0, 1)
_DISTANCE = Axis("6D pose distance, symmetries counted", 0, 0.6)


def write_success_curves(path: Path, sections: Sequence[MeasuredSection]) -> None:
    """Draw success against threshold, a panel for each number of objects (paper, figure 7).

    Args:
        path: of the PNG.
        sections: one for each number.

    Raises:
        CannotWrite: if the disk refuses.
    """
    write_charts(path, [_success_chart(section) for section in sections])


def _success_chart(section: MeasuredSection) -> Chart:
    first = section.cells[0]
    kinds = {cell.label: cell.report.shipped for cell in section.cells} | {"no action": first.report.nothing}
    if first.report.oracle:
        kinds["told the truth"] = first.report.told_truth
    curves = [_curve(name, scores) for name, scores in kinds.items()]
    return Chart(objects_in_words(first.figures["objects"]), _DISTANCE, _SHARE, curves)


def _curve(name: str, scores: Sequence[RearrangementScore]) -> Curve:
    """The share of tasks within each threshold, with Wilson's interval."""
    places = np.linspace(_DISTANCE.low, _DISTANCE.high or 0.0, _POINTS)
    distances = np.sort([score.pose6d_symmetric for score in scores])
    counts = np.searchsorted(distances, places, side="right")
    band = np.array([share_interval(int(count), len(scores)) for count in counts]).T
    return Curve(name, places, counts / len(scores), band=band)


def write_success_bars(path: Path, section: MeasuredSection) -> None:
    """Draw the share of tasks within 2 cm and 0.1 rad of each cell, with Wilson's intervals.

    Args:
        path: of the PNG.
        section: whose cells are shown.

    Raises:
        CannotWrite: if the disk refuses.
    """
    axis = Axis("share of tasks within 2 cm and 0.1 rad", 0, 1)
    write_bars(path, section.section.title, axis, [_bar(cell) for cell in section.cells])


def _bar(cell: MeasuredCell) -> Bar:
    low, high = cell.figures["success_tight_interval"]
    return Bar(cell.label, cell.figures["success_tight"], low, high)
