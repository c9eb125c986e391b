"""`osf reproduce`: the paper's experiments, with its rivals and what else there is to know, in one report."""

from __future__ import annotations

import base64
from collections.abc import Generator, Iterator, Mapping, Sequence
from concurrent.futures import Executor
from dataclasses import asdict, dataclass, field, replace
from importlib.resources import files
from pathlib import Path
from types import MappingProxyType
from typing import Any, Literal

import numpy as np

from osfcore.errors import InvalidInput, OsfError, check_seed
from osfcore.experiments import relighting, video_prediction
from osfcore.experiments.charts import Axis, Bar, Chart, Curve, write_bars, write_charts
from osfcore.experiments.harness import EvaluationStep, Piece, TaskResult, finished, holm, share_interval
from osfcore.experiments.images import FIELD_METHODS, TITLES, common_names
from osfcore.experiments.rearrangement import EvaluateMpc, episode_pieces, episodes_report, figures_of
from osfcore.experiments.rearrangement_report import MpcReport, paired
from osfcore.experiments.relighting import CompareRelighting, compare_relighting
from osfcore.experiments.reproduction.sections import (
    SECTIONS,
    Cell,
    Scale,
    Section,
    SectionName,
    objects_in_words,
    sections_of,
)
from osfcore.experiments.video_prediction import CompareVideos, compare_videos
from osfcore.fields.field_library import FieldLibrary
from osfcore.io.files import write_atomically, write_json
from osfcore.metrics.success import RearrangementScore
from osfcore.objects.asset_library import AssetLibrary

# Measuring the cells of a report side by side, and what their results say next to each other.


@dataclass(frozen=True, eq=False, slots=True)
class MeasuredCell:
    """A cell with what was found.

    Attributes:
        label: in tables and charts.
        report: all results.
        figures: of the report, as plain JSON.
        against: the section's first cell, task by task; None for that cell itself.
    """

    label: str
    report: MpcReport
    figures: Mapping[str, Any]
    against: Mapping[str, Any] | None


@dataclass(frozen=True, eq=False, slots=True)
class MeasuredSection:
    """A section with what was found.

    Attributes:
        section: what was asked.
        cells: in its order.
    """

    section: Section
    cells: tuple[MeasuredCell, ...]


def measure_cells(
    sections: Sequence[Section], fields: FieldLibrary, assets: AssetLibrary, executor: Executor | None = None
) -> Generator[EvaluationStep, None, tuple[MeasuredSection, ...]]:
    """Run the episodes of all sections, each once.

    Args:
        sections: what to measure.
        fields: of the objects.
        assets: meshes for the simulator.
        executor: runs episodes side by side, if given.

    Returns:
        What was found, in the order of the sections.

    Raises:
        UnknownName, MissingAssets, InvalidInput, NoRoom, WorkerDied, CorruptFile, CannotWrite: as `evaluate_mpc` does.
    """
    keys = {id(cell): _piece_keys(cell, fields, assets) for section in sections for cell in section.cells}
    pieces: dict[tuple[str, str], Piece] = {key: piece for found in keys.values() for key, piece in found}
    results = yield from finished(list(pieces.values()), executor, "episodes")
    found = dict(zip(pieces, results, strict=True))
    return tuple(
        _measured(section, [[found[key] for key, _ in keys[id(cell)]] for cell in section.cells])
        for section in sections
    )


def _piece_keys(cell: Cell, fields: FieldLibrary, assets: AssetLibrary) -> list[tuple[tuple[str, str], Piece]]:
    """A cell's pieces by where they are kept, which tells them from all others."""
    return [((str(p.cache.folder), p.name), p) for p in episode_pieces(cell.config, fields, assets)]


def _measured(section: Section, results: Sequence[Sequence[TaskResult]]) -> MeasuredSection:
    reports = [episodes_report(cell.config, found) for cell, found in zip(section.cells, results, strict=True)]
    first = reports[0].shipped
    cells = [
        MeasuredCell(
            cell.label,
            report,
            figures_of(cell.config, report),
            None if number == 0 or not _same_tasks(section, number) else paired(report.shipped, first),
        )
        for number, (cell, report) in enumerate(zip(section.cells, reports, strict=True))
    ]
    return MeasuredSection(section, tuple(cells))


