"""Compare images of several methods along something, such as a light's elevation or predicted steps."""

from __future__ import annotations

from collections.abc import Callable, Iterable, Iterator, Mapping, Sequence
from concurrent.futures import Executor
from dataclasses import asdict, dataclass, field, replace
from pathlib import Path
from types import MappingProxyType
from typing import Any, TypeVar

import numpy as np
from jaxtyping import Float, UInt8

from osfcore.errors import InvalidInput
from osfcore.estimation.objective import ObjectModels
from osfcore.experiments.charts import Axis, Chart, Curve, write_charts
from osfcore.experiments.fields import SCENE_QUALITY
from osfcore.experiments.harness import (
    EvaluationStep,
    Piece,
    TaskResult,
    check_run,
    chosen_objects,
    file_sha256,
    finished,
    table_sha256,
)  # fmt: skip
from osfcore.experiments.rivals.nerf import load_nerf_appearance, nerf_library
from osfcore.experiments.statistics import compare_means, mean_interval
from osfcore.fields.field_library import FieldLibrary
from osfcore.geometry.cameras import DEFAULT_IMAGE_SIDE
from osfcore.geometry.states import MAX_OBJECTS
from osfcore.io.files import write_json
from osfcore.io.image_file import write_png
from osfcore.objects.asset_library import AssetLibrary
from osfcore.paper.method import paper_field_names, paper_field_path
from osfcore.paper.stages import load_paper_appearance
from osfcore.world.tasks import Draw

# Methods that show scenes: which objects each one knows, and how it shows them.
#
#     ours         relightable fields as they ship.
#     paper        KiloOSFs as published.
#     nerf         compositional NeRFs: fields that know of no light.
#     nerf_fitted  the same, each object and the table as bright as fits the true images best.


OURS = "ours"  # what others are compared with
_UNLIT = ("nerf", "nerf_fitted")
FIELD_METHODS = (OURS, "paper", *_UNLIT)
TITLES: Mapping[str, str] = MappingProxyType(
    {
        "copied": "last frame",
        OURS: "ours",
        "paper": "as published",
        "nerf": "NeRF",
        "nerf_fitted": "NeRF, brightness fitted",
        "fitvid": "FitVid",
    }
)  # in charts and beside images


