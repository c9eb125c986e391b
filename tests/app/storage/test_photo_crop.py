"""Cutting a goal image out of a photo: in the photo's own pixels, without shifts, turned about the middle."""

from dataclasses import replace

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st

from app.storage.photo_crop import GOAL_SIDE, PhotoCrop, central_crop, check_crop, cut_out
from app.storage.photos import Photo
from osfcore.errors import InvalidInput
from osfcore.geometry.cameras import goal_camera

CAMERA = goal_camera(64)
WIDE = replace(CAMERA, height=32)
SIZES = st.integers(40, 5000)


def noise(width, height):
    return np.random.default_rng(0).integers(0, 256, (height, width, 3), np.uint8)


def ramp(width, height, full_width):
    """Each pixel's own place in a photo of which this is a smaller copy, red across and green down [px / 20]."""
    scale = full_width / width
    pixels = np.zeros((height, width, 3), np.uint8)
    pixels[..., 0] = (np.arange(width) + 0.5) * scale / 20
    pixels[..., 1] = ((np.arange(height) + 0.5) * scale / 20)[:, None]
    return pixels


@given(width=SIZES, height=SIZES, camera=st.sampled_from([CAMERA, WIDE]))
def test_the_central_crop_touches_two_borders_and_is_always_allowed(width, height, camera):
    crop = central_crop(width, height, camera)
    check_crop(replace(crop, width=max(crop.width, 64)), max(width, 128), max(height, 128), camera)
    assert min(crop.left, crop.top) == pytest.approx(0, abs=1e-6)
    assert crop.left * 2 + crop.width == pytest.approx(width)
    assert crop.top * 2 + crop.width * camera.height / camera.width == pytest.approx(height)


def test_a_whole_square_photo_stays_as_it_is():
    pixels = noise(200, 200)
    np.testing.assert_array_equal(cut_out(Photo(pixels, 200, 200), PhotoCrop(0, 0, 200), CAMERA), pixels)


def test_a_part_is_cut_out_to_the_pixel():
    pixels = noise(200, 150)
    seen = cut_out(Photo(pixels, 200, 150), PhotoCrop(30, 20, 64), WIDE)
    np.testing.assert_array_equal(seen, pixels[20:52, 30:94])


@pytest.mark.parametrize("quarters", [1, 2, 3])
def test_quarter_turns_are_exact(quarters):
    pixels = noise(100, 100)
    seen = cut_out(Photo(pixels, 100, 100), PhotoCrop(0, 0, 100, 90.0 * quarters), CAMERA)
    np.testing.assert_array_equal(seen, np.rot90(pixels, quarters))


@given(left=st.floats(0, 1500), top=st.floats(0, 500), width=st.floats(100, 2500), turn=st.floats(-30, 30))
def test_places_are_those_of_the_photo_as_it_was_sent(left, top, width, turn):
    """The photo had 4000 x 3000 pixels, of which a quarter as many a side are kept."""
    photo = Photo(ramp(1000, 750, 4000), 4000, 3000)
    seen = cut_out(photo, PhotoCrop(left, top, width, turn), CAMERA)
    assert seen.shape[0] == seen.shape[1] <= GOAL_SIDE
    middle = (
        seen[len(seen) // 2 - 1 : len(seen) // 2 + 1].mean(axis=0)[len(seen) // 2 - 1 : len(seen) // 2 + 1].mean(axis=0)
    )
    assert middle[:2] * 20 == pytest.approx([left + width / 2, top + width / 2], abs=45)


@pytest.mark.parametrize(
    ("crop", "words"),
    [
        (PhotoCrop(-5, 0, 100), "-5 to 95 across"),
        (PhotoCrop(150, 0, 100), "within the photo's 200 x 150"),
        (PhotoCrop(0, 60, 100), "60 to 160 down"),
        (PhotoCrop(0, 0, 20), "20 x 20.*at least 32"),
        (PhotoCrop(0, 0, 100, 200), "200"),
        (PhotoCrop(0, 0, 100, float("nan")), "nan"),
    ],
)
def test_what_cannot_be_cut_out_is_told_in_the_photos_pixels(crop, words):
    with pytest.raises(InvalidInput, match=words):
        check_crop(crop, 200, 150, CAMERA)
