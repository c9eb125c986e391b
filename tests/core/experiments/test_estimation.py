import json
from concurrent.futures import ProcessPoolExecutor
from dataclasses import replace
from multiprocessing import get_context
from pathlib import Path

import cv2
import numpy as np
import pytest

from osfcore.errors import InvalidInput, MissingAssets, UnknownName
from osfcore.estimation.first_frame import FirstFrameConfig
from osfcore.estimation.goal_image import GoalImageConfig
from osfcore.estimation.tracking import TrackingConfig
from osfcore.experiments import estimation
from osfcore.experiments.estimation_tasks import KINDS, BadScore
from osfcore.experiments.harness import results_of
from osfcore.geometry.light import Light
from osfcore.geometry.poses import Pose, quaternion_exp, quaternion_multiply
from osfcore.geometry.states import EstimatedState, SceneState
from osfcore.inspection.contact_sheet import Comparison
from osfcore.io.json_codec import decode, encode
from osfcore.objects.asset_library import AssetLibrary
from tests.support.errors import about
from tests.support.estimate_scores import frame, report, score, track
from tests.support.oracle import SHIFT_M, Oracle
from tests.support.solids import SOLIDS

EFFORT = FirstFrameConfig(
    starts=1, population=4, generations=1, joint_population=4, joint_generations=1, coarse_iterations=1,
    fine_iterations=1,
)  # fmt: skip
TRACK = TrackingConfig(sweeps=1, population=4, generations=1)
GOAL = GoalImageConfig(side=64, planar_iterations=1, free_iterations=1)
LOST = replace(track([0.0]), position_mm=(), rotation_deg=(), absent=(), seconds=(), refused="no masks")


def quick(out: Path, **settings) -> estimation.EvaluateEstimate:
    """Two solids in small images, with hardly any search: what is found is not good."""
    small = {"objects": 2, "names": SOLIDS, "steps": 2, "size": 32, "effort": EFFORT, "track": TRACK, "goal": GOAL}
    return estimation.EvaluateEstimate(out, **{**small, **settings})


def last(steps):
    *_, step = steps
    return step


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
    return estimation.TaskRunner(quick(tmp_path), SOLIDS, solids, library)


# Evaluation


@pytest.fixture(scope="module")
def evaluated(solids, library, tmp_path_factory):
    """Two tasks of two objects with everything, and ten bad cases."""
    config = quick(tmp_path_factory.mktemp("estimates"), tasks=2, bad=10)
    with pytest.MonkeyPatch.context() as patch:
        Oracle().install(patch)
        steps = list(estimation.evaluate_estimate(config, solids, library))
    return config, steps


@pytest.mark.slow
def test_everything_is_measured_and_reported(evaluated):
    config, steps = evaluated
    result = json.loads(json.dumps(steps[-1].report.to_json(), allow_nan=False))
    assert (result["tasks"], result["objects_total"], result["goal_objects_total"]) == (2, 4, 8)
    assert result["frac_1cm_5deg"] == result["goal_frac_1cm_5deg"] == result["frac_1cm_5deg_fixed_light"] == 1
    assert result["position_mm_median"] == pytest.approx(1000 * SHIFT_M)
    assert result["rotation_deg_median"] == pytest.approx(0, abs=1e-5)
    assert result["light_deg_median"] == pytest.approx(0, abs=1e-5)
    assert result["two_sigma_coverage"] == result["mean_position_std_mm"] == pytest.approx(1)
    assert (result["track_episodes"], result["track_lost"], result["track_frac_1cm_5deg"]) == (2, 0, 1)
    assert result["bad_confident_wrong"] == sum(row["confident_wrong"] for row in result["bad_by_kind"].values())
    assert result["bad_by_kind"]["wrong name"] == result["bad_by_kind"]["goal of other objects"]
    assert json.loads((config.folder / estimation.REPORT_FILE).read_text()) == result
    assert config.folder == config.out / "estimate" / "2-objects-seed-0"
    pictures = {path.name for path in config.folder.glob("*.*g")}
    assert pictures == {"errors.svg", "calibration.svg", "track.svg", "views.svg", "failures_bad.png"}
    assert [(step.done, step.total) for step in steps] == [(n, 22) for n in range(23)]
    assert [step.report is None for step in steps] == [True] * 22 + [False]


