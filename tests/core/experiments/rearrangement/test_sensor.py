import cv2
import numpy as np
import pytest

from osfcore.estimation.camera_response import srgb_of_linear
from osfcore.experiments.factors import CameraError, received, resized_masks
from osfcore.geometry.cameras import Camera
from osfcore.geometry.poses import rotation_angle

IMAGE = cv2.GaussianBlur(np.random.default_rng(0).uniform(0, 1, (48, 64, 3)), (0, 0), 2).astype(np.float32)
CAMERA = Camera.look_at("above", (0, 0, 0.9), (0, 0, 0))


def rng() -> np.random.Generator:
    return np.random.default_rng(5)


def test_without_a_change_an_image_only_saturates():
    np.testing.assert_array_equal(received(IMAGE, "none", rng()), IMAGE)
    np.testing.assert_array_equal(received(3 * IMAGE, "none", rng()), np.minimum(3 * IMAGE, 1))


def test_noise_has_the_stated_size_and_is_another_one_each_time():
    grey, generator = np.full((128, 128, 3), 0.5, np.float32), rng()
    first, second = (received(grey, "noise", generator) - grey for _ in range(2))
    assert first.mean() == pytest.approx(0, abs=5e-4)
    assert first.std() == pytest.approx(0.02, rel=0.02)
    assert abs(np.corrcoef(first.ravel(), second.ravel())[0, 1]) < 0.02
    assert received(np.zeros_like(grey), "noise", rng()).min() == 0
    assert received(np.ones_like(grey), "noise", rng()).max() == 1


def test_jpeg_is_what_decoding_a_jpeg_file_gives(tmp_path):
    path = str(tmp_path / "image.jpg")
    eight_bit = np.round(255 * IMAGE).astype(np.uint8)
    cv2.imwrite(path, eight_bit[..., ::-1], [cv2.IMWRITE_JPEG_QUALITY, 80])
    from_file = cv2.imread(path)[..., ::-1] / 255
    seen = received(IMAGE, "jpeg", rng())
    np.testing.assert_allclose(seen, from_file, atol=1e-6)
    assert 0.002 < np.abs(seen - IMAGE).mean() < 0.02


def test_undecoded_srgb_is_brighter_and_decoded_srgb_is_off_by_half_a_level():
    raw, decoded = (received(IMAGE, change, rng()) for change in ("srgb_8bit", "srgb_8bit_decoded"))
    np.testing.assert_allclose(255 * raw, np.round(255 * raw), atol=1e-4)
    np.testing.assert_allclose(raw, srgb_of_linear(IMAGE), atol=0.51 / 255)
    assert np.all(raw >= IMAGE - 0.01)
    steepest = 2.4 / 1.055  # of the decoding, at white
    np.testing.assert_allclose(decoded, IMAGE, atol=0.51 / 255 * steepest)
    assert len(np.unique(decoded)) <= 256


@pytest.mark.parametrize("change", ["none", "noise", "jpeg", "srgb_8bit", "srgb_8bit_decoded"])
def test_every_change_leaves_float32_in_range(change):
    seen = received(1.4 * IMAGE, change, rng())
    assert seen.dtype == np.float32
    assert seen.shape == IMAGE.shape
    assert seen.min() >= 0
    assert seen.max() <= 1


@pytest.fixture
def masks():
    """Two views of two objects, one of which is cut by the image's border."""
    masks = np.zeros((2, 2, 32, 40), bool)
    masks[:, 0, 10:20, 12:25] = True
    masks[1, 1, 5:15, 0:9] = True
    return masks


def test_larger_masks_reach_exactly_two_pixels_farther(masks):
    larger = resized_masks(masks, 2)
    for before, after in zip(masks.reshape(4, 32, 40), larger.reshape(4, 32, 40), strict=True):
        if not before.any():
            assert not after.any()
            continue
        away = cv2.distanceTransform(1 - before.astype(np.uint8), cv2.DIST_L2, cv2.DIST_MASK_PRECISE)
        np.testing.assert_array_equal(after, away <= 2)


def test_smaller_masks_keep_what_lies_more_than_two_pixels_inside(masks):
    smaller = resized_masks(masks, -2)
    assert not np.any(smaller & ~masks)
    np.testing.assert_array_equal(np.argwhere(smaller[0, 0])[[0, -1]], [[12, 14], [17, 22]])
    assert smaller[1, 1, 7:13, 0].all(), "an object goes on beyond the image's border"
    np.testing.assert_array_equal(resized_masks(masks, 0), masks)


def test_a_camera_error_moves_a_point_by_the_expected_pixels():
    focal, turn, shift = CAMERA.intrinsics[0, 0], np.deg2rad(0.3), 0.003
    right = CAMERA.T_world_camera.matrix()[:3, 0]
    moved = CameraError(np.zeros(3), shift * right).applied(CAMERA)
    np.testing.assert_allclose(moved.project(np.zeros(3)), [64 - focal * shift / 0.9, 64], atol=1e-6)
    about_down = CAMERA.T_world_camera.matrix()[:3, 1]
    turned = CameraError(turn * about_down, np.zeros(3)).applied(CAMERA)
    np.testing.assert_allclose(turned.project(np.zeros(3)), [64 - focal * np.tan(turn), 64], atol=1e-6)


def test_random_camera_errors_have_the_given_size_and_any_direction():
    generator = rng()
    errors = [CameraError.random(generator, 0.005, 0.003) for _ in range(400)]
    told = CAMERA.T_world_camera
    for error in errors[:5]:
        standing = error.applied(CAMERA)
        assert rotation_angle(standing.T_world_camera.quaternion, told.quaternion) == pytest.approx(0.005)
        assert np.linalg.norm(standing.T_world_camera.position - told.position) == pytest.approx(0.003)
        assert standing.name == CAMERA.name
    np.testing.assert_allclose(np.mean([error.shift for error in errors], axis=0) / 0.003, 0, atol=0.1)
    np.testing.assert_allclose(np.mean([error.rotation for error in errors], axis=0) / 0.005, 0, atol=0.1)


def test_no_error_leaves_a_camera_as_it_is():
    same = CameraError.random(rng(), 0.0, 0.0).applied(CAMERA)
    np.testing.assert_array_equal(same.T_world_camera.position, CAMERA.T_world_camera.position)
    np.testing.assert_array_equal(same.T_world_camera.quaternion, CAMERA.T_world_camera.quaternion)
