import numpy as np
import pytest

from osfcore.world.imaging import TABLE_ALBEDO, wooden_texture


@pytest.fixture(scope="module")
def wood():
    return wooden_texture(np.random.default_rng(0), 512)


def test_wood_is_an_albedo_as_bright_as_the_usual_table(wood):
    assert wood.shape == (512, 512, 3)
    assert wood.dtype == np.float32
    assert wood.min() > 0
    assert wood.max() < 1
    np.testing.assert_allclose(wood.mean(axis=(0, 1)), TABLE_ALBEDO, atol=1e-3)


def test_the_same_generator_draws_the_same_wood(wood):
    np.testing.assert_array_equal(wood, wooden_texture(np.random.default_rng(0), 512))
    assert np.abs(wood - wooden_texture(np.random.default_rng(1), 512)).mean() > 0.02


def test_grain_runs_along_the_boards(wood):
    along, across = (np.abs(np.diff(wood, axis=axis)).mean() for axis in (1, 0))
    assert across > 4 * along
    assert 0.05 < wood.std() < 0.15


def test_boards_are_parted_by_dark_joints(wood):
    rows = wood.mean(axis=(1, 2))
    assert ((rows < 0.6 * rows.mean()) & (np.roll(rows, -1) > 0.8 * rows.mean())).sum() == 10
