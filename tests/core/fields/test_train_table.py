import json
from dataclasses import replace

import numpy as np
import pytest

from osfcore.errors import CannotWrite, CorruptFile, InvalidInput
from osfcore.fields.table import TableField, read_table
from osfcore.fields.train_table import TrainTable, train_table
from tests.support.errors import about
from tests.support.rendered_scenes import wooden_table
from tests.support.rendered_sets import painted_ball, write_object_set, write_table_set


def smooth_table() -> TableField:
    """Albedo that varies across the table as the trained grid can hold it."""
    x, y = np.meshgrid(*[np.linspace(-1, 1, 16)] * 2, indexing="ij")
    albedo = np.stack([0.5 + 0.2 * x, 0.5 - 0.1 * y, 0.4 + 0.1 * x * y], axis=-1).astype(np.float32)
    return replace(wooden_table(0.6), albedo=albedo)


@pytest.fixture(scope="module")
def trained(tmp_path_factory):
    """A table, its progress and its metrics; fewer steps than for the shipped one."""
    data = write_table_set(tmp_path_factory.mktemp("sets") / "table", smooth_table())
    out = tmp_path_factory.mktemp("out") / "table.safetensors"
    steps = list(train_table(TrainTable(data, out, device="cpu", iterations=500, rays=2048)))
    return read_table(out), steps, json.loads(out.with_suffix(".json").read_text()), out


def test_held_out_images_are_met_within_45_db(trained):
    _, steps, metrics, out = trained
    assert metrics["psnr"] > 45
    assert (metrics["train_images"], metrics["test_images"], metrics["device"]) == (24, 4, "cpu")
    assert metrics["bytes"] == out.stat().st_size < 100_000
    assert steps[-1].done == steps[-1].total == 500
    assert [s.done for s in steps] == sorted(s.done for s in steps)


def test_the_direct_part_is_lambert_and_vanishes_on_the_horizon(trained):
    """No image shows a shadow, yet the two parts are kept apart: under low lights only the ambient part is left."""
    table = trained[0]
    elevations = np.deg2rad([90, 70, 50, 30, 10])
    lights = np.stack([np.cos(elevations), 0 * elevations, np.sin(elevations)], axis=1)
    assert np.all(np.diff(table.direct(lights), axis=0) < 0)
    assert not table.direct(np.array([[1.0, 0, 0], [0.6, 0, -0.8]])).any()
    assert table.direct(lights[:1]).mean() / table.ambient.mean() == pytest.approx(0.75 / 0.25, rel=0.1)


def test_radiance_and_background_are_those_of_the_truth(trained):
    table, truth = trained[0], smooth_table()
    light = np.array([[0.5, 0.3, np.sqrt(1 - 0.34)]])
    middle = slice(4, 12)  # the corners of the table are hardly seen
    ours = table.albedo[middle, middle] * (table.ambient + table.direct(light))
    expected = truth.albedo[middle, middle] * (truth.ambient + truth.direct(light))
    np.testing.assert_allclose(ours, expected, atol=0.01)
    np.testing.assert_allclose(table.background, truth.background, atol=0.01)


def test_sets_of_objects_and_settings_out_of_range_are_refused(tmp_path):
    objects = write_object_set(tmp_path / "ball", painted_ball(), train=8, test=1, size=16)
    config = TrainTable(objects, tmp_path / "a.safetensors")
    with pytest.raises(CorruptFile):
        list(train_table(config))
    for name, value in (("seed", -1), ("seed", 2**64), ("iterations", 0), ("rays", 0), ("device", "tpu")):
        with pytest.raises(InvalidInput, check=about(name)):
            next(train_table(replace(config, **{name: value})))
    (tmp_path / "folder.safetensors").mkdir()
    (tmp_path / "mine.json").write_text('{"people": ["Ada"]}')
    for name, error in (
        ("a.npz", InvalidInput),
        ("folder.safetensors", CannotWrite),
        ("mine.safetensors", InvalidInput),
    ):
        with pytest.raises(error):
            next(train_table(replace(config, out=tmp_path / name)))
    assert len(list(tmp_path.iterdir())) == 3
