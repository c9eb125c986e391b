"""`osf reproduce`: the paper's experiments, with its rivals and what else there is to know, in one report.

Everything is kept as soon as it is measured: a killed run goes on where it was. A full run takes over nothing from a
quick one, whose episodes are shorter.
"""

from __future__ import annotations

from collections.abc import Generator, Iterator, Mapping, Sequence
from concurrent.futures import Executor
from dataclasses import asdict, dataclass, replace
from pathlib import Path
from typing import Any, Literal

from osfcore.errors import InvalidInput, check_seed
from osfcore.experiments.dynamics.video_prediction import CompareVideos, compare_videos
from osfcore.experiments.fields.relighting import CompareRelighting, compare_relighting
from osfcore.experiments.image_methods import FIELD_METHODS, common_names
from osfcore.experiments.pieces import EvaluationStep
from osfcore.experiments.rearrangement.evaluation import EvaluateMpc
from osfcore.experiments.reproduction.charts_of_sections import write_success_bars, write_success_curves
from osfcore.experiments.reproduction.findings import findings, rows_of
from osfcore.experiments.reproduction.image_parts import relighting_part, video_part
from osfcore.experiments.reproduction.measured_cells import MeasuredSection, measure_cells
from osfcore.experiments.reproduction.page import About, PagePart, check_jinja, write_page
from osfcore.experiments.reproduction.sections import SECTIONS, Scale, SectionName, objects_in_words, sections_of
from osfcore.fields.field_library import FieldLibrary
from osfcore.io.files import write_json
from osfcore.objects.asset_library import AssetLibrary

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
