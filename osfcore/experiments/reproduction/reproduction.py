"""`osf reproduce`: the paper's experiments, with its rivals and what else there is to know, in one report."""

from __future__ import annotations

import base64
from collections.abc import Generator, Iterator, Mapping, Sequence
from concurrent.futures import Executor
from dataclasses import asdict, dataclass, replace
from importlib.resources import files
from pathlib import Path
from typing import Any, Literal, NamedTuple

import numpy as np

from osfcore.errors import InvalidInput, check_seed
from osfcore.experiments import relighting, video_prediction
from osfcore.experiments.charts import Axis, Bar, Chart, Curve, write_bars, write_charts
from osfcore.experiments.harness import EvaluationStep, Piece, TaskResult, finished
from osfcore.experiments.methods import FIELD_METHODS, TITLES, common_names
from osfcore.experiments.rearrangement import EvaluateMpc, checked, episode_pieces, episodes_report, figures_of
from osfcore.experiments.rearrangement_report import MpcReport, paired
from osfcore.experiments.relighting import CompareRelighting, compare_relighting
from osfcore.experiments.reproduction.sections import (
    SECTIONS,
    Scale,
    Section,
    SectionName,
    objects_in_words,
    sections_of,
)
from osfcore.experiments.statistics import holm, share_interval
from osfcore.experiments.video_prediction import CompareVideos, compare_videos
from osfcore.extras import need
from osfcore.fields.field_library import FieldLibrary
from osfcore.io.files import write_atomically, write_json
from osfcore.metrics.success import RearrangementScore
from osfcore.objects.asset_library import AssetLibrary

# Measuring the cells of a report side by side, and what their results say next to each other.

Steps = Iterator[EvaluationStep[dict[str, Any]]]


class MeasuredCell(NamedTuple):
    """Results of a cell.

    Attributes:
        label: in tables and charts.
        report: all results.
        figures: of the report, as plain JSON.
        against: comparison with the section's first cell, task by task; None for that cell itself and for other tasks.
    """

    label: str
    report: MpcReport
    figures: Mapping[str, Any]
    against: Mapping[str, Any] | None


class MeasuredSection(NamedTuple):
    """A section with the results of its cells, in their order."""

    section: Section
    cells: tuple[MeasuredCell, ...]


def measure_cells(
    sections: Sequence[Section], fields: FieldLibrary, assets: AssetLibrary, executor: Executor | None = None
) -> Generator[EvaluationStep[Any], None, list[MeasuredSection]]:
    """Run the episodes of all sections, each once.

    Args:
        sections: what to measure.
        fields: of the objects.
        assets: meshes for the simulator.
        executor: runs episodes side by side, if given.

    Returns:
        Results in the order of the sections.

    Raises:
        UnknownName, MissingAssets, InvalidInput, NoRoom, WorkerDied, CorruptFile, CannotWrite: as `evaluate_mpc` does.
    """
    pieces = [
        [episode_pieces(checked(cell.config, fields, assets), fields, assets) for cell in section.cells]
        for section in sections
    ]
    unique = {_place(piece): piece for cells in pieces for own in cells for piece in own}
    results = yield from finished(list(unique.values()), executor, "episodes")
    found = dict(zip(unique, results, strict=True))
    return [
        _measured(section, [[found[_place(piece)] for piece in own] for own in cells])
        for section, cells in zip(sections, pieces, strict=True)
    ]


def _place(piece: Piece) -> tuple[Path, str]:
    """Return where a piece is kept, which is the same for equal pieces of several cells."""
    return piece.cache.folder, piece.name


def _measured(section: Section, results: Sequence[Sequence[TaskResult]]) -> MeasuredSection:
    reports = [episodes_report(cell.config, found) for cell, found in zip(section.cells, results, strict=True)]
    cells = []
    for number, (cell, report) in enumerate(zip(section.cells, reports, strict=True)):
        is_comparable = number > 0 and _same_tasks(section.cells[0].config, cell.config)
        against = paired(report.shipped, reports[0].shipped) if is_comparable else None
        cells.append(MeasuredCell(cell.label, report, figures_of(cell.config, report), against))
    return MeasuredSection(section, tuple(cells))


def _same_tasks(one: EvaluateMpc, other: EvaluateMpc) -> bool:
    """Return whether two cells have the same tasks: families differ in them, but for the light of the goal image."""
    places = {config.family.replace("relit", "shifted") for config in (one, other)}
    return len(places) == 1 and (one.objects, one.tasks) == (other.objects, other.tasks)


# The report as one HTML file that needs nothing beside it.


