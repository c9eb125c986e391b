"""Figures and pictures of an evaluation of planning."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np
from scipy.stats import binomtest

from osfcore.experiments.charts import Axis, Chart, cumulative, write_charts
from osfcore.experiments.task_cache import TaskResult
from osfcore.inspection.contact_sheet import contact_sheet
from osfcore.io.image_file import write_png
from osfcore.metrics.success import OTHERS_M, SUCCESS_DEG, SUCCESS_M, RearrangementScore

CURVE_MM = (5, 10, 15, 20, 30, 40, 60, 80, 100)
_NEVER_MM = 1e6  # the error of a task in which something else was pushed away
_CHART_MM, _CHART_6D = 60.0, 0.6
_PER_ROW = 10


@dataclass(frozen=True, eq=False, slots=True)
class MpcReport:
    """Results of all tasks, in their order.

    Attributes:
        ours: from images.
        oracle: told the truth.
    """

    ours: tuple[TaskResult, ...]
    oracle: tuple[TaskResult, ...]

    def to_json(self) -> dict[str, Any]:
        """All figures; lengths in mm, angles in degrees, shares in [0, 1]."""
        scores, oracle = scores_of(self.ours, "score"), scores_of(self.oracle, "score")
        nothing = scores_of(self.ours, "noaction")
        success = [score.is_success() for score in scores]
        strict = [score.is_success(SUCCESS_M, SUCCESS_DEG) for score in scores]
        by_moved = {
            str(count): _mean([score.is_success() for score in scores if score.moved == count])
            for count in sorted({score.moved for score in scores})
        }
        final = [score.moved_mm for score in scores]
        return {
            "tasks": len(scores),
            "success_2cm": _mean(success),
            "success_2cm_interval": [round(end, 3) for end in interval(sum(success), len(success))],
            "success_2cm_15deg": _mean(strict),
            "success_by_moved": by_moved,
            "success_curve": {
                str(mm): _mean([score.is_success(mm / 1000) for score in scores]) for mm in CURVE_MM
            },
            "final_mm_mean": _rounded(np.mean(final), 2),
            "final_mm_median": _rounded(np.median(final), 2),
            "final_deg_median": _rounded(np.median([score.moved_deg for score in scores]), 2),
            "pose6d_mean": _rounded(np.mean([score.pose6d for score in scores]), 4),
            "replan_s_median": self._median("plan_s"),
            "estimate_s_median": self._median("estimate_s"),
            "first_s_median": self._median("first_s"),
            "goal_s_median": self._median("goal_s"),
            "episode_s_median": self._median("episode_s"),
            "steps_median": self._median("steps"),
            "goals_doubted": sum(bool(result.figures["goal_doubt"]) for result in self.ours),
            "goal_mm_median": self._median("goal_mm"),
            "oracle_success_2cm": _mean([score.is_success() for score in oracle]) if oracle else None,
            "oracle_success_2cm_15deg": (
                _mean([score.is_success(SUCCESS_M, SUCCESS_DEG) for score in oracle]) if oracle else None
            ),
            "oracle_final_mm_mean": _rounded(np.mean([score.moved_mm for score in oracle]), 2) if oracle else None,
            "noaction_success_2cm": _mean([score.is_success() for score in nothing]),
            "start_mm_mean": _rounded(np.mean([score.moved_mm for score in nothing]), 1),
        }  # fmt: skip

    def _median(self, key: str) -> float | None:
        values = [result.figures[key] for result in self.ours if result.figures[key] is not None]
        return _rounded(np.median(values), 3) if values else None


def scores_of(results: Sequence[TaskResult], key: str) -> list[RearrangementScore]:
    """The scores among the figures of results."""
    return [RearrangementScore(**result.figures[key]) for result in results]


def write_pictures(folder: Path, report: MpcReport) -> None:
    """Draw mpc.png, success by threshold and errors of 6D poses, and mpc_tasks.png, goals and what was reached.

    Raises:
        CannotWrite: if the disk refuses.
    """
    kinds = {"from images": scores_of(report.ours, "score"), "no action": scores_of(report.ours, "noaction")}
    if report.oracle:
        kinds["told the truth"] = scores_of(report.oracle, "score")
    share, mm, sixd = Axis("share of tasks", 0, 1), Axis("threshold [mm]", 0, _CHART_MM), Axis("distance", 0, _CHART_6D)
    reached = [cumulative(name, [_reached_mm(score) for score in scores], mm) for name, scores in kinds.items()]
    poses = [cumulative(name, [score.pose6d for score in scores], sixd) for name, scores in kinds.items()]
    charts = (Chart("Objects that had to move", mm, share, reached), Chart("6D poses, all objects", sixd, share, poses))
    write_charts(folder / "mpc.png", charts)
    shown = [comparison for result in report.ours for comparison in result.shown]
    write_png(folder / "mpc_tasks.png", contact_sheet(shown, per_row=_PER_ROW, truth="goal"))


def _reached_mm(score: RearrangementScore) -> float:
    return score.moved_mm if score.others_mm <= 1000 * OTHERS_M else _NEVER_MM


def _mean(values: Sequence[bool]) -> float:
    return round(float(np.mean(values)), 4)


def _rounded(value: np.floating[Any] | float, digits: int) -> float:
    return round(float(value), digits)


def interval(successes: int, tasks: int) -> tuple[float, float]:
    """Wilson's 95 % interval of a share."""
    limits = binomtest(successes, tasks).proportion_ci(method="wilson")
    return float(limits.low), float(limits.high)