def _same_tasks(section: Section, number: int) -> bool:
    """Whether a cell has the first one's tasks: another family has others, but for another light of the goal image."""
    one, other = section.cells[0].config, section.cells[number].config
    places = {config.family.replace("relit", "shifted") for config in (one, other)}
    return len(places) == 1 and (one.objects, one.tasks) == (other.objects, other.tasks)


# The report as one HTML file that needs nothing beside it.


_TEMPLATE = "page.html.jinja"


class MissingJinja(OsfError):
    """The report cannot be written."""

    def __init__(self) -> None:
        super().__init__("The report needs jinja2; install it with: pip install 'osf-manipulation[experiments]'.")


@dataclass(frozen=True, slots=True)
class About:
    """How a report came about.

    Attributes:
        date: of the run.
        machine: in words.
        command: that was run.
        seed: of everything.
        names: objects that were drawn from.
    """

    date: str
    machine: str
    command: str
    seed: int
    names: tuple[str, ...]


@dataclass(frozen=True, slots=True)
class PagePart:
    """One part of the page.

    Attributes:
        title: over it.
        text: under the title.
        pictures: PNGs with what they show, in words.
        heads: of the table's columns.
        rows: of the table, words as they stand there.
    """

    title: str
    text: str
    pictures: Sequence[tuple[Path, str]] = ()
    heads: Sequence[str] = ()
    rows: Sequence[Sequence[str]] = field(default=())


def check_jinja() -> None:
    """Check that a page can be written.

    Raises:
        MissingJinja: if it cannot.
    """
    try:
        import jinja2  # noqa: F401  an extra, not among what every installation has
    except ImportError:
        raise MissingJinja from None


def write_page(
    path: Path, about: About, warnings: Sequence[str], findings: Sequence[str], parts: Sequence[PagePart]
) -> None:
    """Write the report; its pictures become part of it.

    Args:
        path: of the HTML file.
        about: how it came about.
        warnings: what a reader must know first.
        findings: in sentences.
        parts: from top to bottom.

    Raises:
        CannotWrite: if the disk refuses.
        MissingJinja: if jinja2 is not installed.
    """
    check_jinja()
    import jinja2

    template = (files("osfcore.experiments.reproduction") / _TEMPLATE).read_text(encoding="utf-8")
    environment = jinja2.Environment(autoescape=True, trim_blocks=True, undefined=jinja2.StrictUndefined)
    shown = [
        {
            "title": part.title,
            "text": part.text,
            "pictures": [{"data": _data_url(picture), "alt": alt} for picture, alt in part.pictures],
            "heads": part.heads,
            "rows": part.rows,
        }
        for part in parts
    ]
    page = environment.from_string(template).render(about=about, warnings=warnings, findings=findings, parts=shown)
    write_atomically(path, page.encode())


def _data_url(path: Path) -> str:
    return f"data:image/png;base64,{base64.b64encode(path.read_bytes()).decode()}"


# Charts of a report's sections.


_POINTS = 61
_SHARE = Axis("share of tasks", 0, 1)
_DISTANCE = Axis("6D pose distance, symmetries counted", 0, 0.6)


def write_success_curves(path: Path, sections: Sequence[MeasuredSection]) -> None:
    """Draw success against threshold, a panel for each number of objects (paper, figure 7).

    Args:
        path: of the PNG.
        sections: one for each number.

    Raises:
        CannotWrite: if the disk refuses.
    """
    write_charts(path, [_success_chart(section) for section in sections])


def _success_chart(section: MeasuredSection) -> Chart:
    first = section.cells[0]
    kinds = {cell.label: cell.report.shipped for cell in section.cells} | {"no action": first.report.nothing}
    if first.report.oracle:
        kinds["told the truth"] = first.report.told_truth
    curves = [_curve(name, scores) for name, scores in kinds.items()]
    return Chart(objects_in_words(first.figures["objects"]), _DISTANCE, _SHARE, curves)


