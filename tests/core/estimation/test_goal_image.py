from dataclasses import replace

import numpy as np
import pytest

from osfcore.errors import InvalidInput, UnknownName
from osfcore.estimation.goal_image import GoalImageConfig, estimate_goal
from osfcore.estimation.objective import yaw_quaternions
from osfcore.geometry.cameras import default_cameras, goal_camera
from osfcore.geometry.light import Light
from osfcore.geometry.poses import Pose, quaternion_multiply
from tests.support.errors import about
from tests.support.posed_scenes import BOTTLE, BOX, apart, lying, observe, scene

QUICK = GoalImageConfig(side=64, planar_iterations=4, free_iterations=3)


def steps_of(models, seen, prior):
    steps = list(estimate_goal(models, seen, prior, QUICK))
    done, totals = ([getattr(step.progress, name) for step in steps] for name in ("done", "total"))
    assert np.all(np.diff(done) >= 0)
    assert done[-1] == totals[-1]
    assert all(d < t for d, t in zip(done[:-1], totals[:-1], strict=True))
    assert [step.estimate is None for step in steps] == [True] * (len(steps) - 1) + [False]
    return steps


@pytest.fixture(scope="module")
def pushed(truth):
    """The box pushed and turned, under another light."""
    position, quaternion = truth.poses.position.copy(), truth.poses.quaternion.copy()
    position[0, :2] = -0.02, -0.06
    quaternion[0] = quaternion_multiply(yaw_quaternions(np.array([0.6]))[0], quaternion[0])
    return replace(truth, poses=Pose(position, quaternion), light=Light(np.array([-0.3, 0.4, 0.8])))


@pytest.fixture(scope="module")
def seen(models, pushed):
    return observe(models, pushed, [goal_camera(96)], masks=False)


@pytest.mark.slow
def test_a_pushed_object_is_found_from_one_view_wherever_the_prior_has_it(models, seen, truth, pushed):
    far = replace(truth, poses=Pose(truth.poses.position + [0.1, 0.1, 0], truth.poses.quaternion))
    for prior in (truth, far):
        estimate = steps_of(models, seen, prior)[-1].estimate
        shift, turn, light = apart(estimate.state, pushed)
        assert shift.max() < 0.006
        assert np.rad2deg(turn).max() < 5
        assert np.rad2deg(light) < 5
        assert estimate.trusted, estimate.reason
        assert estimate.state.pusher is None


@pytest.mark.slow
def test_an_object_that_lies_another_way_is_found_too(models):
    prior = scene({BOX: lying(models, BOX, 30, 0.1, 0.1)})
    goal = scene({BOX: lying(models, BOX, 150, -0.03, 0.0)}, (0.2, 0.3, 0.9))
    steps = steps_of(models, observe(models, goal, [goal_camera(64)], masks=False), prior)
    assert any("lying in any way" in step.progress.note for step in steps)
    shift, turn, _ = apart(steps[-1].estimate.state, goal)
    assert shift[0] < 0.01
    assert np.rad2deg(turn[0]) < 6


@pytest.mark.slow
def test_an_object_that_is_not_there_is_doubted(models, truth):
    alone = observe(models, scene({BOX: truth.pose(BOX)}), [goal_camera(64)], masks=False)
    estimate = steps_of(models, replace(alone, names=truth.names), truth)[-1].estimate
    assert estimate.doubts[1]
    assert not estimate.trusted


def test_what_is_not_a_goal_is_refused(models, seen, truth):
    two, other = observe(models, truth, default_cameras(32)[:2], masks=False), scene({BOX: truth.pose(BOX)})
    for observation, prior, kind, subject in (
        (two, truth, InvalidInput, "views"),
        (seen, other, InvalidInput, "prior"),
        (replace(seen, names=("mug", BOTTLE)), truth, UnknownName, "mug"),
    ):
        with pytest.raises(kind, check=about(subject)):
            next(estimate_goal(models, observation, prior))
