import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st
from safetensors.numpy import load, save

from osfcore.errors import CorruptFile
from osfcore.fields.kiloosf import FORMAT
from osfcore.fields.table import TABLE_FORMAT, TableField, read_table, table_bytes, table_from_bytes, write_table
from tests.support.rendered_scenes import wooden_table

SHAPES = {"albedo": (5, 5, 3), "ambient": (3,), "background": (3,), "w1": (3, 6), "b1": (6,), "w2": (6, 3), "b2": (3,)}


def random_table(seed: int = 0) -> TableField:
    rng = np.random.default_rng(seed)
    return TableField(0.6, **{name: rng.normal(size=shape).astype(np.float32) for name, shape in SHAPES.items()})


def is_refused(meta=TABLE_FORMAT, **changes) -> bool:
    """Whether a file with some tensors changed, or left out where they are None, is refused."""
    tensors = load(table_bytes(random_table())) | changes
    kept = {name: np.array(t, order="C") for name, t in tensors.items() if t is not None}
    try:
        table_from_bytes(save(kept, metadata={"format": meta}), "it")
    except CorruptFile:
        return True
    return False


def test_what_was_written_is_read(tmp_path):
    table, path = random_table(), tmp_path / "table.safetensors"
    write_table(path, table)
    back = read_table(path)
    assert back.half_side == table.half_side
    for name in SHAPES:
        np.testing.assert_array_equal(getattr(back, name), getattr(table, name))
    for length in (0, 5, 8, 100, path.stat().st_size - 1):
        with pytest.raises(CorruptFile):
            table_from_bytes(path.read_bytes()[:length], path)
    with pytest.raises(CorruptFile):
        read_table(tmp_path / "none.safetensors")


@given(seed=st.integers(0, 10**6))
def test_the_direct_part_is_never_negative_and_fades_with_the_lights_height(seed):
    rng = np.random.default_rng(seed)
    table, lights = random_table(seed), rng.normal(size=(20, 3))
    lights /= np.linalg.norm(lights, axis=1, keepdims=True)
    direct = table.direct(lights)
    assert direct.dtype == np.float32
    assert np.all(direct >= 0)
    # Whatever was learned: lz times something bounded.
    bound = np.abs(table.w2).sum(0) * (np.abs(table.w1).sum() + np.abs(table.b1).max()) + np.abs(table.b2)
    assert np.all(direct <= np.maximum(lights[:, 2:], 0) * bound + 1e-6)


def test_the_network_is_the_one_that_is_written_down():
    table, light = random_table(3), np.array([[0.2, 0.3, 0.9]])
    hidden = np.maximum(light @ table.w1 + table.b1, 0)
    np.testing.assert_allclose(table.direct(light), np.maximum(hidden @ table.w2 + table.b2, 0) * 0.9, rtol=1e-5)
    np.testing.assert_allclose(wooden_table().direct(light), [[0.675] * 3], rtol=1e-5)


@pytest.mark.parametrize("name", SHAPES)
def test_missing_tensors_and_those_of_another_shape_or_with_nan_are_refused(name):
    tensor = getattr(random_table(), name)
    scalar, longer = np.float32(1).reshape(()), np.concatenate([tensor, tensor])
    for other in (None, np.full_like(tensor, np.nan), scalar, tensor[:0], longer, tensor[..., None]):
        assert is_refused(**{name: other})


def test_other_formats_and_sizes_that_make_no_sense_are_refused():
    assert not is_refused()
    assert is_refused(meta=FORMAT)
    assert is_refused(meta="table-0")
    assert is_refused(half_side=None)
    for half_side in (0.0, -1.0, 1e9, np.nan):
        assert is_refused(half_side=np.array([half_side]))
    assert is_refused(albedo=np.ones((1, 1, 3), np.float32))  # one point cannot be interpolated
