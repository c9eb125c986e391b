import json
from dataclasses import replace

import numpy as np
import pytest

from osfcore.errors import CannotWrite, CorruptFile, InvalidInput
from osfcore.fields import train_table as module
from osfcore.fields.table import TableField, read_table
from osfcore.fields.train_table import TrainTable, train_table
from tests.core.fields.rendered_sets import painted_ball, write_object_set, write_table_set
from tests.core.render.scenes import wooden_table

HALF = 0.6


def smooth_table() -> TableField:
    """Albedo that varies across the table as the trained grid can hold it."""
    x, y = np.meshgrid(*[np.linspace(-1, 1, 16)] * 2, indexing="ij")
    albedo = np.stack([0.5 + 0.2 * x, 0.5 - 0.1 * y, 0.4 + 0.1 * x * y], axis=-1).astype(np.float32)
    return replace(wooden_table(HALF), albedo=albedo)


@pytest.fixture(scope="module")
def table_set(tmp_path_factory):
    return write_table_set(tmp_path_factory.mktemp("sets") / "table", smooth_table())


@pytest.fixture(scope="module")
def trained(table_set, tmp_path_factory):
    """A table, its progress and its metrics; fewer steps than for the shipped one."""
    out = tmp_path_factory.mktemp("out") / "table.safetensors"
    steps = list(train_table(TrainTable(table_set, out, device="cpu", iterations=800, rays=2048)))
    return read_table(out), steps, json.loads(out.with_suffix(".json").read_text()), out


def test_held_out_images_are_met_within_45_db(trained):
    _, steps, metrics, out = trained
    assert metrics["psnr"] > 45
    assert (metrics["train_images"], metrics["test_images"], metrics["device"]) == (24, 4, "cpu")
    assert metrics["bytes"] == out.stat().st_size < 100_000
    assert steps[-1].done == steps[-1].total == 800
    assert "dB held out" in steps[-1].note
    assert [s.done for s in steps] == sorted(s.done for s in steps)


def test_it_darkens_as_the_light_tilts(trained):
    table = trained[0]
    elevations = np.deg2rad([90, 70, 50, 30, 10])
    lights = np.stack([np.cos(elevations), 0 * elevations, np.sin(elevations)], axis=1)
    assert np.all(np.diff(table.direct(lights), axis=0) < 0)


def test_the_direct_part_is_lambert_and_vanishes_on_the_horizon(trained):
    """No image shows a shadow, yet the two parts are told apart: under low lights only the ambient part is left."""
    table = trained[0]
    assert not table.direct(np.array([[1.0, 0, 0], [0.6, 0, -0.8]])).any()
    white = table.ambient.mean(), table.direct(np.array([[0, 0, 1.0]])).mean()
    assert white[1] / white[0] == pytest.approx(0.75 / 0.25, rel=0.1)


def test_radiance_and_background_are_those_of_the_truth(trained):
    table, truth = trained[0], smooth_table()
    light = np.array([[0.5, 0.3, np.sqrt(1 - 0.34)]])
    middle = slice(4, 12)  # the corners of the table are hardly seen
    ours = table.albedo[middle, middle] * (table.ambient + table.direct(light))
    expected = truth.albedo[middle, middle] * (truth.ambient + truth.direct(light))
    np.testing.assert_allclose(ours, expected, atol=0.01)
    np.testing.assert_allclose(table.background, truth.background, atol=0.01)


def test_sets_of_objects_and_bad_settings_are_told(tmp_path):
    objects = write_object_set(tmp_path / "ball", painted_ball(), train=8, test=1, size=16)
    with pytest.raises(CorruptFile, match="the bare table is opaque"):
        list(train_table(TrainTable(objects, tmp_path / "a.safetensors")))
    with pytest.raises(InvalidInput, match=r"ends in \.safetensors"):
        next(train_table(TrainTable(objects, tmp_path / "a.npz")))
    with pytest.raises(InvalidInput, match="device is tpu"):
        next(train_table(TrainTable(objects, tmp_path / "a.safetensors", device="tpu")))


def test_a_place_that_cannot_be_written_is_told(table_set, tmp_path):
    (tmp_path / "file").write_text("")
    with pytest.raises(CannotWrite, match="file"):
        list(train_table(TrainTable(table_set, tmp_path / "file" / "a.safetensors", device="cpu", iterations=2)))


def test_seeds_and_places_are_tried_before_anything_is_read(tmp_path):
    (tmp_path / "folder.safetensors").mkdir()
    (tmp_path / "mine.json").write_text('{"people": ["Ada"]}')
    for config, error, words in (
        (TrainTable(tmp_path, tmp_path / "a.safetensors", seed=-1), InvalidInput, "seed is -1"),
        (TrainTable(tmp_path, tmp_path / "a.safetensors", seed=2**64), InvalidInput, "seed"),
        (TrainTable(tmp_path, tmp_path / "a.safetensors", iterations=0), InvalidInput, "iterations is 0"),
        (TrainTable(tmp_path, tmp_path / "a.safetensors", rays=0), InvalidInput, "rays is 0"),
        (TrainTable(tmp_path, tmp_path / "folder.safetensors"), CannotWrite, "it is a folder"),
        (TrainTable(tmp_path, tmp_path / "mine.safetensors"), InvalidInput, "mine.json beside it"),
    ):
        with pytest.raises(error, match=words):
            next(train_table(config))
    assert len(list(tmp_path.iterdir())) == 2


def test_a_table_that_cannot_be_read_back_leaves_the_older_one(table_set, tmp_path, monkeypatch):
    monkeypatch.setattr(module, "table_bytes", lambda table: b"broken")
    out = tmp_path / "a.safetensors"
    out.write_bytes(b"older")
    with pytest.raises(CorruptFile, match="The trained table cannot be used"):
        list(train_table(TrainTable(table_set, out, device="cpu", iterations=2)))
    assert out.read_bytes() == b"older"
