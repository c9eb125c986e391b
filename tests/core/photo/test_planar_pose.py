import numpy as np
import pytest

from osfcore.errors import InvalidInput
from osfcore.experiments.board_views import random_camera
from osfcore.geometry.poses import rotation_angle
from osfcore.photo.board import focal_length, planar_pose

SIZE = (640, 480)
POINTS = np.stack(np.meshgrid(np.linspace(-0.1, 0.1, 5), np.linspace(-0.06, 0.06, 3)), axis=-1).reshape(-1, 2)


def seen(camera, points=POINTS):
    pose, intrinsics = camera
    projected = pose.inverse().apply(np.pad(points, ((0, 0), (0, 1)))) @ intrinsics.T
    return projected[:, :2] / projected[:, 2:]


@pytest.mark.parametrize("points", [POINTS, POINTS[[0, 4, 14, 10]]], ids=["15 points", "4 points"])
def test_pose_is_exact_for_exact_points(points):
    rng = np.random.default_rng(0)
    for _ in range(20):
        pose, intrinsics = camera = random_camera(rng, SIZE)
        found, rms = planar_pose(points, seen(camera, points), intrinsics)
        assert rotation_angle(found.quaternion, pose.quaternion) < 1e-5
        assert np.linalg.norm(found.position - pose.position) < 1e-5
        assert rms < 1e-3


def test_camera_is_above_the_table_however_the_points_scatter():
    rng = np.random.default_rng(1)
    for _ in range(20):
        camera = random_camera(rng, SIZE, elevations_deg=(70, 90))
        found, _ = planar_pose(POINTS, seen(camera) + rng.normal(0, 1, POINTS.shape), camera[1])
        assert found.position[2] > 0


def test_a_view_from_below_is_refused():
    pose, intrinsics = random_camera(np.random.default_rng(2), SIZE)
    mirrored = seen((pose, intrinsics)) * (-1, 1) + (SIZE[0], 0)
    with pytest.raises(InvalidInput, match="its back"):
        planar_pose(POINTS, mirrored, intrinsics)


def test_focal_length_is_exact_for_exact_points():
    rng = np.random.default_rng(3)
    for _ in range(10):
        camera = random_camera(rng, SIZE, elevations_deg=(30, 60))
        focal, deviation = focal_length(POINTS, seen(camera), SIZE, accuracy_px=0.01)
        assert focal == pytest.approx(camera[1][0, 0], rel=1e-3)
        assert 0 < deviation < 0.01 * focal


def test_deviation_of_the_focal_length_tells_its_scatter():
    rng = np.random.default_rng(4)
    camera = random_camera(rng, SIZE, elevations_deg=(45, 45))
    found = [focal_length(POINTS, seen(camera) + rng.normal(0, 0.1, POINTS.shape), SIZE, 0.01) for _ in range(100)]
    focals, deviations = np.array(found).T
    assert np.std(focals) == pytest.approx(np.median(deviations), rel=0.3)
    assert abs(np.mean(focals) - camera[1][0, 0]) < 0.5 * np.std(focals)


@pytest.mark.parametrize("noise_px", [0.0, 0.1])
def test_focal_length_is_refused_from_straight_above(noise_px):
    rng = np.random.default_rng(5)
    for _ in range(10):
        pixels = seen(random_camera(rng, SIZE, elevations_deg=(87, 90)))
        with pytest.raises(InvalidInput, match="focal length is unknown"):
            focal_length(POINTS, pixels + rng.normal(0, noise_px, pixels.shape), SIZE, accuracy_px=0.05)