@pytest.mark.slow
def test_what_was_measured_is_taken_over_unless_circumstances_changed(evaluated, solids, library, oracle):
    config, steps = evaluated
    again = last(estimation.evaluate_estimate(config, solids, library))
    assert again.report.to_json() == steps[-1].report.to_json()
    config = replace(config, bad=0)
    fewer = last(estimation.evaluate_estimate(replace(config, tasks=1, parts=("goal",)), solids, library)).report
    assert fewer.first == steps[-1].report.first[:1]
    assert fewer.goals == steps[-1].report.goals[:1]
    assert fewer.tracks is fewer.views is fewer.fixed_light is fewer.bad is None
    assert not oracle.asked
    effort = replace(EFFORT, generations=2)
    for change in ({"tasks": 3}, {"seed": 1}, {"size": 48}, {"effort": effort}):
        before = len(oracle.asked)
        last(estimation.evaluate_estimate(replace(config, parts=("first",), **change), solids, library))
        assert len(oracle.asked) - before == (1 if "tasks" in change else 2)


def test_a_killed_evaluation_goes_on(solids, library, tmp_path, oracle):
    config = quick(tmp_path, tasks=2, parts=("track",), factors=("noise_2",))
    for step in estimation.evaluate_estimate(config, solids, library):
        if step.done == 3:
            break
    assert [what for what, _ in oracle.asked] == ["first search 4"] * 2 + ["next"] * 2
    found = last(estimation.evaluate_estimate(config, solids, library)).report
    assert [what for what, _ in oracle.asked[4:]] == ["next"] * 2 + ["first search 4"] * 2
    assert [frame.names for frame in found.first] == [names for _, names in oracle.asked[:2]]
    assert all(len(track.seconds) == 2 for track in found.tracks)
    assert found.to_json()["by_factor"]["noise_2"]["objects_total"] == 4


@pytest.mark.slow
def test_a_refused_first_frame_is_a_result_too(solids, library, tmp_path, oracle):
    oracle.refuses = 1
    found = last(estimation.evaluate_estimate(quick(tmp_path, tasks=2), solids, library)).report
    assert [bool(frame.refused) for frame in found.first] == [True, False]
    assert [bool(track.refused) for track in found.tracks] == [True, False]
    assert [goal.refused != "" for task in found.goals for goal in task] == [True, True, False, False]
    result = found.to_json()
    assert (result["frac_1cm_5deg"], result["track_lost"], result["first_refused"]) == (0.5, 1, 1)
    assert (quick(tmp_path).folder / "failures_first.png").exists()
    assert last(estimation.evaluate_estimate(quick(tmp_path, tasks=2), solids, library)).report.to_json() == result


def test_what_cannot_be_measured_is_refused_before_anything_is_done(solids, library, tmp_path, oracle):
    config = quick(tmp_path / "out")
    for change, error, what in (
        ({"names": ("teapot",)}, UnknownName, "teapot"),
        ({"factors": ("fog",)}, UnknownName, "fog"),
        ({"objects": 4}, InvalidInput, "number of names"),
        ({"bad": 1, "objects": 3}, InvalidInput, "number of names"),
        ({"bad": 1, "objects": 1}, InvalidInput, "objects in a scene"),
        ({"parts": ("second",)}, InvalidInput, "part"),
    ):
        with pytest.raises(error, check=about(what)):
            next(estimation.evaluate_estimate(replace(config, **change), solids, library))
    with pytest.raises(MissingAssets):
        next(estimation.evaluate_estimate(config, solids, AssetLibrary(tmp_path / "none")))
    assert not oracle.asked
    assert not (tmp_path / "out").exists()


