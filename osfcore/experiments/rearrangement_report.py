"""Figures and pictures of an evaluation of rearrangement."""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import dataclass
from functools import cached_property
from pathlib import Path
from typing import Any

import numpy as np

from osfcore.experiments.charts import Axis, Chart, cumulative, write_charts
from osfcore.experiments.harness import TaskResult, compare_means, compare_shares, mean_interval, share_interval
from osfcore.inspection.contact_sheet import contact_sheet
from osfcore.io.image_file import write_png
from osfcore.io.json_codec import decode
from osfcore.metrics.success import SUCCESS_M, ObjectScore, RearrangementScore

CURVE_MM = (5, 10, 15, 20, 30, 40, 60, 80, 100)
_LOOSE_DEG = 15.0
_NEVER_MM = 1e6  # the error of a task in which something else was pushed away
_CHART_MM, _CHART_6D = 60.0, 0.6
_PER_ROW = 10
_TESTS: dict[str, Callable[[RearrangementScore], bool]] = {
    "success_tight": RearrangementScore.is_tight,
    "success_2cm": RearrangementScore.is_success,
    "success_2cm_15deg": lambda score: score.is_success(SUCCESS_M, _LOOSE_DEG),
}


@dataclass(frozen=True, eq=False)
class MpcReport:
    """Results of all tasks, in their order.

    Attributes:
        ours: from images.
        oracle: told the truth.
        may_refuse: whether nothing is moved where the goal is doubted, as ours ships; a doubt of our loop about what
            another method's fields show counts for nothing.
    """

    ours: tuple[TaskResult, ...]
    oracle: tuple[TaskResult, ...]
    may_refuse: bool = True

    @cached_property
    def overruled(self) -> list[RearrangementScore]:
        """How our tables ended, where doubts about the goal were overruled."""
        return scores_of(self.ours, "score")

    @cached_property
    def nothing(self) -> list[RearrangementScore]:
        """How they are without any action."""
        return scores_of(self.ours, "noaction")

    @cached_property
    def shipped(self) -> list[RearrangementScore]:
        """How the method's tables end: ours moves nothing where the goal is doubted."""
        if not self.may_refuse:
            return self.overruled
        trio = zip(self.ours, self.overruled, self.nothing, strict=True)
        return [nothing if result.figures["goal_doubt"] else overruled for result, overruled, nothing in trio]

    @cached_property
    def told_truth(self) -> list[RearrangementScore]:
        """How the oracle's tables ended."""
        return scores_of(self.oracle, "score")

    def to_json(self) -> dict[str, Any]:
        """All figures; lengths in mm, angles in degrees, shares in [0, 1]."""
        scores, nothing = self.shipped, self.nothing
        final = [score.moved_mm for score in scores]
        is_curve = {str(mm): _mean([score.is_success(mm / 1000) for score in scores]) for mm in CURVE_MM}
        return {
            "tasks": len(scores),
            **_figures(scores, ""),
            **_figures(self.told_truth, "oracle_"),
            **_figures(nothing, "noaction_"),
            **{f"{key}_overruled": _mean([test(s) for s in self.overruled]) for key, test in _TESTS.items()},
            "refused": sum(bool(result.figures["goal_doubt"]) for result in self.ours),
            "success_by_moved": self._by_moved("success_2cm"),
            "success_tight_by_moved": self._by_moved("success_tight"),
            "success_curve": is_curve,
            "final_mm_mean": _rounded(np.mean(final), 2),
            "final_mm_median": _rounded(np.median(final), 2),
            "final_deg_median": _rounded(np.median([score.moved_deg for score in scores]), 2),
            "start_mm_mean": _rounded(np.mean([score.moved_mm for score in nothing]), 1),
            "oracle_success_tight_by_try": self._by_try() if self.oracle else None,
            "oracle_final_mm_mean": _mean_of([score.moved_mm for score in self.told_truth]),
            "seconds_robot_median": self._robot_s(),
            **{f"{told}_s_median": self._median(f"{key}_s") for told, key in _STAGES.items()},
            "steps_median": self._median("steps"),
            **self._own_pushes(),
            **{f"{key}_median": self._median(key) for key in ("goal_mm", "first_mm", "first_deg", "light_deg")},
            "against_noaction": paired(scores, nothing),
            "against_oracle": paired(scores, self.told_truth) if self.oracle else None,
            "by_object": _by_object(scores),
            "rejected_layouts": self._rejected(),
        }

    def _by_try(self) -> list[float]:
        """The oracle's share of tight successes after one try, after two, and so on: whether more still help."""
        pairs = [
            (score.is_tight(), one.figures["tries"]) for score, one in zip(self.told_truth, self.oracle, strict=True)
        ]
        most = max(tries for _, tries in pairs)
        return [_mean([is_tight and tries <= count for is_tight, tries in pairs]) for count in range(1, most + 1)]

    def _by_moved(self, key: str) -> dict[str, float]:
        counts = sorted({len(score.moved) for score in self.shipped})
        test = _TESTS[key]
        return {
            str(count): _mean([test(score) for score in self.shipped if len(score.moved) == count]) for count in counts
        }

    def _robot_s(self) -> float | None:
        """Until the loop ended, over tasks within 2 cm."""
        pairs = zip(self.ours, self.shipped, strict=True)
        seconds = [result.figures["robot_s"] for result, score in pairs if score.is_success()]
        return _rounded(np.median(seconds), 2) if seconds else None

    def _own_pushes(self) -> dict[str, float | int | None]:
        """How well our own pushes were predicted four actions ahead, from estimated poses."""
        told: dict[str, float | int | None] = {}
        for unit in ("mm", "deg"):
            values = [value for result in self.ours for value in result.figures["predicted"][unit]]
            told[f"own_pushes_mean_{unit}_4"] = _rounded(np.mean(values), 2) if values else None
            told[f"own_pushes_median_{unit}_4"] = _rounded(np.median(values), 2) if values else None
            told["own_pushes"] = len(values)
        return told

    def _rejected(self) -> dict[str, int]:
        reasons = sorted({reason for result in self.ours for reason in result.figures["rejected"]})
        return {reason: sum(one.figures["rejected"].get(reason, 0) for one in self.ours) for reason in reasons}

    def _median(self, key: str) -> float | None:
        values = [result.figures[key] for result in self.ours if result.figures[key] is not None]
        return _rounded(np.median(values), 3) if values else None


