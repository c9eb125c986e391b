import numpy as np
import pytest

from osfcore.experiments.estimation import PARTS, VIEWS, TaskRunner, state_of
from osfcore.experiments.estimation_scores import FrameScore, TrackScore
from osfcore.experiments.estimation_tasks import KINDS, BadScore
from osfcore.experiments.harness import results_of
from osfcore.geometry.cameras import default_cameras
from osfcore.geometry.poses import rotate
from osfcore.io.json_codec import decode
from tests.core.experiments.oracle import SHIFT_M, Oracle
from tests.core.experiments.quick import quick
from tests.core.experiments.solids import SOLIDS


def done(piece):
    """The result of a piece, kept or made now."""
    *_, (result,) = results_of([piece])
    return result


@pytest.fixture
def oracle(monkeypatch):
    oracle = Oracle()
    oracle.install(monkeypatch)
    return oracle


@pytest.fixture
def runner(solids, library, tmp_path, oracle):
    return TaskRunner(quick(tmp_path), SOLIDS, solids, library)


@pytest.mark.slow
def test_the_real_estimators_are_called_as_they_want_to_be(solids, library, tmp_path):
    config = quick(tmp_path, objects=1, names=SOLIDS[:1], steps=1, size=32)
    runner = TaskRunner(config, SOLIDS[:1], solids, library)
    first = done(runner.first(0))
    score = decode(FrameScore, first.figures["score"], "score")
    assert not score.refused
    assert score.seconds > 0
    assert state_of(first).names == SOLIDS[:1]
    assert len(decode(TrackScore, done(runner.track(0, first)).figures["score"], "score").position_mm) == 1
    (goal,) = done(runner.goal(0, first)).figures["scores"]
    assert not goal["refused"]
    assert decode(FrameScore, done(runner.fixed_light(0)).figures["score"], "score").light_ratios == ()
    assert [comparison.label for comparison in first.shown] == [f"camera {n}" for n in range(4)]
    assert np.abs(first.shown[0].ours.astype(int) - first.shown[0].truth).mean() < 20


def test_tracks_and_goals_begin_with_estimates_and_never_with_the_truth(runner, oracle):
    first = done(runner.first(0))
    start = state_of(first)
    track = decode(TrackScore, done(runner.track(0, first)).figures["score"], "score")
    assert [what for what, _ in oracle.asked] == ["first search 4", "next", "next"]
    before, after = oracle.given
    np.testing.assert_array_equal(before.poses.position, start.poses.position)
    assert np.ptp(np.array(track.position_mm)) < 1e-6  # each is off by the shift, also the one that the next began with
    assert track.position_mm[0][0] == pytest.approx(1000 * SHIFT_M)
    assert np.abs(after.poses.position - start.poses.position).max() < 0.1
    assert track.right_at_start == (True, True)
    goals = done(runner.goal(0, first)).figures
    assert [len(names) for names in goals["moved"]] == [1, 2]
    for prior in oracle.given[2:]:
        np.testing.assert_array_equal(prior.poses.position, start.poses.position)


def test_another_first_estimate_makes_later_parts_stale(runner, oracle):
    first = done(runner.first(0))
    done(runner.track(0, first))
    count = len(oracle.asked)
    done(runner.track(0, first))
    assert len(oracle.asked) == count
    first.figures["state"]["objects"][0]["position"][0] += 0.001
    done(runner.track(0, first))
    assert len(oracle.asked) == count + 2


def test_ablations_see_fewer_cameras_or_hold_the_light(runner, oracle):
    done(runner.fixed_light(0))
    for views in VIEWS:
        done(runner.few_views(0, views))
    assert [what for what, _ in oracle.asked] == ["first held 4", "first search 1", "first search 2"]
    one, other = (default_cameras()[n] for n in VIEWS[2])
    forward = [rotate(camera.T_world_camera.quaternion, np.array([0, 0, 1.0])) for camera in (one, other)]
    assert forward[0][:2] @ forward[1][:2] < 0  # they face each other


@pytest.mark.slow
def test_bad_cases_are_judged_by_what_is_there(runner, oracle):
    scores = {kind: decode(BadScore, done(runner.bad(n)).figures["score"], "score") for n, kind in enumerate(KINDS)}
    assert [scores[kind].kind for kind in KINDS] == list(KINDS)
    assert not scores["wrong name"].is_right
    assert len(scores["wrong name"].position_mm) == 1  # the other name is not there
    assert not scores["goal of other objects"].is_right
    assert scores["goal of other objects"].is_confidently_wrong
    assert scores["swapped masks"].is_right  # the oracle sees through it
    assert [what for what, _ in oracle.asked].count("goal") == 2
    before = len(oracle.asked)
    done(runner.bad(0))
    assert len(oracle.asked) == before


def test_a_refused_bad_case_says_so(runner, oracle):
    oracle.refuses = 1
    score = decode(BadScore, done(runner.bad(0)).figures["score"], "score")
    assert "masks" in score.refused
    assert not score.is_confidently_wrong


def test_parts_are_those_that_can_be_asked_for():
    assert PARTS == ("first", "track", "goal", "ablations")