def _curve(name: str, scores: Sequence[RearrangementScore]) -> Curve:
    """The share of tasks within each threshold, with Wilson's interval."""
    places = np.linspace(_DISTANCE.low, _DISTANCE.high or 0.0, _POINTS)
    distances = np.sort([score.pose6d_symmetric for score in scores])
    counts = np.searchsorted(distances, places, side="right")
    band = np.array([share_interval(int(count), len(scores)) for count in counts]).T
    return Curve(name, places, counts / len(scores), band=band)


def write_success_bars(path: Path, section: MeasuredSection) -> None:
    """Draw the share of tasks within 2 cm and 0.1 rad of each cell, with Wilson's intervals.

    Args:
        path: of the PNG.
        section: whose cells are shown.

    Raises:
        CannotWrite: if the disk refuses.
    """
    axis = Axis("share of tasks within 2 cm and 0.1 rad", 0, 1)
    write_bars(path, section.section.title, axis, [_bar(cell) for cell in section.cells])


def _bar(cell: MeasuredCell) -> Bar:
    low, high = cell.figures["success_tight_interval"]
    return Bar(cell.label, cell.figures["success_tight"], low, high)


# What a report's sections say in sentences: who is ahead, who is not, and what costs most.


_COMPARED: Mapping[str, str] = MappingProxyType(
    {"success_tight": "within 2 cm and 0.1 rad", "success_2cm": "within 2 cm"}
)
_SIGNIFICANT = 0.05
MOST_LOST = 0.15  # of success, that one factor of variation may cost
_HALF = 0.5


def findings(sections: Sequence[MeasuredSection]) -> tuple[str, ...]:
    """One sentence for each comparison of the methods, for the mean distance, and for what costs too much."""
    methods = [section for section in sections if section.section.name == "methods"]
    comparisons = [
        (section.cells[0], cell, key) for section in methods for cell in section.cells[1:] for key in _COMPARED
    ]
    corrected = holm([_gap_of(cell, key)["p"] for _, cell, key in comparisons])
    told = [_method(*one, p) for one, p in zip(comparisons, corrected, strict=True)]
    told += [_distance(section.cells[0]) for section in methods]
    for section in sections:
        if section.section.name == "factors":
            told += _costly(section)
    return tuple(told)


def _gap_of(cell: MeasuredCell, key: str) -> Mapping[str, Any]:
    assert cell.against is not None, "all methods and all factors have the same tasks"
    return cell.against[key]


def _method(ours: MeasuredCell, other: MeasuredCell, key: str, corrected: float) -> str:
    """Ours against another method; who is better is said where p, corrected for all comparisons, is below 5 %."""
    gap = _gap_of(other, key)  # the other one minus ours
    low, high = (-100 * end for end in reversed(gap["interval"]))
    lead = 0.0 - gap["difference"]  # never -0
    better = "ours is better" if lead > 0 else "ours is worse"
    verdict = better if corrected < _SIGNIFICANT else "no difference is shown"
    return (
        f"{_objects(ours)}, ours and {other.label}, {_COMPARED[key]}: {_percent(ours, key)} against "
        f"{_percent(other, key)}, which is {100 * lead:+.0f} points (95 %: {low:+.0f} to {high:+.0f}; "
        f"McNemar p = {gap['p']:.2g}, {corrected:.2g} by Holm for all these comparisons): {verdict}."
    )


def _distance(ours: MeasuredCell) -> str:
    mean, nothing = (ours.figures[f"{who}pose6d_symmetric_mean"] for who in ("", "noaction_"))
    verdict = "at most" if mean <= _HALF * nothing else "more than"
    return (
        f"{_objects(ours)}: mean 6D pose distance, symmetries counted, {mean:.3f}; doing nothing "
        f"{nothing:.3f}: {verdict} half."
    )


def _costly(section: MeasuredSection) -> Iterator[str]:
    for cell in section.cells[1:]:
        gap = _gap_of(cell, "success_tight")
        low, high = (-100 * end for end in reversed(gap["interval"]))
        if -gap["difference"] > MOST_LOST:
            yield (
                f"Under {cell.label} {-100 * gap['difference']:.0f} points of success are lost (95 %: {low:.0f} to "
                f"{high:.0f}), more than {100 * MOST_LOST:.0f}."
            )


