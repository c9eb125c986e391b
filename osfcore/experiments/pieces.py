"""Pieces of a long evaluation: independent, done by any `concurrent.futures.Executor`, kept as soon as they are done.

Whatever runs them, a result reaches the disk of the process that asked for it and nothing else does: workers may be on
other machines, and a piece whose worker dies is done again by an executor that can (Dask's does) or by the next run.
"""

from __future__ import annotations

from collections.abc import Callable, Generator, Iterator, Mapping, Sequence
from concurrent.futures import FIRST_COMPLETED, Executor, Future, wait
from concurrent.futures.process import BrokenProcessPool
from contextlib import contextmanager
from dataclasses import dataclass
from typing import Any

from osfcore.errors import WorkerDied
from osfcore.experiments.task_cache import TaskCache, TaskResult
from osfcore.fields.devices import computing_threads


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
