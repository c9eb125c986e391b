"""What a push was predicted to do, and did, as a small table for the panel."""

from __future__ import annotations

from collections.abc import Iterable, Mapping
from html import escape

from app.services.pushes import Outcome

_STYLE = "width:100%;border-collapse:collapse;font-size:0.7em;line-height:1.35"
_HEAD = "text-align:right;padding-left:0.5em;font-weight:600;vertical-align:bottom"
_CELL = "text-align:right;padding-left:0.5em;vertical-align:top;white-space:nowrap"


def report(outcomes: Iterable[Outcome], labels: Mapping[str, str]) -> str:
    """HTML of a table with a line for each object; labels, which users choose, are escaped."""
    rows = tuple(outcomes)
    if not rows:
        return ""
    is_tried = rows[0].off_mm is not None
    heads = ("Predicted", "True", "Off by") if is_tried else ("Predicted to go",)
    head = "".join(f'<th style="{_HEAD}">{text}</th>' for text in heads)
    lines = "".join(_line(row, labels.get(row.name, row.name)) for row in rows)
    return (
        f'<div style="padding:0 0.7em 0.4em"><table class="push-report" style="{_STYLE}">'
        f'<tr><th style="text-align:left">Object</th>{head}</tr>{lines}</table></div>'
    )


def _line(row: Outcome, label: str) -> str:
    cells = [_motion(row.predicted_mm, row.predicted_deg)]
    if row.went_mm is not None and row.turned_deg is not None:
        cells.append(_motion(row.went_mm, row.turned_deg))
    if row.off_mm is not None and row.off_deg is not None:
        cells.append(f"<b>{_motion(row.off_mm, row.off_deg)}</b>")
    data = "".join(f'<td style="{_CELL}">{cell}</td>' for cell in cells)
    return f'<tr data-object="{escape(row.name)}"><td>{escape(label)}</td>{data}</tr>'


def _motion(shift_mm: float, turn_deg: float) -> str:
    if shift_mm < 0.05 and turn_deg < 0.05:
        return "still"
    return f"{_digits(shift_mm)} mm<br>{_digits(turn_deg)}°"


def _digits(value: float) -> str:
    return f"{value:.1f}" if value < 9.95 else f"{value:.0f}"
