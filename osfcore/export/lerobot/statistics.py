"""Statistics that LeRobot normalises by: minimum, maximum, mean, standard deviation, count and quantiles."""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np
from jaxtyping import Float, UInt8

_QUANTILES = {"q01": 0.01, "q10": 0.1, "q50": 0.5, "q90": 0.9, "q99": 0.99}
_THINNED = 4  # every so many pixels of an image stand for all
Statistics = dict[str, np.ndarray]


def statistics_of(values: Float[np.ndarray, "T D"]) -> Statistics:
    """Of each of D numbers over T rows."""
    quantiles = dict(zip(_QUANTILES, np.quantile(values, list(_QUANTILES.values()), axis=0), strict=True))
    return {
        "min": values.min(axis=0),
        "max": values.max(axis=0),
        "mean": values.mean(axis=0),
        "std": values.std(axis=0),
        "count": np.array([len(values)]),
        **quantiles,
    }


def image_statistics(images: UInt8[np.ndarray, "T h w 3"]) -> Statistics:
    """Of each colour of T images over their pixels, as values in [0, 1] of shape (3, 1, 1)."""
    pixels = images[:, ::_THINNED, ::_THINNED].reshape(-1, 3) / 255
    found = {key: value.reshape(3, 1, 1) for key, value in statistics_of(pixels).items() if key != "count"}
    return {**found, "count": np.array([len(images)])}


def pooled(parts: Sequence[Statistics]) -> Statistics:
    """Of several data sets together; quantiles are means, weighted by count, as LeRobot's own are."""
    counts = np.array([part["count"][0] for part in parts])
    shares = counts / counts.sum()

    def mean_of(values: Sequence[np.ndarray]) -> np.ndarray:
        return np.tensordot(shares, np.stack(values), axes=1)

    mean = mean_of([part["mean"] for part in parts])
    spread = mean_of([part["std"] ** 2 + (part["mean"] - mean) ** 2 for part in parts])
    return {
        "min": np.min([part["min"] for part in parts], axis=0),
        "max": np.max([part["max"] for part in parts], axis=0),
        "mean": mean,
        "std": np.sqrt(spread),
        "count": np.array([counts.sum()]),
        **{key: mean_of([part[key] for part in parts]) for key in _QUANTILES},
    }
