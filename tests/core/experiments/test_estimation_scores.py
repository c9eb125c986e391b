import json
from dataclasses import replace

import numpy as np
import pytest

from osfcore.experiments.estimation_scores import (
    FrameScore,
    TrackScore,
    coverage,
    flagged_shares,
    flags,
    lost_at,
    objects_of,
    pose_errors,
    ratios_of,
    refused_frame,
    score_frame,
    share_right,
)
from osfcore.geometry.light import Light
from osfcore.geometry.poses import Pose, quaternion_exp, quaternion_multiply
from osfcore.geometry.states import EstimatedState, SceneState
from osfcore.io.json_codec import decode, encode
from tests.support.estimate_scores import frame, score, track

BOX, CAN = NAMES = ("003_cracker_box", "005_tomato_soup_can")


@pytest.fixture(scope="module")
def assets(library):
    return {name: library.load(name) for name in NAMES}


@pytest.fixture
def truth():
    rng = np.random.default_rng(1)
    poses = Pose(rng.normal(0, 0.1, (2, 3)), quaternion_exp(rng.normal(size=(2, 3))))
    return SceneState(NAMES, poses, Light([0.3, 0.1, 0.9]), None)


def believed(truth, shift=(0, 0, 0), turn=(0, 0, 0), *, doubts=("", ""), reason="", std=0.001, light=None):
    """The truth, the first object shifted [m] and turned [rad]."""
    position, quaternion = truth.poses.position.copy(), truth.poses.quaternion.copy()
    position[0] += shift
    quaternion[0] = quaternion_multiply(quaternion_exp(np.array(turn, float)), quaternion[0])
    state = replace(truth, poses=Pose(position, quaternion), light=light or truth.light)
    return EstimatedState(state, np.full(2, std), np.full(2, std), 0.01, doubts, reason)


def test_errors_are_what_was_done_to_the_truth(truth, assets):
    estimate = believed(truth, (0.003, 0, -0.004), (0, 0.06, 0))
    found = score_frame(estimate, truth, assets, 3.0)
    first, second = found.objects
    assert first.position_mm == pytest.approx(5)
    assert first.rotation_deg == pytest.approx(np.rad2deg(0.06))
    np.testing.assert_allclose(first.position_ratios, [3, 0, 4], atol=1e-9)
    np.testing.assert_allclose(first.rotation_ratios, [0, 60, 0], atol=1e-6)
    assert 0 < first.adds_mm < 15
    assert second.position_mm == second.adds_mm == 0
    assert second.rotation_deg == pytest.approx(0, abs=1e-6)
    assert found.light_deg == pytest.approx(0, abs=1e-6)
    assert (found.seconds, found.trusted, found.is_right) == (3.0, True, True)
    shift, turn = pose_errors(estimate.state, truth, assets)
    np.testing.assert_allclose(shift, [5, 0], atol=1e-12)
    np.testing.assert_allclose(turn, [np.rad2deg(0.06), 0], atol=1e-6)


def test_the_order_of_objects_plays_no_part(truth, assets):
    estimate = believed(truth, (0.02, 0, 0))
    swapped = replace(estimate.state, names=NAMES[::-1], poses=estimate.state.poses[::-1])
    found = score_frame(replace(estimate, state=swapped), truth, assets, 0.0, ("", "out of view"))
    assert [(o.name, round(o.position_mm), o.absent) for o in found.objects] == [(CAN, 0, "out of view"), (BOX, 20, "")]


def test_light_errors_are_angles_across_the_true_direction(truth, assets):
    turned = Light(truth.light.direction + 0.02 * np.cross(truth.light.direction, [0, 0, 1.0]))
    found = score_frame(believed(truth, light=turned), truth, assets, 0.0)
    assert found.light_deg == pytest.approx(np.rad2deg(0.02 * np.hypot(*truth.light.direction[:2])), rel=1e-3)
    assert np.hypot(*found.light_ratios) == pytest.approx(np.deg2rad(found.light_deg) / 0.01)
    held = score_frame(replace(believed(truth), light_std=0.0), truth, assets, 0.0)
    assert held.light_ratios == ()


