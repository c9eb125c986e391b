import json

import cv2
import numpy as np
import pytest

from osfcore.experiments.harness import TaskResult
from osfcore.experiments.rearrangement_report import CURVE_MM, MpcReport, write_pictures
from osfcore.inspection.contact_sheet import Comparison
from osfcore.metrics.success import ObjectScore, RearrangementScore

NAMES = ("004_sugar_box", "006_mustard_bottle", "025_mug")


def score(moved, mm, deg, others) -> RearrangementScore:
    """Of a task with one object more than had to move."""
    ends = [ObjectScore(name, True, mm, deg, mm / 1000, mm / 2000) for name in NAMES[:moved]]
    return RearrangementScore((*ends, ObjectScore("061_foam_brick", False, others, 0.0, mm / 1000, mm / 2000)))


def result(moved=1, mm=5.0, deg=3.0, *, others=0.0, **figures) -> TaskResult:
    """A task that ended so far off, 100 mm at first."""
    plain = {"plan_s": 1.0, "estimate_s": 0.5, "first_s": 8.0, "goal_s": 20.0, "episode_s": 60.0, "steps": 30}
    found = {
        "score": score(moved, mm, deg, others).to_json(),
        "noaction": score(moved, 100.0, 0.0, 0.0).to_json(),
        "goal_doubt": "",
        "goal_mm": 2.0,
        "first_mm": 0.5,
        "first_deg": 0.4,
        "light_deg": 1.5,
        "robot_s": 6.0,
        "rejected": {},
        "predicted": {"mm": [3.0, 4.0], "deg": [1.0, 2.0]},
    }
    images = (np.full((16, 16, 3), shade, np.uint8) for shade in (40, 200))
    return TaskResult(found | plain | figures, (Comparison("0", *images),))


OURS = (result(), result(2, 15.0, 20.0), result(3, 40.0, 1.0), result(1, 10.0, 1.0, others=30.0))
ORACLE = (
    result(mm=1.0, tries=1), result(2, mm=3.0, tries=3), result(3, mm=1.0, deg=90.0, tries=4), result(mm=50.0, tries=4)
)  # fmt: skip


def test_figures_are_means_and_medians_over_tasks():
    found = MpcReport(OURS, ORACLE).to_json()
    assert found == json.loads(json.dumps(found, allow_nan=False))
    assert found["tasks"] == 4
    assert found["success_2cm"] == 0.5  # one is too far away, one pushed something else
    assert found["success_tight"] == found["success_2cm_15deg"] == 0.25
    assert found["success_by_moved"] == {"1": 0.5, "2": 1.0, "3": 0.0}
    assert found["success_tight_by_moved"] == {"1": 0.5, "2": 0.0, "3": 0.0}
    assert (found["final_mm_mean"], found["final_mm_median"]) == (17.5, 12.5)
    assert found["final_deg_median"] == 2.0
    assert (found["pose6d_mean"], found["pose6d_symmetric_mean"]) == (0.0175, pytest.approx(0.0175 / 2, abs=1e-4))
    assert (found["replan_s_median"], found["episode_s_median"]) == (1.0, 60.0)
    assert (found["first_mm_median"], found["first_deg_median"], found["light_deg_median"]) == (0.5, 0.4, 1.5)
    assert (found["oracle_success_2cm"], found["oracle_success_tight"]) == (0.75, 0.5)
    assert found["oracle_success_tight_by_try"] == [0.25, 0.25, 0.5, 0.5]
    assert found["oracle_final_mm_mean"] == 13.75
    assert (found["noaction_success_2cm"], found["start_mm_mean"]) == (0.0, 100.0)
    assert (found["own_pushes"], found["own_pushes_mean_mm_4"], found["own_pushes_median_deg_4"]) == (8, 3.5, 1.5)
    low, high = found["success_2cm_interval"]
    assert 0 < low < 0.5 < high < 1


def test_methods_are_compared_task_by_task():
    found = MpcReport(OURS, ORACLE).to_json()
    against = found["against_noaction"]["success_2cm"]
    assert (against["difference"], against["p"]) == (0.5, 0.5)  # two tasks of two that differ
    assert found["against_noaction"]["pose6d"]["difference"] == pytest.approx(0.0175 - 0.1)
    assert found["against_oracle"]["success_2cm"]["difference"] == pytest.approx(-0.25)


def test_objects_that_had_to_move_have_rows_of_their_own():
    rows = MpcReport(OURS, ()).to_json()["by_object"]
    assert {name: row["moved"] for name, row in rows.items()} == dict(zip(NAMES, (4, 2, 1), strict=True))
    assert rows[NAMES[0]]["within_2cm"] == 0.75
    assert rows[NAMES[0]]["tight"] == 0.5
    assert rows[NAMES[0]]["mm_median"] == 12.5


def test_a_refused_goal_is_a_failure_and_the_overruled_figure_stands_beside_it():
    found = MpcReport((result(), result(goal_doubt="009_gelatin_box: hidden")), ()).to_json()
    assert (found["success_tight"], found["success_tight_overruled"], found["refused"]) == (0.5, 1.0, 1)
    assert found["final_mm_mean"] == 52.5
    assert found["seconds_robot_median"] == 6.0


def test_rejected_layouts_are_counted_by_reason():
    drawn = result(rejected={"no room": 2}), result(rejected={"no room": 1, "not at rest": 4}), result()
    assert MpcReport(drawn, ()).to_json()["rejected_layouts"] == {"no room": 3, "not at rest": 4}


def test_more_succeed_the_farther_off_they_may_be():
    found = MpcReport(OURS, ()).to_json()
    curve = [found["success_curve"][str(mm)] for mm in CURVE_MM]
    assert curve == sorted(curve)
    assert found["success_curve"]["20"] == found["success_2cm"]
    assert curve[-1] == 0.75  # what was pushed away stays so


def test_without_an_oracle_it_has_no_figures():
    found = MpcReport(OURS, ()).to_json()
    assert set(found) == set(MpcReport(OURS, ORACLE).to_json())
    assert {json.dumps(found[key]) for key in found if key.startswith("oracle_")} == {"null"}
    assert found["against_oracle"] is None


def test_what_never_happened_has_no_median():
    refused = result(plan_s=None, estimate_s=None, goal_doubt="009_gelatin_box: hidden")
    found = MpcReport((refused,), ()).to_json()
    assert found["replan_s_median"] is found["estimate_s_median"] is found["seconds_robot_median"] is None
    found = MpcReport((refused, result(plan_s=3.0)), ()).to_json()
    assert found["replan_s_median"] == 3.0


def test_pictures_show_tasks_and_the_oracle_has_its_own_curve(tmp_path):
    charts = []
    for name, oracle in (("with", ORACLE), ("without", ())):
        write_pictures(tmp_path / name, MpcReport(OURS, oracle))
        charts.append((tmp_path / name / "mpc.png").read_bytes())
        sheet = cv2.imread(str(tmp_path / name / "mpc_tasks.png"))
        assert {40, 200} <= set(np.unique(sheet))  # goals and what was reached
    assert charts[0] != charts[1]
