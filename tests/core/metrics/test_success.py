import json

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st

from osfcore.geometry.light import Light
from osfcore.geometry.poses import Pose, quaternion_exp, quaternion_multiply
from osfcore.geometry.states import SceneState
from osfcore.io.json_codec import decode
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


def test_nothing_off_is_a_success():
    score = off()
    assert (score.moved_mm, score.others_mm, len(score.moved)) == (0.0, 0.0, 1)
    assert score.moved_deg == pytest.approx(0, abs=1e-5)
    assert score.pose6d == pytest.approx(0, abs=1e-9)
    assert score.is_success(0.0, 0.1)
    assert score.is_tight()
    assert not score_of(TASK, START, SYMMETRIES).is_success()
    assert score_of(TASK, START, SYMMETRIES).moved_mm == pytest.approx(100)


@given(shift=st.floats(0, 0.1), turn=st.floats(0, 3.1))
def test_a_shift_and_a_turn_are_what_they_are(shift, turn):
    score = off({0: shift}, {0: turn})
    assert score.moved_mm == pytest.approx(1000 * shift)
    assert score.moved_deg == pytest.approx(np.rad2deg(turn), abs=1e-4)
    chord = 2 * np.sin(turn / 4)  # between unit quaternions half a turn apart at an angle of turn / 2
    assert score.pose6d == pytest.approx(np.hypot(shift, chord) / 3, abs=1e-6)


def test_thresholds_are_of_distance_and_of_angle():
    assert off({0: 0.0199}).is_success()
    assert not off({0: 0.0201}).is_success()
    assert off({0: 0.0201}).is_success(0.03)
    turned = off(turns={0: np.deg2rad(16)})
    assert turned.is_success()
    assert not turned.is_success(threshold_deg=15.0)
    assert off(turns={0: np.deg2rad(14)}).is_success(threshold_deg=15.0)


def test_what_should_stay_must_not_be_pushed_away():
    assert off({1: 0.0199}).is_success()
    spoiled = off({1: 0.0201, 2: -0.01})
    assert spoiled.others_mm == pytest.approx(20.1)
    assert spoiled.moved_mm == 0
    assert not spoiled.is_success(1.0)


def test_every_object_that_had_to_move_must_arrive():
    task = RearrangementTask(2, START, GOAL, NAMES)
    score = off({0: 0.03, 1: 0.006}, {2: 0.3}, task)
    assert (len(score.moved), score.others_mm) == (3, 0.0)
    assert score.moved_mm == pytest.approx(12)
    assert score.moved_deg == pytest.approx(np.rad2deg(0.1), abs=1e-4)
    assert not score.is_success()
    assert score.is_success(0.031)


def test_tight_means_two_centimetres_and_a_tenth_of_a_radian_for_all():
    assert off({0: 0.0199}, {0: 0.0999}).is_tight()
    assert not off({0: 0.0201}).is_tight()
    assert not off(turns={0: 0.1001}).is_tight()
    assert not off(turns={1: 0.1001}).is_tight()  # it should have stayed as it was
    assert off(turns={1: 0.1001}).is_success()


def test_scores_survive_as_json():
    score = off({0: 0.03, 1: 0.006}, {2: 0.3})
    told = json.loads(json.dumps(score.to_json()))
    assert decode(RearrangementScore, told, "score") == score
    assert (told["moved"], told["moved_mm"]) == (1, pytest.approx(30))


def test_orientations_that_look_the_same_are_the_same():
    brick = RearrangementTask(0, START, GOAL, NAMES[2:])
    assert off(turns={2: np.pi}, task=brick).moved_deg == pytest.approx(0, abs=1e-4)
    assert off(turns={2: np.pi / 2}, task=brick).moved_deg == pytest.approx(90)
    turned = off(turns={2: np.pi}, task=brick)
    assert turned.pose6d == pytest.approx(np.sqrt(2) / 3)
    assert turned.pose6d_symmetric == pytest.approx(0, abs=1e-6)
    none = dict.fromkeys(NAMES, Symmetry("none"))
    assert off(turns={2: np.pi}, task=brick, symmetries=none).moved_deg == pytest.approx(180)


@given(signs=st.tuples(*[st.sampled_from([-1.0, 1.0])] * 3), turn=st.floats(-3.0, 3.0))
def test_a_quaternion_and_its_opposite_are_the_same(signs, turn):
    turned = np.tile(quaternion_exp(np.array([0, 0, turn])), (3, 1))
    plain = score_of(TASK, state(GOAL.poses.position, turned), SYMMETRIES)
    flipped = score_of(TASK, state(GOAL.poses.position, turned * np.array(signs)[:, None]), SYMMETRIES)
    assert flipped.pose6d == pytest.approx(plain.pose6d, abs=1e-9)
    assert flipped.moved_deg == pytest.approx(plain.moved_deg, abs=1e-4)
