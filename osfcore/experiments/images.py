"""Compare images of several methods along something, such as a light's elevation or predicted steps."""

from __future__ import annotations

from collections.abc import Generator, Mapping, Sequence
from concurrent.futures import Executor
from pathlib import Path
from typing import Any

import numpy as np
from jaxtyping import Float

from osfcore.experiments.charts import Axis, Chart, Curve, write_charts
from osfcore.experiments.harness import EvaluationStep, Piece, TaskResult, finished
from osfcore.experiments.methods import OURS, TITLES
from osfcore.experiments.statistics import compare_means, mean_interval
from osfcore.io.files import write_json

Tables = Mapping[str, Mapping[str, Float[np.ndarray, "tasks x"]]]  # by method and measure; NaN where there is no figure


def measured(
    pieces: Mapping[str, Sequence[Piece]], executor: Executor | None
) -> Generator[EvaluationStep[Any], None, dict[str, list[TaskResult]]]:
    """Work on all pieces, and yield progress.

    Args:
        pieces: of each method, equally many.
        executor: works on them side by side, if given.

    Returns:
        The results of each method.

    Raises:
        WorkerDied: if a worker process ended.
        CannotWrite: if the disk refuses.
    """
    results = yield from finished([piece for part in pieces.values() for piece in part], executor, "scenes")
    left = iter(results)
    return {method: [next(left) for _ in part] for method, part in pieces.items()}


def tables_of(results: Mapping[str, Sequence[TaskResult]], measures: Sequence[str]) -> Tables:
    """Return the figures of all results as tables; a result has a list along x, with None where there is no figure."""
    return {
        method: {key: np.array([result.figures[key] for result in part], float) for key in measures}
        for method, part in results.items()
    }


def summary(tables: Tables, spans: Mapping[str, Sequence[int]]) -> dict[str, Any]:
    """Summarize tables; a task's figure is its mean over a span, over which tasks are averaged.

    Args:
        tables: of the methods.
        spans: indices along x, by name.

    Returns:
        "methods": for each measure the mean over tasks "along" x and, for each of the "spans", "mean" and 95 %
        "interval"; "against": for each other method and measure the mean "difference" of ours from it and its
        "interval", task by task. None where nothing was measured.
    """
    methods = {
        method: {
            key: {
                "along": [_mean(column) for column in table.T],
                "spans": {name: _interval(_task_means(table, at)) for name, at in spans.items()},
            }
            for key, table in part.items()
        }
        for method, part in tables.items()
    }
    ours = tables.get(OURS, {})
    against = {
        method: {
            key: {name: _difference(_task_means(table, at), _task_means(part[key], at)) for name, at in spans.items()}
            for key, table in ours.items()
        }
        for method, part in tables.items()
        if ours and method != OURS
    }
    return {"methods": methods, "against": against}


def chart_of(tables: Tables, key: str, x: Axis, places: Sequence[float], label: str, tick: float) -> Chart:
    """Draw the means of one measure over tasks, a curve for each method.

    Args:
        tables: of the methods.
        key: of the measure.
        x: axis along which it was measured.
        places: on it.
        label: of the measure, with its unit.
        tick: the axis of the measure begins at a multiple of it.
    """
    means = {m: np.array([_mean(column) for column in part[key].T], float) for m, part in tables.items()}
    lowest = min(float(np.nanmin(values, initial=np.inf)) for values in means.values())
    low = tick * np.floor(lowest / tick) if np.isfinite(lowest) else 0.0
    curves = [Curve(TITLES[method], np.asarray(places, float), values, dots=True) for method, values in means.items()]
    return Chart("", x, Axis(label, low), curves)


def write_comparison(
    files: tuple[Path, Path], report: Mapping[str, Any], tables: Tables, x: Axis, places: Sequence[float]
) -> None:
    """Write a report as JSON, and as PNG a chart of PSNR and SSIM along x.

    Args:
        files: of the report and of the chart.
        report: all figures.
        tables: of the methods.
        x: axis along which it was measured.
        places: on it.

    Raises:
        CannotWrite: if the disk refuses.
    """
    axes = (("psnr", "PSNR [dB]", 5.0), ("ssim", "SSIM", 0.1))
    write_charts(files[1], [chart_of(tables, key, x, places, label, tick) for key, label, tick in axes])
    write_json(files[0], report)


def _task_means(table: Float[np.ndarray, "tasks x"], at: Sequence[int]) -> Float[np.ndarray, "tasks"]:
    """Average each task over the figures that there are; NaN where there is none."""
    part = table[:, list(at)]
    count = np.isfinite(part).sum(axis=1)
    return np.where(count > 0, np.nansum(part, axis=1) / np.maximum(count, 1), np.nan)


def _mean(values: Float[np.ndarray, "tasks"]) -> float | None:
    values = values[np.isfinite(values)]
    return _rounded(values.mean()) if len(values) else None


def _interval(values: Float[np.ndarray, "tasks"]) -> dict[str, Any]:
    known = values[np.isfinite(values)]
    return {"mean": _mean(values), "interval": _rounded_ends(mean_interval(known.tolist()))}


def _difference(ours: Float[np.ndarray, "tasks"], others: Float[np.ndarray, "tasks"]) -> dict[str, Any]:
    both = np.isfinite(ours) & np.isfinite(others)
    if not both.any():
        return {"difference": None, "interval": None}
    found = compare_means(ours[both].tolist(), others[both].tolist())
    return {"difference": _rounded(found["difference"]), "interval": _rounded_ends(found["interval"])}


def _rounded_ends(interval: list[float] | None) -> list[float] | None:
    return None if interval is None else [_rounded(end) for end in interval]


def _rounded(value: float | np.floating) -> float:
    return float(f"{value:.6g}")
