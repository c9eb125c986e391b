import numpy as np
import pytest

from osfcore.estimation.tracking import joint_push_hypotheses, push_hypotheses, resting_hypotheses, rolling_hypotheses
from osfcore.geometry.poses import rotate, rotation_angle
from tests.core.estimation.scenes import lying, params_of, scene

PUSH = np.array([0.06, 0.03, 0.0])


def test_objects_are_shoved_together_in_all_ways(truth):
    params = params_of(truth)
    positions = joint_push_hypotheses(params, [0, 1], PUSH)
    np.testing.assert_array_equal(positions[0], params.positions)
    shifts = positions - params.positions
    ways = {tuple(np.round(way @ PUSH / (PUSH @ PUSH), 6)) for way in shifts}
    assert ways == {(a, b) for a in (0, 0.5, 1) for b in (0, 0.5, 1)}


def test_who_was_not_shoved_stays(truth):
    params = params_of(truth)
    positions = joint_push_hypotheses(params, [1], PUSH)
    np.testing.assert_array_equal(positions[:, 0], np.tile(params.positions[0], (3, 1)))
    np.testing.assert_allclose(positions[:, 1] - params.positions[1], np.outer([0, 0.5, 1], PUSH), atol=1e-12)


def test_many_objects_share_one_share(plain):
    state = scene({name: lying(plain, "block", 0, 0.1 * k, 0) for k, name in enumerate("abcde")})
    positions = joint_push_hypotheses(params_of(state), range(5), PUSH)
    shifts = positions - params_of(state).positions
    assert len(positions) == 3
    np.testing.assert_allclose(shifts, np.repeat(shifts[:, :1], 5, axis=1), atol=1e-12)


def test_a_ball_rolls_without_slipping(plain):
    state = scene({"ball": lying(plain, "ball", 0, 0.0, 0.0)})
    params = params_of(state)
    tried = push_hypotheses(plain, params, 0, PUSH)
    slid, rolled = tried[:27], tried[27:]
    assert len(rolled.position) == 9
    centre = plain.resting("ball").centre
    before = params.positions[0] + rotate(params.quaternions[0], centre)
    after = rolled.position + rotate(rolled.quaternion, centre)
    # They began where they had already been shoved along the push.
    path = (after - before + PUSH) @ PUSH / np.linalg.norm(PUSH)  # what is beside is no farther along
    np.testing.assert_allclose(rotation_angle(rolled.quaternion, params.quaternions[0]), path / before[2], rtol=1e-9)
    up = np.array([0.0, 0.0, 1.0])
    turned = rotate(slid.quaternion, rotate(params.quaternions[0] * [1, -1, -1, -1], up))
    np.testing.assert_allclose(turned, np.tile(up, (27, 1)), atol=1e-12)  # sliding turns about the vertical only


@pytest.mark.parametrize("push", [np.zeros(3), np.array([1e-3, 0, 0])])
def test_without_a_push_it_is_looked_for_around(models, truth, push):
    params = params_of(truth)
    tried = push_hypotheses(models, params, 0, push)
    centre = models.resting(params.names[0]).centre
    there = tried.position + rotate(tried.quaternion, centre)
    shifts = there - (params.positions[0] + rotate(params.quaternions[0], centre))
    assert len(shifts) == 27
    assert 0.015 < np.abs(shifts[:, :2]).max() < 0.03
    np.testing.assert_allclose(shifts.mean(axis=0), 0, atol=1e-12)


def test_every_way_of_lying_is_on_the_table_in_the_same_place(models, truth):
    params = params_of(truth)
    tried, resting = resting_hypotheses(models, params, 1), models.resting(params.names[1])
    centres = tried.position + rotate(tried.quaternion, resting.centre)
    here = params.positions[1] + rotate(params.quaternions[1], resting.centre)
    np.testing.assert_allclose(centres[:, :2], np.tile(here[:2], (len(centres), 1)), atol=1e-12)
    np.testing.assert_allclose(centres[:, 2], resting.heights, atol=1e-12)


def test_a_ball_may_have_rolled_any_way(plain):
    params = params_of(scene({"ball": lying(plain, "ball", 0, 0.0, 0.0)}))
    tried, centre = rolling_hypotheses(plain, params, 0, PUSH), plain.resting("ball").centre
    assert len(tried.position) == 18
    here = params.positions[0] + rotate(params.quaternions[0], centre)
    np.testing.assert_allclose(tried.position + rotate(tried.quaternion, centre), np.tile(here, (18, 1)), atol=1e-12)
    along = PUSH / np.linalg.norm(PUSH)
    across = np.array([-along[1], along[0], 0.0])
    axis = rotate(params.quaternions[0] * [1, -1, -1, -1], across)  # of the roll, in the ball
    np.testing.assert_allclose(rotate(tried.quaternion, axis), np.tile(across, (18, 1)), atol=1e-12)
    np.testing.assert_allclose(tried.quaternion[0], params.quaternions[0], atol=1e-12)


def test_what_stands_on_a_face_does_not_roll(models, truth):
    """Nothing of it is tried but sliding, and its own pose."""
    params = params_of(truth)
    assert len(push_hypotheses(models, params, 0, PUSH).position) == 27
    alone = rolling_hypotheses(models, params, 0, PUSH)
    np.testing.assert_allclose(alone.position, params.positions[:1], atol=1e-12)
    np.testing.assert_allclose(alone.quaternion, params.quaternions[:1], atol=1e-12)


def test_nothing_rolls_without_a_push(plain):
    params = params_of(scene({"ball": lying(plain, "ball", 0, 0.0, 0.0)}))
    assert len(rolling_hypotheses(plain, params, 0, np.zeros(3)).position) == 1