@pytest.mark.slow
def test_an_executor_changes_no_estimate(solids, library, tmp_path):
    config = quick(tmp_path / "alone", tasks=1, objects=1, names=SOLIDS[:1], parts=("first",))
    alone = last(estimation.evaluate_estimate(config, solids, library)).report
    with ProcessPoolExecutor(1, mp_context=get_context("spawn")) as executor:
        shared = last(
            estimation.evaluate_estimate(replace(config, out=tmp_path / "shared"), solids, library, executor)
        ).report
    for one, other in zip(alone.first, shared.first, strict=True):
        assert replace(one, seconds=other.seconds) == other


# Parts


@pytest.mark.slow
def test_the_real_estimators_are_called_as_they_want_to_be(solids, library, tmp_path):
    config = quick(tmp_path, objects=1, names=SOLIDS[:1], steps=1)
    runner = estimation.TaskRunner(config, SOLIDS[:1], solids, library)
    first = done(runner.first(0))
    score = decode(estimation.FrameScore, first.figures["score"], "score")
    assert not score.refused
    assert score.seconds > 0
    assert estimation.state_of(first).names == SOLIDS[:1]
    assert len(decode(estimation.TrackScore, done(runner.track(0, first)).figures["score"], "score").position_mm) == 1
    (goal,) = done(runner.goal(0, first)).figures["scores"]
    assert not goal["refused"]
    assert decode(estimation.FrameScore, done(runner.fixed_light(0)).figures["score"], "score").light_ratios == ()
    assert np.abs(first.shown[0].ours.astype(int) - first.shown[0].truth).mean() < 20


@pytest.mark.slow
def test_parts_see_what_they_should_and_begin_with_estimates_never_with_the_truth(runner, oracle):
    done(runner.fixed_light(0))
    for cameras in estimation.VIEWS.values():
        done(runner.first(0, cameras))
    assert [what for what, _ in oracle.asked] == ["first held 4", "first search 1", "first search 2"]
    oracle.asked.clear()
    first = done(runner.first(0))
    start = estimation.state_of(first)
    track = decode(estimation.TrackScore, done(runner.track(0, first)).figures["score"], "score")
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
    asked = len(oracle.asked)
    first.figures["state"]["objects"][0]["position"][0] += 0.001
    done(runner.track(0, first))  # another first estimate makes it stale
    assert len(oracle.asked) == asked + 2


@pytest.mark.slow
def test_bad_cases_are_judged_by_what_is_there(runner, oracle):
    oracle.refuses = 1
    assert decode(BadScore, done(runner.bad(len(KINDS))).figures["score"], "score").refused
    scores = {kind: decode(BadScore, done(runner.bad(n)).figures["score"], "score") for n, kind in enumerate(KINDS)}
    assert [scores[kind].kind for kind in KINDS] == list(KINDS)
    assert not scores["wrong name"].is_right
    assert len(scores["wrong name"].position_mm) == 1  # the other name is not there
    assert not scores["goal of other objects"].is_right
    assert scores["goal of other objects"].is_confidently_wrong
    assert scores["swapped masks"].is_right  # the oracle sees through it
    assert [what for what, _ in oracle.asked].count("goal") == 2


# Report


def test_figures_follow_from_the_scores():
    found = json.loads(json.dumps(report().to_json(), allow_nan=False))
    assert (found["frac_1cm_5deg"], found["position_mm_median"], found["first_s_median"]) == (0.75, 1.5, 2)
    assert found["goal_frac_1cm_5deg"] == 7 / 8
    assert found["goal_frac_1cm_5deg_by_moved"] == {"1": 1.0, "2": 0.75}
    assert found["frac_1cm_5deg_fixed_light"] == found["fixed_light"]["frac_1cm_5deg"] == 0.5
    assert {n: row["frac_1cm_5deg"] for n, row in found["by_views"].items()} == {"1": 0.5, "2": 0.75, "4": 0.75}
    assert (found["refine_hz"], found["refine_s_p90"]) == (2.0, 0.5)
    assert found["mean_position_std_mm"] == 1.0
    assert found["two_sigma_coverage"] == found["two_sigma_coverage_light"] == 1.0  # the wrong frame's light is out
    assert (found["flagged_good"], found["flagged_bad"]) == (0.0, 1.0)
    assert (found["bad_cases"], found["bad_refused"], found["bad_confident_wrong"]) == (2, 1, 1)
    boundless = estimation.EstimateReport((frame(score(std_mm=None), score(std_mm=3.0)),)).to_json()
    assert boundless["mean_position_std_mm"] == pytest.approx(3.0)


