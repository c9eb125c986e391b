from dataclasses import replace

import numpy as np
import pytest

from osfcore.errors import InvalidInput, UnknownName
from osfcore.estimation.objective import yaw_quaternions
from osfcore.estimation.tracking import (
    estimate_next,
    joint_push_hypotheses,
    push_hypotheses,
    resting_hypotheses,
    rolling_hypotheses,
)
from osfcore.geometry.cameras import default_cameras
from osfcore.geometry.light import Light
from osfcore.geometry.poses import Pose, quaternion_multiply, rotate, rotation_angle
from tests.support.errors import about
from tests.support.posed_scenes import apart, lying, observe, params_of, scene

CAMERAS = default_cameras(96)[:3]


def followed(models, state, expected, effort=None):
    seen = observe(models, state, CAMERAS, masks=False)
    steps = list(estimate_next(models, seen, expected, np.random.default_rng(0), effort))
    assert [step.estimate is None for step in steps] == [True] * (len(steps) - 1) + [False]
    return steps


def pushed(truth, shift, yaw):
    """The first object pushed and turned."""
    position, quaternion = truth.poses.position.copy(), truth.poses.quaternion.copy()
    position[0, :2] += shift
    quaternion[0] = quaternion_multiply(yaw_quaternions(np.array([yaw]))[0], quaternion[0])
    return replace(truth, poses=Pose(position, quaternion))


def test_what_stands_still_stays_where_it_is(models, truth):
    steps = followed(models, truth, truth)
    shift, turn, light = apart(steps[-1].estimate.state, truth)
    assert shift.max() < 0.001
    assert np.rad2deg(turn).max() < 1
    assert light == steps[-1].estimate.light_std == 0  # held
    assert steps[-1].estimate.trusted
    assert all(step.candidates is None for step in steps)  # nothing to search


def check_followed(models, moved, before):
    steps = followed(models, moved, before)
    shift, turn, _ = apart(steps[-1].estimate.state, moved)
    assert shift.max() < 0.004
    assert np.rad2deg(turn).max() < 4
    assert "light" not in [step.stage for step in steps]  # objects that moved are no moved lamp
    return steps[-1].estimate


@pytest.mark.parametrize(
    ("shift", "yaw"), [((0.008, -0.006), 0.08), pytest.param((-0.03, 0.03), 0.3, marks=pytest.mark.slow)]
)
def test_a_pushed_object_is_followed(models, truth, shift, yaw):
    check_followed(models, pushed(truth, shift, yaw), truth)


def test_what_a_push_moved_far_is_followed(models, truth):
    push, pusher = np.array([0.07, -0.04, 0.0]), np.array([0.0, 0.0, 0.062])
    moved = replace(pushed(truth, push[:2], 0.0), pusher=pusher + push)
    assert check_followed(models, moved, replace(truth, pusher=pusher)).trusted


@pytest.mark.slow
def test_what_fell_over_or_was_taken_the_wrong_way_round_is_found_lying_in_another_way(models, truth):
    fallen = lying(models, truth.names[0], 0, 0.05, -0.08)
    assert rotation_angle(fallen.quaternion, truth.poses.quaternion[0]) > 1
    other = params_of(truth).with_pose(0, fallen).state()
    check_followed(models, other, truth)
    assert check_followed(models, truth, pushed(truth, (0.0, 0.0), np.pi)).trusted


def test_a_moved_lamp_is_noticed(models, truth):
    moved = replace(truth, light=Light(np.array([-0.6, 0.2, 0.5])))
    steps = followed(models, moved, truth)
    shift, turn, light = apart(steps[-1].estimate.state, moved)
    assert "light" in [step.stage for step in steps]
    assert np.rad2deg(light) < 1
    assert light < 10 * steps[-1].estimate.light_std < np.deg2rad(20)
    assert shift.max() < 0.002
    assert np.rad2deg(turn).max() < 2


def test_other_objects_than_expected_are_refused(models, truth):
    seen = observe(models, truth, CAMERAS, masks=False)
    other = replace(truth, names=(truth.names[0], "another"))
    with pytest.raises(InvalidInput, check=about("expected state")):
        next(estimate_next(models, seen, other, np.random.default_rng(0)))
    with pytest.raises(UnknownName, check=about("unheard")):
        next(estimate_next(models, replace(seen, names=("unheard", truth.names[1])), truth, np.random.default_rng(0)))


# Motion hypotheses


PUSH = np.array([0.06, 0.03, 0.0])


