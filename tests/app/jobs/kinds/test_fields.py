"""The job's own work, with a stand-in for the training itself; tests/app/routes/test_fields.py trains for real."""

import dataclasses
import json

import numpy as np
import pytest
from PIL import Image

import osfcore.fields.train_kiloosf as training
import osfcore.paper.train_fields as paper_training
from app.jobs.context import JobContext
from app.jobs.kinds.fields import COMPARISON, PREVIEW, FieldSource, TrainFieldParams, train_field_job
from app.storage.field_files import workshop
from osfcore.errors import MissingAssets
from osfcore.fields.field_library import FieldLibrary
from osfcore.fields.kiloosf import field_bytes
from osfcore.paper.method import own_field_path, paper_field_path
from osfcore.progress import Progress
from tests.app.processes.fields import write_box

GELATIN, NAME = "009_gelatin_box", "thing"  # there is a field of the first already
ORDER = TrainFieldParams(name=NAME, source=FieldSource(mesh=GELATIN), minutes=0.5, seed=3, images=60)
UPLOAD = FieldSource(set="abc")


def order(**changes):
    return ORDER.model_copy(update=changes)


@pytest.fixture
def place(data_dir, tmp_path):
    folder = tmp_path / "job"
    folder.mkdir()
    return JobContext(data_dir, folder)


@pytest.fixture
def weights():
    return b"weights"


@pytest.fixture
def trained(monkeypatch, weights):
    """Replaces the training; the list holds the configuration of each run."""
    runs = []

    def fake(config):
        runs.append(config)
        assert (config.data / "train" / "anno.json").is_file()
        preview = np.full((4, 12, 3), 200, np.uint8)
        yield training.FieldStep(Progress(15, 30, "20.0 dB held out, 15 s left"), 20.0, 15.0, preview)
        config.out.with_suffix(".partial").write_bytes(b"checkpoint")
        config.out.write_bytes(weights)
        config.out.with_suffix(".json").write_text(json.dumps({"psnr_full": 30.5, "psnr_mask": 25.5}))
        yield training.FieldStep(Progress(30, 30, "Done"), 30.5, 25.5, preview)

    monkeypatch.setattr(training, "train_field", fake)
    return runs


@pytest.mark.slow
def test_from_a_mesh_images_are_taken_first_and_the_field_is_put_in_place(place, trained):
    steps = list(train_field_job(ORDER, place))
    done = [step.done for step in steps]
    assert done == sorted(done)
    assert done[-1] == steps[-1].total == {step.total for step in steps}.pop()
    assert any("Image 60 of 60" in step.note for step in steps)
    halfway = next(step for step in steps if step.psnr_mask == 15.0)
    assert (halfway.previews, halfway.note[-4:]) == (1, "left")
    assert (steps[-1].psnr_full, steps[-1].psnr_mask, steps[-1].previews) == (30.5, 25.5, 2)
    installed = place.data_dir / "fields" / NAME
    assert (installed / "field.safetensors").read_bytes() == b"weights"
    assert {path.name for path in installed.iterdir()} == {"field.safetensors", "field.json"}
    with Image.open(place.folder / PREVIEW) as preview:
        assert preview.size == (12, 4)
    assert not workshop(place.data_dir, NAME).exists()
    assert (trained[0].minutes, trained[0].seed) == (0.5, 3)
    json.dumps(dataclasses.asdict(steps[-1]))


@pytest.mark.slow
def test_after_a_kill_the_same_order_uses_the_images_that_are_there(place, trained):
    first = train_field_job(ORDER, place)
    next(step for step in first if step.previews)
    first.close()
    shop = workshop(place.data_dir, NAME)
    kept = (shop / GELATIN / "train" / "anno.json").stat().st_mtime_ns
    again = train_field_job(ORDER, place)
    notes = [next(again).note, next(again).note]
    assert not any("Image" in note for note in notes)
    assert (shop / GELATIN / "train" / "anno.json").stat().st_mtime_ns == kept
    again.close()
    other = train_field_job(order(seed=4), place)
    next(other)
    assert "Image 1 of 60" in next(other).note


