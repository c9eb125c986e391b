"""Harness: pieces, task cache, statistics."""

import os
from concurrent.futures import ProcessPoolExecutor
from dataclasses import replace
from functools import partial
from multiprocessing import get_context
from pathlib import Path

import numpy as np
import pytest
import torch
from hypothesis import given
from hypothesis import strategies as st

from osfcore.errors import CannotWrite, CorruptFile, WorkerDied
from osfcore.experiments.harness import (
    Piece,
    TaskCache,
    TaskResult,
    compare_means,
    compare_shares,
    file_sha256,
    holm,
    mean_interval,
    results_of,
    share_interval,
    table_sha256,
)
from osfcore.inspection.contact_sheet import Comparison
from tests.clusters import deadly, number_of
from tests.core.experiments.solids import exact_table

# Pieces


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


# Task cache


CIRCUMSTANCES = {"weights": "abc", "size": 32, "light": (0.1, 0.2)}


@pytest.fixture
def result():
    rng = np.random.default_rng(0)
    pixels = rng.integers(0, 256, (2, 2, 8, 9, 3), dtype=np.uint8)
    return TaskResult({"psnr": [31.25, None]}, tuple(Comparison(f"image {i}", *pixels[i]) for i in range(2)))


def test_a_result_comes_back_as_it_was(tmp_path, result):
    TaskCache(tmp_path / "new").write("task", CIRCUMSTANCES, result)
    back = TaskCache(tmp_path / "new").read("task", CIRCUMSTANCES)
    assert back.figures == result.figures
    for mine, theirs in zip(back.shown, result.shown, strict=True):
        assert mine.label == theirs.label
        np.testing.assert_array_equal(mine.truth, theirs.truth)
        np.testing.assert_array_equal(mine.ours, theirs.ours)


def test_another_task_and_other_circumstances_have_no_result(tmp_path, result):
    cache = TaskCache(tmp_path)
    assert cache.read("task", CIRCUMSTANCES) is None
    cache.write("task", CIRCUMSTANCES, result)
    assert cache.read("other", CIRCUMSTANCES) is None
    assert cache.read("task", {**CIRCUMSTANCES, "weights": "abd"}) is None
    assert cache.read("task", {"weights": "abc"}) is None


@pytest.mark.parametrize("kind", ["json", "npz"])
@pytest.mark.parametrize("content", [b"", b"[]", b"PK\x03\x04 cut short", None])
def test_a_damaged_result_is_none(tmp_path, result, kind, content):
    cache = TaskCache(tmp_path)
    cache.write("task", CIRCUMSTANCES, result)
    path = tmp_path / f"task.{kind}"
    if content is None:
        path.unlink()
    else:
        path.write_bytes(content)
    assert cache.read("task", CIRCUMSTANCES) is None
    cache.write("task", CIRCUMSTANCES, result)
    assert cache.read("task", CIRCUMSTANCES) is not None


def test_an_unwritable_place_is_told(result):
    with pytest.raises(CannotWrite, match="/proc/results"):
        TaskCache(Path("/proc/results")).write("task", CIRCUMSTANCES, result)


def test_digests_follow_the_content(tmp_path):
    (tmp_path / "a").write_bytes(b"abc")
    assert file_sha256(tmp_path / "a").startswith("ba7816bf")
    with pytest.raises(CorruptFile, match="cannot be read"):
        file_sha256(tmp_path / "b")
    table = exact_table()
    assert table_sha256(table) == table_sha256(exact_table())
    assert table_sha256(replace(table, background=table.background * 2)) != table_sha256(table)


# Statistics


OUTCOMES = st.lists(st.tuples(st.booleans(), st.booleans()), min_size=2, max_size=30)


def test_the_interval_of_a_share_is_wilsons():
    # By Wilson (1927), with z = 1.96: (p + z^2/2n -+ z sqrt(p(1-p)/n + z^2/4n^2)) / (1 + z^2/n).
    n, p, z = 20, 0.95, 1.959964
    middle, half = p + z**2 / (2 * n), z * np.sqrt(p * (1 - p) / n + z**2 / (4 * n**2))
    expected = np.array([middle - half, middle + half]) / (1 + z**2 / n)
    assert share_interval(19, 20) == pytest.approx(expected, abs=1e-6)