def test_what_was_not_measured_is_null_under_the_same_keys():
    bare = estimation.EstimateReport(report().first).to_json()
    assert set(bare) == {key for key in report().to_json() if not key.startswith("bad_")}
    empty = ("refine_hz", "track_lost", "goal_frac_1cm_5deg", "frac_1cm_5deg_fixed_light", "by_views")
    assert {bare[key] for key in empty} == {None}
    assert bare["flagged_bad"] == 1.0  # of first frames alone


def test_lost_episodes_are_counted_and_drift_is_the_median_over_visible_objects():
    tracks = (
        track([0.0, 40.0, 40.0], [0.0, 50.0, 50.0]),
        track([40.0, 40.0, 40.0], [0.0, 0.0, 0.0], right=False),
        track([0.0, 40.0, 0.0]),
    )
    found = replace(report(), tracks=tracks).to_json()
    assert (found["track_episodes"], found["track_lost"], found["track_objects_lost"]) == (3, 2, 3)
    assert found["track_lost_from_wrong_start"] == 1
    tracks = [track([float(step) for step in range(15)], [float(step) + 2 for step in range(15)], rotation=3.0)]
    assert estimation.drift(tracks, 0) == {"5": 5.0, "10": 10.0, "15": 15.0, "20": None}
    assert estimation.drift(tracks, 1) == {"5": 3.0, "10": 3.0, "15": 3.0, "20": None}
    tracks = (track([1.0, 1.0, 1.0, 1.0, 1.0]), track([99.0] * 5, absent="off the table"))
    found = replace(report(), tracks=tracks).to_json()
    assert (found["track_off_table"], found["track_out_of_view"], found["track_lost"]) == (5, 0, 0)
    assert found["track_frac_1cm_5deg"] == found["drift_mm"]["5"] == 1


def test_refusals_count_everywhere_and_can_be_drawn(tmp_path):
    refused = estimation.refused_frame(("can", "box"), "no masks", 0.5)
    nothing = estimation.EstimateReport((refused,), (LOST,), ((refused,),), (refused,), {1: (refused,), 2: (refused,)})
    found = nothing.to_json()
    json.dumps(found, allow_nan=False)
    assert found["frac_1cm_5deg"] == found["goal_frac_1cm_5deg"] == 0
    assert found["first_refused"] == found["goal_refused"] == found["track_lost"] == 1
    assert found["position_mm_median"] is found["refine_hz"] is found["two_sigma_coverage"] is None
    estimation.write_plots(tmp_path / "all", nothing)
    assert {path.stem for path in (tmp_path / "all").iterdir()} == {"errors", "calibration", "track", "views"}
    estimation.write_plots(tmp_path / "first", estimation.EstimateReport((refused,)))
    assert {path.stem for path in (tmp_path / "first").iterdir()} == {"errors", "calibration"}


# Galleries


@pytest.fixture
def shown():
    return (Comparison("camera 0", *np.zeros((2, 32, 32, 3), np.uint8)),)


def test_failures_are_what_is_wrong_lost_or_believed_and_the_worst_come_without_a_warning(shown):
    assert estimation.frame_failure("task 0", frame(score(), score()), shown) is None
    warned = estimation.frame_failure("task 0", frame(score(flagged=True)), shown)
    flagged = estimation.frame_failure("task 1", frame(score(20.0, flagged=True), score(30.0, flagged=True)), shown)
    unflagged = estimation.frame_failure("task 2", frame(score(), score(1.0, 170.0)), shown)
    refused = estimation.frame_failure("task 3", estimation.refused_frame(("a",), "no masks", 0.0), shown)
    assert refused.badness > unflagged.badness > flagged.badness > warned.badness
    assert "no masks" in refused.lines[0]
    assert estimation.track_failure("task 0", track([1.0] * 5), shown) is None
    lost = estimation.track_failure("task 0", track([1.0] * 5, [1.0, 1.0, 40.0, 40.0, 40.0], right=False), shown)
    assert "step 4" in lost.lines[0]
    assert len(lost.lines) == 2
    assert estimation.track_failure("task 0", LOST, shown).badness > lost.badness
    wrong = BadScore(KINDS[3], "", "", False, (50.0, 1.0), (3.0, 4.0))
    assert estimation.bad_failure("bad case 3", wrong, shown)
    assert not estimation.bad_failure("bad case 3", replace(wrong, reason="too dark"), shown)


