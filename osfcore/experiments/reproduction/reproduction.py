"""`osf reproduce`: the paper's experiments, with its rivals and what else there is to know, in one report.

Everything is kept as soon as it is measured: a killed run goes on where it was. A full run takes over nothing from a
quick one, whose episodes are shorter.
"""

from __future__ import annotations

from collections.abc import Iterator, Sequence
from concurrent.futures import Executor
from dataclasses import asdict, dataclass, replace
from pathlib import Path
from typing import Any, Literal, get_args

from osfcore.errors import InvalidInput, check_seed
from osfcore.experiments.rearrangement.evaluation import EvaluateMpc
from osfcore.experiments.reproduction.charts_of_sections import write_success_bars, write_success_curves
from osfcore.experiments.reproduction.findings import findings, rows_of
from osfcore.experiments.reproduction.measured_cells import MeasuredSection, measure_cells
from osfcore.experiments.reproduction.page import About, PagePart, check_jinja, write_page
from osfcore.experiments.reproduction.sections import SECTIONS, Scale, SectionName, sections_of
from osfcore.experiments.rivals.nerf import nerf_library
from osfcore.fields.field_library import FieldLibrary
from osfcore.io.files import write_json
from osfcore.objects.asset_library import AssetLibrary
from osfcore.paper.stages import paper_field_names

PAGE_FILE, FIGURES_FILE = "report.html", "reproduction.json"
_CURVES = "success.png"
PartName = Literal["methods", "families", "ablations", "ladder", "factors", "attribution"]
PARTS: tuple[PartName, ...] = get_args(PartName)
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


@dataclass(frozen=True, eq=False, slots=True)
class ReproduceStep:
    """How far a reproduction is.

    Attributes:
        done: pieces of the present part that are finished.
        total: pieces of it in all.
        note: what is being done.
        report: all figures, with the last step only.
    """

    done: int
    total: int
    note: str
    report: dict[str, Any] | None = None


def reproduce(
    config: Reproduce, fields: FieldLibrary, assets: AssetLibrary, executor: Executor | None = None
) -> Iterator[ReproduceStep]:
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
    names = common_names(config.data_dir, fields, assets) if config.names is None else config.names
    config = replace(config, about=replace(config.about, names=names))
    base = EvaluateMpc(config.folder, config.data_dir, seed=config.about.seed, names=names)
    chosen: tuple[SectionName, ...] = tuple(name for name in SECTIONS if name in config.parts)
    measured: tuple[MeasuredSection, ...] = ()
    for step in measure_cells(sections_of(base, config.scale, chosen), fields, assets, executor):
        if step.sections is None:
            yield ReproduceStep(step.done, step.total, f"{step.done} of {step.total} episodes")
        else:
            measured = step.sections
    report = _figures(config, measured)
    write_json(config.folder / FIGURES_FILE, report)
    write_page(
        config.folder / PAGE_FILE, config.about, _warnings(config), findings(measured), _parts(config.folder, measured)
    )
    yield ReproduceStep(1, 1, "The report is written", report)


def common_names(data_dir: Path, fields: FieldLibrary, assets: AssetLibrary) -> tuple[str, ...]:
    """Objects with a mesh that all methods have a field of."""
    known = set(paper_field_names(data_dir)) & set(nerf_library(data_dir).names()) & set(fields.names())
    return tuple(sorted(name for name in known if assets.has(name)))


def _figures(config: Reproduce, measured: Sequence[MeasuredSection]) -> dict[str, Any]:
    return {
        "about": asdict(config.about),
        "quick": config.is_quick,
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


def _warnings(config: Reproduce) -> tuple[str, ...]:
    """What a reader must know before anything else."""
    if not config.is_quick:
        return ()
    scale = config.scale
    left_out = [part for part in PARTS if part not in config.parts]
    more = f" Parts left out: {', '.join(left_out)}." if left_out else ""
    return (
        f"A quick look and no measurement: {scale.tasks} tasks a cell, {scale.settings.steps} actions instead of 30, "
        f"plans of {scale.settings.plan.samples} sequences, {scale.objects} objects, and only the factors "
        f"{', '.join(scale.factors)}. Intervals are as wide as that makes them; run it without --quick for figures "
        f"that mean something.{more}",
    )


def _parts(folder: Path, measured: Sequence[MeasuredSection]) -> list[PagePart]:
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
