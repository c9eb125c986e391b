"""Figures and pictures of an evaluation of rearrangement."""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import dataclass
from functools import cached_property
from pathlib import Path
from typing import Any

import numpy as np

from osfcore.experiments.charts import Axis, Chart, cumulative, write_charts
from osfcore.experiments.harness import TaskResult
from osfcore.experiments.statistics import compare_means, compare_shares, mean, mean_interval, median, share_interval
from osfcore.inspection.contact_sheet import contact_sheet
from osfcore.io.image_file import write_png
from osfcore.io.json_codec import decode
from osfcore.metrics.success import SUCCESS_M, ObjectScore, RearrangementScore

CURVE_MM = (5, 10, 15, 20, 30, 40, 60, 80, 100)
_LOOSE_DEG = 15.0
_NEVER_MM = 1e6  # the error of a task in which something else was pushed away
_CHART_MM, _CHART_6D = 60.0, 0.6
_PER_ROW = 10
_DISTANCES = ("pose6d", "pose6d_symmetric")
_Test = Callable[[RearrangementScore], bool]
_TESTS: dict[str, _Test] = {
    "success_tight": RearrangementScore.is_tight,
    "success_2cm": RearrangementScore.is_success,
    "success_2cm_15deg": lambda score: score.is_success(SUCCESS_M, _LOOSE_DEG),
}


@dataclass(frozen=True, eq=False)
class MpcReport:
    """Results of all tasks, in their order.

    Attributes:
        ours: of the method, which sees images.
        oracle: of the planner that knows the truth.
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
        """Return all figures; lengths in mm, angles in degrees, shares in [0, 1]."""
        scores, nothing = self.shipped, self.nothing
        final = [score.moved_mm for score in scores]
        return {
            "tasks": len(scores),
            **_figures(scores, ""),
            **_figures(self.told_truth, "oracle_"),
            **_figures(nothing, "noaction_"),
            **{f"{key}_overruled": _share(self.overruled, test) for key, test in _TESTS.items()},
            "refused": sum(bool(result.figures["goal_doubt"]) for result in self.ours),
            "success_by_moved": self._by_moved(_TESTS["success_2cm"]),
            "success_tight_by_moved": self._by_moved(_TESTS["success_tight"]),
            "success_curve": {str(mm): _share(scores, lambda s, mm=mm: s.is_success(mm / 1000)) for mm in CURVE_MM},
            "final_mm_mean": _rounded(mean(final), 2),
            "final_mm_median": _rounded(median(final), 2),
            "final_deg_median": _rounded(median(score.moved_deg for score in scores), 2),
            "start_mm_mean": _rounded(mean(score.moved_mm for score in nothing), 1),
            "oracle_success_tight_by_try": self._by_try() if self.oracle else None,
            "oracle_final_mm_mean": _rounded(mean(score.moved_mm for score in self.told_truth), 2),
            "seconds_robot_median": self._robot_s(),
            **{f"{name}_s_median": self._median(f"{key}_s") for name, key in _STAGES.items()},
            "steps_median": self._median("steps"),
            **self._own_pushes(),
            **{f"{key}_median": self._median(key) for key in ("goal_mm", "first_mm", "first_deg", "light_deg")},
            "against_noaction": paired(scores, nothing),
            "against_oracle": paired(scores, self.told_truth) if self.oracle else None,
            "by_object": _by_object(scores),
            "rejected_layouts": self._rejected(),
        }

    def _by_try(self) -> list[float | None]:
        """Return the oracle's share of tight successes after one try, after two, and so on: whether more still help."""
        pairs = zip(self.told_truth, self.oracle, strict=True)
        needed = [one.figures["tries"] if score.is_tight() else np.inf for score, one in pairs]
        most = max(one.figures["tries"] for one in self.oracle)
        return [_rounded(mean(tries <= count for tries in needed), 4) for count in range(1, most + 1)]

    def _by_moved(self, test: _Test) -> dict[str, float | None]:
        counts = sorted({len(score.moved) for score in self.shipped})
        return {str(n): _share([score for score in self.shipped if len(score.moved) == n], test) for n in counts}

    def _robot_s(self) -> float | None:
        """Return the median time until the loop ended, over tasks within 2 cm [s]."""
        pairs = zip(self.ours, self.shipped, strict=True)
        return _rounded(median(result.figures["robot_s"] for result, score in pairs if score.is_success()), 2)

    def _own_pushes(self) -> dict[str, float | int | None]:
        """Return how well our own pushes were predicted four actions ahead, from estimated poses."""
        figures: dict[str, float | int | None] = {}
        for unit in ("mm", "deg"):
            values = [value for result in self.ours for value in result.figures["predicted"][unit]]
            figures[f"own_pushes_mean_{unit}_4"] = _rounded(mean(values), 2)
            figures[f"own_pushes_median_{unit}_4"] = _rounded(median(values), 2)
            figures["own_pushes"] = len(values)
        return figures

    def _rejected(self) -> dict[str, int]:
        reasons = sorted({reason for result in self.ours for reason in result.figures["rejected"]})
        return {reason: sum(one.figures["rejected"].get(reason, 0) for one in self.ours) for reason in reasons}

    def _median(self, key: str) -> float | None:
        return _rounded(median(result.figures[key] for result in self.ours), 3)


