from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest

from osfcore.errors import CannotWrite, CorruptFile
from osfcore.experiments.harness import TaskCache, TaskResult, file_sha256, table_sha256
from osfcore.inspection.contact_sheet import Comparison
from tests.core.experiments.solids import exact_table

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
