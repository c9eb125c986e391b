import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st

from app.services.pushes import MAX_ACTIONS, along, outcomes, straight, toward_nearest, way
from osfcore.errors import InvalidInput
from osfcore.geometry.light import Light
from osfcore.geometry.poses import Pose
from osfcore.geometry.rollouts import Rollouts, check_actions
from osfcore.geometry.states import SceneState
from osfcore.geometry.workspace import PUSHER_CENTRE_Z_M, PUSHER_REACH_M, STEP_S

BOX, CAN = "003_cracker_box", "005_tomato_soup_can"
place = st.floats(-0.5, 0.5)


def state(positions, quaternions=None, pusher=(0.1, 0.2)):
    count = len(positions)
    turns = np.tile([1.0, 0, 0, 0], (count, 1)) if quaternions is None else np.array(quaternions)
    hand = None if pusher is None else np.array([*pusher, PUSHER_CENTRE_Z_M])
    poses = Pose(np.array(positions, float).reshape(count, 3), turns.reshape(count, 4))
    return SceneState((BOX, CAN)[:count], poses, Light(np.array([0, 0, 1.0])), hand)


@given(st.floats(0, 7), st.floats(0.05, 0.3), st.integers(1, MAX_ACTIONS))
def test_straight_goes_as_far_as_speed_and_time_tell(heading, speed, count):
    actions = check_actions(straight(heading, speed, count)[None])[0]
    assert actions.shape == (count, 3)
    assert np.linalg.norm(STEP_S * actions.sum(axis=0)) == pytest.approx(speed * count * STEP_S)


@given(st.lists(st.tuples(place, place), min_size=1, max_size=3), st.floats(0.2, 0.3))
def test_along_passes_every_waypoint_within_limits(waypoints, speed):
    start = np.array([0.3, 0.3])
    try:
        actions = along(start, np.array(waypoints), speed)
    except InvalidInput:
        return
    check_actions(actions[None])
    assert np.linalg.norm(actions, axis=1).max() <= speed + 1e-9
    places = way(start, actions)
    for waypoint in np.clip(waypoints, -PUSHER_REACH_M, PUSHER_REACH_M):
        assert np.linalg.norm(places - waypoint, axis=1).min() < 1e-6


def test_a_fast_diagonal_keeps_to_the_limit_of_each_axis():
    actions = along(np.zeros(2), np.array([[0.12, 0.0]]), 1.0)
    np.testing.assert_allclose(actions, [[0.3, 0, 0], [0.3, 0, 0]], atol=1e-12)


@pytest.mark.parametrize(
    ("waypoints", "words"),
    [
        ([[0.0, 0.0]], "number of actions on this path is 0"),
        ([[0.3, 0], [-0.3, 0]] * 4, "50"),
        ([[np.nan, 0]], "finite"),
    ],
)
def test_paths_that_lead_nowhere_or_too_far_are_refused(waypoints, words):
    with pytest.raises(InvalidInput, match=words):
        along(np.zeros(2), np.array(waypoints), 0.1)


def test_the_way_ends_where_the_reach_does():
    np.testing.assert_allclose(way(np.array([0.3, 0]), straight(0, 0.3, 3))[:, 0], [0.3, 0.35, 0.35, 0.35], atol=1e-12)


def test_toward_the_nearest():
    heading, far = toward_nearest(state([[0.1, 0.1, 0.1], [-0.2, 0.2, 0.1]]))
    assert np.rad2deg(heading) == pytest.approx(-90)
    assert far == pytest.approx(0.1)
    assert toward_nearest(state([])) == toward_nearest(state([[0, 0, 0]], pusher=None)) == (0.0, 0.0)


def test_outcomes_tell_ways_and_errors(library):
    before = state([[0, 0, 0.1], [0.2, 0, 0.05]])
    turned = np.array([np.cos(0.1), 0, 0, np.sin(0.1)])
    after = state([[0.05, 0, 0.1], [0.2, 0, 0.05]], [turned, [1, 0, 0, 0]])
    end = np.array([[0.04, 0, 0.1], [0.2, 0, 0.05]])
    rollouts = Rollouts(
        before.names,
        np.stack([before.poses.position, end])[None],
        np.stack([before.poses.quaternion] * 2)[None],
        np.zeros((1, 2, 3)),
    )
    box, can = outcomes(before, rollouts, None, library)
    assert (box.predicted_mm, box.went_mm, box.off_deg) == (pytest.approx(40), None, None)
    box, can = outcomes(before, rollouts, after, library)
    assert (box.went_mm, box.off_mm) == (pytest.approx(50), pytest.approx(10))
    assert (box.predicted_deg, box.turned_deg, box.off_deg) == pytest.approx((0, np.rad2deg(0.2), np.rad2deg(0.2)))
    assert (can.predicted_mm, can.went_mm, can.off_mm) == (0, 0, 0)
