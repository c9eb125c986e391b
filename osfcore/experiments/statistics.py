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
        "difference" of the shares, its bootstrap "interval" over tasks, and "p" of McNemar's exact test: how likely
        tasks in which only one of both succeeds are shared out so unevenly if both are equally good.
    """
    only_ours = sum(a and not b for a, b in zip(ours, others, strict=True))
    only_others = sum(b and not a for a, b in zip(ours, others, strict=True))
    differing = only_ours + only_others
    return {
        **compare_means([float(a) for a in ours], [float(b) for b in others]),
        "p": float(binomtest(only_ours, differing).pvalue) if differing else 1.0,
    }


def compare_means(ours: Sequence[float], others: Sequence[float]) -> dict[str, Any]:
    """The mean "difference" of two methods on the same tasks and its bootstrap "interval" over tasks."""
    differences = [a - b for a, b in zip(ours, others, strict=True)]
    low, high = mean_interval(differences)
    return {"difference": float(np.mean(differences)), "interval": [low, high]}