def test_a_gallery_shows_the_worst_and_goes_when_nothing_fails(shown, tmp_path):
    path = tmp_path / "failures.png"
    failure = estimation.frame_failure("task 1", frame(score(20.0)), shown)
    estimation.write_gallery(path, [failure])
    one = cv2.imread(str(path)).shape
    estimation.write_gallery(path, [None, *[failure] * (estimation.MOST_SHOWN + 1)])
    assert cv2.imread(str(path)).shape == (estimation.MOST_SHOWN * one[0], one[1], 3)
    estimation.write_gallery(path, [None])
    assert not path.exists()


# Scores


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
    found = estimation.score_frame(estimate, truth, assets, 3.0)
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
    shift, turn = estimation.pose_errors(estimate.state, truth, assets)
    np.testing.assert_allclose(shift, [5, 0], atol=1e-12)
    np.testing.assert_allclose(turn, [np.rad2deg(0.06), 0], atol=1e-6)


def test_the_order_of_objects_plays_no_part(truth, assets):
    estimate = believed(truth, (0.02, 0, 0))
    swapped = replace(estimate.state, names=NAMES[::-1], poses=estimate.state.poses[::-1])
    found = estimation.score_frame(replace(estimate, state=swapped), truth, assets, 0.0, ("", "out of view"))
    assert [(o.name, round(o.position_mm), o.absent) for o in found.objects] == [(CAN, 0, "out of view"), (BOX, 20, "")]


def test_light_errors_are_angles_across_the_true_direction(truth, assets):
    turned = Light(truth.light.direction + 0.02 * np.cross(truth.light.direction, [0, 0, 1.0]))
    found = estimation.score_frame(believed(truth, light=turned), truth, assets, 0.0)
    assert found.light_deg == pytest.approx(np.rad2deg(0.02 * np.hypot(*truth.light.direction[:2])), rel=1e-3)
    assert np.hypot(*found.light_ratios) == pytest.approx(np.deg2rad(found.light_deg) / 0.01)
    held = estimation.score_frame(replace(believed(truth), light_std=0.0), truth, assets, 0.0)
    assert held.light_ratios == ()


def test_boundless_and_vanishing_deviations_stay_plain_numbers(truth, assets):
    for std in (0.0, np.inf):
        found = estimation.score_frame(believed(truth, (0.003, 0, 0), std=std), truth, assets, 0.0)
        json.dumps(encode(found), allow_nan=False)
        assert found.objects[0].position_ratios[0] == (0 if std else 1e6)


def test_coverage_looks_at_right_estimates_only():
    frames = [
        frame(score(ratios=(0.5, 1.0, 3.0)), light=(9.0, 9.0)),
        frame(score(position_mm=50, ratios=(99.0,) * 3), light=(99.0, 99.0)),
    ]
    found = estimation.ratios_of(frames)
    assert found == ((0.5, 1.0, 3.0), (0.5, 1.0, 3.0), (9.0, 9.0))
    assert estimation.coverage(found.position) == pytest.approx(2 / 3)
    assert estimation.coverage(()) is None
    errors = np.abs(np.random.default_rng(0).normal(size=20_000))
    assert estimation.coverage(errors) == pytest.approx(0.9545, abs=0.008)


def test_a_doubt_about_the_whole_flags_all_objects(truth):
    assert estimation.flags(believed(truth)) == (False, False)
    assert estimation.flags(believed(truth, doubts=("why", ""), reason="why")) == (True, False)
    assert estimation.flags(believed(truth, reason="too dark")) == (True, True)  # a doubt about the whole


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
    assert estimation.lost_at(position, rotation, absent) == expected
