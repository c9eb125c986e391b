"""Run long evaluations: checks of what is asked for, results kept on disk, and independent pieces on any executor."""

from __future__ import annotations

import hashlib
import io
import json
import zipfile
from collections.abc import Callable, Generator, Iterable, Iterator, Mapping, Sequence
from concurrent.futures import FIRST_COMPLETED, Executor, Future, wait
from concurrent.futures.process import BrokenProcessPool
from contextlib import contextmanager
from dataclasses import dataclass
from dataclasses import fields as fields_of
from pathlib import Path
from typing import Any, Generic, TypeVar

import numpy as np

from osfcore.errors import CorruptFile, InvalidInput, MissingAssets, WorkerDied, check_ranges, check_seed
from osfcore.fields.devices import computing_threads
from osfcore.fields.field_library import FieldLibrary
from osfcore.fields.table import TableField
from osfcore.geometry.cameras import image_side
from osfcore.inspection.contact_sheet import Comparison
from osfcore.io.files import write_atomically, write_json
from osfcore.objects.asset_library import AssetLibrary
from osfcore.world.tasks import Draw

MAX_TASKS = 10_000
ReportT = TypeVar("ReportT")


@dataclass(frozen=True, eq=False, slots=True)
class EvaluationStep(Generic[ReportT]):
    """Progress of an evaluation.

    Attributes:
        done: parts finished.
        total: parts in all.
        note: what is being done.
        report: all figures, with the last step only.
    """

    done: int
    total: int
    note: str
    report: ReportT | None = None


# Checks of what is asked for.


def check_run(tasks: int, seed: int, *limits: tuple[str, float, float, float], size: int | None = None) -> None:
    """Check the settings that most evaluations have.

    Args:
        tasks: number of tasks, 1 or more.
        seed: of everything random.
        limits: further numbers, as `check_ranges` takes them.
        size: side of the images [px], if there are any.

    Raises:
        InvalidInput: if a number is out of range.
    """
    check_ranges(("number of tasks", tasks, 1, MAX_TASKS), *limits)
    check_seed(seed)
    if size is not None:
        image_side(size)


def measurable(fields: FieldLibrary, assets: AssetLibrary) -> tuple[str, ...]:
    """Return the names of all objects with both a field and a mesh.

    Raises:
        InvalidInput: if there is no field at all.
        MissingAssets: if there are fields, but no mesh for any.
    """
    known = fields.names()
    if not known:
        raise InvalidInput("number of trained fields", 0, "1 or more: train one with 'osf train field'")
    names = tuple(name for name in known if assets.has(name))
    if not names:
        raise MissingAssets(known)
    return names


def chosen_objects(names: Iterable[str] | None, fields: FieldLibrary, assets: AssetLibrary) -> tuple[str, ...]:
    """Return the objects to draw from, sorted: those named, or all measurable ones if None.

    Tasks depend on the order, and kept results do not know it.

    Raises:
        UnknownName: if a named object has no field.
        MissingAssets: if one has no mesh on this machine.
        InvalidInput: if there is no field at all.
    """
    if names is None:
        return measurable(fields, assets)
    chosen = tuple(sorted(set(names)))
    for name in chosen:
        fields.info(name)  # raises UnknownName
    missing = [name for name in chosen if not assets.has(name)]
    if missing:
        assets.info(missing[0])  # raises UnknownName
        raise MissingAssets(missing)
    return chosen


# What results depend on.


def file_sha256(path: Path) -> str:
    """Return the checksum of a file.

    Raises:
        CorruptFile: if it cannot be read.
    """
    try:
        return hashlib.sha256(path.read_bytes()).hexdigest()
    except OSError as error:
        raise CorruptFile(path, "it cannot be read") from error


def table_sha256(table: TableField) -> str:
    """Return the checksum of a table's weights."""
    arrays = [np.asarray(getattr(table, entry.name)).tobytes() for entry in fields_of(table)]
    return hashlib.sha256(b"".join(arrays)).hexdigest()


def scene_circumstances(draw: Draw, fields: FieldLibrary, assets: AssetLibrary) -> dict[str, Any]:
    """Return what all figures of a scene depend on, as plain JSON: fields, meshes, table, arrangement and light.

    Raises:
        UnknownName, MissingAssets, CorruptFile: if a field or a mesh cannot be read.
    """
    return {
        "weights": {name: file_sha256(fields.info(name).path) for name in draw.names},
        "assets": {name: assets.digest(name) for name in draw.names},
        "table": table_sha256(fields.load_table()),
        "arrangement": draw.seed,
        "light": draw.light.direction.tolist(),
    }


# Results of finished tasks on disk, so that a long evaluation can be killed, resumed and run in pieces.


@dataclass(frozen=True, eq=False, slots=True)
class TaskResult:
    """Result of one task.

    Attributes:
        figures: plain JSON.
        shown: images for contact sheets.
    """

    figures: dict[str, Any]
    shown: tuple[Comparison, ...]


