"""Tracking: tracking, motion hypotheses."""

from dataclasses import replace

import numpy as np
import pytest

from osfcore.errors import InvalidInput, UnknownName
from osfcore.estimation.objective import yaw_quaternions
from osfcore.estimation.tracking import (
    TrackingConfig,
    estimate_next,
    joint_push_hypotheses,
    push_hypotheses,
    resting_hypotheses,
    rolling_hypotheses,
)
from osfcore.geometry.cameras import default_cameras
from osfcore.geometry.light import Light
from osfcore.geometry.poses import Pose, quaternion_multiply, rotate, rotation_angle
from tests.core.estimation.scenes import apart, lying, observe, params_of, scene

# Tracking


CAMERAS = default_cameras(96)[:3]


def followed(models, state, expected, effort=None, seed=0):
    seen = observe(models, state, CAMERAS, masks=False)
    steps = list(estimate_next(models, seen, expected, np.random.default_rng(seed), effort))
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


@pytest.mark.parametrize(("shift", "yaw"), [((0.008, -0.006), 0.08), ((-0.03, 0.03), 0.3)])
def test_a_pushed_object_is_followed(models, truth, shift, yaw):
    moved = pushed(truth, shift, yaw)
    shift, turn, _ = apart(followed(models, moved, truth)[-1].estimate.state, moved)
    assert shift.max() < 0.004
    assert np.rad2deg(turn).max() < 4


def test_what_a_push_moved_far_is_followed(models, truth):
    push = np.array([0.07, -0.04, 0.0])
    moved = replace(pushed(truth, push[:2], 0.0), pusher=np.array([0.0, 0.0, 0.062]) + push)
    before = replace(truth, pusher=np.array([0.0, 0.0, 0.062]))
    estimate = followed(models, moved, before)[-1].estimate
    shift, turn, _ = apart(estimate.state, moved)
    assert shift.max() < 0.004
    assert np.rad2deg(turn).max() < 4
    assert estimate.trusted


@pytest.mark.slow
def test_what_fell_over_is_found_lying_in_another_way(models, truth):
    fallen = lying(models, truth.names[0], 0, 0.05, -0.08)
    position, quaternion = truth.poses.position.copy(), truth.poses.quaternion.copy()
    position[0], quaternion[0] = fallen.position, fallen.quaternion
    other = replace(truth, poses=Pose(position, quaternion))
    assert rotation_angle(fallen.quaternion, truth.poses.quaternion[0]) > 1
    shift, turn, _ = apart(followed(models, other, truth)[-1].estimate.state, other)
    assert shift.max() < 0.004
    assert np.rad2deg(turn).max() < 4


@pytest.mark.slow
def test_what_was_taken_the_wrong_way_round_is_turned(models, truth):
    wrong = pushed(truth, (0.0, 0.0), np.pi)
    estimate = followed(models, truth, wrong)[-1].estimate
    shift, turn, _ = apart(estimate.state, truth)
    assert shift.max() < 0.002
    assert np.rad2deg(turn).max() < 2
    assert estimate.trusted


def test_objects_that_moved_are_no_moved_lamp(models, truth):
    steps = followed(models, pushed(truth, (0.05, 0.05), 0.5), truth)
    assert "light" not in [step.stage for step in steps]


def test_a_moved_lamp_is_noticed(models, truth):
    moved = replace(truth, light=Light(np.array([-0.6, 0.2, 0.5])))
    steps = followed(models, moved, truth)
    shift, turn, light = apart(steps[-1].estimate.state, moved)
    assert "light" in [step.stage for step in steps]
    assert np.rad2deg(light) < 1
    assert light < 10 * steps[-1].estimate.light_std < np.deg2rad(20)
    assert shift.max() < 0.002
    assert np.rad2deg(turn).max() < 2


@pytest.mark.slow
def test_a_vanished_object_is_doubted(models, truth):
    away = truth.poses.position.copy()
    away[0] = 3.0, 0.0, 0.0
    gone = replace(truth, poses=Pose(away, truth.poses.quaternion))
    effort = TrackingConfig(generations=2, sweeps=1)
    assert followed(models, gone, truth, effort)[-1].estimate.doubts[0]


def test_the_same_generator_gives_the_same_estimate(models, truth):
    moved, effort = pushed(truth, (0.02, 0.01), 0.2), TrackingConfig(generations=2, sweeps=1)
    first, second = (followed(models, moved, truth, effort, seed=5)[-1].estimate.state for _ in range(2))
    np.testing.assert_array_equal(first.poses.position, second.poses.position)
    np.testing.assert_array_equal(first.poses.quaternion, second.poses.quaternion)


def test_the_order_of_the_expected_objects_does_not_matter(models, truth):
    seen = observe(models, pushed(truth, (0.02, 0.01), 0.2), CAMERAS, masks=False)
    first, second = (
        next(estimate_next(models, seen, expected, np.random.default_rng(0))).state
        for expected in (truth, truth.reordered(truth.names[::-1]))
    )
    assert first.names == second.names == seen.names
    np.testing.assert_array_equal(first.poses.position, second.poses.position)


def test_other_objects_than_expected_are_refused(models, truth):
    seen = observe(models, truth, CAMERAS, masks=False)
    other = replace(truth, names=(truth.names[0], "another"))
    with pytest.raises(InvalidInput, match="expected state"):
        next(estimate_next(models, seen, other, np.random.default_rng(0)))
    unheard = replace(seen, names=("unheard", truth.names[1]))
    with pytest.raises(UnknownName, match="unheard"):
        next(estimate_next(models, unheard, truth, np.random.default_rng(0)))


# Motion hypotheses


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
