import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st

from app.services.pushes import beyond_nearest, outcomes, toward
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


@given(st.tuples(place, place), st.floats(0.05, 0.3))
def test_a_push_ends_at_its_target_within_limits(target, speed):
    start = np.array([0.3, 0.3])
    try:
        actions = toward(start, np.array(target), speed)
    except InvalidInput:
        return
    check_actions(actions[None])
    assert np.linalg.norm(actions, axis=1).max() <= speed + 1e-9
    end = start + STEP_S * actions[:, :2].sum(axis=0)
    np.testing.assert_allclose(end, np.clip(target, -PUSHER_REACH_M, PUSHER_REACH_M), atol=1e-9)


def test_a_fast_diagonal_keeps_to_the_limit_of_each_axis():
    actions = toward(np.zeros(2), np.array([0.12, 0.0]), 1.0)
    np.testing.assert_allclose(actions, [[0.3, 0, 0], [0.3, 0, 0]], atol=1e-12)


@pytest.mark.parametrize(
    ("target", "speed", "words"), [([0.0, 0.0], 0.1, "is 0"), ([0.3, 0.3], 0.01, "50"), ([np.nan, 0], 0.1, "finite")]
)
def test_pushes_that_lead_nowhere_or_take_too_long_are_refused(target, speed, words):
    with pytest.raises(InvalidInput, match=words):
        toward(np.zeros(2), np.array(target), speed)


def test_the_nearest_object_is_pushed_a_little_beyond_its_place():
    target = beyond_nearest(state([[0.1, 0.1, 0.1], [-0.2, 0.2, 0.1]]))
    assert target == pytest.approx([0.1, 0.05])
    assert beyond_nearest(state([])) is beyond_nearest(state([[0, 0, 0]], pusher=None)) is None


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
