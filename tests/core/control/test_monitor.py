from dataclasses import replace

import numpy as np
import pytest

from osfcore.control.closed_loop import ProgressMonitor, lamp_moved, lies_otherwise, moved_by_hand, offsets
from osfcore.geometry.light import Light
from osfcore.geometry.poses import Pose, quaternion_exp
from osfcore.geometry.states import SceneState
from osfcore.planning.costs import PoseGoal

UPRIGHT = np.array([1.0, 0, 0, 0])
STATE = SceneState(
    ("a", "b"),
    Pose(np.array([[0.1, 0.0, 0.02], [-0.2, 0.05, 0.03]]), np.stack([UPRIGHT, UPRIGHT])),
    Light(np.array([0.0, 0.3, 1])),
    np.array([0.15, 0.0, 0.06]),
)


def shifted(state: SceneState, number: int, shift) -> SceneState:
    position = state.poses.position.copy()
    position[number] += shift
    return replace(state, poses=Pose(position, state.poses.quaternion))


def test_offsets_are_on_the_table_and_turns_about_any_axis():
    there = Pose(np.array([0.1, 0.03, 0.5]), quaternion_exp(np.array([0, 0, 0.4])))
    far, turned = offsets(PoseGoal.of(STATE, {"a": there}), STATE)
    np.testing.assert_allclose(far, [0.03, 0], atol=1e-12)
    np.testing.assert_allclose(turned, [0.4, 0], atol=1e-7)


def test_what_is_turned_about_the_vertical_lies_on_the_same_side_and_what_rolled_does_not():
    turned, rolled = (Pose(STATE.pose("a").position, quaternion_exp(np.array(by))) for by in ([0, 0, 2.0], [0.4, 0, 0]))
    np.testing.assert_array_equal(lies_otherwise(PoseGoal.of(STATE, {"a": turned}), STATE), [False, False])
    np.testing.assert_array_equal(lies_otherwise(PoseGoal.of(STATE, {"a": rolled}), STATE), [True, False])


def test_patience_lasts_while_there_is_progress():
    patience = ProgressMonitor()
    assert not any(patience.is_stalled(0.5 - 0.005 * step) for step in range(60))


def test_patience_ends_after_a_while_without_and_begins_anew():
    patience = ProgressMonitor()
    told = [patience.is_stalled(0.2) for _ in range(40)]
    assert told.index(True) == 16
    assert sum(told) == 2


@pytest.mark.parametrize(("angle", "is_told"), [(0.0, False), (0.03, False), (0.2, True), (1.0, True)])
def test_a_lamp_counts_as_moved_from_a_few_degrees_on(angle, is_told):
    told = lamp_moved(Light.from_angles(0.3, 0.3), Light.from_angles(0.3, 0.3 + angle))
    assert told == (pytest.approx(angle) if is_told else None)


def test_an_object_far_from_the_pusher_was_carried():
    assert moved_by_hand(STATE, shifted(STATE, 1, [0.0, 0.06, 0.0])) == ("b",)
    assert moved_by_hand(STATE, shifted(STATE, 1, [0.0, 0.01, 0.0])) == ()


def test_what_the_pusher_can_reach_may_have_been_pushed():
    assert moved_by_hand(STATE, shifted(STATE, 0, [0.0, 0.06, 0.0])) == ()