def _objects(cell: MeasuredCell) -> str:
    return objects_in_words(cell.figures["objects"])


def _percent(cell: MeasuredCell, key: str) -> str:
    return f"{100 * cell.figures[key]:.0f} %"


def rows_of(section: MeasuredSection) -> list[dict[str, Any]]:
    """The rows of a section's table, the oracle's and those of doing nothing among them, as plain words."""
    rows = [_row(cell.label, cell.figures, "", cell) for cell in section.cells]
    first = section.cells[0]
    if first.report.oracle:
        rows.append(_row("told the truth", first.figures, "oracle_"))
    rows.append(_row("no action", first.figures, "noaction_"))
    return rows


def _row(label: str, figures: Any, who: str, cell: MeasuredCell | None = None) -> dict[str, Any]:  # noqa: ANN401
    row = {"label": label, "tasks": figures["tasks"]}
    for key in ("success_tight", "success_2cm"):
        row[key] = _share(figures[who + key], figures[f"{who}{key}_interval"])
    for key in ("pose6d_mean", "pose6d_symmetric_mean", "pose6d_symmetric_median"):
        row[key] = f"{figures[who + key]:.3f}"
    own = dict.fromkeys(("refused", "first_mm", "first_deg", "light_deg", "against"), "")
    if cell is not None:
        own["refused"] = str(figures["refused"])
        for key in ("first_mm", "first_deg", "light_deg"):
            value = figures[f"{key}_median"]
            own[key] = "" if value is None else f"{value:.2f}"
        own["against"] = "" if cell.against is None else _gap(cell.against["success_tight"])
    return {**row, **own}


def _share(value: float, interval: Sequence[float]) -> str:
    low, high = interval
    return f"{100 * value:.0f} % ({100 * low:.0f} to {100 * high:.0f})"


def _gap(gap: Any) -> str:  # noqa: ANN401
    low, high = gap["interval"]
    return f"{100 * gap['difference']:+.0f} ({100 * low:+.0f} to {100 * high:+.0f}), p = {gap['p']:.2g}"


# The parts of a report that compare images: relit scenes (Fig. 5) and predicted videos (Fig. 6).


def relighting_part(folder: Path, report: Mapping[str, Any]) -> PagePart:
    """Scenes under lights of all elevations.

    Args:
        folder: with the pictures.
        report: of `compare_relighting`.
    """
    columns = [(key, relighting.ALL, title) for key, title in _RELIT.items()]
    text = (
        f"{report['tasks']} scenes of {objects_in_words(report['objects'])}, poses and light given, under lights "
        f"between {min(report['elevations_deg']):g} and {max(report['elevations_deg']):g} deg above the table."
    )
    pictures = (
        (folder / relighting.CHART_FILE, "PSNR and SSIM by elevation of the light"),
        (folder / relighting.IMAGES_FILE, "One scene under a low, a middle and a high light, by each method"),
    )
    return PagePart("Scenes under any light (Fig. 5)", text, pictures, *_table(report, columns))


def video_part(folder: Path, report: Mapping[str, Any]) -> PagePart:
    """Pushes predicted as images.

    Args:
        folder: with the pictures.
        report: of `compare_videos`.
    """
    spans = list(next(iter(report["methods"].values()))["psnr"]["spans"])
    columns = [(key, span, f"{title}, {span} steps") for span in spans for key, title in _VIDEO.items()]
    text = (
        f"{report['tasks']} episodes of {objects_in_words(report['objects'])}, {report['steps']} actions known "
        "in advance, from the first frame's estimate; FitVid sees two frames of the goal camera."
    )
    pictures = (
        (folder / video_prediction.CHART_FILE, "PSNR and SSIM by predicted step"),
        (folder / video_prediction.IMAGES_FILE, "One episode as it was and as each method predicts it"),
    )
    return PagePart("Predicted futures as images (Fig. 6)", text, pictures, *_table(report, columns))


