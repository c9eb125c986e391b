import os
from concurrent.futures import ProcessPoolExecutor
from functools import partial
from multiprocessing import get_context

import pytest
import torch

from osfcore.errors import WorkerDied
from osfcore.experiments.harness import Piece, TaskCache, TaskResult, results_of
from tests.clusters import deadly, number_of


def pieces(folder, count=4, work=number_of, circumstances=None):
    cache = TaskCache(folder)
    return [Piece(f"{n:02d}", cache, circumstances or {}, partial(work, n)) for n in range(count)]


def numbers(results):
    return [None if result is None else result.figures["number"] for result in results]


def last(steps):
    *_, step = steps
    return step


def threads(_: int) -> TaskResult:
    return TaskResult({"number": torch.get_num_threads()}, number_of(0).shown)


def test_pieces_are_done_in_turn_and_told_in_their_order(tmp_path):
    assert [numbers(results) for results in results_of(pieces(tmp_path, 2))] == [
        [None, None], [0, None], [0, 1],
    ]  # fmt: skip


def test_what_was_done_is_not_done_again(tmp_path):
    first = last(results_of(pieces(tmp_path, 2)))
    again = list(results_of(pieces(tmp_path, 3)))
    assert numbers(again[0]) == [0, 1, None]
    assert [one.figures for one in again[-1][:2]] == [one.figures for one in first]
    (stale, *_) = results_of(pieces(tmp_path, 3, circumstances={"seed": 1}))
    assert numbers(stale) == [None] * 3


def test_one_that_is_left_keeps_what_was_done(tmp_path):
    steps = results_of(pieces(tmp_path))
    next(steps)
    next(steps)
    steps.close()
    (there, *_) = results_of(pieces(tmp_path))
    assert numbers(there) == [0, None, None, None]


def test_torch_has_one_thread_meanwhile(tmp_path):
    before = torch.get_num_threads()
    torch.set_num_threads(2)
    try:
        assert numbers(last(results_of(pieces(tmp_path, 1, threads)))) == [1]
        assert torch.get_num_threads() == 2
    finally:
        torch.set_num_threads(before)


@pytest.mark.slow
def test_processes_do_them_and_the_results_are_kept_here(tmp_path):
    with ProcessPoolExecutor(2, mp_context=get_context("spawn")) as executor:
        results = last(results_of(pieces(tmp_path), executor))
    assert numbers(results) == [0, 1, 2, 3]
    assert os.getpid() not in {result.figures["process"] for result in results}
    assert numbers(last(results_of(pieces(tmp_path)))) == [0, 1, 2, 3]
    assert {result.figures["process"] for result in last(results_of(pieces(tmp_path)))} == {
        result.figures["process"] for result in results
    }


@pytest.mark.slow
def test_a_worker_that_dies_is_told_and_costs_nothing_that_was_done(tmp_path):
    begun = pieces(tmp_path, 2)
    last(results_of(begun))
    with ProcessPoolExecutor(1, mp_context=get_context("spawn")) as executor, pytest.raises(WorkerDied):
        last(results_of([*begun, Piece("99", TaskCache(tmp_path), {}, partial(deadly, 9))], executor))
    assert numbers(last(results_of(begun))) == [0, 1]
