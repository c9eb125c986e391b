"""A predicted push, what came of its execution, and when a change of the scene makes it outdated."""

from __future__ import annotations

from collections.abc import Iterable, Mapping
from dataclasses import dataclass, replace
from html import escape

import numpy as np
from jaxtyping import Float

from app.processes.messages.scene_messages import SceneRecord
from app.services.pushes import Outcome
from osfcore.geometry.rollouts import Rollouts
from osfcore.geometry.states import SceneState


@dataclass(frozen=True, eq=False, slots=True)
class PushPrediction:
    """A push that was predicted, and perhaps executed.

    Attributes:
        record: the scene from which it starts.
        actions: that are tried.
        rollouts: what they were predicted to lead to.
        took_s: time that predicting took [s].
        truth: the way things truly went, as far as it has been executed; empty before.
        is_executed: whether exactly these actions, all of them, were executed.
    """

    record: SceneRecord
    actions: Float[np.ndarray, "T 3"]
    rollouts: Rollouts
    took_s: float
    truth: tuple[SceneState, ...] = ()
    is_executed: bool = False

    @property
    def last_revision(self) -> int:
        """Of the scene once it has been executed: the simulation counts actions."""
        return self.record.revision + len(self.actions)

    def after(
        self, record: SceneRecord, states: tuple[SceneState, ...], executing: PushPrediction | None
    ) -> PushPrediction | None:
        """What is left of it after a change: it outlives the execution of its own actions, and nothing else.

        Args:
            record: the scene after the change.
            states: the way there.
            executing: whose actions are being executed now.
        """
        if record.revision <= self.record.revision:
            return self
        is_own = executing is not None and executing.rollouts is self.rollouts
        if is_own and record.revision <= self.last_revision:
            truth = (*(self.truth or (self.record.state,)), *states, record.state)
            return replace(self, truth=truth, is_executed=record.revision == self.last_revision)
        return self if self.is_executed and record.revision == self.last_revision else None


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
