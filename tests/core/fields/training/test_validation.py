from dataclasses import replace

import numpy as np
import pytest

from osfcore.fields.train_osf import Holdout, dilated_mask
from osfcore.io.image_set import ImageSet, read_image_set
from tests.core.fields.rendered_sets import painted_block, write_object_set


@pytest.fixture(scope="module")
def images(tmp_path_factory) -> ImageSet:
    folder = write_object_set(tmp_path_factory.mktemp("sets") / "block", painted_block(), train=8, test=12)
    return read_image_set(folder, "test")


def nothing():
    """A field without any density: black images."""
    field = painted_block()
    return replace(field, index=np.zeros_like(field.index), rows=field.rows[:1])


def test_the_field_itself_is_nearly_perfect(images):
    look = Holdout(images).everything(painted_block())
    assert look.images == 12
    assert look.psnr_full > 33  # the images were drawn with four rays a pixel
    assert look.psnr_mask > 25
    assert look.psnr_mask < look.psnr_full


def test_psnr_is_that_of_each_image_averaged(images):
    """Against black, the error is the truth itself."""
    truth = images.rgba[..., :3] / 255 * (images.rgba[..., 3:] / 255)
    error = np.mean(truth**2, axis=-1)
    full = np.mean([-10 * np.log10(e.mean()) for e in error])
    masks = [dilated_mask(a) for a in images.rgba[..., 3]]
    inside = np.mean([-10 * np.log10(e[m].mean()) for e, m in zip(error, masks, strict=True)])
    look = Holdout(images).everything(nothing())
    assert look.psnr_full == pytest.approx(full, abs=1e-3)
    assert look.psnr_mask == pytest.approx(inside, abs=1e-3)


def test_a_glance_looks_at_a_few(images):
    look = Holdout(images).glance(painted_block())
    assert look.images == 6
    few = ImageSet(images.cameras[:2], images.light_directions[:2], images.rgba[:2])
    assert Holdout(few).glance(painted_block()).images == 2


def test_a_preview_shows_truth_ours_and_their_difference(images):
    look = Holdout(images).everything(nothing())
    assert look.preview.shape == (32, 96, 3)
    truth, ours, difference = np.split(look.preview.astype(int), 3, axis=1)
    assert truth.any()
    assert not ours.any()
    np.testing.assert_allclose(difference, np.minimum(4 * truth, 255), atol=2)


def test_a_mask_is_grown_by_two_pixels():
    alpha = np.zeros((12, 12), np.uint8)
    alpha[5, 6] = 1
    rows, columns = np.nonzero(dilated_mask(alpha))
    assert (rows.min(), rows.max(), columns.min(), columns.max()) == (3, 7, 4, 8)
    assert len(rows) == 25


def test_perfection_is_100_db(images):
    """A black object met exactly; infinity would spoil every mean and is no JSON."""
    black = images.rgba[:1] * np.uint8([0, 0, 0, 1])
    look = Holdout(ImageSet(images.cameras[:1], images.light_directions[:1], black)).everything(nothing())
    assert (look.psnr_full, look.psnr_mask) == (100, 100)