_STAGES = {"replan": "plan", "estimate": "estimate", "first": "first", "goal": "goal", "episode": "episode"}


def _figures(scores: Sequence[RearrangementScore], who: str) -> dict[str, Any]:
    """What is told of everybody alike; None of nobody."""
    told: dict[str, Any] = {}
    for key, test in _TESTS.items():
        passed = [test(score) for score in scores]
        told[who + key] = _mean(passed) if scores else None
        limits = share_interval(sum(passed), len(scores)) if scores else None
        told[f"{who}{key}_interval"] = None if limits is None else [round(end, 3) for end in limits]
    for key in ("pose6d", "pose6d_symmetric"):
        values = [getattr(score, key) for score in scores]
        told[f"{who}{key}_mean"] = _rounded(np.mean(values), 4) if scores else None
        told[f"{who}{key}_median"] = _rounded(np.median(values), 4) if scores else None
        limits = mean_interval(values) if scores else None
        told[f"{who}{key}_mean_interval"] = None if limits is None else [_rounded(end, 4) for end in limits]
    return told


def paired(ours: Sequence[RearrangementScore], others: Sequence[RearrangementScore]) -> dict[str, Any]:
    """Two methods compared task by task: differences with intervals, and McNemar's test of the shares."""
    told: dict[str, Any] = {}
    for key in ("success_tight", "success_2cm"):
        test = _TESTS[key]
        told[key] = compare_shares([test(score) for score in ours], [test(score) for score in others])
    for key in ("pose6d", "pose6d_symmetric"):
        told[key] = compare_means(*([getattr(score, key) for score in them] for them in (ours, others)))
    return told


def _by_object(scores: Sequence[RearrangementScore]) -> dict[str, dict[str, float]]:
    """Of each object, how it ended where it had to move."""
    rows: dict[str, list[ObjectScore]] = {}
    for score in scores:
        for one in score.moved:
            rows.setdefault(one.name, []).append(one)
    return {
        name: {
            "moved": len(ends),
            "tight": _mean([end.is_tight() for end in ends]),
            "within_2cm": _mean([end.is_within(SUCCESS_M, np.inf) for end in ends]),
            "mm_median": _rounded(np.median([end.mm for end in ends]), 2),
            "deg_median": _rounded(np.median([end.deg for end in ends]), 2),
        }
        for name, ends in sorted(rows.items())
    }


def scores_of(results: Sequence[TaskResult], key: str) -> list[RearrangementScore]:
    """The scores among the figures of results."""
    return [decode(RearrangementScore, result.figures[key], "score") for result in results]


def write_pictures(folder: Path, report: MpcReport) -> None:
    """Draw mpc.png, success by threshold and errors of 6D poses, and mpc_tasks.png, goals and what was reached.

    Raises:
        CannotWrite: if the disk refuses.
    """
    kinds = {"from images": report.shipped, "no action": report.nothing}
    if report.oracle:
        kinds["told the truth"] = report.told_truth
    share, mm, sixd = Axis("share of tasks", 0, 1), Axis("threshold [mm]", 0, _CHART_MM), Axis("distance", 0, _CHART_6D)
    reached = [cumulative(name, [_reached_mm(score) for score in scores], mm) for name, scores in kinds.items()]
    poses = [cumulative(name, [score.pose6d for score in scores], sixd) for name, scores in kinds.items()]
    charts = (Chart("Objects that had to move", mm, share, reached), Chart("6D poses, all objects", sixd, share, poses))
    write_charts(folder / "mpc.png", charts)
    shown = [comparison for result in report.ours for comparison in result.shown]
    write_png(folder / "mpc_tasks.png", contact_sheet(shown, per_row=_PER_ROW, truth="goal"))


def _reached_mm(score: RearrangementScore) -> float:
    """Of the object that is farthest from its goal."""
    return max(one.mm for one in score.moved) if score.others_mm <= 1000 * SUCCESS_M else _NEVER_MM


def _mean(values: Sequence[bool]) -> float:
    return round(float(np.mean(values)), 4)


def _mean_of(values: Sequence[float]) -> float | None:
    return _rounded(np.mean(values), 2) if values else None


def _rounded(value: np.floating[Any] | float, digits: int) -> float:
    return round(float(value), digits)