class TaskCache:
    """One folder of results: NAME.json and NAME.npz for each task.

    Args:
        folder: made at the first write.
    """

    def __init__(self, folder: Path) -> None:
        self.folder = folder

    def read(self, name: str, circumstances: Mapping[str, Any]) -> TaskResult | None:
        """Return the result of a task, or None if it has to be done (again).

        Args:
            name: of the task.
            circumstances: plain JSON of everything the result depends on; a result with other ones is stale.
        """
        try:
            content = json.loads((self.folder / f"{name}.json").read_text(encoding="utf-8"))
            if content["circumstances"] != json.loads(json.dumps(circumstances)):
                return None
            arrays = io.BytesIO((self.folder / f"{name}.npz").read_bytes())
            with np.load(arrays, allow_pickle=False) as stored:
                labels, truth, ours = (stored[key] for key in ("labels", "truth", "ours"))
            shown = tuple(Comparison(str(a), b, c) for a, b, c in zip(labels, truth, ours, strict=True))
            return TaskResult(dict(content["figures"]), shown)
        except (OSError, ValueError, KeyError, TypeError, EOFError, zipfile.BadZipFile):
            return None  # not there, or damaged: the task can always be done again

    def write(self, name: str, circumstances: Mapping[str, Any], result: TaskResult) -> None:
        """Keep the result of a task.

        Args:
            name: of the task.
            circumstances: plain JSON, as `read` will be asked.
            result: with one comparison or more, all of one image size.

        Raises:
            CannotWrite: if the disk refuses.
        """
        arrays = io.BytesIO()
        np.savez_compressed(
            arrays,
            labels=np.array([c.label for c in result.shown]),
            truth=np.stack([c.truth for c in result.shown]),
            ours=np.stack([c.ours for c in result.shown]),
        )
        write_atomically(self.folder / f"{name}.npz", arrays.getvalue())
        # Last: where the JSON is, the images are.
        write_json(self.folder / f"{name}.json", {"circumstances": circumstances, "figures": result.figures})


# Independent pieces of an evaluation, done by any `concurrent.futures.Executor` and kept as soon as they are done.
#
# Only the process that asked for a result writes it to disk: workers may be on other machines. A piece whose worker
# dies is done again by an executor that can (Dask's does) or by the next run.


@dataclass(frozen=True, slots=True)
class Piece:
    """One independent part of an evaluation.

    Attributes:
        name: of its files.
        cache: where they are.
        circumstances: plain JSON of everything the result depends on.
        work: makes the result; can be sent to other processes.
    """

    name: str
    cache: TaskCache
    circumstances: Mapping[str, Any]
    work: Callable[[], TaskResult]

    def is_done(self) -> bool:
        """Return whether its result is kept."""
        return self.cache.read(self.name, self.circumstances) is not None


def results_of(pieces: Sequence[Piece], executor: Executor | None = None) -> Iterator[list[TaskResult | None]]:
    """Do what is not done yet, and yield all results so far, in the order of the pieces, after each that was done.

    Args:
        pieces: no two of one name and cache.
        executor: does them, each in one thread, if given. Otherwise this process does one after the other, with torch
            in one thread as in episodes, so that the results are the same.

    Raises:
        WorkerDied: if a worker process ended; what was done until then is kept.
        CannotWrite: if the disk refuses.
    """
    results = [piece.cache.read(piece.name, piece.circumstances) for piece in pieces]
    yield list(results)
    missing = [n for n, result in enumerate(results) if result is None]
    for n, result in _alone(pieces, missing) if executor is None else _shared_out(pieces, missing, executor):
        pieces[n].cache.write(pieces[n].name, pieces[n].circumstances, result)
        results[n] = result
        yield list(results)


def finished(
    pieces: Sequence[Piece], executor: Executor | None, what: str
) -> Generator[EvaluationStep[Any], None, list[TaskResult]]:
    """Do what is not done yet, and yield progress.

    Args:
        pieces: no two of one name and cache.
        executor: does them side by side, if given.
        what: they are, in the plural.

    Returns:
        All results, in the order of the pieces.

    Raises:
        WorkerDied, CannotWrite: as `results_of` does.
    """
    results: list[TaskResult | None] = []
    for results in results_of(pieces, executor):
        done = sum(result is not None for result in results)
        if done < len(pieces):
            yield EvaluationStep(done, len(pieces), f"{done} of {len(pieces)} {what}")
    return [result for result in results if result is not None]


def _alone(pieces: Sequence[Piece], missing: Sequence[int]) -> Iterator[tuple[int, TaskResult]]:
    for n in missing:
        with torch_in_one_thread():
            result = pieces[n].work()
        yield n, result


def _shared_out(
    pieces: Sequence[Piece], missing: Sequence[int], executor: Executor
) -> Iterator[tuple[int, TaskResult]]:
    running: dict[Future[TaskResult], int] = {executor.submit(_in_one_thread, pieces[n].work): n for n in missing}
    try:
        while running:
            finished, _ = wait(running, return_when=FIRST_COMPLETED)
            for future in finished:
                yield running.pop(future), future.result()
    except BrokenProcessPool as error:
        raise WorkerDied("working on a task") from error
    finally:
        for future in running:
            future.cancel()


def _in_one_thread(work: Callable[[], TaskResult]) -> TaskResult:
    with computing_threads(1):
        return work()


@contextmanager
def torch_in_one_thread() -> Iterator[None]:
    """Let torch compute in one thread meanwhile."""
    import torch

    before = torch.get_num_threads()
    torch.set_num_threads(1)
    try:
        yield
    finally:
        torch.set_num_threads(before)
