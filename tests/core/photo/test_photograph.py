import numpy as np
import pytest

from osfcore.errors import InvalidInput
from osfcore.photo.photograph import Photograph

K = np.array([[200.0, 0, 64], [0, 200, 48], [0, 0, 1]])


def photograph(height=96, width=128, **changes):
    arguments = {"image": np.full((height, width, 3), 0.4, np.float32), "well_exposed": np.ones((height, width), bool)}
    return Photograph(**{**arguments, "intrinsics": K, **changes})


def test_a_reduced_photograph_sees_the_same_rays():
    point = np.array([0.03, -0.02, 0.5])
    photo = photograph(192, 256, masks={"a": np.ones((192, 256), bool)})
    small = photo.reduced(128)
    assert small.image.shape == (96, 128, 3)
    whole, half = (K @ point, small.intrinsics @ point)
    np.testing.assert_allclose(half[:2] / half[2], whole[:2] / whole[2] / 2)
    assert small.masks["a"].all()
    assert small.well_exposed.all()


def test_a_small_photograph_is_not_enlarged():
    photo = photograph()
    assert photo.reduced(5000) is photo


@pytest.mark.parametrize(
    ("changes", "sentence"),
    [
        ({"masks": {"mug": np.zeros((96, 128), bool)}}, "mask of mug is empty"),
        ({"masks": {"mug": np.ones((95, 128), bool)}}, "size of the mask of mug is 128 x 95 pixels"),
        ({"intrinsics": np.diag([-1.0, 1, 1])}, "K of the photo is"),
        ({"intrinsics": np.full((3, 3), np.nan)}, "K of the photo is"),
    ],
)
def test_mistakes_are_told(changes, sentence):
    with pytest.raises(InvalidInput, match=sentence):
        photograph(**changes)


def test_a_tiny_photograph_is_refused():
    with pytest.raises(InvalidInput, match="size of the photo is 20 x 20 pixels"):
        photograph(20, 20)
