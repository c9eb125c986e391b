"""Long evaluations: independent tasks on any executor, results kept on disk, and intervals of figures."""

from __future__ import annotations

import hashlib
import io
import json
import zipfile
from collections.abc import Callable, Generator, Iterator, Mapping, Sequence
from concurrent.futures import FIRST_COMPLETED, Executor, Future, wait
from concurrent.futures.process import BrokenProcessPool
from contextlib import contextmanager
from dataclasses import dataclass
from dataclasses import fields as fields_of
from pathlib import Path
from typing import Any

import numpy as np
from scipy.stats import binomtest, bootstrap

from osfcore.errors import CorruptFile, WorkerDied
from osfcore.fields.devices import computing_threads
from osfcore.fields.table import TableField
from osfcore.inspection.contact_sheet import Comparison
from osfcore.io.files import write_atomically, write_json
from osfcore.random_streams import Stream, stream_rng

# Results of finished tasks on disk, so that a long evaluation can be killed, resumed and run in pieces.


@dataclass(frozen=True, eq=False, slots=True)
class TaskResult:
    """What one task left.

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
        """The result of a task, or None if it has to be done (again).

        Args:
            name: of the task.
            circumstances: plain JSON that tells everything the result depends on; another one makes it stale.
        """
        try:
            content = json.loads((self.folder / f"{name}.json").read_text())
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


def file_sha256(path: Path) -> str:
    """What a result that depends on a file depends on.

    Raises:
        CorruptFile: if it cannot be read.
    """
    try:
        return hashlib.sha256(path.read_bytes()).hexdigest()
    except OSError as error:
        raise CorruptFile(path, "it cannot be read") from error


def table_sha256(table: TableField) -> str:
    """The same of a table."""
    arrays = [np.asarray(getattr(table, entry.name)).tobytes() for entry in fields_of(table)]
    return hashlib.sha256(b"".join(arrays)).hexdigest()


# Intervals of shares and means, and paired tests between methods that were given the same tasks.


_LEVEL = 0.95
_RESAMPLES = 9999


def share_interval(successes: int, tasks: int) -> tuple[float, float]:
    """Wilson's 95 % interval of a share."""
    limits = binomtest(successes, tasks).proportion_ci(_LEVEL, method="wilson")
    return float(limits.low), float(limits.high)


def mean_interval(values: Sequence[float]) -> list[float] | None:
    """Return the percentile bootstrap's 95 % interval of a mean (Efron 1979).

    Returns:
        None where all values are equal, or there is one alone: nothing says how far the next one would be.
    """
    if len(values) < 2 or np.ptp(values) == 0:
        return None
    rng = stream_rng(0, Stream.BOOTSTRAP)
    found = bootstrap(
        (np.asarray(values, float),), np.mean, n_resamples=_RESAMPLES, confidence_level=_LEVEL, method="percentile",
        rng=rng,
    )  # fmt: skip
    return [float(found.confidence_interval.low), float(found.confidence_interval.high)]


def compare_shares(ours: Sequence[bool], others: Sequence[bool]) -> dict[str, Any]:
    """Successes of two methods on the same tasks.

    Args:
        ours: of one method, task by task.
        others: of the other one.

    Returns:
        "difference" of the shares, Newcombe's 95 % "interval" of a paired difference, and "p" of McNemar's exact test:
        how likely tasks in which only one of both succeeds are shared out so unevenly if both are equally good.
    """
    pairs = list(zip(ours, others, strict=True))
    both, neither = pairs.count((True, True)), pairs.count((False, False))
    only_ours, only_others = pairs.count((True, False)), pairs.count((False, True))
    differing = only_ours + only_others
    return {
        "difference": (only_ours - only_others) / len(pairs),
        "interval": list(_newcombe(both, only_ours, only_others, neither)),
        "p": float(binomtest(only_ours, differing).pvalue) if differing else 1.0,
    }


def _newcombe(both: int, only_ours: int, only_others: int, neither: int) -> tuple[float, float]:
    """The interval of the difference of two paired shares (Newcombe 1998, method 10), from Wilson's of each of them."""
    tasks = both + only_ours + only_others + neither
    ours, others = both + only_ours, both + only_others
    (low, high), (other_low, other_high) = share_interval(ours, tasks), share_interval(others, tasks)
    below, above = ours / tasks - low, high - ours / tasks
    other_below, other_above = others / tasks - other_low, other_high - others / tasks
    spread = np.sqrt(float(ours * others) * (tasks - ours) * (tasks - others))
    excess = both * neither - only_ours * only_others
    corrected = max(excess - tasks / 2, 0) if excess > 0 else excess
    phi = corrected / spread if spread else 0.0
    difference = (only_ours - only_others) / tasks
    down = np.sqrt(below**2 - 2 * phi * below * other_above + other_above**2)
    up = np.sqrt(above**2 - 2 * phi * above * other_below + other_below**2)
    return float(difference - down), float(difference + up)


def holm(p_values: Sequence[float]) -> list[float]:
    """The p of several tests, corrected for their number (Holm 1979): the k-th smallest of m counts m - k + 1 times."""
    corrected, least = [0.0] * len(p_values), 0.0
    for rank, n in enumerate(np.argsort(p_values)):
        least = max(least, min(1.0, (len(p_values) - rank) * p_values[n]))
        corrected[n] = least
    return corrected


def compare_means(ours: Sequence[float], others: Sequence[float]) -> dict[str, Any]:
    """Return the mean "difference" of two methods on the same tasks and its "interval", see `mean_interval`."""
    differences = [a - b for a, b in zip(ours, others, strict=True)]
    return {"difference": float(np.mean(differences)), "interval": mean_interval(differences)}


# Pieces of a long evaluation: independent, done by any `concurrent.futures.Executor`, kept as soon as they are
# done.
#
# Whatever runs them, a result reaches the disk of the process that asked for it and nothing else does: workers may
# be on other machines, and a piece whose worker dies is done again by an executor that can (Dask's does) or by the
# next run.


@dataclass(frozen=True, eq=False, slots=True)
class EvaluationStep:
    """How far an evaluation is.

    Attributes:
        done: pieces finished.
        total: pieces in all.
        note: what is being done.
        report: all figures as plain JSON, with the last step only.
    """

    done: int
    total: int
    note: str
    report: dict[str, Any] | None = None


@dataclass(frozen=True, slots=True)
class Piece:
    """One of them.

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

    def kept(self) -> TaskResult | None:
        """What it left when it was done before."""
        return self.cache.read(self.name, self.circumstances)


def results_of(pieces: Sequence[Piece], executor: Executor | None = None) -> Iterator[list[TaskResult | None]]:
    """Do what is not done yet; yields what there is so far, in the order of the pieces, after each that was done.

    Args:
        pieces: no two of one name and cache.
        executor: does them, each in one thread, if given; else this process does, one after the other, with torch in
            one thread as in episodes, so that the results are the same.

    Raises:
        WorkerDied: if a worker process ended; what was done until then is kept.
        CannotWrite: if the disk refuses.
    """
    results = [piece.kept() for piece in pieces]
    yield list(results)
    missing = [n for n, result in enumerate(results) if result is None]
    for n, result in _alone(pieces, missing) if executor is None else _shared_out(pieces, missing, executor):
        pieces[n].cache.write(pieces[n].name, pieces[n].circumstances, result)
        results[n] = result
        yield list(results)


def finished(
    pieces: Sequence[Piece], executor: Executor | None, what: str
) -> Generator[EvaluationStep, None, list[TaskResult]]:
    """Do what is not done yet, telling how far it is.

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
