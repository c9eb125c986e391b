import json
from dataclasses import asdict

import cv2
import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st

from osfcore.experiments.rearrangement.report import CURVE_MM, MpcReport, interval, scores_of, write_pictures
from osfcore.experiments.task_cache import TaskResult
from osfcore.inspection.contact_sheet import Comparison
from osfcore.metrics.success import RearrangementScore

STABLE = {
    "tasks",
    "success_2cm",
    "success_2cm_15deg",
    "success_by_moved",
    "final_mm_mean",
    "final_mm_median",
    "final_deg_median",
    "pose6d_mean",
    "replan_s_median",
    "episode_s_median",
    "oracle_success_2cm",
    "oracle_final_mm_mean",
    "noaction_success_2cm",
    "start_mm_mean",
}


def result(moved=1, mm=5.0, deg=3.0, *, others=0.0, **figures) -> TaskResult:
    """A task that ended so far off, 100 mm at first."""
    plain = {"plan_s": 1.0, "estimate_s": 0.5, "first_s": 8.0, "goal_s": 20.0, "episode_s": 60.0, "steps": 30}
    told = {
        "score": asdict(RearrangementScore(moved, mm, deg, others, mm / 1000)),
        "noaction": asdict(RearrangementScore(moved, 100.0, 0.0, 0.0, 0.1)),
        "goal_doubt": "",
        "goal_mm": 2.0,
    }
    images = (np.full((16, 16, 3), shade, np.uint8) for shade in (40, 200))
    return TaskResult(told | plain | figures, (Comparison("0", *images),))


OURS = (result(), result(2, 15.0, 20.0), result(3, 40.0, 1.0), result(1, 10.0, 1.0, others=30.0))
ORACLE = (result(mm=1.0), result(mm=3.0), result(mm=1.0, deg=90.0), result(mm=50.0))


def test_figures_are_means_and_medians_over_tasks():
    told = MpcReport(OURS, ORACLE).to_json()
    assert set(told) >= STABLE
    assert told == json.loads(json.dumps(told, allow_nan=False))
    assert told["tasks"] == 4
    assert told["success_2cm"] == 0.5  # one is too far away, one pushed something else
    assert told["success_2cm_15deg"] == 0.25
    assert told["success_by_moved"] == {"1": 0.5, "2": 1.0, "3": 0.0}
    assert (told["final_mm_mean"], told["final_mm_median"]) == (17.5, 12.5)
    assert told["final_deg_median"] == 2.0
    assert told["pose6d_mean"] == 0.0175
    assert (told["replan_s_median"], told["episode_s_median"]) == (1.0, 60.0)
    assert (told["oracle_success_2cm"], told["oracle_success_2cm_15deg"]) == (0.75, 0.5)
    assert told["oracle_final_mm_mean"] == 13.75
    assert (told["noaction_success_2cm"], told["start_mm_mean"]) == (0.0, 100.0)
    low, high = told["success_2cm_interval"]
    assert 0 < low < 0.5 < high < 1


def test_more_succeed_the_farther_off_they_may_be():
    told = MpcReport(OURS, ()).to_json()
    curve = [told["success_curve"][str(mm)] for mm in CURVE_MM]
    assert curve == sorted(curve)
    assert told["success_curve"]["20"] == told["success_2cm"]
    assert curve[-1] == 0.75  # what was pushed away stays so


def test_without_an_oracle_it_has_no_figures():
    told = MpcReport(OURS, ()).to_json()
    assert set(told) == set(MpcReport(OURS, ORACLE).to_json())
    assert {told[key] for key in told if key.startswith("oracle_")} == {None}


def test_what_never_happened_has_no_median():
    refused = result(plan_s=None, estimate_s=None, goal_doubt="009_gelatin_box: hidden")
    told = MpcReport((refused,), ()).to_json()
    assert told["replan_s_median"] is told["estimate_s_median"] is None
    assert told["goals_doubted"] == 1
    told = MpcReport((refused, result(plan_s=3.0)), ()).to_json()
    assert told["replan_s_median"] == 3.0
    assert told["goals_doubted"] == 1


def test_scores_come_back_as_they_were():
    assert scores_of(OURS, "noaction") == [RearrangementScore(n, 100.0, 0.0, 0.0, 0.1) for n in (1, 2, 3, 1)]


@pytest.mark.parametrize("oracle", [(), ORACLE])
def test_pictures_show_something(tmp_path, oracle):
    write_pictures(tmp_path, MpcReport(OURS, oracle))
    assert {path.name for path in tmp_path.iterdir()} == {"mpc.png", "mpc_tasks.png"}
    for path in tmp_path.iterdir():
        image = cv2.imread(str(path))
        assert min(image.shape[:2]) > 50
        assert image.std() > 5
        assert len(np.unique(image.reshape(-1, 3), axis=0)) > 3


def test_the_oracle_has_its_own_curve(tmp_path):
    pictures = []
    for name, oracle in (("with", ORACLE), ("without", ())):
        write_pictures(tmp_path / name, MpcReport(OURS, oracle))
        pictures.append((tmp_path / name / "mpc.png").read_bytes())
    assert pictures[0] != pictures[1]


@given(st.integers(1, 500).flatmap(lambda tasks: st.tuples(st.integers(0, tasks), st.just(tasks))))
def test_an_interval_holds_the_share_and_shrinks_with_more_tasks(counts):
    successes, tasks = counts
    low, high = interval(successes, tasks)
    assert 0 <= low < high <= 1
    assert low - 1e-9 <= successes / tasks <= high + 1e-9
    more = interval(4 * successes, 4 * tasks)
    assert more[1] - more[0] < high - low
    assert interval(tasks - successes, tasks) == (pytest.approx(1 - high), pytest.approx(1 - low))


def test_an_interval_is_the_one_of_the_books():
    assert interval(5, 10) == (pytest.approx(0.2366, abs=1e-4), pytest.approx(0.7634, abs=1e-4))
    assert interval(0, 10) == (pytest.approx(0, abs=1e-12), pytest.approx(0.2775, abs=1e-4))
