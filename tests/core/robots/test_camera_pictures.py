import cv2
import numpy as np
import pytest

from osfcore.errors import InvalidInput
from osfcore.estimation.camera_response import srgb_of_linear
from osfcore.geometry.cameras import Camera
from osfcore.io.image_file import encode_png, to_uint8
from osfcore.robots.http_robot import SentCamera, observation_of

LOOK = Camera.look_at("side", (0.6, 0.1, 0.5), (0, 0, 0), size=64)


def sent(width, height, focal, distortion=()):
    K = np.array([[focal, 0, width / 2], [0, focal, height / 2], [0, 0, 1.0]])
    return SentCamera("side", LOOK.T_world_camera, K, width, height, distortion)


def test_large_pictures_are_reduced_and_points_stay_where_they_are():
    camera = sent(1280, 720, 900.0)
    kept = camera.kept()
    assert (kept.width, kept.height) == (640, 360)
    point = np.array([0.05, -0.03, 0.02])
    whole = Camera("side", LOOK.T_world_camera, camera.intrinsics, 1024, 720)
    np.testing.assert_allclose(kept.project(point), whole.project(point) / 2, atol=1e-12)
    assert camera.radiance(encode_png(np.zeros((720, 1280, 3), np.uint8))).shape == (360, 640, 3)


def test_pictures_are_srgb(tmp_path):
    linear = np.linspace(0.1, 0.9, 64 * 64).reshape(64, 64, 1).repeat(3, axis=2)
    found = sent(64, 64, 80.0).radiance(encode_png(to_uint8(srgb_of_linear(linear))))
    np.testing.assert_allclose(found, linear, atol=0.005)


def test_bent_lines_are_straightened():
    """A dot is drawn where OpenCV's model projects it to, and found where a pinhole would."""
    camera = sent(320, 240, 250.0, (-0.2, 0.05, 0.0, 0.0, 0.0))
    K = camera.intrinsics - np.array([[0, 0, 0.5], [0, 0, 0.5], [0, 0, 0]])
    point = np.array([[0.4, -0.3, 1.0]])
    bent = cv2.projectPoints(point, np.zeros(3), np.zeros(3), K, np.array(camera.distortion))[0].ravel()
    straight = (K @ point[0])[:2]
    assert np.linalg.norm(bent - straight) > 4
    picture = np.zeros((240, 320, 3), np.uint8)
    cv2.circle(picture, np.round(16 * bent).astype(int).tolist(), 16 * 3, (255, 255, 255), -1, cv2.LINE_AA, 4)
    found = camera.radiance(encode_png(picture))[..., 0]
    rows, columns = np.indices(found.shape)
    np.testing.assert_allclose([np.average(axis, weights=found) for axis in (columns, rows)], straight, atol=0.3)


@pytest.mark.parametrize("shape", [(64, 48), (32, 32)])
def test_another_size_than_was_described_is_told(shape):
    with pytest.raises(InvalidInput, match=f"{shape[1]} x {shape[0]}, but it must be 64 x 64"):
        sent(64, 64, 80.0).radiance(encode_png(np.zeros((*shape, 3), np.uint8)))


@pytest.mark.parametrize("size", [(0, 10), (5000, 100)])
def test_sizes_that_no_picture_has_are_refused(size):
    with pytest.raises(InvalidInput, match="a side"):
        sent(*size, 80.0).kept()


def test_cameras_of_different_sizes_are_told():
    cameras = (sent(64, 64, 80.0), sent(80, 64, 80.0))
    with pytest.raises(InvalidInput, match="64 x 64, 80 x 64, but it must be one size"):
        observation_of(cameras, [b"", b""], (), np.zeros(3), 0.0)
