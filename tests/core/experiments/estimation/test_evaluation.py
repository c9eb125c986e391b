import json
from concurrent.futures import ProcessPoolExecutor
from dataclasses import replace
from multiprocessing import get_context

import pytest

import osfcore.experiments.estimation as parts
from osfcore.errors import InvalidInput, MissingAssets, UnknownName
from osfcore.experiments.estimation import REPORT_FILE, evaluate_estimate
from osfcore.objects.asset_library import AssetLibrary
from tests.core.experiments.oracle import SHIFT_M, Oracle
from tests.core.experiments.quick import quick
from tests.core.experiments.solids import SOLIDS


def last(steps):
    *_, step = steps
    return step


def refuse(*_args, **_more):
    raise AssertionError("this was measured before")


@pytest.fixture
def oracle(monkeypatch):
    oracle = Oracle()
    oracle.install(monkeypatch)
    return oracle


@pytest.fixture(scope="module")
def evaluated(solids, library, tmp_path_factory):
    """Two tasks of two objects with everything, and ten bad cases."""
    config = quick(tmp_path_factory.mktemp("estimates"), tasks=2, bad=10)
    with pytest.MonkeyPatch.context() as patch:
        Oracle().install(patch)
        steps = list(evaluate_estimate(config, solids, library))
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
    assert result["mean_position_std_mm"] == pytest.approx(1)
    assert result["two_sigma_coverage"] == 1
    assert (result["track_episodes"], result["track_lost"], result["track_frac_1cm_5deg"]) == (2, 0, 1)
    assert result["refine_hz"] > 0
    assert {n: row["frac_1cm_5deg"] for n, row in result["by_views"].items()} == {"1": 1, "2": 1, "4": 1}
    assert result["bad_cases"] == 10
    assert result["bad_confident_wrong"] == sum(row["confident_wrong"] for row in result["bad_by_kind"].values())
    assert result["bad_by_kind"]["wrong name"] == result["bad_by_kind"]["goal of other objects"]
    assert json.loads((config.folder / REPORT_FILE).read_text()) == result


@pytest.mark.slow
def test_pictures_lie_beside_the_results(evaluated):
    config, _ = evaluated
    assert config.folder == config.out / "estimate" / "2-objects-seed-0"
    pictures = {path.name for path in config.folder.glob("*.png")}
    assert pictures == {"errors.png", "calibration.png", "track.png", "views.png", "failures_bad.png"}


@pytest.mark.slow
def test_progress_grows_and_only_the_last_step_reports(evaluated):
    _, steps = evaluated
    assert [step.done for step in steps] == list(range(23))
    assert {step.total for step in steps} == {22}
    assert [step.report is None for step in steps] == [True] * 22 + [False]
    assert steps[3].note == "Tracks (2 of 2)"


@pytest.mark.slow
def test_what_was_measured_is_taken_over(evaluated, solids, library, oracle):
    config, steps = evaluated
    again = last(evaluate_estimate(config, solids, library))
    assert again.report.to_json() == steps[-1].report.to_json()
    fewer = last(evaluate_estimate(replace(config, tasks=1, parts=("goal",), bad=0), solids, library)).report
    assert fewer.first == steps[-1].report.first[:1]
    assert fewer.goals == steps[-1].report.goals[:1]
    assert fewer.tracks is fewer.views is fewer.fixed_light is fewer.bad is None
    assert not oracle.asked


@pytest.mark.slow
@pytest.mark.parametrize(
    ("change", "asked"),
    [
        ({"tasks": 3}, 1),
        ({"seed": 1}, 2),
        ({"objects": 1}, 2),
        ({"size": 32}, 2),
        ({"effort": replace(quick(None).effort, generations=2)}, 2),
    ],
)
def test_other_circumstances_are_measured_anew(evaluated, solids, library, oracle, change, asked):
    config = replace(evaluated[0], parts=("first",), bad=0)
    last(evaluate_estimate(replace(config, **change), solids, library))
    assert len(oracle.asked) == asked


def test_a_killed_evaluation_goes_on(solids, library, tmp_path, oracle):
    config = quick(tmp_path, tasks=3, parts=("track",))
    for step in evaluate_estimate(config, solids, library):
        if step.done == 4:
            break
    assert [what for what, _ in oracle.asked] == ["first search 4"] * 3 + ["next"] * 2
    report = last(evaluate_estimate(config, solids, library)).report
    assert [what for what, _ in oracle.asked] == ["first search 4"] * 3 + ["next"] * 6
    assert [frame.names for frame in report.first] == [names for _, names in oracle.asked[:3]]
    assert all(len(track.seconds) == 2 for track in report.tracks)


@pytest.mark.slow
def test_a_refused_first_frame_is_a_result_too(solids, library, tmp_path, oracle):
    oracle.refuses = 1
    report = last(evaluate_estimate(quick(tmp_path, tasks=2), solids, library)).report
    assert "masks" in report.first[0].refused
    assert not report.first[1].refused
    assert [bool(track.refused) for track in report.tracks] == [True, False]
    assert [goal.refused != "" for task in report.goals for goal in task] == [True, True, False, False]
    result = report.to_json()
    assert (result["frac_1cm_5deg"], result["track_lost"], result["first_refused"]) == (0.5, 1, 1)
    assert (quick(tmp_path).folder / "failures_first.png").exists()
    again = last(evaluate_estimate(quick(tmp_path, tasks=2), solids, library)).report
    assert again.to_json() == result


def test_what_cannot_be_measured_is_told_before_anything_is_done(solids, library, tmp_path, monkeypatch):
    monkeypatch.setattr(parts, "warm_models", refuse)
    config = quick(tmp_path / "out")
    cases = [
        (replace(config, names=("teapot",)), UnknownName, "teapot"),
        (replace(config, tasks=0), InvalidInput, "number of tasks is 0"),
        (replace(config, objects=9), InvalidInput, "objects in a scene is 9"),
        (replace(config, objects=4), InvalidInput, "number of names is 3, but it must be 4 or more"),
        (replace(config, seed=-1), InvalidInput, "seed"),
        (replace(config, bad=-1), InvalidInput, "bad cases"),
        (replace(config, bad=1, objects=3), InvalidInput, "4 or more"),
        (replace(config, bad=1, objects=1), InvalidInput, "2 or more"),
        (replace(config, parts=("second",)), InvalidInput, "first, track, goal, ablations"),
        (replace(config, size=5), InvalidInput, "size"),
    ]
    for wrong, error, words in cases:
        with pytest.raises(error, match=words):
            next(evaluate_estimate(wrong, solids, library))
    with pytest.raises(MissingAssets, match=SOLIDS[0]):
        next(evaluate_estimate(config, solids, AssetLibrary(tmp_path / "none")))
    assert not (tmp_path / "out").exists()


@pytest.mark.slow
def test_an_executor_changes_no_estimate(solids, library, tmp_path):
    config = quick(tmp_path / "alone", tasks=1, objects=1, names=SOLIDS[:1], size=32, parts=("first",))
    alone = last(evaluate_estimate(config, solids, library)).report
    with ProcessPoolExecutor(1, mp_context=get_context("spawn")) as executor:
        shared = last(evaluate_estimate(replace(config, out=tmp_path / "shared"), solids, library, executor)).report
    for one, other in zip(alone.first, shared.first, strict=True):
        assert replace(one, seconds=other.seconds) == other
