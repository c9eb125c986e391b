import json
import shutil
from concurrent.futures import ProcessPoolExecutor, ThreadPoolExecutor
from dataclasses import replace
from functools import partial
from multiprocessing import get_context

import numpy as np
import pytest

from osfcore.errors import CorruptFile, InvalidInput, WorkerDied
from osfcore.fields.kiloosf import read_field
from osfcore.fields.train_kiloosf import TrainField, train_field
from osfcore.fields.train_osf import TeacherRecipe
from osfcore.fields.train_several import train_several
from osfcore.paper.train_fields import PaperFieldRecipe, TrainPaperField, train_paper_field
from tests.clusters import training_that_dies
from tests.core.fields.rendered_sets import QUICK, painted_ball, painted_block, write_object_set, write_table_set
from tests.core.render.scenes import plain_table

pytestmark = pytest.mark.usefixtures("one_thread")
TRAIN = partial(train_field, recipe=QUICK)


@pytest.fixture(scope="module")
def sets(tmp_path_factory):
    folder = tmp_path_factory.mktemp("sets")
    return [
        write_object_set(folder / "ball", painted_ball(), train=12, test=2),
        write_object_set(folder / "block", painted_block(), train=12, test=2, seed=1),
    ]


def settings_of(sets, folder, iterations=10) -> list[TrainField]:
    return [TrainField(one, folder / f"{one.name}.safetensors", iterations=iterations, device="cpu") for one in sets]


def notes(*arguments, **keywords) -> list[str]:
    return [step.note for step in train_several(*arguments, **keywords)]


def metrics(settings: TrainField) -> dict:
    return json.loads(settings.out.with_suffix(".json").read_text())


def assert_same_fields(some, others):
    """To what rounding makes of it: sums depend on how arrays lie in memory."""
    for one, other in zip(some, others, strict=True):
        assert metrics(one)["psnr_full"] == pytest.approx(metrics(other)["psnr_full"], abs=0.1)
        np.testing.assert_allclose(read_field(one.out).networks, read_field(other.out).networks, atol=0.02)


def test_each_becomes_what_it_becomes_alone_wherever_it_is_trained(sets, tmp_path):
    alone, here, beside, elsewhere = (settings_of(sets, tmp_path / name) for name in "abcd")
    for one in alone:
        list(TRAIN(one))
    steps = list(train_several(here, TRAIN))
    with ThreadPoolExecutor(1) as executor:
        notes(beside, TRAIN, executor)
        told = notes(elsewhere, TRAIN, executor, shares_disk=False)
    assert told[-1].startswith("2 of 2 trained, block with ")
    assert (steps[-1].done, steps[-1].total) == (20, 20)
    assert [step.done for step in steps] == sorted(step.done for step in steps)
    assert steps[-1].note.startswith("block: ")
    for settings in (here, beside, elsewhere):
        assert_same_fields(settings, alone)
        assert all(
            set(metrics(one)) == {*metrics(plain), "made_of"} for one, plain in zip(settings, alone, strict=True)
        )
        names = sorted(path.name for path in settings[0].out.parent.iterdir())
        assert names == ["ball.json", "ball.safetensors", "block.json", "block.safetensors"]


def test_what_is_finished_is_trained_again_only_where_something_has_changed(sets, tmp_path):
    moved = [shutil.copytree(one, tmp_path / "sets" / one.name) for one in sets]
    settings = settings_of(moved, tmp_path / "out")
    ball, block = settings
    assert notes(settings[:1], TRAIN)[1] == "0 of 1 trained"
    assert notes(settings, TRAIN)[2] == "1 of 2 trained"
    assert notes(settings, TRAIN)[-1] == "2 of 2 trained"
    assert notes(settings_of(sets, tmp_path / "out"), TRAIN)[-1] == "2 of 2 trained"
    assert notes([ball, replace(block, seed=1)], TRAIN)[2] == "1 of 2 trained"
    assert notes(settings, TRAIN)[2] == "1 of 2 trained"
    block.out.write_bytes(ball.out.read_bytes())
    assert notes(settings, TRAIN)[2] == "1 of 2 trained"
    anno = moved[0] / "train" / "anno.json"
    entries = json.loads(anno.read_text())
    entries[3]["light_pos"] = [0, 0, 1]
    anno.write_text(json.dumps(entries))
    assert notes(settings, TRAIN)[2] == "1 of 2 trained"


def test_one_that_is_left_goes_on_where_it_was(sets, tmp_path):
    recipe = PaperFieldRecipe(
        TeacherRecipe(across=20, rays=256, rebake=20), across=2, width=16, rays=256, report_s=0.0, checkpoint_s=0.0
    )
    train = partial(train_paper_field, recipe=recipe)
    settings = [
        TrainPaperField(one.data, one.out, iterations=20, device="cpu", teacher_width=16, teacher_depth=2)
        for one in settings_of(sets, tmp_path)
    ]
    begun = train_several(settings, train)
    for step in begun:
        if step.note.startswith("block: Teacher, step 4"):
            break
    begun.close()
    again = [step for step in train_several(settings, train) if step.note.startswith("block: ")]
    assert again[1].done > 20 + 3
    assert [one.out.with_suffix(".partial").exists() for one in settings] == [False, False]


def test_mistakes_are_told_before_anything_is_trained(sets, tmp_path):
    good, other = settings_of(sets, tmp_path / "out")
    for wrong, error, words in (
        (replace(other, minutes=0.0), InvalidInput, "minutes"),
        (replace(other, data=tmp_path), CorruptFile, "anno.json"),
        (replace(other, out=tmp_path / "block.npz"), InvalidInput, r"\.safetensors"),
    ):
        with pytest.raises(error, match=words):
            notes([good, wrong], TRAIN)
    assert not good.out.exists()


def test_one_that_cannot_be_learned_keeps_no_other_from_it(sets, tmp_path):
    opaque = write_table_set(tmp_path / "table", plain_table(), train=8, test=1, size=16)
    settings = settings_of([opaque, sets[1]], tmp_path / "out")
    with ThreadPoolExecutor(1) as executor, pytest.raises(CorruptFile, match="opaque all over"):
        notes(settings, TRAIN, executor)
    assert [one.out.exists() for one in settings] == [False, True]


@pytest.mark.slow
def test_a_worker_that_dies_is_told_and_the_next_run_goes_on(sets, tmp_path):
    settings = settings_of(sets, tmp_path)
    train = partial(training_that_dies, name="block", mark=tmp_path / "mark")
    executor = ProcessPoolExecutor(1, mp_context=get_context("spawn"))
    with executor, pytest.raises(WorkerDied, match="training a field"):
        notes(settings, train, executor)
    assert [one.out.exists() for one in settings] == [True, False]
    assert notes(settings, train)[2] == "1 of 2 trained"
    assert settings[1].out.exists()
