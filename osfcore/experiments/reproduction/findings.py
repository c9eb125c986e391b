"""What a report's sections say in sentences: who is ahead, who is not, and what costs most."""

from __future__ import annotations

from collections.abc import Iterator, Mapping, Sequence
from types import MappingProxyType
from typing import Any

from osfcore.experiments.reproduction.measured_cells import MeasuredCell, MeasuredSection
from osfcore.experiments.reproduction.sections import objects_in_words
from osfcore.experiments.statistics import holm

_COMPARED: Mapping[str, str] = MappingProxyType(
    {"success_tight": "within 2 cm and 0.1 rad", "success_2cm": "within 2 cm"}
)
_SIGNIFICANT = 0.05
MOST_LOST = 0.15  # of success, that one factor of variation may cost
_HALF = 0.5


def findings(sections: Sequence[MeasuredSection]) -> tuple[str, ...]:
    """One sentence for each comparison of the methods, for the mean distance, and for what costs too much."""
    methods = [section for section in sections if section.section.name == "methods"]
    comparisons = [
        (section.cells[0], cell, key) for section in methods for cell in section.cells[1:] for key in _COMPARED
    ]
    corrected = holm([_gap_of(cell, key)["p"] for _, cell, key in comparisons])
    told = [_method(*one, p) for one, p in zip(comparisons, corrected, strict=True)]
    told += [_distance(section.cells[0]) for section in methods]
    for section in sections:
        if section.section.name == "factors":
            told += _costly(section)
    return tuple(told)


def _gap_of(cell: MeasuredCell, key: str) -> Mapping[str, Any]:
    assert cell.against is not None, "all methods and all factors have the same tasks"
    return cell.against[key]


def _method(ours: MeasuredCell, other: MeasuredCell, key: str, corrected: float) -> str:
    """Ours against another method; who is better is said where p, corrected for all comparisons, is below 5 %."""
    gap = _gap_of(other, key)  # the other one minus ours
    low, high = (-100 * end for end in reversed(gap["interval"]))
    lead = 0.0 - gap["difference"]  # never -0
    better = "ours is better" if lead > 0 else "ours is worse"
    verdict = better if corrected < _SIGNIFICANT else "no difference is shown"
    return (
        f"{_objects(ours)}, ours and {other.label}, {_COMPARED[key]}: {_percent(ours, key)} against "
        f"{_percent(other, key)}, which is {100 * lead:+.0f} points (95 %: {low:+.0f} to {high:+.0f}; "
        f"McNemar p = {gap['p']:.2g}, {corrected:.2g} by Holm for all these comparisons): {verdict}."
    )


def _distance(ours: MeasuredCell) -> str:
    mean, nothing = (ours.figures[f"{who}pose6d_symmetric_mean"] for who in ("", "noaction_"))
    verdict = "at most" if mean <= _HALF * nothing else "more than"
    return (
        f"{_objects(ours)}: mean 6D pose distance, symmetries counted, {mean:.3f}; doing nothing "
        f"{nothing:.3f}: {verdict} half."
    )


def _costly(section: MeasuredSection) -> Iterator[str]:
    for cell in section.cells[1:]:
        gap = _gap_of(cell, "success_tight")
        low, high = (-100 * end for end in reversed(gap["interval"]))
        if -gap["difference"] > MOST_LOST:
            yield (
                f"Under {cell.label} {-100 * gap['difference']:.0f} points of success are lost (95 %: {low:.0f} to "
                f"{high:.0f}), more than {100 * MOST_LOST:.0f}."
            )


def _objects(cell: MeasuredCell) -> str:
    return objects_in_words(cell.figures["objects"])


def _percent(cell: MeasuredCell, key: str) -> str:
    return f"{100 * cell.figures[key]:.0f} %"


def rows_of(section: MeasuredSection) -> list[dict[str, Any]]:
    """The rows of a section's table, the oracle's and those of doing nothing among them, as plain words."""
    rows = [_row(cell.label, cell.figures, "", cell) for cell in section.cells]
    first = section.cells[0]
    if first.report.oracle:
        rows.append(_row("told the truth", first.figures, "oracle_"))
    rows.append(_row("no action", first.figures, "noaction_"))
    return rows


def _row(label: str, figures: Any, who: str, cell: MeasuredCell | None = None) -> dict[str, Any]:  # noqa: ANN401
    row = {"label": label, "tasks": figures["tasks"]}
    for key in ("success_tight", "success_2cm"):
        row[key] = _share(figures[who + key], figures[f"{who}{key}_interval"])
    for key in ("pose6d_mean", "pose6d_symmetric_mean", "pose6d_symmetric_median"):
        row[key] = f"{figures[who + key]:.3f}"
    own = dict.fromkeys(("refused", "first_mm", "first_deg", "light_deg", "against"), "")
    if cell is not None:
        own["refused"] = str(figures["refused"])
        for key in ("first_mm", "first_deg", "light_deg"):
            value = figures[f"{key}_median"]
            own[key] = "" if value is None else f"{value:.2f}"
        own["against"] = "" if cell.against is None else _gap(cell.against["success_tight"])
    return {**row, **own}


def _share(value: float, interval: Sequence[float]) -> str:
    low, high = interval
    return f"{100 * value:.0f} % ({100 * low:.0f} to {100 * high:.0f})"


def _gap(gap: Any) -> str:  # noqa: ANN401
    low, high = gap["interval"]
    return f"{100 * gap['difference']:+.0f} ({100 * low:+.0f} to {100 * high:+.0f}), p = {gap['p']:.2g}"
