"""Comparison of images between methods: which objects each knows, how it shows them, and figures with intervals."""

from __future__ import annotations

from collections.abc import Generator, Iterable, Mapping, Sequence
from concurrent.futures import Executor
from pathlib import Path
from types import MappingProxyType
from typing import Any

import numpy as np
from jaxtyping import Float

from osfcore.errors import InvalidInput, MissingAssets
from osfcore.estimation.objective import ObjectModels
from osfcore.experiments.charts import Axis, Chart, Curve, write_charts
from osfcore.experiments.harness import EvaluationStep, Piece, TaskResult, compare_means, finished, mean_interval
from osfcore.experiments.rivals.nerf import load_nerf_appearance, nerf_library
from osfcore.fields.field_library import FieldLibrary
from osfcore.geometry.states import MAX_OBJECTS
from osfcore.io.files import write_json
from osfcore.objects.asset_library import AssetLibrary
from osfcore.paper.method import paper_field_names, paper_field_path
from osfcore.paper.stages import load_paper_appearance

# Who shows scenes where images are compared: which objects each method knows, and how it shows them.
#
# Methods:
#     ours   relightable fields as they ship.
#     paper  KiloOSFs as published.
#     nerf   compositional NeRFs: fields that know of no light.


FIELD_METHODS = ("ours", "paper", "nerf")
TITLES: Mapping[str, str] = MappingProxyType(
    {"copied": "last frame", "ours": "ours", "paper": "as published", "nerf": "NeRF", "fitvid": "FitVid"}
)  # in charts and beside images


def check_methods(methods: Iterable[str], known: Sequence[str]) -> tuple[str, ...]:
    """The methods in the order of the known ones, each once.

    Raises:
        InvalidInput: if there is none, or one is not known.
    """
    asked = tuple(dict.fromkeys(methods))
    unknown = [method for method in asked if method not in known]
    if unknown or not asked:
        raise InvalidInput("methods", ", ".join(unknown) or "none", f"some of {', '.join(known)}")
    return tuple(method for method in known if method in asked)


def common_names(
    methods: Sequence[str],
    names: Iterable[str] | None,
    fields: FieldLibrary,
    assets: AssetLibrary,
    data_dir: Path | None,
    count: int,
) -> tuple[str, ...]:
    """Objects with a mesh, a field of ours and one of each method, so that all methods are given the same scenes.

    Args:
        methods: to compare; those without fields know all objects.
        names: objects to draw from; all that can be compared if None.
        fields: ours.
        assets: meshes, for the simulator.
        data_dir: whose fields of other methods come before the installed ones.
        count: objects of a scene.

    Raises:
        UnknownName, MissingAssets: if an object that is named lacks a field or a mesh.
        InvalidInput: if there are too few, or no scene has so many objects.
    """
    if not 1 <= count <= MAX_OBJECTS:
        raise InvalidInput("objects in a scene", count, f"between 1 and {MAX_OBJECTS}")
    if names is None:
        known = set(fields.names()).intersection(*(known_names(method, fields, data_dir) for method in methods))
        chosen = tuple(name for name in sorted(known) if assets.has(name))
    else:
        chosen = tuple(dict.fromkeys(names))
        for name in chosen:
            for method in ("ours", *methods):
                field_path(method, name, fields, data_dir)
            if not assets.has(name):
                raise MissingAssets([name])
    if len(chosen) < count:
        what = "number of objects with a mesh and a field of every method"
        raise InvalidInput(what, len(chosen), f"at least {count}, as a scene has")
    return chosen


def known_names(method: str, fields: FieldLibrary, data_dir: Path | None) -> tuple[str, ...]:
    """Objects that a method has a field of; ours for methods that have no own ones."""
    match method:
        case "paper":
            return paper_field_names(data_dir)
        case "nerf":
            return nerf_library(data_dir).names()
        case _:
            return fields.names()


def field_path(method: str, name: str, fields: FieldLibrary, data_dir: Path | None) -> Path:
    """Where a method's field of an object lies; ours for methods that have no own ones.

    Raises:
        UnknownName: if there is none.
    """
    match method:
        case "paper":
            return paper_field_path(name, data_dir)
        case "nerf":
            return nerf_library(data_dir).info(name).path
        case _:
            return fields.info(name).path


def load_appearance(method: str, names: Iterable[str], fields: FieldLibrary, data_dir: Path | None) -> ObjectModels:
    """How a method shows objects on the table.

    Args:
        method: one of `FIELD_METHODS`.
        names: of the objects.
        fields: ours, and the table.
        data_dir: whose fields come before the installed ones.

    Raises:
        UnknownName: if an object has no such field.
        CorruptFile: if a file is broken.
    """
    match method:
        case "paper":
            return load_paper_appearance(names, fields, data_dir)
        case "nerf":
            return load_nerf_appearance(names, fields, data_dir)
        case _:
            return ObjectModels({name: fields.load(name) for name in names}, fields.load_table())


# Figures of images along something, such as a light's elevation or predicted steps: means, intervals, differences.


OURS = "ours"  # what others are compared with
Tables = Mapping[str, Mapping[str, Float[np.ndarray, "tasks x"]]]  # by method and measure; NaN where there is no figure


def measured(
    pieces: Mapping[str, Sequence[Piece]], executor: Executor | None
) -> Generator[EvaluationStep, None, dict[str, list[TaskResult]]]:
    """Work on all pieces, telling how far it is.

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
    """What results hold: of each measure a list along x, with None where there is no figure."""
    return {
        method: {key: np.array([result.figures[key] for result in part], float) for key in measures}
        for method, part in results.items()
    }


def summary(tables: Tables, spans: Mapping[str, Sequence[int]]) -> dict[str, Any]:
    """What was measured as plain numbers; a task's figure is its mean over a span, over which tasks are averaged.

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
                "along": [_mean(table[:, at]) for at in range(table.shape[1])],
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
    """Means of one measure over tasks, a curve for each method.

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
        report: what was found.
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
    """Over what there is; NaN where there is nothing."""
    part = table[:, list(at)]
    count = np.isfinite(part).sum(axis=1)
    return np.where(count > 0, np.nansum(part, axis=1) / np.maximum(count, 1), np.nan)


def _mean(values: Float[np.ndarray, "tasks"]) -> float | None:
    values = values[np.isfinite(values)]
    return _rounded(values.mean()) if len(values) else None


def _interval(values: Float[np.ndarray, "tasks"]) -> dict[str, Any]:
    values = values[np.isfinite(values)]
    if not len(values):
        return {"mean": None, "interval": None}
    return {"mean": _rounded(values.mean()), "interval": _rounded_ends(mean_interval(values.tolist()))}


def _difference(ours: Float[np.ndarray, "tasks"], others: Float[np.ndarray, "tasks"]) -> dict[str, Any]:
    both = np.isfinite(ours) & np.isfinite(others)
    if not both.any():
        return {"difference": None, "interval": None}
    told = compare_means(ours[both].tolist(), others[both].tolist())
    return {"difference": _rounded(told["difference"]), "interval": _rounded_ends(told["interval"])}


def _rounded_ends(interval: list[float] | None) -> list[float] | None:
    return None if interval is None else [_rounded(end) for end in interval]


def _rounded(value: float | np.floating) -> float:
    return float(f"{value:.6g}")