@pytest.mark.slow
def test_a_kill_between_training_and_putting_in_place_trains_nothing_twice(place, trained):
    first = train_field_job(ORDER, place)
    next(step for step in first if step.psnr_full == 30.5)
    first.close()
    steps = list(train_field_job(ORDER, place))
    assert len(trained) == 1
    assert steps[-1].psnr_full == 30.5
    assert (place.data_dir / "fields" / NAME / "field.json").is_file()


def test_from_a_set_no_mesh_is_needed(place, trained):
    images = place.data_dir / "sets" / "abc" / "images" / "train"
    images.mkdir(parents=True)
    (images / "anno.json").write_text("[]")
    list(train_field_job(order(name="thing", source=UPLOAD), place))
    assert trained[0].data == images.parent
    assert (place.data_dir / "fields" / "thing" / "field.safetensors").is_file()


SHIPPED = field_bytes(FieldLibrary(None).load(GELATIN))


def grey_box(folder):
    write_box(folder, GELATIN, np.array([0.03, 0.09, 0.07]), (0.5, 0.5, 0.5))
    return (folder / "fields" / GELATIN / "field.safetensors").read_bytes()


@pytest.mark.slow
@pytest.mark.parametrize("is_better", [False, True])
def test_of_two_fields_the_one_that_is_better_on_the_same_images_stays(place, monkeypatch, tmp_path, is_better):
    box = grey_box(place.data_dir if is_better else tmp_path)  # what is there, or what is new

    def fake(config):
        config.out.write_bytes(SHIPPED if is_better else box)
        config.out.with_suffix(".json").write_text(json.dumps({"psnr_full": 99.0, "psnr_mask": 99.0}))
        yield training.FieldStep(Progress(30, 30, "Done"), 99.0, 99.0, None)

    monkeypatch.setattr(training, "train_field", fake)
    steps = list(train_field_job(order(name=GELATIN), place))
    last = steps[-1]
    assert last.in_use is is_better
    assert (last.psnr_mask > last.before_mask + 3) is is_better
    assert (last.psnr_full > last.before_full) is is_better
    assert last.done == last.total == {step.total for step in steps}.pop()
    assert (place.folder / f"{GELATIN}.safetensors").is_file()  # to be used all the same
    installed = place.data_dir / "fields" / GELATIN / "field.safetensors"
    assert (installed.exists() and installed.read_bytes() == SHIPPED) is is_better
    with Image.open(place.folder / COMPARISON) as pictures:
        assert pictures.width == pictures.height  # three images, and of each the truth and both fields
        truth, before, new = (np.asarray(pictures.convert("RGB"), float)[:, n * 128 : (n + 1) * 128] for n in range(3))
    assert (np.abs(truth - new).mean() < np.abs(truth - before).mean()) == is_better


def test_a_mesh_that_is_gone_is_told(place, trained):
    with pytest.raises(MissingAssets):
        list(train_field_job(order(source=FieldSource(mesh="025_mug")), place))
    assert trained == []


def test_a_field_as_published_is_kept_beside_ours(place, monkeypatch, weights):
    def fake(config):
        config.out.write_bytes(weights)
        config.out.with_suffix(".json").write_text(json.dumps({"psnr_full": 20.5, "psnr_mask": 15.5}))
        yield training.FieldStep(Progress(30, 30, "Done"), 20.5, 15.5, None)

    monkeypatch.setattr(paper_training, "train_paper_field", fake)
    (place.data_dir / "sets" / "s1" / "images").mkdir(parents=True)
    ours = FieldLibrary(place.data_dir).stamp(GELATIN)
    published = order(name=GELATIN, source=FieldSource(set="s1"), method="paper")
    *_, last = train_field_job(published, place)
    assert (last.in_use, last.before_mask, last.psnr_mask) == (True, None, 15.5)
    assert paper_field_path(GELATIN, place.data_dir) == own_field_path(GELATIN, place.data_dir)
    assert own_field_path(GELATIN, place.data_dir).read_bytes() == weights
    assert json.loads(own_field_path(GELATIN, place.data_dir).with_suffix(".json").read_text())["psnr_full"] == 20.5
    assert FieldLibrary(place.data_dir).stamp(GELATIN) == ours
    assert not (place.folder / COMPARISON).exists()
    assert (place.folder / f"{GELATIN}.safetensors").read_bytes() == weights
