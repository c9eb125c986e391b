"""Intervals of shares and means, and paired tests between methods that were given the same tasks."""

from __future__ import annotations

from collections.abc import Sequence
from typing import Any

import numpy as np
from scipy.stats import binomtest, bootstrap

from osfcore.random_streams import Stream, stream_rng

_LEVEL = 0.95
_RESAMPLES = 9999


def share_interval(successes: int, tasks: int) -> tuple[float, float]:
    """Wilson's 95 % interval of a share."""
    limits = binomtest(successes, tasks).proportion_ci(_LEVEL, method="wilson")
    return float(limits.low), float(limits.high)


def mean_interval(values: Sequence[float]) -> tuple[float, float]:
    """Percentile bootstrap's 95 % interval of a mean (Efron 1979); one value alone says nothing of its spread."""
    if len(values) < 2 or np.ptp(values) == 0:
        return float(np.mean(values)), float(np.mean(values))
    rng = stream_rng(0, Stream.BOOTSTRAP)
    found = bootstrap(
        (np.asarray(values, float),), np.mean, n_resamples=_RESAMPLES, confidence_level=_LEVEL, method="percentile",
        rng=rng,
    )  # fmt: skip
    return float(found.confidence_interval.low), float(found.confidence_interval.high)


def compare_shares(ours: Sequence[bool], others: Sequence[bool]) -> dict[str, Any]:
    """Successes of two methods on the same tasks.

    Args:
        ours: of one method, task by task.
        others: of the other one.

    Returns:
        "difference" of the shares, Newcombe's 95 % "interval" of a paired difference, and "p" of McNemar's exact test:
        how likely tasks in which only one of both succeeds are shared out so unevenly if both are equally good.
    """
    pairs = list(zip(ours, others, strict=True))
    both, neither = pairs.count((True, True)), pairs.count((False, False))
    only_ours, only_others = pairs.count((True, False)), pairs.count((False, True))
    differing = only_ours + only_others
    return {
        "difference": (only_ours - only_others) / len(pairs),
        "interval": list(_newcombe(both, only_ours, only_others, neither)),
        "p": float(binomtest(only_ours, differing).pvalue) if differing else 1.0,
    }


def _newcombe(both: int, only_ours: int, only_others: int, neither: int) -> tuple[float, float]:
    """The interval of the difference of two paired shares (Newcombe 1998, method 10), from Wilson's of each of them."""
    tasks = both + only_ours + only_others + neither
    ours, others = both + only_ours, both + only_others
    (low, high), (other_low, other_high) = share_interval(ours, tasks), share_interval(others, tasks)
    below, above = ours / tasks - low, high - ours / tasks
    other_below, other_above = others / tasks - other_low, other_high - others / tasks
    spread = np.sqrt(float(ours * others) * (tasks - ours) * (tasks - others))
    excess = both * neither - only_ours * only_others
    corrected = max(excess - tasks / 2, 0) if excess > 0 else excess
    phi = corrected / spread if spread else 0.0
    difference = (only_ours - only_others) / tasks
    down = np.sqrt(below**2 - 2 * phi * below * other_above + other_above**2)
    up = np.sqrt(above**2 - 2 * phi * above * other_below + other_below**2)
    return float(difference - down), float(difference + up)


def holm(p_values: Sequence[float]) -> list[float]:
    """The p of several tests, corrected for their number (Holm 1979): the k-th smallest of m counts m - k + 1 times."""
    corrected, least = [0.0] * len(p_values), 0.0
    for rank, n in enumerate(np.argsort(p_values)):
        least = max(least, min(1.0, (len(p_values) - rank) * p_values[n]))
        corrected[n] = least
    return corrected


def compare_means(ours: Sequence[float], others: Sequence[float]) -> dict[str, Any]:
    """The mean "difference" of two methods on the same tasks and its bootstrap "interval" over tasks."""
    differences = [a - b for a, b in zip(ours, others, strict=True)]
    low, high = mean_interval(differences)
    return {"difference": float(np.mean(differences)), "interval": [low, high]}
