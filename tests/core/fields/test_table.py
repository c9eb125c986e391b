import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st
from safetensors.numpy import load, save

from osfcore.errors import CorruptFile
from osfcore.fields.kiloosf import FORMAT
from osfcore.fields.table import TABLE_FORMAT, TableField, read_table, write_table
from tests.core.render.scenes import wooden_table

NAMES = ("albedo", "ambient", "background", "w1", "b1", "w2", "b2")


def random_table(seed: int = 0) -> TableField:
    rng = np.random.default_rng(seed)
    shapes = {
        "albedo": (5, 5, 3),
        "ambient": (3,),
        "background": (3,),
        "w1": (3, 6),
        "b1": (6,),
        "w2": (6, 3),
        "b2": (3,),
    }
    return TableField(0.6, **{name: rng.normal(size=shape).astype(np.float32) for name, shape in shapes.items()})


def refused(path, data: bytes, match: str) -> None:
    path.write_bytes(data)
    with pytest.raises(CorruptFile, match=match):
        read_table(path)


def repacked(tmp_path, meta=TABLE_FORMAT, **changes) -> bytes:
    write_table(tmp_path / "good.safetensors", random_table())
    tensors = load((tmp_path / "good.safetensors").read_bytes()) | changes
    return save({n: np.array(t, order="C") for n, t in tensors.items() if t is not None}, metadata={"format": meta})


def test_what_was_written_is_read(tmp_path):
    table, path = random_table(), tmp_path / "table.safetensors"
    assert write_table(path, table) == path.stat().st_size
    back = read_table(path)
    assert back.half_side == table.half_side
    for name in NAMES:
        np.testing.assert_array_equal(getattr(back, name), getattr(table, name))


@given(seed=st.integers(0, 10**6))
def test_the_direct_part_is_never_negative_and_fades_with_the_lights_height(seed):
    rng = np.random.default_rng(seed)
    table, lights = random_table(seed), rng.normal(size=(20, 3))
    lights /= np.linalg.norm(lights, axis=1, keepdims=True)
    direct = table.direct(lights)
    assert direct.dtype == np.float32
    assert np.all(direct >= 0)
    assert not direct[lights[:, 2] <= 0].any()
    # Whatever was learned: lz times something bounded.
    bound = np.abs(table.w2).sum(0) * (np.abs(table.w1).sum() + np.abs(table.b1).max()) + np.abs(table.b2)
    assert np.all(direct <= np.maximum(lights[:, 2:], 0) * bound + 1e-6)


def test_the_network_is_the_one_that_is_written_down():
    table, light = random_table(3), np.array([[0.2, 0.3, 0.9]])
    hidden = np.maximum(light @ table.w1 + table.b1, 0)
    np.testing.assert_allclose(table.direct(light), np.maximum(hidden @ table.w2 + table.b2, 0) * 0.9, rtol=1e-5)
    np.testing.assert_allclose(wooden_table().direct(light), [[0.675] * 3], rtol=1e-5)


def test_files_that_are_no_tables_are_refused(tmp_path):
    path, good = tmp_path / "a.safetensors", repacked(tmp_path)
    for length in (0, 5, 8, 100, len(good) - 1):
        refused(path, good[:length], "not a whole safetensors file")
    refused(path, repacked(tmp_path, meta=FORMAT), f"format is {FORMAT}; this version reads {TABLE_FORMAT}")
    refused(path, repacked(tmp_path, meta="table-0"), "table-0")
    with pytest.raises(CorruptFile, match="cannot be read"):
        read_table(tmp_path / "none.safetensors")


@pytest.mark.parametrize("name", [*NAMES, "half_side"])
def test_missing_tensors_are_told(tmp_path, name):
    refused(tmp_path / "a.safetensors", repacked(tmp_path, **{name: None}), f"not a sound table.*{name}")


@pytest.mark.parametrize("name", NAMES)
@pytest.mark.parametrize("change", ["nan", "scalar", "empty", "longer", "deeper"])
def test_tensors_of_another_shape_or_with_nan_are_told(tmp_path, name, change):
    tensor = getattr(random_table(), name)
    other = {
        "nan": np.full_like(tensor, np.nan),
        "scalar": np.float32(1).reshape(()),
        "empty": tensor[:0],
        "longer": np.concatenate([tensor, tensor]),
        "deeper": tensor[..., None],
    }[change]
    refused(tmp_path / "a.safetensors", repacked(tmp_path, **{name: other}), "shape|not a sound table")


@pytest.mark.parametrize("half_side", [0.0, -1.0, 1e9, np.nan])
def test_silly_sizes_are_told(tmp_path, half_side):
    refused(tmp_path / "a.safetensors", repacked(tmp_path, half_side=np.array([half_side])), "half_side is")


def test_an_albedo_of_one_point_cannot_be_interpolated(tmp_path):
    refused(tmp_path / "a.safetensors", repacked(tmp_path, albedo=np.ones((1, 1, 3), np.float32)), "albedo has shape")