def test_objects_are_shoved_in_all_ways_up_to_four_and_many_by_one_share(truth, plain):
    params = params_of(truth)
    shifts = joint_push_hypotheses(params, [0, 1], PUSH) - params.positions
    np.testing.assert_array_equal(shifts[0], 0)
    ways = {tuple(np.round(way @ PUSH / (PUSH @ PUSH), 6)) for way in shifts}
    assert ways == {(a, b) for a in (0, 0.5, 1) for b in (0, 0.5, 1)}
    alone = joint_push_hypotheses(params, [1], PUSH) - params.positions
    np.testing.assert_allclose(alone, np.outer([0, 0.5, 1], PUSH)[:, None] * [[[0.0], [1.0]]], atol=1e-12)
    many = params_of(scene({name: lying(plain, "block", 0, 0.1 * k, 0) for k, name in enumerate("abcde")}))
    shifts = joint_push_hypotheses(many, range(5), PUSH) - many.positions
    assert len(shifts) == 3
    np.testing.assert_allclose(shifts, np.repeat(shifts[:, :1], 5, axis=1), atol=1e-12)


@pytest.mark.parametrize("push", [np.zeros(3), np.array([1e-3, 0, 0])])
def test_without_a_push_it_is_looked_for_around_and_what_stands_on_a_face_never_rolls(models, truth, push):
    params = params_of(truth)
    tried = push_hypotheses(models, params, 0, push)
    there = tried.position + rotate(tried.quaternion, models.resting(params.names[0]).centre)
    shifts = there - models.centre_of_mass(params, 0)
    assert len(shifts) == 27
    assert 0.015 < np.abs(shifts[:, :2]).max() < 0.03
    np.testing.assert_allclose(shifts.mean(axis=0), 0, atol=1e-12)
    for shove in (push, PUSH):  # what stands on a face does not roll under any
        assert len(push_hypotheses(models, params, 0, shove).position) == 27
        alone = rolling_hypotheses(models, params, 0, shove)
        np.testing.assert_allclose(alone.position, params.positions[:1], atol=1e-12)
        np.testing.assert_allclose(alone.quaternion, params.quaternions[:1], atol=1e-12)


def test_a_ball_rolls_without_slipping(plain):
    state = scene({"ball": lying(plain, "ball", 0, 0.0, 0.0)})
    params = params_of(state)
    tried = push_hypotheses(plain, params, 0, PUSH)
    slid, rolled = tried[:27], tried[27:]
    assert len(rolled.position) == 9
    centre, before = plain.resting("ball").centre, plain.centre_of_mass(params, 0)
    after = rolled.position + rotate(rolled.quaternion, centre)
    # They began where they had already been shoved along the push.
    path = (after - before + PUSH) @ PUSH / np.linalg.norm(PUSH)  # what is beside is no farther along
    np.testing.assert_allclose(rotation_angle(rolled.quaternion, params.quaternions[0]), path / before[2], rtol=1e-9)
    up = np.array([0.0, 0.0, 1.0])
    turned = rotate(slid.quaternion, rotate(params.quaternions[0] * [1, -1, -1, -1], up))
    np.testing.assert_allclose(turned, np.tile(up, (27, 1)), atol=1e-12)  # sliding turns about the vertical only


def test_every_way_of_lying_is_on_the_table_in_the_same_place(models, truth):
    params, resting = params_of(truth), models.resting(truth.names[1])
    tried = resting_hypotheses(models, params, 1)
    centres, here = tried.position + rotate(tried.quaternion, resting.centre), models.centre_of_mass(params, 1)
    np.testing.assert_allclose(centres[:, :2], np.tile(here[:2], (len(centres), 1)), atol=1e-12)
    np.testing.assert_allclose(centres[:, 2], resting.heights, atol=1e-12)


def test_a_ball_may_have_rolled_any_way(plain):
    params = params_of(scene({"ball": lying(plain, "ball", 0, 0.0, 0.0)}))
    tried, centre = rolling_hypotheses(plain, params, 0, PUSH), plain.resting("ball").centre
    assert len(tried.position) == 18
    here = plain.centre_of_mass(params, 0)
    np.testing.assert_allclose(tried.position + rotate(tried.quaternion, centre), np.tile(here, (18, 1)), atol=1e-12)
    along = PUSH / np.linalg.norm(PUSH)
    across = np.array([-along[1], along[0], 0.0])
    axis = rotate(params.quaternions[0] * [1, -1, -1, -1], across)  # of the roll, in the ball
    np.testing.assert_allclose(rotate(tried.quaternion, axis), np.tile(across, (18, 1)), atol=1e-12)
    np.testing.assert_allclose(tried.quaternion[0], params.quaternions[0], atol=1e-12)
