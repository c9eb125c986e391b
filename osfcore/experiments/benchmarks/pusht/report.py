"""Figures of planners that did the same tasks of Push-T."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from typing import Any

import numpy as np

from osfcore.experiments.statistics import compare_means, compare_shares, mean_interval, share_interval

_OURS = "ours"


@dataclass(frozen=True, slots=True)
class PushTEpisode:
    """One task by one planner.

    Attributes:
        planner: its name.
        seed: of the environment.
        start: coverage before anything moves.
        coverage: the most that was reached.
        is_success: whether that is enough.
        steps: actions executed.
        plan_s: duration of each plan, with simulated dynamics [s].
        own_s: likewise, from the same states with dynamics that cost next to nothing [s].
    """

    planner: str
    seed: int
    start: float
    coverage: float
    is_success: bool
    steps: int
    plan_s: tuple[float, ...]
    own_s: tuple[float, ...]


@dataclass(frozen=True, slots=True)
class PlannerReport:
    """All episodes, the tasks of each planner in the same order."""

    episodes: tuple[PushTEpisode, ...]

    def to_json(self) -> dict[str, Any]:
        """Shares and coverages in [0, 1] with 95 % intervals, times in seconds, rates in plans a second.

        Returns:
            "tasks", "start_mean" (coverage before anything moves), "planners" by name, "against" (ours against each
            other one, task by task) and "episodes".
        """
        planners = {name: self._of(name) for name in dict.fromkeys(e.planner for e in self.episodes)}
        ours = planners.get(_OURS, [])
        first = next(iter(planners.values()))
        return {
            "tasks": len(first),
            "start_mean": float(np.mean([episode.start for episode in first])),
            "planners": {name: _figures(episodes) for name, episodes in planners.items()},
            "against": {name: _against(ours, other) for name, other in planners.items() if ours and name != _OURS},
            "episodes": [
                {"planner": e.planner, "seed": e.seed, "start": e.start, "coverage": e.coverage, "steps": e.steps}
                for e in self.episodes
            ],
        }

    def _of(self, planner: str) -> list[PushTEpisode]:
        return [episode for episode in self.episodes if episode.planner == planner]


def _figures(episodes: Sequence[PushTEpisode]) -> dict[str, Any]:
    successes, coverages = [e.is_success for e in episodes], [e.coverage for e in episodes]
    return {
        "success": float(np.mean(successes)),
        "success_interval": list(share_interval(sum(successes), len(successes))),
        "coverage_mean": float(np.mean(coverages)),
        "coverage_interval": list(mean_interval(coverages)),
        "coverage_median": float(np.median(coverages)),
        "coverage_p10": float(np.quantile(coverages, 0.1)),
        "coverage_least": min(coverages),
        "steps_mean": float(np.mean([e.steps for e in episodes])),
        **_times([s for e in episodes for s in e.plan_s], "plan"),
        **_times([s for e in episodes for s in e.own_s], "own"),
    }


def _times(seconds: Sequence[float], what: str) -> dict[str, float]:
    return {
        f"{what}_hz": 1 / float(np.mean(seconds)),
        f"{what}_s_mean": float(np.mean(seconds)),
        f"{what}_s_median": float(np.median(seconds)),
        f"{what}_s_p90": float(np.quantile(seconds, 0.9)),
        f"{what}_s_p99": float(np.quantile(seconds, 0.99)),
        f"{what}_s_most": max(seconds),
    }


def _against(ours: Sequence[PushTEpisode], others: Sequence[PushTEpisode]) -> dict[str, Any]:
    return {
        "success": compare_shares([e.is_success for e in ours], [e.is_success for e in others]),
        "coverage": compare_means([e.coverage for e in ours], [e.coverage for e in others]),
    }
