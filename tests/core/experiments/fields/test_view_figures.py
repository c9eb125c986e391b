from dataclasses import replace

import numpy as np
import pytest

from osfcore.experiments.fields import compare_views
from osfcore.fields.train_osf import Holdout
from osfcore.io.image_file import to_uint8
from osfcore.io.image_set import read_image_set
from osfcore.metrics.image_errors import dilated, psnr
from osfcore.render.reference import solid_field
from tests.core.fields.sets import CENTRE, HALF, write_set


@pytest.fixture(scope="module")
def images(tmp_path_factory):
    return read_image_set(write_set(tmp_path_factory.mktemp("views") / "egg", test=6, size=48), "test")


@pytest.fixture(scope="module")
def egg():
    """The ellipsoid of those images as a field, where the images have it."""

    def depth(x):
        return (1 - np.linalg.norm(x / HALF, axis=-1)) * HALF.min()

    def normal(x):
        n = x / HALF**2
        return n / np.maximum(np.linalg.norm(n, axis=-1, keepdims=True), 1e-9)

    field = solid_field(depth, normal, HALF, (0.8, 0.5, 0.3), voxel=0.02, hidden=16)
    return replace(field, origin=(field.origin + CENTRE).astype(np.float32))


def test_the_right_field_is_close_and_a_shifted_one_is_not(images, egg):
    right = list(compare_views(egg, images))
    assert len(right) == 6
    assert np.mean([view.psnr_full for view in right]) > 28
    assert np.mean([view.ssim for view in right]) > 0.9
    shifted = replace(egg, origin=egg.origin + np.float32(0.1))
    wrong = list(compare_views(shifted, images))
    for a, b in zip(right, wrong, strict=True):
        assert b.psnr_mask < a.psnr_mask - 6
        assert b.ssim < a.ssim


def test_figures_agree_with_those_that_training_tells(images, egg):
    views = list(compare_views(egg, images))
    look = Holdout(images).everything(egg)
    assert np.mean([view.psnr_full for view in views]) == pytest.approx(look.psnr_full, abs=0.3)
    assert np.mean([view.psnr_mask for view in views]) == pytest.approx(look.psnr_mask, abs=0.3)


def test_truth_is_premultiplied_over_black_and_figures_follow_from_the_images(images, egg):
    rgba = images.rgba.copy()
    rgba[..., :3] = 200
    rgba[..., 3] //= 2
    half = replace(images, rgba=rgba)
    for view, alpha in zip(compare_views(egg, half), rgba[..., 3], strict=True):
        expected = 200 * (alpha / 255)
        np.testing.assert_allclose(view.comparison.truth[..., 0], expected, atol=0.51)
        truth, ours = view.comparison.truth / 255, view.comparison.ours / 255
        assert view.psnr_mask == pytest.approx(psnr(truth, ours, dilated(alpha > 0)), abs=0.1)
        assert view.psnr_full == pytest.approx(psnr(truth, ours), abs=0.1)
        assert to_uint8(truth).max() == 100  # 200 * 127 / 255
