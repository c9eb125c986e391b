from dataclasses import replace

import numpy as np
import pytest

from osfcore.estimation.hypotheses import compare_orientations, side_hypotheses, with_pose, yaw_hypotheses
from osfcore.estimation.objective import QUALITY, SceneParameters
from osfcore.estimation.search import GaussNewtonState
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
    return with_pose(params, 0, flips[11])  # half a turn


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


def test_tipped_in_place_onto_each_other_side(models, truth):
    """Each pose rests on the table, on another side, and half of them are the others turned by 180 deg."""
    resting, pose = models.resting(truth.names[0]), truth.poses[0]
    sides = side_hypotheses(models, params_of(truth), 0)
    assert len(sides.position) >= 2
    middle = rotate(sides.quaternion, resting.centre) + sides.position
    np.testing.assert_allclose(middle[:, :2], np.tile(pose.apply(resting.centre)[:2], (len(middle), 1)), atol=1e-12)
    for side in sides:
        assert abs(resting.lowest(side)) < 3e-3  # the axis of half a turn is about the longest one
    up, now = (rotate(q * [1, -1, -1, -1], np.array([0, 0, 1.0])) for q in (sides.quaternion, pose.quaternion))
    assert (up @ now < np.cos(np.deg2rad(10))).all()
    half = len(sides.position) // 2
    np.testing.assert_allclose(up[:half], up[half:], atol=1e-12)
    between = rotation_angle(sides.quaternion[:half], sides.quaternion[half:])
    np.testing.assert_allclose(between, np.pi, atol=1e-6)


def test_an_object_on_its_other_side_is_tipped_over(models, truth, coarse, fine):
    right = params_of(truth)
    tipped = side_hypotheses(models, right, 0)
    farthest = int(np.argmax(rotation_angle(tipped.quaternion, right.quaternions[0])))
    wrong = with_pose(right, 0, tipped[farthest])
    at, ratio = compare_orientations(
        models, coarse, coarse, fine, GaussNewtonState.at(wrong), 0, side_hypotheses(models, wrong, 0)
    )
    shift, turn, _ = apart(at.params, truth)
    assert shift[0] < 0.002
    assert turn[0] < np.deg2rad(2)
    assert ratio > 1.5


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
