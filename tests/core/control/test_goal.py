from dataclasses import replace

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st

from osfcore.control.goal import GoalImage, nearest_symmetric_goal, prefer_current_poses, snap_near_goals
from osfcore.errors import InvalidInput
from osfcore.geometry.cameras import goal_camera
from osfcore.geometry.light import Light
from osfcore.geometry.poses import Pose, quaternion_exp, quaternion_multiply, rotate, rotation_angle
from osfcore.geometry.states import SceneState
from osfcore.objects.asset import Symmetry
from osfcore.planning.costs import PoseGoal
from tests.support.tabletop_scenes import CAN, GELATIN, models, sure, table

ABOUT_Z = np.array([0.0, 0.0, 1.0])
NONE = Symmetry("none")
HALF = Symmetry("discrete", ((0.0, 0.0, 0.0, 1.0),))
ROUND = Symmetry("continuous", axis=(0.0, 0.0, 1.0))
angle = st.floats(-np.pi, np.pi)


def state_of(*yaws: float) -> SceneState:
    names = tuple("abcdefgh"[: len(yaws)])
    positions = np.array([[0.1 * n - 0.1, 0.0, 0.03] for n in range(len(yaws))])
    quaternions = np.stack([quaternion_exp(yaw * ABOUT_Z) for yaw in yaws])
    return SceneState(names, Pose(positions, quaternions), Light(ABOUT_Z), None)


def goal_of(state: SceneState) -> PoseGoal:
    return PoseGoal(state.names, state.poses)


def turn_left(symmetry: Symmetry, goal_yaw: float, yaw: float) -> float:
    state = state_of(yaw)
    goal = nearest_symmetric_goal(goal_of(state_of(goal_yaw)), state, {"a": symmetry})
    return float(rotation_angle(goal.pose("a").quaternion, state.pose("a").quaternion))


@given(a=angle, b=angle)
def test_of_orientations_that_look_alike_the_nearest_counts(a, b):
    apart = abs((a - b + np.pi) % (2 * np.pi) - np.pi)
    assert turn_left(NONE, a, b) == pytest.approx(apart, abs=1e-6)
    assert turn_left(HALF, a, b) == pytest.approx(min(apart, np.pi - apart), abs=1e-6)
    assert turn_left(ROUND, a, b) == pytest.approx(0, abs=1e-6)


@given(axis=st.tuples(angle, angle, angle), other=st.tuples(angle, angle, angle))
def test_a_body_of_revolution_keeps_the_tilt_of_its_axis(axis, other):
    state = state_of(0.0)
    here, there = quaternion_exp(np.array(axis)), quaternion_exp(np.array(other))
    state = replace(state, poses=Pose(state.poses.position, here[None]))
    goal = nearest_symmetric_goal(PoseGoal(("a",), Pose(state.poses.position, there[None])), state, {"a": ROUND})
    found = goal.pose("a").quaternion
    np.testing.assert_allclose(rotate(found, ABOUT_Z), rotate(there, ABOUT_Z), atol=1e-7)
    for turn in np.linspace(0, 2 * np.pi, 13):
        rival = quaternion_multiply(there, quaternion_exp(turn * ABOUT_Z))
        assert rotation_angle(found, here) <= rotation_angle(rival, here) + 1e-6


def test_what_is_there_but_for_the_errors_of_estimates_stays_exactly_where_it_is():
    state = state_of(0.0, 1.0, 2.0)
    wanted = state_of(0.05, 1.0, 2.4)
    wanted.poses.position[1, 1] = 0.08
    goal = snap_near_goals(goal_of(wanted), state, {})
    np.testing.assert_array_equal(goal.pose("a").quaternion, state.pose("a").quaternion)
    np.testing.assert_array_equal(goal.pose("b").position, wanted.pose("b").position)
    np.testing.assert_array_equal(goal.pose("c").quaternion, wanted.pose("c").quaternion)


def test_an_image_of_another_size_than_its_camera_or_not_finite_is_refused():
    for shape, value in (((64, 64, 3), 0), ((128, 128), 0), ((128, 128, 4), 0), ((128, 128, 3), np.nan)):
        with pytest.raises(InvalidInput):
            GoalImage(goal_camera(), np.full(shape, value, np.float32))


def test_an_object_stays_unless_the_goal_image_shows_that_it_moved(library):
    """Of two wrong beliefs, the image refutes the one about what it shows; what lies outside of it stays."""
    world = table(library)
    start = world.truth()
    away = start.poses.position.copy()
    away[0], away[1] = (0.5, -0.2, away[0, 2]), (0.0, 0.0, away[1, 2])
    seen = replace(start, poses=Pose(away, start.poses.quaternion), pusher=None)
    world.restore(seen)
    camera = goal_camera()
    image = GoalImage(camera, world.render((camera,), with_pusher=False).images[0])
    world.close()
    now = replace(start, poses=Pose(away + [[0.05, 0, 0], [0.12, 0, 0]], start.poses.quaternion))
    found = prefer_current_poses(models().appearance, image, sure(seen, ("it is hardly visible", "")), now)
    np.testing.assert_array_equal(found.state.pose(GELATIN).position, now.pose(GELATIN).position)
    np.testing.assert_array_equal(found.state.pose(CAN).position, seen.pose(CAN).position)
    assert found.trusted
