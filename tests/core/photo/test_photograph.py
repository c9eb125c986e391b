from dataclasses import replace

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st

from osfcore.errors import InvalidInput
from osfcore.geometry.poses import Pose, quaternion_exp
from osfcore.photo.photograph import Photograph
from tests.support.errors import about

K = np.array([[90.0, 0, 31.0], [0, 92.0, 25.0], [0, 0, 1]])
TABLE = Pose(np.array([0.1, -0.5, 0.7]), quaternion_exp(np.array([2.2, 0.1, 0.0])))


def photograph(**changed):
    image, exposed = np.random.default_rng(0).random((48, 64, 3), np.float32), np.ones((48, 64), bool)
    return replace(Photograph(image, exposed, K, TABLE, True), **changed)


def disc(radius=14.0):
    y, x = np.mgrid[:48, :64] + 0.5
    return np.hypot(x - 30, y - 22) < radius


@pytest.mark.wrong_arrays
@pytest.mark.parametrize(
    ("changed", "what"),
    [
        ({"image": np.zeros((48, 64, 3))}, "image"),
        ({"image": np.full((48, 64, 3), np.nan, np.float32)}, "radiance"),
        ({"well_exposed": np.ones((64, 48), bool)}, "exposure mask"),
        ({"intrinsics": np.diag([1.0, 1, 2])}, "K of"),
        ({"T_world_camera": Pose(np.full(3, np.nan), np.array([1.0, 0, 0, 0]))}, "pose"),
        ({"masks": {"mug": np.ones((24, 32), bool)}}, "mask of mug"),
        ({"masks": {"mug": np.zeros((48, 64), bool)}}, "mask of mug"),
        ({"masks": {"mug": np.ones((48, 64))}}, "mask of mug"),
    ],
)
def test_what_makes_no_sense_is_refused(changed, what):
    with pytest.raises(InvalidInput, check=about(what)):
        photograph(**changed)


@given(longest=st.integers(4, 64))
def test_a_smaller_photo_shows_the_same_view(longest):
    """Points are projected to the same share of the image, wherever they are."""
    whole = photograph()
    small = whole.resized(longest)
    assert max(small.width, small.height) == longest
    points = np.random.default_rng(longest).normal(size=(20, 3)) + [0, 0, 6]
    shares = [(points @ p.intrinsics.T / points[:, 2:])[:, :2] / (p.width, p.height) for p in (whole, small)]
    np.testing.assert_allclose(*shares, atol=1e-12)
    np.testing.assert_allclose(small.image.mean((0, 1)), whole.image.mean((0, 1)), atol=0.03)


def test_radiance_and_masks_are_averaged_over_areas():
    whole = photograph(well_exposed=~disc(0.8)).with_masks({"mug": disc()})
    small = whole.resized(16)
    np.testing.assert_allclose(small.image, whole.image.reshape(12, 4, 16, 4, 3).mean((1, 3)), atol=1e-6)
    shares = whole.masks["mug"].reshape(12, 4, 16, 4).mean((1, 3))
    np.testing.assert_array_equal(small.masks["mug"], shares > 0.5)
    np.testing.assert_array_equal(small.well_exposed, whole.well_exposed.reshape(12, 4, 16, 4).all((1, 3)))


@given(longest=st.integers(3, 63), seed=st.integers(0, 1000))
def test_a_pixel_is_well_exposed_only_if_all_that_it_is_made_of_is(longest, seed):
    """The number of bad pixels covers at least the area that was bad, at any ratio of sizes."""
    bad = np.random.default_rng(seed).random((48, 64)) < 0.01
    small = photograph(well_exposed=~bad).resized(longest)
    y, x = np.nonzero(bad)
    rows = (y * small.height // 48, ((y + 1) * small.height - 1) // 48)
    columns = (x * small.width // 64, ((x + 1) * small.width - 1) // 64)
    assert not any(small.well_exposed[r, c].any() for r in rows for c in columns)
    assert (~small.well_exposed).sum() <= 4 * bad.sum()


def test_a_photo_is_never_enlarged_nor_reduced_to_nothing():
    whole = photograph(masks={"pin": disc(1.0)})
    assert whole.resized(64) is whole.resized(1000) is whole
    for longest in (8, 0):
        with pytest.raises(InvalidInput, check=about("longest side")):
            whole.resized(longest)
