import numpy as np
import pytest
from hypothesis import example, given, settings
from hypothesis import strategies as st

from osfcore.geometry.light import Light
from osfcore.geometry.poses import Pose, quaternion_exp, quaternion_multiply
from osfcore.geometry.states import SceneState
from osfcore.metrics.success import RearrangementScore, RearrangementTask, score_of
from osfcore.objects.asset import Symmetry
from osfcore.objects.catalogue import CATALOGUE

NAMES = ("003_cracker_box", "009_gelatin_box", "061_foam_brick")
SYMMETRIES = {name: CATALOGUE[name].symmetry for name in NAMES}


def state(positions, quaternions=None) -> SceneState:
    turns = np.tile([1.0, 0, 0, 0], (3, 1)) if quaternions is None else np.asarray(quaternions)
    return SceneState(NAMES, Pose(np.asarray(positions, float), turns), Light(np.array([0, 0, 1.0])), None)


START = state([[0, 0, 0.1], [0.2, 0, 0.02], [0, 0.2, 0.03]])
GOAL = state([[0.1, 0, 0.1], [0.2, 0, 0.02], [0, 0.2, 0.03]])
TASK = RearrangementTask(0, START, GOAL, NAMES[:1])


def off(shifts=(), turns=(), task: RearrangementTask = TASK, symmetries=SYMMETRIES) -> RearrangementScore:
    """The score of the goal with some objects off by a shift [m] along y, or a turn [rad] about z."""
    positions, quaternions = GOAL.poses.position.copy(), GOAL.poses.quaternion.copy()
    for n, shift in dict(shifts).items():
        positions[n, 1] += shift
    for n, turn in dict(turns).items():
        quaternions[n] = quaternion_multiply(quaternion_exp(np.array([0, 0, turn])), quaternions[n])
    return score_of(task, state(positions, quaternions), symmetries)


@given(shift=st.floats(0, 0.1), turn=st.floats(0, 3.1))
@settings(max_examples=40)
@example(0.0, 0.0)
def test_a_shift_and_a_turn_of_the_one_object_are_its_errors(shift, turn):
    score = off({0: shift}, {0: turn})
    assert (score.others_mm, len(score.moved)) == (0.0, 1)
    assert score.moved_mm == pytest.approx(1000 * shift)
    assert score.moved_deg == pytest.approx(np.rad2deg(turn), abs=1e-4)
    chord = 2 * np.sin(turn / 4)  # between unit quaternions half a turn apart at an angle of turn / 2
    assert score.pose6d == pytest.approx(np.hypot(shift, chord) / 3, abs=1e-6)


def test_thresholds_are_of_distance_and_of_angle():
    assert off().is_success(0.0, 0.1)
    assert not score_of(TASK, START, SYMMETRIES).is_success()
    every = off({0: 0.03, 1: 0.006}, {2: 0.3}, RearrangementTask(2, START, GOAL, NAMES))
    assert (len(every.moved), every.moved_mm) == (3, pytest.approx(12))
    assert not every.is_success()
    assert every.is_success(0.031)
    assert off({0: 0.0199}).is_success()
    assert not off({0: 0.0201}).is_success()
    assert off({0: 0.0201}).is_success(0.03)
    assert off({0: 0.0199}, {0: 0.0999}).is_tight()
    assert not off(turns={1: 0.1001}).is_tight()  # it should have stayed as it was
    turned = off(turns={0: np.deg2rad(16)})
    assert turned.is_success()
    assert not turned.is_success(threshold_deg=15.0)
    assert off(turns={0: np.deg2rad(14)}).is_success(threshold_deg=15.0)


def test_what_should_stay_must_not_be_pushed_away():
    assert off({1: 0.0199}).is_success()
    spoiled = off({1: 0.0201, 2: -0.01})
    assert spoiled.others_mm == pytest.approx(20.1)
    assert spoiled.moved_mm == spoiled.to_json()["moved_mm"] == 0
    assert not spoiled.is_success(1.0)


def test_orientations_that_look_the_same_are_the_same():
    brick = RearrangementTask(0, START, GOAL, NAMES[2:])
    assert off(turns={2: np.pi}, task=brick).moved_deg == pytest.approx(0, abs=1e-4)
    assert off(turns={2: np.pi / 2}, task=brick).moved_deg == pytest.approx(90)
    turned = off(turns={2: np.pi}, task=brick)
    assert turned.pose6d == pytest.approx(np.sqrt(2) / 3)
    assert turned.pose6d_symmetric == pytest.approx(0, abs=1e-6)
    none = dict.fromkeys(NAMES, Symmetry("none"))
    assert off(turns={2: np.pi}, task=brick, symmetries=none).moved_deg == pytest.approx(180)
