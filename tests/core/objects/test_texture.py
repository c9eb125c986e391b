import cv2
import numpy as np
import pytest

from osfcore.objects.mesh import clean_texture, coverage

SQUARE_UV = np.array([[0.25, 0.25], [0.75, 0.25], [0.75, 0.75], [0.25, 0.75]])
SQUARE = np.array([[0, 1, 2], [0, 2, 3]])


def test_coverage_of_a_square():
    mask = coverage(SQUARE_UV, SQUARE, 64, 64)
    assert mask[20:44, 20:44].all()
    assert not mask[:14].any()
    assert not mask[50:].any()
    assert int(mask.sum()) == pytest.approx(32 * 32, rel=0.1)


def test_coverage_counts_v_upwards():
    uv = np.array([[0.0, 0.8], [1.0, 0.8], [0.5, 1.0]])
    mask = coverage(uv, np.array([[0, 1, 2]]), 50, 50)
    assert mask[:10].any()
    assert not mask[12:].any()


def test_black_background_never_reaches_any_mip_level():
    texture = np.zeros((256, 256, 3), np.uint8)
    texture[64:192, 64:192] = (200, 150, 100)
    clean = clean_texture(texture, SQUARE_UV, SQUARE)
    level = clean.astype(np.float32)
    while min(level.shape[:2]) > 1:
        assert np.abs(level - (200, 150, 100)).max() <= 2
        level = cv2.resize(level, None, fx=0.5, fy=0.5, interpolation=cv2.INTER_AREA)


def test_covered_texels_stay_as_they_are():
    texture = np.random.default_rng(0).integers(0, 256, (128, 128, 3), dtype=np.uint8)
    clean = clean_texture(texture, SQUARE_UV, SQUARE)
    np.testing.assert_array_equal(clean[34:94, 34:94], texture[34:94, 34:94])


def test_reduction_keeps_means_inside_and_ignores_outside():
    texture = np.zeros((512, 512, 3), np.uint8)
    texture[128:384, 128:384] = np.random.default_rng(1).integers(0, 256, (256, 256, 3))
    clean = clean_texture(texture, SQUARE_UV, SQUARE, max_side=128)
    assert clean.shape == (128, 128, 3)
    expected = cv2.resize(texture.astype(np.float32), (128, 128), interpolation=cv2.INTER_AREA)
    np.testing.assert_allclose(clean[36:92, 36:92], expected[36:92, 36:92], atol=0.51)
    assert clean.min() > 20  # the black background is gone


def test_uncovered_or_oblong_textures_are_fine():
    texture = np.full((3, 7, 3), 9, np.uint8)
    outside = np.full((4, 2), 0.5)
    assert clean_texture(texture, outside, np.zeros((0, 3), int)).shape == (3, 7, 3)
    assert (clean_texture(texture, SQUARE_UV, SQUARE) == 9).all()


def test_a_chart_thinner_than_its_rim_keeps_a_colour():
    texture = np.zeros((64, 64, 3), np.uint8)
    texture[31:33] = 200
    uv = np.array([[0.0, 0.5], [1.0, 0.5], [1.0, 0.51]])
    clean = clean_texture(texture, uv, np.array([[0, 1, 2]]))
    assert clean[31:33].max() == 200
