"""Statistics of measured figures: means and spreads, intervals, and paired comparisons of two methods."""

from __future__ import annotations

from collections.abc import Iterable, Sequence
from typing import Any

import numpy as np
from scipy.stats import binomtest, bootstrap

from osfcore.random_streams import Stream, stream_rng

_LEVEL = 0.95
_RESAMPLES = 9999


def mean(values: Iterable[float | None]) -> float | None:
    """Return the mean of the values that are not None; None if there are none."""
    return float(np.mean(known)) if (known := [value for value in values if value is not None]) else None


def median(values: Iterable[float | None]) -> float | None:
    """Return the median of the values that are not None; None if there are none."""
    return float(np.median(known)) if (known := [value for value in values if value is not None]) else None


def quantile(values: Iterable[float], share: float) -> float | None:
    """Return the value below which a share of the values lie; None without values."""
    return float(np.quantile(known, share)) if (known := list(values)) else None


def spread(name: str, values: Sequence[float], of: Sequence[str]) -> dict[str, float | None]:
    """Return some statistics of the values as NAME_STATISTIC, in the order that is asked for; None without values.

    Args:
        name: of the figure, with its unit.
        values: of one sample.
        of: some of "mean", "median", "p90", "p95", "p99" and "max".
    """

    def most(values: Sequence[float]) -> float | None:
        return float(max(values)) if values else None

    known = {"mean": mean, "median": median, "max": most}
    return {
        f"{name}_{what}": known[what](values) if what in known else quantile(values, int(what[1:]) / 100) for what in of
    }


def rounded(value: Any, digits: int) -> Any:  # noqa: ANN401 - a number, several of them, or None
    """Round a number, or each of several, to so many digits after the point; None stays None."""
    if isinstance(value, list | tuple):
        return [rounded(one, digits) for one in value]
    return None if value is None else round(value, digits)


def share_interval(successes: int, tasks: int) -> tuple[float, float]:
    """Return Wilson's 95 % interval of a share."""
    limits = binomtest(successes, tasks).proportion_ci(_LEVEL, method="wilson")
    return float(limits.low), float(limits.high)


def mean_interval(values: Sequence[float]) -> list[float] | None:
    """Return the percentile bootstrap's 95 % interval of a mean (Efron 1979).

    Returns:
        None for a single value or equal values: nothing says how far the next one would be.
    """
    if len(values) < 2 or np.ptp(values) == 0:
        return None
    rng = stream_rng(0, Stream.BOOTSTRAP)
    found = bootstrap(
        (np.asarray(values, float),), np.mean, n_resamples=_RESAMPLES, confidence_level=_LEVEL, method="percentile",
        rng=rng,
    )  # fmt: skip
    return [float(found.confidence_interval.low), float(found.confidence_interval.high)]


def compare_means(ours: Sequence[float], others: Sequence[float]) -> dict[str, Any]:
    """Return the mean "difference" of two methods on the same tasks and its "interval", see `mean_interval`."""
    differences = [a - b for a, b in zip(ours, others, strict=True)]
    return {"difference": float(np.mean(differences)), "interval": mean_interval(differences)}


def compare_shares(ours: Sequence[bool], others: Sequence[bool]) -> dict[str, Any]:
    """Compare the successes of two methods on the same tasks.

    Args:
        ours: of one method, task by task.
        others: of the other one.

    Returns:
        "difference" of the shares, its 95 % "interval" (Newcombe 1998, method 10), and "p" of McNemar's exact test:
        how likely tasks in which only one of both succeeds are shared out so unevenly if both are equally good.
    """
    pairs = list(zip(ours, others, strict=True))
    both, neither = pairs.count((True, True)), pairs.count((False, False))
    only_ours, only_others = pairs.count((True, False)), pairs.count((False, True))
    tasks, mine, theirs = len(pairs), both + only_ours, both + only_others
    (low, high), (other_low, other_high) = share_interval(mine, tasks), share_interval(theirs, tasks)
    below, above = mine / tasks - low, high - mine / tasks
    other_below, other_above = theirs / tasks - other_low, other_high - theirs / tasks
    scale = np.sqrt(float(mine * theirs) * (tasks - mine) * (tasks - theirs))
    excess = both * neither - only_ours * only_others
    corrected = max(excess - tasks / 2, 0) if excess > 0 else excess
    phi = corrected / scale if scale else 0.0
    difference, differing = (only_ours - only_others) / tasks, only_ours + only_others
    down = np.sqrt(below**2 - 2 * phi * below * other_above + other_above**2)
    up = np.sqrt(above**2 - 2 * phi * above * other_below + other_below**2)
    return {
        "difference": difference,
        "interval": [float(difference - down), float(difference + up)],
        "p": float(binomtest(only_ours, differing).pvalue) if differing else 1.0,
    }


def holm(p_values: Sequence[float]) -> list[float]:
    """Correct the p of m tests for their number (Holm 1979): the k-th smallest counts m - k + 1 times."""
    corrected, least = [0.0] * len(p_values), 0.0
    for rank, n in enumerate(np.argsort(p_values)):
        least = max(least, min(1.0, (len(p_values) - rank) * p_values[n]))
        corrected[n] = least
    return corrected