_RELIT = {"psnr": "PSNR [dB]", "ssim": "SSIM", "psnr_object": "on objects [dB]", "psnr_shadow": "in shadow [dB]"}
_VIDEO = {"psnr": "PSNR [dB]", "ssim": "SSIM"}


def _table(
    report: Mapping[str, Any], columns: Sequence[tuple[str, str, str]]
) -> tuple[tuple[str, ...], list[list[str]]]:
    """Heads and rows: means with intervals, and ours against each other method in the first column's measure."""
    key, span, _ = columns[0]
    rows = []
    for method, measures in report["methods"].items():
        cells = [_interval(measures[measure]["spans"][over], "mean") for measure, over, _ in columns]
        gap = report["against"].get(method)
        rows.append([TITLES[method], *cells, "" if gap is None else _interval(gap[key][span], "difference")])
    return ("", *(title for _, _, title in columns), "ours better by [dB]"), rows


def _interval(told: Mapping[str, Any], what: str) -> str:
    if told[what] is None:
        return "-"
    if told["interval"] is None:
        return f"{told[what]:.3g}"
    low, high = told["interval"]
    return f"{told[what]:.3g} ({low:.3g} to {high:.3g})"


# `osf reproduce`: the paper's experiments, with its rivals and what else there is to know, in one report.
#
# Everything is kept as soon as it is measured: a killed run goes on where it was. A full run takes over nothing
# from a quick one, whose episodes are shorter.


PAGE_FILE, FIGURES_FILE = "report.html", "reproduction.json"
_CURVES = "success.png"
PartName = Literal["relighting", "video"] | SectionName
PARTS: tuple[PartName, ...] = ("relighting", "video", *SECTIONS)
_TITLES = {"relighting": "Scenes under any light", "video": "Predicted futures"}
_IMAGE_PARTS = {"relighting": relighting_part, "video": video_part}
_HEADS = (
    "", "tasks", "2 cm and 0.1 rad", "2 cm", "refused", "6D mean", "with symmetry", "its median", "first frame [mm]",
    "[deg]", "light [deg]", "points against the first row",
)  # fmt: skip
_KEYS = (
    "label", "tasks", "success_tight", "success_2cm", "refused", "pose6d_mean", "pose6d_symmetric_mean",
    "pose6d_symmetric_median", "first_mm", "first_deg", "light_deg", "against",
)  # fmt: skip


@dataclass(frozen=True, slots=True)
class Reproduce:
    """What to measure and to report.

    Attributes:
        folder: for report.html, reproduction.json, pictures, and all results.
        data_dir: where objects, fields and networks of this machine are.
        about: what the page tells of its making; its names are filled in.
        scale: how much is measured.
        is_quick: whether the page must warn that it is little.
        parts: of the report.
        names: objects to draw from; those that all methods have a field of if None.
    """

    folder: Path
    data_dir: Path
    about: About
    scale: Scale
    is_quick: bool = False
    parts: tuple[PartName, ...] = PARTS
    names: tuple[str, ...] | None = None


def reproduce(
    config: Reproduce, fields: FieldLibrary, assets: AssetLibrary, executor: Executor | None = None
) -> Iterator[EvaluationStep]:
    """Measure what is not measured yet, and write the report.

    Args:
        config: what to measure.
        fields: of the objects.
        assets: meshes for the simulator.
        executor: runs pieces side by side, if given.

    Raises:
        UnknownName, MissingAssets: if an object lacks a field or a mesh.
        InvalidInput: if a number or name is out of range.
        MissingJinja, MissingMatplotlib: if these are not installed.
        NoRoom, WorkerDied, CorruptFile, CannotWrite: as for evaluations.
    """
    check_jinja()
    check_seed(config.about.seed)
    for part in config.parts:
        if part not in PARTS:
            raise InvalidInput("part of the report", part, ", ".join(PARTS))
    names = common_names(FIELD_METHODS, config.names, fields, assets, config.data_dir, config.scale.objects)
    config = replace(config, about=replace(config.about, names=names))
    images = yield from _images(config, fields, assets, executor)
    measured = yield from _episodes(config, fields, assets, executor)
    report = _figures(config, images, measured)
    write_json(config.folder / FIGURES_FILE, report)
    parts = [_IMAGE_PARTS[name](config.folder, figures) for name, figures in images.items()]
    parts += _section_parts(config.folder, measured)
    write_page(config.folder / PAGE_FILE, config.about, _warnings(config), findings(measured), parts)
    yield EvaluationStep(1, 1, "The report is written", report)