@given(tasks=st.integers(1, 200), share=st.floats(0, 1))
def test_a_share_lies_in_its_interval(tasks, share):
    low, high = share_interval(round(share * tasks), tasks)
    assert 0 <= low <= round(share * tasks) / tasks + 1e-9
    assert round(share * tasks) / tasks - 1e-9 <= high <= 1


def test_the_interval_of_a_mean_narrows_with_the_root_of_the_number():
    values = np.random.default_rng(0).normal(5, 1, 1600)
    widths = [np.ptp(mean_interval(values[:count])) for count in (100, 1600)]
    assert widths[0] == pytest.approx(2 * 1.96 / 10, rel=0.25)
    assert widths[0] / widths[1] == pytest.approx(4, rel=0.25)


@pytest.mark.parametrize("values", [[3.0], [3.0, 3.0, 3.0]])
def test_values_without_spread_have_no_interval(values):
    assert mean_interval(values) is None
    assert compare_means(values, [0.0] * len(values)) == {"difference": 3.0, "interval": None}


@pytest.mark.parametrize(("only_one", "p"), [(5, 2 / 2**5), (6, 2 / 2**6), (0, 1.0)])
def test_mcnemar_counts_tasks_in_which_one_alone_succeeds(only_one, p):
    ours = [True] * (10 + only_one) + [False] * 10
    others = [True] * 10 + [False] * (10 + only_one)
    found = compare_shares(ours, others)
    assert found["p"] == pytest.approx(p)
    assert found["difference"] == pytest.approx(only_one / len(ours))


@given(outcomes=OUTCOMES)
def test_the_interval_of_a_difference_holds_it_and_is_never_without_width(outcomes):
    ours, others = zip(*outcomes, strict=True)
    found = compare_shares(ours, others)
    low, high = found["interval"]
    assert -1 <= low <= found["difference"] <= high <= 1
    assert high - low > 0.05


def test_without_correlation_the_interval_of_a_difference_adds_the_squares_of_both():
    """Newcombe (1998), method 10, where one method always succeeds."""
    ours, others = [True] * 20, [True] * 15 + [False] * 5
    (low, _), (other_low, other_high) = share_interval(20, 20), share_interval(15, 20)
    found = compare_shares(ours, others)["interval"]
    assert found[0] == pytest.approx(0.25 - np.hypot(1 - low, other_high - 0.75))
    assert found[1] == pytest.approx(0.25 + 0.75 - other_low)


def test_tasks_that_are_hard_for_both_narrow_the_interval_of_their_difference():
    ours = [True] * 10 + [False] * 10
    alike, unlike = ours, [*ours[5:], *ours[:5]]
    widths = [np.ptp(compare_shares(ours, others)["interval"]) for others in (alike, unlike)]
    assert widths[0] < 0.7 * widths[1]


def test_holm_corrects_for_the_number_of_tests():
    assert holm([0.01, 0.04, 0.03]) == pytest.approx([0.03, 0.06, 0.06])
    assert holm([0.5, 0.9]) == [1.0, 1.0]
    assert holm([]) == []


@given(outcomes=OUTCOMES)
def test_comparing_the_other_way_round_turns_the_sign(outcomes):
    ours, others = zip(*outcomes, strict=True)
    one, other = compare_shares(ours, others), compare_shares(others, ours)
    assert one["difference"] == pytest.approx(-other["difference"])
    assert one["p"] == pytest.approx(other["p"])


def test_a_paired_difference_is_narrower_than_both_spreads():
    rng = np.random.default_rng(1)
    tasks = rng.normal(0, 10, 200)  # some are hard, some are easy, for both alike
    low, high = compare_means(list(tasks + rng.normal(1, 0.1, 200)), list(tasks))["interval"]
    assert 0.9 < low < 1 < high < 1.1