_STAGES = {"replan": "plan", "estimate": "estimate", "first": "first", "goal": "goal", "episode": "episode"}


def _figures(scores: Sequence[RearrangementScore], who: str) -> dict[str, Any]:
    """Return the figures that the method, the oracle and doing nothing all have; None without scores."""
    figures: dict[str, Any] = {}
    for key, test in _TESTS.items():
        interval = share_interval(sum(test(score) for score in scores), len(scores)) if scores else None
        figures[who + key] = _share(scores, test)
        figures[f"{who}{key}_interval"] = _rounded_ends(interval, 3)
    for key in _DISTANCES:
        values = [getattr(score, key) for score in scores]
        figures[f"{who}{key}_mean"] = _rounded(mean(values), 4)
        figures[f"{who}{key}_median"] = _rounded(median(values), 4)
        figures[f"{who}{key}_mean_interval"] = _rounded_ends(mean_interval(values), 4)
    return figures


def paired(ours: Sequence[RearrangementScore], others: Sequence[RearrangementScore]) -> dict[str, Any]:
    """Compare two methods task by task: differences with intervals, and McNemar's test of the shares."""
    shares = {
        key: [[_TESTS[key](s) for s in them] for them in (ours, others)] for key in ("success_tight", "success_2cm")
    }
    distances = {key: [[getattr(s, key) for s in them] for them in (ours, others)] for key in _DISTANCES}
    compared = {key: compare_shares(*both) for key, both in shares.items()}
    return {**compared, **{key: compare_means(*both) for key, both in distances.items()}}


def _by_object(scores: Sequence[RearrangementScore]) -> dict[str, dict[str, float | None]]:
    """Return how each object ended where it had to move."""
    rows: dict[str, list[ObjectScore]] = {}
    for score in scores:
        for one in score.moved:
            rows.setdefault(one.name, []).append(one)
    return {
        name: {
            "moved": len(ends),
            "tight": _rounded(mean(end.is_tight() for end in ends), 4),
            "within_2cm": _rounded(mean(end.is_within(SUCCESS_M, np.inf) for end in ends), 4),
            "mm_median": _rounded(median(end.mm for end in ends), 2),
            "deg_median": _rounded(median(end.deg for end in ends), 2),
        }
        for name, ends in sorted(rows.items())
    }


def scores_of(results: Sequence[TaskResult], key: str) -> list[RearrangementScore]:
    """Return the scores among the figures of results."""
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
    """Return the error of the object that is farthest from its goal [mm]."""
    return max(one.mm for one in score.moved) if score.others_mm <= 1000 * SUCCESS_M else _NEVER_MM


def _share(scores: Sequence[RearrangementScore], test: _Test) -> float | None:
    return _rounded(mean(test(score) for score in scores), 4)


def _rounded(value: float | None, digits: int) -> float | None:
    return None if value is None else round(value, digits)


def _rounded_ends(interval: Sequence[float] | None, digits: int) -> list[float] | None:
    return None if interval is None else [round(end, digits) for end in interval]