def _images(
    config: Reproduce, fields: FieldLibrary, assets: AssetLibrary, executor: Executor | None
) -> Generator[EvaluationStep, None, dict[str, dict[str, Any]]]:
    """The reports of parts that compare images, by name."""
    scale, about = config.scale, config.about
    given = {"names": about.names, "seed": about.seed, "objects": scale.objects}
    relit = CompareRelighting(config.folder, config.data_dir, tasks=scale.scenes, **given)
    videos = CompareVideos(config.folder, config.data_dir, tasks=scale.videos, **given)
    comparisons = {
        "relighting": lambda: compare_relighting(relit, fields, assets, executor),
        "video": lambda: compare_videos(videos, fields, assets, executor),
    }
    reports: dict[str, dict[str, Any]] = {}
    for name in (part for part in comparisons if part in config.parts):
        for step in comparisons[name]():
            yield EvaluationStep(step.done, step.total, f"{_TITLES[name]}: {step.note}")
            reports[name] = step.report or {}
    return reports


def _episodes(
    config: Reproduce, fields: FieldLibrary, assets: AssetLibrary, executor: Executor | None
) -> Generator[EvaluationStep, None, tuple[MeasuredSection, ...]]:
    """Episodes of all sections."""
    base = EvaluateMpc(config.folder, config.data_dir, seed=config.about.seed, names=config.about.names)
    chosen: tuple[SectionName, ...] = tuple(name for name in SECTIONS if name in config.parts)
    sections = sections_of(base, config.scale, chosen)
    return (yield from measure_cells(sections, fields, assets, executor))


def _figures(config: Reproduce, images: Mapping[str, Any], measured: Sequence[MeasuredSection]) -> dict[str, Any]:
    return {
        "about": asdict(config.about),
        "quick": config.is_quick,
        **images,
        "findings": list(findings(measured)),
        "sections": [
            {
                "name": section.section.name,
                "title": section.section.title,
                "cells": [
                    {"label": cell.label, "figures": dict(cell.figures), "against_first": cell.against}
                    for cell in section.cells
                ],
            }
            for section in measured
        ],
    }


def _warnings(config: Reproduce) -> list[str]:
    """What a reader must know before anything else."""
    scale, told = config.scale, list[str]()
    if config.is_quick:
        told.append(
            f"A quick look and no measurement: {scale.tasks} tasks a cell, {scale.settings.steps} actions instead of "
            f"30, plans of {scale.settings.plan.samples} sequences, {objects_in_words(scale.objects)}, "
            f"and only the factor {', '.join(scale.factors)}. Cells that take "
            "longest are left out. Intervals are as wide as that makes them."
        )
    left_out = [part for part in PARTS if part not in config.parts]
    if left_out:
        told.append(f"Parts left out: {', '.join(left_out)}.")
    return told


def _section_parts(folder: Path, measured: Sequence[MeasuredSection]) -> list[PagePart]:
    parts: list[PagePart] = []
    methods = [section for section in measured if section.section.name == "methods"]
    if methods:
        write_success_curves(folder / _CURVES, methods)
    for section in measured:
        about, pictures = section.section, list[tuple[Path, str]]()
        if section is methods[0] if methods else False:
            pictures.append((folder / _CURVES, "Share of tasks within each 6D distance, for each number of objects"))
        if about.name != "methods":
            picture = folder / f"{about.name}.png"
            write_success_bars(picture, section)
            pictures.append((picture, f"{about.title}: share of tasks within 2 cm and 0.1 rad"))
        rows = [[str(row[key]) for key in _KEYS] for row in rows_of(section)]
        parts.append(PagePart(about.title, about.text, pictures, _HEADS, rows))
    return parts
