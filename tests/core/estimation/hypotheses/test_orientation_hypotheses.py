from dataclasses import replace

import numpy as np
import pytest

from osfcore.estimation.hypotheses.orientation_hypotheses import compare_orientations, yaw_hypotheses
from osfcore.estimation.objective.observed_views import QUALITY
from osfcore.estimation.objective.parametrization import SceneParameters
from osfcore.estimation.search.gauss_newton import GaussNewtonState
from osfcore.geometry.cameras import default_cameras
from osfcore.geometry.poses import rotate, rotation_angle
from tests.core.estimation.scenes import apart, own_views, params_of


@pytest.fixture(scope="module")
def coarse(models, truth):
    return own_views(models, params_of(truth), default_cameras(48)[:3])


@pytest.fixture(scope="module")
def fine(models, truth):
    return own_views(models, params_of(truth), default_cameras(64)[:3], replace(QUALITY, samples_per_side=2))


@pytest.fixture(scope="module")
def flips(models, truth):
    """Ways in which the box is turned about the vertical."""
    return yaw_hypotheses(models, params_of(truth), 0)


def flipped(params, flips) -> SceneParameters:
    other = flips[11]  # half a turn
    positions, quaternions = params.positions.copy(), params.quaternions.copy()
    positions[0], quaternions[0] = other.position, other.quaternion
    return replace(params, positions=positions, quaternions=quaternions)


def test_turned_in_place_about_the_vertical(models, truth, flips):
    assert len(flips.position) == 23
    centre = models.resting(truth.names[0]).centre
    pose = truth.poses[0]
    np.testing.assert_allclose(
        rotate(flips.quaternion, centre) + flips.position, np.tile(pose.apply(centre), (23, 1)), atol=1e-12
    )
    angles = np.rad2deg(rotation_angle(flips.quaternion, pose.quaternion))
    np.testing.assert_allclose(np.sort(angles), np.sort([15 * min(k, 24 - k) for k in range(1, 24)]), atol=1e-6)
    up = rotate(flips.quaternion * [1, -1, -1, -1], np.array([0, 0, 1.0]))
    np.testing.assert_allclose(up, np.tile(up[0], (23, 1)), atol=1e-12)


def test_a_flipped_object_is_turned_round(models, truth, coarse, fine, flips):
    wrong = flipped(params_of(truth), flips)
    at, ratio = compare_orientations(
        models, coarse, coarse, fine, GaussNewtonState.at(wrong), 0, yaw_hypotheses(models, wrong, 0)
    )
    shift, turn, _ = apart(at.params, truth)
    assert shift[0] < 0.002
    assert turn[0] < np.deg2rad(2)
    assert ratio > 1.5
    np.testing.assert_array_equal(at.params.positions[1], wrong.positions[1])


def test_the_right_pose_stays(models, truth, coarse, fine, flips):
    before = GaussNewtonState.at(params_of(truth))
    at, ratio = compare_orientations(models, coarse, coarse, fine, before, 0, flips)
    assert at is before
    assert ratio > 1.5


def test_a_ball_of_one_colour_is_a_close_call(plain):
    """It looks alike however it lies, up to the noise of the images."""
    params = SceneParameters(
        ("ball",), np.array([[0, 0, 0.05]]), np.array([[1.0, 0, 0, 0]]), np.array([0, 0.6, 0.8]), None
    )
    views = own_views(plain, params, default_cameras(48)[:2])
    noise = np.random.default_rng(0).normal(0, 0.02, views.images.shape).astype(np.float32)
    views = replace(views, images=views.images + noise)
    _, ratio = compare_orientations(
        plain, views, views, views, GaussNewtonState.at(params), 0, yaw_hypotheses(plain, params, 0)
    )
    assert 1 <= ratio < 1.05


def test_poses_much_like_its_own_are_no_rivals(models, truth, coarse, fine):
    before = GaussNewtonState.at(params_of(truth))
    at, ratio = compare_orientations(models, coarse, coarse, fine, before, 0, truth.poses[[0, 0]])
    assert at is before
    assert ratio == np.inf
