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
from osfcore.fields.train_several import train_several
from tests.clusters import training_that_dies
from tests.support.errors import about
from tests.support.rendered_scenes import plain_table
from tests.support.rendered_sets import QUICK, painted_ball, painted_block, write_object_set, write_table_set

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


def done_before(settings, train=TRAIN) -> int:
    """How many trainings an earlier run has finished; the rest is trained."""
    steps = list(train_several(settings, train))
    return int(steps[len(settings)].note.split()[0])


def metrics(settings: TrainField) -> dict:
    return json.loads(settings.out.with_suffix(".json").read_text())


def test_each_becomes_what_it_becomes_alone_wherever_it_is_trained(sets, tmp_path):
    alone, here, beside, elsewhere = (settings_of(sets, tmp_path / name) for name in "abcd")
    for one in alone:
        list(TRAIN(one))
    steps = list(train_several(here, TRAIN))
    with ThreadPoolExecutor(1) as executor:
        notes(beside, TRAIN, executor)
        notes(elsewhere, TRAIN, executor, shares_disk=False)
    assert (steps[-1].done, steps[-1].total) == (20, 20)
    assert [step.done for step in steps] == sorted(step.done for step in steps)
    for settings in (here, beside, elsewhere):
        for one, other in zip(settings, alone, strict=True):  # sums depend on how arrays lie in memory
            assert metrics(one)["psnr_full"] == pytest.approx(metrics(other)["psnr_full"], abs=0.1)
            np.testing.assert_allclose(read_field(one.out).networks, read_field(other.out).networks, atol=0.02)
            assert set(metrics(one)) == {*metrics(other), "made_of"}
        names = sorted(path.name for path in settings[0].out.parent.iterdir())
        assert names == ["ball.json", "ball.safetensors", "block.json", "block.safetensors"]


def test_what_is_finished_is_trained_again_only_where_something_has_changed(sets, tmp_path):
    moved = [shutil.copytree(one, tmp_path / "sets" / one.name) for one in sets]
    settings = settings_of(moved, tmp_path / "out")
    ball, block = settings
    assert done_before(settings[:1]) == 0
    assert done_before(settings) == 1
    assert done_before(settings_of(sets, tmp_path / "out")) == 2
    assert done_before([ball, replace(block, seed=1)]) == 1
    block.out.write_bytes(ball.out.read_bytes())
    assert done_before(settings) == 1
    anno = moved[0] / "train" / "anno.json"
    entries = json.loads(anno.read_text())
    entries[3]["light_pos"] = [0, 0, 1]
    anno.write_text(json.dumps(entries))
    assert done_before(settings) == 1


def test_mistakes_are_found_before_anything_is_trained(sets, tmp_path):
    good, other = settings_of(sets, tmp_path / "out")
    for wrong, error, subject in (
        (replace(other, minutes=0.0), InvalidInput, "minutes"),
        (replace(other, data=tmp_path), CorruptFile, "anno.json"),
        (replace(other, out=tmp_path / "block.npz"), InvalidInput, "output"),
    ):
        with pytest.raises(error, check=about(subject)):
            notes([good, wrong], TRAIN)
    assert not good.out.exists()


def test_one_that_cannot_be_learned_keeps_no_other_from_it(sets, tmp_path):
    opaque = write_table_set(tmp_path / "table", plain_table(), train=8, test=1, size=16)
    settings = settings_of([opaque, sets[1]], tmp_path / "out")
    with ThreadPoolExecutor(1) as executor, pytest.raises(CorruptFile):
        notes(settings, TRAIN, executor)
    assert [one.out.exists() for one in settings] == [False, True]


@pytest.mark.slow
def test_after_a_worker_has_died_the_next_run_goes_on(sets, tmp_path):
    settings = settings_of(sets, tmp_path)
    train = partial(training_that_dies, name="block", mark=tmp_path / "mark")
    executor = ProcessPoolExecutor(1, mp_context=get_context("spawn"))
    with executor, pytest.raises(WorkerDied):
        notes(settings, train, executor)
    assert [one.out.exists() for one in settings] == [True, False]
    assert done_before(settings, train) == 1
    assert settings[1].out.exists()
