import numpy as np
import pytest

from osfcore.errors import InvalidInput
from osfcore.geometry.poses import Pose
from osfcore.photo.photograph import Photograph
from osfcore.photo.pose_loss import object_windows, signed_distance

K = np.array([[200.0, 0, 64], [0, 200, 48], [0, 0, 1]])


def photo(**masks):
    image = np.random.default_rng(0).uniform(size=(96, 128, 3)).astype(np.float32)
    return Photograph(image, np.ones((96, 128), bool), K, Pose.identity(), False, masks)


def rectangle(top, bottom, left, right):
    mask = np.zeros((96, 128), bool)
    mask[top:bottom, left:right] = True
    return mask


def test_a_window_looks_along_the_same_rays():
    window = object_windows([photo(a=rectangle(30, 60, 40, 60))], "a", 15)[0]
    point = np.array([0.02, -0.01, 0.5])
    pixel, own = K @ point, window.intrinsics @ point
    frame = window.frame
    scale = np.array([frame.width, frame.height]) / [frame.right - frame.left, frame.bottom - frame.top]
    np.testing.assert_allclose(own[:2] / own[2], (pixel[:2] / pixel[2] - [frame.left, frame.top]) * scale, atol=1e-12)


def test_what_another_object_may_hide_is_not_known():
    window = object_windows([photo(a=rectangle(30, 60, 40, 60), b=rectangle(30, 60, 60, 80))], "a", 100)[0]
    columns = np.arange(window.size[1]) + window.frame.left
    assert not window.known[15, (columns >= 61) & (columns < 70)].any()
    assert window.known[window.mask].all()


def test_what_lies_beyond_the_photo_is_not_known():
    window = object_windows([photo(a=rectangle(0, 40, 40, 60))], "a", 100)[0]
    rows = np.arange(window.size[0]) + window.frame.top
    assert not window.known[rows < 0].any()
    assert window.cut > 0.1


def test_an_object_within_the_photo_is_not_cut():
    assert object_windows([photo(a=rectangle(30, 60, 40, 60))], "a", 100)[0].cut == 0


def test_distances_to_a_straight_border():
    distances = signed_distance(rectangle(0, 96, 0, 64))
    np.testing.assert_allclose(
        distances[50], np.concatenate([np.arange(64, 0, -1) - 0.5, -(np.arange(64) + 0.5)]), atol=1e-12
    )


def test_an_object_without_a_mask_is_told():
    with pytest.raises(InvalidInput, match="mask of mug is missing"):
        object_windows([photo(a=rectangle(30, 60, 40, 60))], "mug", 40)


def test_a_mask_of_few_pixels_is_told():
    with pytest.raises(InvalidInput, match="size of the mask of a is 4 pixels"):
        object_windows([photo(a=rectangle(30, 32, 40, 42))], "a", 40)
