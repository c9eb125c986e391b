"""Measuring the cells of a report side by side, and what their results say next to each other."""

from __future__ import annotations

from collections.abc import Generator, Mapping, Sequence
from concurrent.futures import Executor
from dataclasses import dataclass
from typing import Any

from osfcore.experiments.pieces import EvaluationStep, Piece, finished
from osfcore.experiments.rearrangement.evaluation import episode_pieces, episodes_report, figures_of
from osfcore.experiments.rearrangement.report import MpcReport, paired
from osfcore.experiments.reproduction.sections import Cell, Section
from osfcore.experiments.task_cache import TaskResult
from osfcore.fields.field_library import FieldLibrary
from osfcore.objects.asset_library import AssetLibrary


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
