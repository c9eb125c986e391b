import os
import shutil
from concurrent.futures import Future, ProcessPoolExecutor
from dataclasses import replace
from functools import partial
from multiprocessing import get_context

import numpy as np
import pytest
import torch

from osfcore.errors import CorruptFile, InvalidInput, MissingAssets, UnknownName, WorkerDied
from osfcore.experiments import harness
from osfcore.fields.field_library import FieldLibrary
from osfcore.inspection.contact_sheet import Comparison
from osfcore.objects.asset_library import AssetLibrary
from osfcore.world.tasks import draw_scene
from tests.clusters import deadly, number_of
from tests.support.errors import about
from tests.support.solids import SOLIDS

CIRCUMSTANCES = {"weights": "abc", "size": 32, "light": (0.1, 0.2)}


def pieces(folder, count=4, work=number_of, circumstances=None):
    cache = harness.TaskCache(folder)
    return [harness.Piece(f"{n:02d}", cache, circumstances or {}, partial(work, n)) for n in range(count)]


def numbers(results):
    return [None if result is None else result.figures["number"] for result in results]


def last(steps):
    *_, step = steps
    return step


def threads(_: int) -> harness.TaskResult:
    return harness.TaskResult({"number": torch.get_num_threads()}, number_of(0).shown)


class Elsewhere:
    """An executor that does its work at once."""

    def submit(self, work, *arguments):
        future = Future()
        future.set_result(work(*arguments))
        return future


@pytest.mark.parametrize("executor", [None, Elsewhere()])
def test_pieces_are_done_once_even_if_the_evaluation_is_left(tmp_path, executor):
    steps = harness.results_of(pieces(tmp_path), executor)
    assert numbers(next(steps)) == [None] * 4
    assert len([number for number in numbers(next(steps)) if number is not None]) == 1
    steps.close()
    begun = numbers(next(harness.results_of(pieces(tmp_path))))
    assert begun.count(None) == 3
    assert numbers(last(harness.results_of(pieces(tmp_path), executor))) == [0, 1, 2, 3]
    assert [numbers(results) for results in harness.results_of(pieces(tmp_path))] == [[0, 1, 2, 3]]
    assert numbers(next(harness.results_of(pieces(tmp_path, circumstances={"seed": 1})))) == [None] * 4
    before = torch.get_num_threads()
    (result,) = last(harness.results_of(pieces(tmp_path, 1, threads, {"seed": 2}), executor))
    assert (result.figures["number"], torch.get_num_threads()) == (1, before)


@pytest.mark.slow
def test_processes_do_them_and_the_results_are_kept_here(tmp_path):
    deadly_one = harness.Piece("99", harness.TaskCache(tmp_path), {}, partial(deadly, 9))
    with ProcessPoolExecutor(2, mp_context=get_context("spawn")) as executor:
        results = last(harness.results_of(pieces(tmp_path), executor))
        with pytest.raises(WorkerDied):  # what was done is not lost
            last(harness.results_of([*pieces(tmp_path), deadly_one], executor))
    assert numbers(results) == [0, 1, 2, 3]
    made_by = [result.figures["process"] for result in results]
    assert os.getpid() not in made_by
    assert [result.figures["process"] for result in last(harness.results_of(pieces(tmp_path)))] == made_by


@pytest.fixture
def result():
    pixels = np.random.default_rng(0).integers(0, 256, (2, 2, 8, 9, 3), dtype=np.uint8)
    return harness.TaskResult({"psnr": [31.25, None]}, tuple(Comparison(f"image {i}", *pixels[i]) for i in range(2)))


def test_a_result_comes_back_as_it_was_under_the_same_circumstances(tmp_path, result):
    cache = harness.TaskCache(tmp_path / "new")
    assert cache.read("task", CIRCUMSTANCES) is None
    cache.write("task", CIRCUMSTANCES, result)
    back = cache.read("task", CIRCUMSTANCES)
    assert back.figures == result.figures
    for mine, theirs in zip(back.shown, result.shown, strict=True):
        assert mine.label == theirs.label
        np.testing.assert_array_equal(mine.truth, theirs.truth)
        np.testing.assert_array_equal(mine.ours, theirs.ours)
    assert cache.read("other", CIRCUMSTANCES) is None
    assert cache.read("task", {**CIRCUMSTANCES, "weights": "abd"}) is None
    assert cache.read("task", {"weights": "abc"}) is None


@pytest.mark.parametrize("kind", ["json", "npz"])
@pytest.mark.parametrize("content", [b"", b"[]", b"PK\x03\x04 cut short", None])
def test_a_damaged_result_is_none(tmp_path, result, kind, content):
    cache = harness.TaskCache(tmp_path)
    cache.write("task", CIRCUMSTANCES, result)
    path = tmp_path / f"task.{kind}"
    if content is None:
        path.unlink()
    else:
        path.write_bytes(content)
    assert cache.read("task", CIRCUMSTANCES) is None
    cache.write("task", CIRCUMSTANCES, result)
    assert cache.read("task", CIRCUMSTANCES) is not None


def test_circumstances_follow_fields_and_meshes(solids, library, tmp_path):
    draw = draw_scene(SOLIDS, 2, 0, 0)
    assets = AssetLibrary(shutil.copytree(library.root, tmp_path / "objects"))
    before = harness.scene_circumstances(draw, solids, assets)
    assert before == harness.scene_circumstances(draw, solids, library)
    asset = assets.load(draw.names[0])
    assets.write(replace(asset, mesh=replace(asset.mesh, texture=asset.mesh.texture // 4)), "a test")
    after = harness.scene_circumstances(draw, solids, assets)
    assert {key for key in before if before[key] != after[key]} == {"assets"}
    shipped = harness.scene_circumstances(draw, FieldLibrary(None), library)
    assert {key for key in before if before[key] != shipped[key]} == {"weights", "table"}


def test_checksums_follow_the_content(tmp_path):
    (tmp_path / "a").write_bytes(b"abc")
    assert harness.file_sha256(tmp_path / "a").startswith("ba7816bf")
    with pytest.raises(CorruptFile):
        harness.file_sha256(tmp_path / "b")


def test_objects_need_a_field_and_a_mesh(solids, library, tmp_path):
    assert harness.chosen_objects(None, solids, library) == harness.measurable(solids, library) == SOLIDS
    assert harness.chosen_objects((SOLIDS[2], SOLIDS[0], SOLIDS[2]), solids, library) == (SOLIDS[0], SOLIDS[2])
    with pytest.raises(UnknownName, check=about("teapot")):
        harness.chosen_objects(("teapot",), solids, library)
    bare = AssetLibrary(tmp_path / "none")
    for names in (None, SOLIDS[:2]):
        with pytest.raises(MissingAssets, check=about(SOLIDS[1])):
            harness.chosen_objects(names, solids, bare)
    with pytest.raises(InvalidInput, check=about("fields")):
        harness.chosen_objects(None, FieldLibrary(None, shipped=tmp_path), library)