def common_names(
    methods: Sequence[str],
    names: Iterable[str] | None,
    fields: FieldLibrary,
    assets: AssetLibrary,
    data_dir: Path | None,
    count: int,
) -> tuple[str, ...]:
    """Return the objects with a mesh, a field of ours and one of each method, so that all are given the same scenes.

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
        named = tuple(dict.fromkeys(names))
        for name in named:
            for method in (OURS, *methods):
                field_path(method, name, fields, data_dir)  # raises UnknownName
        chosen = chosen_objects(named, fields, assets)
    if len(chosen) < count:
        what = "number of objects with a mesh and a field of every method"
        raise InvalidInput(what, len(chosen), f"at least {count}, as a scene has")
    return chosen


def known_names(method: str, fields: FieldLibrary, data_dir: Path | None) -> tuple[str, ...]:
    """Return the objects that a method has a field of; ours for methods without fields of their own."""
    if method == "paper":
        return paper_field_names(data_dir)
    return (nerf_library(data_dir) if method in _UNLIT else fields).names()


def field_path(method: str, name: str, fields: FieldLibrary, data_dir: Path | None) -> Path:
    """Return the file of a method's field of an object; ours for methods without fields of their own.

    Raises:
        UnknownName: if there is none.
    """
    if method == "paper":
        return paper_field_path(name, data_dir)
    return (nerf_library(data_dir) if method in _UNLIT else fields).info(name).path


def load_appearance(method: str, names: Iterable[str], fields: FieldLibrary, data_dir: Path | None) -> ObjectModels:
    """Load a method's fields of objects and of the table.

    Args:
        method: one of `FIELD_METHODS`.
        names: of the objects.
        fields: ours, and the table.
        data_dir: whose fields come before the installed ones.

    Raises:
        UnknownName: if an object has no such field.
        CorruptFile: if a file is broken.
    """
    if method == "paper":
        return load_paper_appearance(names, fields, data_dir)
    if method in _UNLIT:
        return load_nerf_appearance(names, fields, data_dir)
    return ObjectModels({name: fields.load(name) for name in names}, fields.load_table())


def shown_circumstances(
    draw: Draw, methods: Sequence[str], fields: FieldLibrary, assets: AssetLibrary, data_dir: Path | None, size: int
) -> dict[str, Any]:
    """Return what the images of a scene depend on, as plain JSON.

    Args:
        draw: the scene.
        methods: whose fields of its objects are used.
        fields: ours, and the table.
        assets: meshes of the objects.
        data_dir: whose fields of other methods come before the installed ones.
        size: side of the images [px].

    Raises:
        UnknownName, MissingAssets, CorruptFile: if a field or a mesh cannot be read.
    """
    paths = {name: [field_path(method, name, fields, data_dir) for method in methods] for name in draw.names}
    return {
        "objects": {name: [assets.digest(name), *map(file_sha256, own)] for name, own in paths.items()},
        "arrangement": draw.seed,
        "light": draw.light.direction.tolist(),
        "size": size,
        "quality": asdict(SCENE_QUALITY),
        "table": table_sha256(fields.load_table()),
    }


# Comparisons along something.


Tables = Mapping[str, Mapping[str, Float[np.ndarray, "tasks x"]]]  # by method and measure; NaN where there is no figure


@dataclass(frozen=True, slots=True)
class CompareImages:
    """What to compare.

    Attributes:
        folder: for results, pictures and the report.
        data_dir: where fields and networks trained on this machine are.
        names: objects to draw from; all with a mesh and a field of every method if None.
        tasks: number of scenes or episodes.
        seed: of these.
        methods: some of those that can be compared.
        objects: in each scene.
        size: side of the images [px].
    """

    folder: Path
    data_dir: Path
    names: tuple[str, ...] | None = None
    tasks: int = 20
    seed: int = 0
    methods: tuple[str, ...] = FIELD_METHODS
    objects: int = 3
    size: int = field(default=DEFAULT_IMAGE_SIDE, kw_only=True)


ConfigT = TypeVar("ConfigT", bound=CompareImages)


def checked(
    config: ConfigT,
    known: Sequence[str],
    fields: FieldLibrary,
    assets: AssetLibrary,
    *limits: tuple[str, float, float, float],
) -> ConfigT:
    """Check the settings, and return them with methods and names in order.

    Args:
        config: what to compare.
        known: all methods.
        fields: ours.
        assets: meshes, for the simulator.
        limits: further numbers, as `check_ranges` takes them.

    Raises:
        UnknownName, MissingAssets: if an object lacks a field or a mesh.
        InvalidInput: if a number is out of range, a method is unknown, or objects are too few.
    """
    check_run(config.tasks, config.seed, *limits, size=config.size)
    unknown = [method for method in dict.fromkeys(config.methods) if method not in known]
    if unknown or not config.methods:
        raise InvalidInput("methods", ", ".join(unknown) or "none", f"some of {', '.join(known)}")
    methods = tuple(method for method in known if method in config.methods)
    names = common_names(methods, config.names, fields, assets, config.data_dir, config.objects)
    return replace(config, methods=methods, names=names)


def compare(
    config: CompareImages,
    piece: Callable[[str, int], Piece],
    executor: Executor | None,
    *,
    files: tuple[str, str, str],
    about: Mapping[str, Any],
    measures: Sequence[str],
    spans: Mapping[str, Sequence[int]],
    charts: Callable[[Mapping[str, Any]], Sequence[Chart]],
    picture: Callable[[Mapping[str, TaskResult]], UInt8[np.ndarray, "H W 3"]],
) -> Iterator[EvaluationStep[dict[str, Any]]]:
    """Do all tasks by all methods, and write the report as JSON, its charts, and a picture.

    Args:
        config: what to compare.
        piece: returns the work on a task by a method, given its name and the task's number.
        executor: works on pieces side by side, if given.
        files: names of the report, of the charts and of the picture.
        about: begins the report.
        measures: names of figures; a result has a list of each along x, with None where there is no figure.
        spans: indices along x over which means are reported, by name.
        charts: draws the report.
        picture: draws the first results of the methods.

    Raises:
        WorkerDied: if a worker process ended.
        CannotWrite: if the disk refuses.
    """
    pieces = [piece(method, number) for method in config.methods for number in range(config.tasks)]
    left = iter((yield from finished(pieces, executor, "scenes")))
    results = {method: [next(left) for _ in range(config.tasks)] for method in config.methods}
    tables = {
        method: {key: np.array([result.figures[key] for result in part], float) for key in measures}
        for method, part in results.items()
    }
    report = {**about, **summary(tables, spans)}
    report_file, chart_file, picture_file = (config.folder / name for name in files)
    write_charts(chart_file, charts(report))
    write_json(report_file, report)
    write_png(picture_file, picture({method: part[0] for method, part in results.items()}))
    yield EvaluationStep(len(pieces), len(pieces), "Everything is measured", report)


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


def image_charts(report: Mapping[str, Any], x: Axis, places: Sequence[float]) -> list[Chart]:
    """Draw the means of PSNR and SSIM over tasks, a curve for each method.

    Args:
        report: of `compare`.
        x: axis along which was measured.
        places: on it; figures behind the last one are not drawn.
    """
    charts = []
    for key, label, tick in (("psnr", "PSNR [dB]", 5.0), ("ssim", "SSIM", 0.1)):
        means = {m: np.array(part[key]["along"][: len(places)], float) for m, part in report["methods"].items()}
        lowest = min(float(np.nanmin(values, initial=np.inf)) for values in means.values())
        low = tick * np.floor(lowest / tick) if np.isfinite(lowest) else 0.0
        at = np.asarray(places, float)
        curves = [Curve(TITLES[method], at, values, dots=True) for method, values in means.items()]
        charts.append(Chart("", x, Axis(label, low), curves))
    return charts


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
    return {"mean": _mean(values), "interval": _rounded(mean_interval(known.tolist()))}


def _difference(ours: Float[np.ndarray, "tasks"], others: Float[np.ndarray, "tasks"]) -> dict[str, Any]:
    both = np.isfinite(ours) & np.isfinite(others)
    if not both.any():
        return {"difference": None, "interval": None}
    return {key: _rounded(found) for key, found in compare_means(ours[both].tolist(), others[both].tolist()).items()}


def _rounded(value: Any) -> Any:  # noqa: ANN401 - numbers, lists of them and None
    """Round to six significant digits."""
    if isinstance(value, list):
        return [_rounded(one) for one in value]
    return None if value is None else float(f"{value:.6g}")