def test_boundless_and_vanishing_deviations_stay_plain_numbers(truth, assets):
    for std in (0.0, np.inf):
        found = score_frame(believed(truth, (0.003, 0, 0), std=std), truth, assets, 0.0)
        json.dumps(encode(found), allow_nan=False)
        assert found.objects[0].position_ratios[0] == (0 if std else 1e6)


def test_scores_survive_json(truth, assets):
    found = score_frame(believed(truth, (0.003, 0, 0), doubts=("why", ""), reason="why"), truth, assets, 1.5)
    for kind, one in ((FrameScore, found), (FrameScore, refused_frame(NAMES, "no", 0.1)), (TrackScore, track([1.0]))):
        assert decode(kind, json.loads(json.dumps(encode(one))), "score") == one


def test_coverage_looks_at_right_estimates_only():
    frames = [
        frame(score(ratios=(0.5, 1.0, 3.0)), light=(9.0, 9.0)),
        frame(score(position_mm=50, ratios=(99.0,) * 3), light=(99.0, 99.0)),
    ]
    found = ratios_of(frames)
    assert found.position == found.rotation == (0.5, 1.0, 3.0)
    assert found.light == (9.0, 9.0)
    assert coverage(found.position) == pytest.approx(2 / 3)
    assert coverage(found.pooled) == pytest.approx(4 / 8)
    assert coverage(()) is None
    errors = np.abs(np.random.default_rng(0).normal(size=20_000))
    assert coverage(errors) == pytest.approx(0.9545, abs=0.008)


def test_a_refused_frame_counts_as_wrong_in_shares():
    frames = [frame(score(), score(position_mm=10.0), score(rotation_deg=5.0)), refused_frame(("a",), "no", 0.0)]
    assert share_right(frames) == pytest.approx(1 / 4)
    assert len(objects_of(frames)) == 3
    assert not frames[1].is_right
    assert share_right([]) is None


def test_flags_are_counted_apart_for_right_and_wrong_estimates(truth):
    right = [score(flagged=True), score(), score(), score()]
    wrong = [score(position_mm=20, flagged=True), score(rotation_deg=90)]
    assert flagged_shares([frame(*right), frame(*wrong)]) == (0.25, 0.5)
    assert flagged_shares([frame(*right)]) == (0.25, None)
    assert flags(believed(truth)) == (False, False)
    assert flags(believed(truth, doubts=("why", ""), reason="why")) == (True, False)
    assert flags(believed(truth, reason="too dark")) == (True, True)  # a doubt about the whole


@pytest.mark.parametrize(
    ("position", "rotation", "absent", "expected"),
    [
        ([0, 40, 0, 40, 0], [0] * 5, [""] * 5, None),
        ([0, 31, 31, 0, 0], [0] * 5, [""] * 5, 2),
        ([30] * 5, [20] * 5, [""] * 5, None),  # not over
        ([0, 40, 0, 0, 0], [0, 0, 21, 0, 0], [""] * 5, 2),  # one way or the other
        ([0, 0, 0, 0, 40], [0] * 5, [""] * 5, None),  # once only
        ([40] * 5, [0] * 5, ["off the table"] * 5, None),
        ([40] * 5, [0] * 5, ["", "out of view", "", "", ""], 3),
    ],
)
def test_a_track_is_lost_when_it_is_far_off_for_two_steps_running(position, rotation, absent, expected):
    assert lost_at(position, rotation, absent) == expected


def test_each_object_is_lost_by_itself():
    assert track([0.0, 40.0, 0.0], [0.0, 0.0, 40.0]).lost_at == (None, None)  # never the same one twice
    assert track([0.0, 40.0, 40.0], [0.0, 0.0, 40.0]).lost_at == (2, None)
    nothing = replace(track([0.0]), position_mm=(), rotation_deg=(), absent=(), refused="no start")
    assert nothing.lost_at == (0,)