_TEMPLATE = "page.html.jinja"


@dataclass(frozen=True, slots=True)
class About:
    """Circumstances of a report.

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


class PagePart(NamedTuple):
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
    pictures: Sequence[tuple[Path, str]]
    heads: Sequence[str]
    rows: Sequence[Sequence[str]]


def write_page(
    path: Path, about: About, warnings: Sequence[str], findings: Sequence[str], parts: Sequence[PagePart]
) -> None:
    """Write the report; its pictures become part of it.

    Args:
        path: of the HTML file.
        about: circumstances of the report.
        warnings: what a reader must know first.
        findings: in sentences.
        parts: from top to bottom.

    Raises:
        CannotWrite: if the disk refuses.
        MissingExtra: if jinja2 is not installed.
    """
    need("experiments", "The report")
    import jinja2

    template = (files("osfcore.experiments.reproduction") / _TEMPLATE).read_text(encoding="utf-8")
    environment = jinja2.Environment(autoescape=True, trim_blocks=True, undefined=jinja2.StrictUndefined)
    given = {"about": about, "warnings": warnings, "findings": findings, "parts": parts, "data_url": _data_url}
    write_atomically(path, environment.from_string(template).render(given).encode())


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
    """Return the share of tasks within each threshold, with Wilson's interval."""
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
    key, axis = "success_tight", Axis("share of tasks within 2 cm and 0.1 rad", 0, 1)
    bars = [Bar(cell.label, cell.figures[key], *cell.figures[f"{key}_interval"]) for cell in section.cells]
    write_bars(path, section.section.title, axis, bars)


# What a report's sections say in sentences: who is ahead, who is not, and what costs most.


_COMPARED = {"success_tight": "within 2 cm and 0.1 rad", "success_2cm": "within 2 cm"}
_SIGNIFICANT = 0.05
MOST_LOST = 0.15  # of success, that one factor of variation may cost
_HALF = 0.5


def findings(sections: Sequence[MeasuredSection]) -> list[str]:
    """Return a sentence for each comparison of the methods, for the mean distance, and for what costs too much."""
    methods = [section for section in sections if section.section.name == "methods"]
    comparisons = [
        (section.cells[0], cell, key) for section in methods for cell in section.cells[1:] for key in _COMPARED
    ]
    corrected = holm([_gap(cell, key)["p"] for _, cell, key in comparisons])
    sentences = [_method(*one, p) for one, p in zip(comparisons, corrected, strict=True)]
    sentences += [_distance(section.cells[0]) for section in methods]
    for section in sections:
        if section.section.name == "factors":
            sentences += _costly(section)
    return sentences


def _gap(cell: MeasuredCell, key: str) -> Mapping[str, Any]:
    """Return how a cell differs from the first of its section; all methods and all factors have the same tasks."""
    return (cell.against or {})[key]


def _lead(cell: MeasuredCell, key: str) -> tuple[float, float, float]:
    """Return by how much the first cell is ahead of another one, and the interval [percent]."""
    gap = _gap(cell, key)  # the other one minus the first
    low, high = (-100 * end for end in reversed(gap["interval"]))
    return 100 * (0.0 - gap["difference"]), low, high  # never -0


def _method(ours: MeasuredCell, other: MeasuredCell, key: str, corrected: float) -> str:
    """Compare ours with another method; who is better is said where p, corrected for all comparisons, is below 5 %."""
    lead, low, high = _lead(other, key)
    better = "ours is better" if lead > 0 else "ours is worse"
    verdict = better if corrected < _SIGNIFICANT else "no difference is shown"
    return (
        f"{_objects(ours)}, ours and {other.label}, {_COMPARED[key]}: {100 * ours.figures[key]:.0f} % against "
        f"{100 * other.figures[key]:.0f} %, which is {lead:+.0f} points (95 %: {low:+.0f} to {high:+.0f}; "
        f"McNemar p = {_gap(other, key)['p']:.2g}, {corrected:.2g} by Holm for all these comparisons): {verdict}."
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
        lost, low, high = _lead(cell, "success_tight")
        if -_gap(cell, "success_tight")["difference"] > MOST_LOST:
            yield (
                f"Under {cell.label} {lost:.0f} points of success are lost (95 %: {low:.0f} to "
                f"{high:.0f}), more than {100 * MOST_LOST:.0f}."
            )


def _objects(cell: MeasuredCell) -> str:
    return objects_in_words(cell.figures["objects"])


_HEADS = (
    "", "tasks", "2 cm and 0.1 rad", "2 cm", "refused", "6D mean", "with symmetry", "its median", "first frame [mm]",
    "[deg]", "light [deg]", "points against the first row",
)  # fmt: skip


def rows_of(section: MeasuredSection) -> list[list[str]]:
    """Return the rows of a section's table, those of the oracle and of doing nothing among them, as plain words."""
    rows = [_row(cell.label, cell.figures, "", cell) for cell in section.cells]
    first = section.cells[0]
    if first.report.oracle:
        rows.append(_row("told the truth", first.figures, "oracle_"))
    rows.append(_row("no action", first.figures, "noaction_"))
    return rows


def _row(label: str, figures: Mapping[str, Any], who: str, cell: MeasuredCell | None = None) -> list[str]:
    shares = []
    for key in _COMPARED:
        low, high = figures[f"{who}{key}_interval"]
        shares.append(f"{100 * figures[who + key]:.0f} % ({100 * low:.0f} to {100 * high:.0f})")
    distances = ("pose6d_mean", "pose6d_symmetric_mean", "pose6d_symmetric_median")
    refused, errors, gap = "", ["", "", ""], ""
    if cell is not None:
        refused = str(figures["refused"])
        medians = [figures[f"{key}_median"] for key in ("first_mm", "first_deg", "light_deg")]
        errors = ["" if value is None else f"{value:.2f}" for value in medians]
        if cell.against is not None:
            ahead = cell.against["success_tight"]
            low, high = ahead["interval"]
            gap = f"{100 * ahead['difference']:+.0f} ({100 * low:+.0f} to {100 * high:+.0f}), p = {ahead['p']:.2g}"
    six_d = [f"{figures[who + key]:.3f}" for key in distances]
    return [label, str(figures["tasks"]), *shares, refused, *six_d, *errors, gap]


# The parts of a report that compare images: relit scenes (Fig. 5) and predicted videos (Fig. 6).


def relighting_part(folder: Path, report: Mapping[str, Any]) -> PagePart:
    """Return the part on scenes under lights of all elevations.

    Args:
        folder: with the pictures.
        report: of `compare_relighting`.
    """
    titles = {"psnr": "PSNR [dB]", "ssim": "SSIM", "psnr_object": "on objects [dB]", "psnr_shadow": "in shadow [dB]"}
    columns = [(key, relighting.ALL, title) for key, title in titles.items()]
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
    """Return the part on pushes predicted as images.

    Args:
        folder: with the pictures.
        report: of `compare_videos`.
    """
    spans, titles = next(iter(report["methods"].values()))["psnr"]["spans"], {"psnr": "PSNR [dB]", "ssim": "SSIM"}
    columns = [(key, span, f"{title}, {span} steps") for span in spans for key, title in titles.items()]
    text = (
        f"{report['tasks']} episodes of {objects_in_words(report['objects'])}, {report['steps']} actions known "
        "in advance, from the first frame's estimate; FitVid sees two frames of the goal camera."
    )
    pictures = (
        (folder / video_prediction.CHART_FILE, "PSNR and SSIM by predicted step"),
        (folder / video_prediction.IMAGES_FILE, "One episode as it was and as each method predicts it"),
    )
    return PagePart("Predicted futures as images (Fig. 6)", text, pictures, *_table(report, columns))


def _table(
    report: Mapping[str, Any], columns: Sequence[tuple[str, str, str]]
) -> tuple[tuple[str, ...], list[list[str]]]:
    """Return heads and rows: means with intervals, and how much ours is ahead in the first column's measure."""
    key, span, _ = columns[0]
    rows = []
    for method, measures in report["methods"].items():
        cells = [_interval(measures[measure]["spans"][over], "mean") for measure, over, _ in columns]
        gap = report["against"].get(method)
        rows.append([TITLES[method], *cells, "" if gap is None else _interval(gap[key][span], "difference")])
    return ("", *(title for _, _, title in columns), "ours better by [dB]"), rows


def _interval(figure: Mapping[str, Any], what: str) -> str:
    if figure[what] is None:
        return "-"
    if figure["interval"] is None:
        return f"{figure[what]:.3g}"
    low, high = figure["interval"]
    return f"{figure[what]:.3g} ({low:.3g} to {high:.3g})"


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


@dataclass(frozen=True, slots=True)
class Reproduce:
    """What to measure and to report.

    Attributes:
        folder: for report.html, reproduction.json, pictures, and all results.
        data_dir: where objects, fields and networks of this machine are.
        about: circumstances, as the page shows them; the names are filled in.
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


def reproduce(config: Reproduce, fields: FieldLibrary, assets: AssetLibrary, executor: Executor | None = None) -> Steps:
    """Measure what is not measured yet, and write the report.

    Args:
        config: what to measure.
        fields: of the objects.
        assets: meshes for the simulator.
        executor: runs pieces side by side, if given.

    Raises:
        UnknownName, MissingAssets: if an object lacks a field or a mesh.
        InvalidInput: if a number or name is out of range.
        MissingExtra: if what writes pages or draws charts is not installed.
        NoRoom, WorkerDied, CorruptFile, CannotWrite: as for evaluations.
    """
    need("experiments", "The report")
    check_seed(config.about.seed)
    for part in config.parts:
        if part not in PARTS:
            raise InvalidInput("part of the report", part, ", ".join(PARTS))
    names = common_names(FIELD_METHODS, config.names, fields, assets, config.data_dir, config.scale.objects)
    config = replace(config, about=replace(config.about, names=names))
    images: dict[str, dict[str, Any]] = {}
    for name, steps in _image_comparisons(config, fields, assets, executor).items():
        for step in steps:
            yield EvaluationStep(step.done, step.total, f"{_TITLES[name]}: {step.note}")
            images[name] = step.report or {}
    base = EvaluateMpc(config.folder, config.data_dir, seed=config.about.seed, names=names)
    chosen: tuple[SectionName, ...] = tuple(name for name in SECTIONS if name in config.parts)
    measured = yield from measure_cells(sections_of(base, config.scale, chosen), fields, assets, executor)
    report = _figures(config, images, measured)
    write_json(config.folder / FIGURES_FILE, report)
    parts = [_IMAGE_PARTS[name](config.folder, figures) for name, figures in images.items()]
    parts += _section_parts(config.folder, measured)
    write_page(config.folder / PAGE_FILE, config.about, _warnings(config), report["findings"], parts)
    yield EvaluationStep(1, 1, "The report is written", report)


def _image_comparisons(
    config: Reproduce, fields: FieldLibrary, assets: AssetLibrary, executor: Executor | None
) -> dict[str, Steps]:
    """Return the parts that compare images, not begun."""
    scale, about = config.scale, config.about
    given = {"names": about.names, "seed": about.seed, "objects": scale.objects}
    relit = CompareRelighting(config.folder, config.data_dir, tasks=scale.scenes, **given)
    videos = CompareVideos(config.folder, config.data_dir, tasks=scale.videos, **given)
    comparisons = {
        "relighting": compare_relighting(relit, fields, assets, executor),
        "video": compare_videos(videos, fields, assets, executor),
    }
    return {name: steps for name, steps in comparisons.items() if name in config.parts}


def _figures(config: Reproduce, images: Mapping[str, Any], measured: Sequence[MeasuredSection]) -> dict[str, Any]:
    sections = []
    for section, cells in measured:
        rows = [{"label": c.label, "figures": dict(c.figures), "against_first": c.against} for c in cells]
        sections.append({"name": section.name, "title": section.title, "cells": rows})
    about = {"about": asdict(config.about), "quick": config.is_quick}
    return {**about, **images, "findings": findings(measured), "sections": sections}


def _warnings(config: Reproduce) -> list[str]:
    """Return what a reader must know before anything else."""
    scale, warnings = config.scale, list[str]()
    if config.is_quick:
        warnings.append(
            f"A quick look and no measurement: {scale.tasks} tasks a cell, {scale.settings.steps} actions instead of "
            f"30, plans of {scale.settings.plan.samples} sequences, {objects_in_words(scale.objects)}, "
            f"and only the factor {', '.join(scale.factors)}. Cells that take "
            "longest are left out. Intervals are as wide as that makes them."
        )
    left_out = [part for part in PARTS if part not in config.parts]
    if left_out:
        warnings.append(f"Parts left out: {', '.join(left_out)}.")
    return warnings


def _section_parts(folder: Path, measured: Sequence[MeasuredSection]) -> list[PagePart]:
    methods = [section for section in measured if section.section.name == "methods"]
    parts: list[PagePart] = []
    for section in measured:
        about, pictures = section.section, list[tuple[Path, str]]()
        if about.name != "methods":
            picture = folder / f"{about.name}.png"
            write_success_bars(picture, section)
            pictures.append((picture, f"{about.title}: share of tasks within 2 cm and 0.1 rad"))
        elif section is methods[0]:  # one picture for all numbers of objects
            write_success_curves(folder / _CURVES, methods)
            pictures.append((folder / _CURVES, "Share of tasks within each 6D distance, for each number of objects"))
        parts.append(PagePart(about.title, about.text, pictures, _HEADS, rows_of(section)))
    return parts
