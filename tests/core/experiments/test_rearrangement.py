import json
from dataclasses import replace

import cv2
import numpy as np
import pytest

import osfcore.experiments.rearrangement as measured
from osfcore.control.estimators import load_scene_models
from osfcore.control.events import EpisodeSettings, Finished
from osfcore.errors import InvalidInput, MissingAssets, UnknownName
from osfcore.experiments.harness import TaskResult
from osfcore.experiments.rearrangement_runs import METHODS, Ended, Variant
from osfcore.experiments.rivals.fitvid import FitVidModel, FitVidSettings, write_fitvid
from osfcore.fields.field_library import FieldLibrary
from osfcore.geometry.poses import Pose
from osfcore.inspection.contact_sheet import Comparison
from osfcore.metrics.success import ObjectScore, RearrangementScore
from osfcore.paper.mppi import GaussianPlanSettings
from osfcore.planning.mppi import PlanSettings
from osfcore.world.scenes import SceneRequest
from osfcore.world.tabletop import Tabletop
from osfcore.world.tasks import TaskSet, draw_task
from tests.support.errors import about

# Evaluation


NAME = "005_tomato_soup_can"
FEW = PlanSettings(samples=8, horizon=4)
QUICK = EpisodeSettings(plan=FEW)


def config(folder, **changes) -> measured.EvaluateMpc:
    given = measured.EvaluateMpc(
        folder / "out", folder / "data", tasks=1, objects=1, actions=2, names=(NAME,), settings=QUICK, oracle_plan=FEW,
        oracle_tries=2,
    )  # fmt: skip
    return replace(given, **changes)


def last(steps):
    *_, step = steps
    return step


def report_of(asked, library, executor=None):
    return last(measured.evaluate_mpc(asked, FieldLibrary(None), library, executor)).report


@pytest.mark.slow
def test_a_real_task_is_measured_once_and_reported(library, tmp_path):
    asked = config(tmp_path)
    steps = list(measured.evaluate_mpc(asked, FieldLibrary(None), library))
    assert [(step.done, step.total, step.report is None) for step in steps] == [
        (0, 2, True), (1, 2, True), (2, 2, False)
    ]  # fmt: skip
    report = steps[-1].report
    assert json.loads((asked.folder / measured.REPORT_FILE).read_text()) == report
    assert report["start_mm_mean"] > 70
    assert report["noaction_success_2cm"] == 0
    assert report["goal_mm_median"] < 20  # the only object is found in the goal image
    assert report["steps_median"] == 2
    assert all(report[f"{stage}_s_median"] > 0 for stage in ("first", "goal", "estimate", "replan", "episode"))
    assert report["oracle_final_mm_mean"] is not None
    assert report["by_object"][NAME]["moved"] == 1
    for name in ("mpc.svg", "mpc_tasks.png"):
        assert (asked.folder / name).exists()
    assert report_of(asked, library) == report  # times of episodes too: nothing was run again
    without = report_of(replace(asked, oracle=False), library)
    assert (without["oracle_success_2cm"], without["final_mm_mean"]) == (None, report["final_mm_mean"])


def test_figures_are_those_of_the_events(library, tmp_path, runs):
    report = report_of(config(tmp_path, tasks=3), library)
    assert report["refused"] == 1
    assert report["success_2cm"] == report["success_tight"] == pytest.approx(2 / 3, abs=1e-4)
    assert report["success_2cm_overruled"] == report["success_tight_overruled"] == 1
    assert report["oracle_success_2cm"] == report["noaction_success_2cm"] == 0
    assert report["oracle_final_mm_mean"] == pytest.approx(report["start_mm_mean"], abs=0.1)
    assert (report["replan_s_median"], report["estimate_s_median"]) == (2.0, 0.5)
    assert (report["first_s_median"], report["goal_s_median"], report["steps_median"]) == (8.0, 20.0, 2.0)
    assert (report["seconds_robot_median"], report["goal_mm_median"]) == (0.4, 0)
    tries = [("oracle", n, pushes, 8) for n in range(3) for pushes in ("network", "simulator")]
    assert runs == [("ours", n, "pose") for n in range(3)] + tries


@pytest.mark.parametrize("method", sorted({*METHODS} - {"ours", "foresight"}))
def test_methods_other_than_ours_refuse_no_goal(library, tmp_path, runs, method):
    report = report_of(config(tmp_path, tasks=2, oracle=False, variant=Variant(method)), library)
    assert (report["method"], report["refused"]) == (method, 1)
    assert report["success_2cm"] == report["success_2cm_overruled"] == 1
    assert [who for who, *_ in runs] == [method] * 2


def test_the_plan_is_that_of_whoever_plans(library, tmp_path, runs):
    for variant in (Variant("paper"), Variant("paper", frozenset({"planning"}))):
        asked = config(tmp_path, oracle=False, variant=variant, published=GaussianPlanSettings(9, 5))
        report = report_of(asked, library)
        is_published = not variant.replaced
        assert (report["samples"], report["horizon"]) == ((9, 5) if is_published else (8, 4))
        assert report["cost"] == ("image" if is_published else "pose")


@pytest.mark.slow
@pytest.mark.parametrize(
    ("change", "made"),
    [
        ({}, 0),
        ({"tasks": 2}, 1),
        ({"settings": EpisodeSettings(plan=PlanSettings(samples=9, horizon=4))}, 1),
        ({"family": "relit"}, 1),
        ({"names": (NAME, "009_gelatin_box")}, 1),
    ],
)
def test_other_circumstances_are_measured_anew(library, tmp_path, runs, change, made):
    asked = config(tmp_path, oracle=False)
    report_of(asked, library)
    runs.clear()
    report_of(replace(asked, **change), library)
    assert len(runs) == made


def test_both_costs_share_an_oracle(library, tmp_path, runs):
    for cost in ("pose", "image"):
        report_of(config(tmp_path, cost=cost), library)
    assert [(who, *what) for who, _, *what in runs] == [
        ("ours", "pose"), ("oracle", "network", 8), ("oracle", "simulator", 8), ("ours", "image")
    ]  # fmt: skip


def test_the_best_of_the_oracles_tries_counts(library, tmp_path, runs, monkeypatch):
    made = []

    def nearer_each_time(task, *_given, knows_pushes, simulator):
        made.append((task.number, knows_pushes))
        reached = task.goal if (task.number, len(made)) == (0, 2) else task.start
        return Ended(reached, np.full((16, 16, 3), 0.5), np.full((16, 16, 3), 0.5))

    monkeypatch.setattr(measured, "run_told_the_truth", nearer_each_time)
    report = report_of(config(tmp_path, tasks=2, oracle_tries=3), library)
    assert made == [(0, False), (0, False), (1, False), (1, False), (1, True)]  # until it succeeds; the last simulates
    assert report["oracle_success_tight"] == report["oracle_success_2cm"] == 0.5
    assert report["oracle_success_tight_by_try"] == [0.0, 0.5, 0.5]


def test_unseen_objects_are_predicted_by_a_network_that_was_trained_without_them(library, tmp_path, monkeypatch):
    given = []

    def ours(task, _assets, parts, *_):
        given.append(parts.models.dynamics)
        yield Finished(0, "reached", "The table looks like the goal.", task.goal)
        yield Ended(task.goal, np.zeros((8, 8, 3)), np.zeros((8, 8, 3)))

    monkeypatch.setattr(measured, "run_from_images", ours)
    state = draw_task(library, TaskSet((NAME,), objects=1), 0).task.start
    push = np.full((1, 1, 3), [0.2, 0.1, 0.0])
    state = replace(state, pusher=np.array([*(state.poses.position[0, :2] - [0.06, 0.03]), state.pusher[2]]))
    for factor in ("", "objects_unseen"):
        report_of(config(tmp_path, oracle=False, factor=factor), library)
    usual, unseen = (dynamics.rollout(state, push).positions for dynamics in given)
    assert not np.array_equal(usual, unseen)
    np.testing.assert_allclose(usual, unseen, atol=0.03)


def test_visual_foresight_pushes_until_all_actions_are_done(library, tmp_path, runs):
    write_fitvid(tmp_path / "data" / "fitvid.safetensors", FitVidModel(FitVidSettings(16, 1, 2, 2, 1)).eval())
    report = report_of(config(tmp_path, oracle=False, variant=Variant("foresight")), library)
    assert runs == [("foresight", 0, 2)]
    assert (report["steps_median"], report["replan_s_median"], report["success_2cm"]) == (2, 2.5, 0)
    assert report["first_mm_median"] is report["own_pushes_mean_mm_4"] is None


@pytest.mark.parametrize(
    ("changes", "error", "subject"),
    [
        ({"tasks": 0}, InvalidInput, "tasks"),
        ({"seed": -1}, InvalidInput, "seed"),
        ({"variant": Variant("magic")}, InvalidInput, "method"),
        ({"actions": 0}, InvalidInput, "steps"),
        ({"factor": "objects_unseen", "variant": Variant("paper")}, InvalidInput, "factor"),
        ({"names": ("teapot",)}, UnknownName, "teapot"),
        ({"names": ("011_banana",)}, MissingAssets, "011_banana"),
    ],
)
def test_a_mistake_is_found_before_anything_is_written(library, tmp_path, changes, error, subject):
    with pytest.raises(error, check=about(subject)):
        next(measured.evaluate_mpc(config(tmp_path, **changes), FieldLibrary(None), library))
    assert not list(tmp_path.iterdir())


# Own pushes


BOX = "009_gelatin_box"
PUSH = np.array([0.0, 0.15, 0.0])


@pytest.fixture(scope="module")
def models(library):
    return load_scene_models((BOX,), FieldLibrary(None), library, None)


def pushed(library, models, count=6):
    """The course of straight pushes of a box, whose estimates are the truth."""
    world = Tabletop(library, request=SceneRequest(names=(BOX,)))
    world.arrange(2)
    box = world.truth().pose(BOX)
    world.load(replace(world.truth(), pusher=box.position * [1, 1, 0] + [0, -0.09, 0.062]))
    course = measured.Course()
    for number in range(count + 1):
        if number:
            world.act(PUSH)
            course.actions[number] = PUSH
        course.true[number] = course.estimated[number] = world.truth()
    world.close()
    return course


def test_a_straight_push_of_a_box_is_predicted_within_a_centimetre(library, models):
    course = pushed(library, models)
    found = measured.prediction_errors(course, models)
    assert len(found["mm"]) == len(found["deg"]) >= 2  # of three starts
    assert max(found["mm"]) < 10
    for number, state in course.true.items():  # what did not move does not count
        course.true[number] = replace(state, poses=course.true[0].poses)
    assert measured.prediction_errors(course, models) == {"mm": [], "deg": []}


def test_an_estimate_that_is_off_shows_in_the_error(library, models):
    course = pushed(library, models, count=4)
    exact = measured.prediction_errors(course, models)["mm"]
    first = course.estimated[0]
    shift = np.array([0.3, 0, 0])  # out of the pusher's way
    course.estimated = {0: replace(first, poses=Pose(first.poses.position + shift, first.poses.quaternion))}
    off = measured.prediction_errors(course, models)["mm"]
    assert off[0] > 290 > exact[0]
    del course.actions[2]  # a start counts if four actions follow
    assert measured.prediction_errors(course, models) == {"mm": [], "deg": []}


# Report


NAMES = ("004_sugar_box", "006_mustard_bottle", "025_mug")


def score(moved, mm, deg, others) -> RearrangementScore:
    """Of a task with one object more than had to move."""
    ends = [ObjectScore(name, True, mm, deg, mm / 1000, mm / 2000) for name in NAMES[:moved]]
    return RearrangementScore((*ends, ObjectScore("061_foam_brick", False, others, 0.0, mm / 1000, mm / 2000)))


def ended(moved=1, mm=5.0, deg=3.0, *, others=0.0, **figures) -> TaskResult:
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


OURS = (ended(), ended(2, 15.0, 20.0), ended(3, 40.0, 1.0), ended(1, 10.0, 1.0, others=30.0))
ORACLE = (
    ended(mm=1.0, tries=1), ended(2, mm=3.0, tries=3), ended(3, mm=1.0, deg=90.0, tries=4), ended(mm=50.0, tries=4)
)  # fmt: skip


def test_figures_are_means_and_medians_over_tasks():
    found = measured.MpcReport(OURS, ORACLE).to_json()
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


def test_methods_are_compared_task_by_task_and_without_an_oracle_it_has_no_figures():
    found, without = (measured.MpcReport(OURS, oracle).to_json() for oracle in (ORACLE, ()))
    assert set(found) == set(without)
    assert {without[key] for key in found if key.startswith("oracle_") or key == "against_oracle"} == {None}
    against = found["against_noaction"]["success_2cm"]
    assert (against["difference"], against["p"]) == (0.5, 0.5)  # two tasks of two that differ
    assert found["against_noaction"]["pose6d"]["difference"] == pytest.approx(0.0175 - 0.1)
    assert found["against_oracle"]["success_2cm"]["difference"] == pytest.approx(-0.25)
    rows = found["by_object"]
    assert {name: row["moved"] for name, row in rows.items()} == dict(zip(NAMES, (4, 2, 1), strict=True))
    assert rows[NAMES[0]]["within_2cm"] == 0.75
    assert rows[NAMES[0]]["tight"] == 0.5
    assert rows[NAMES[0]]["mm_median"] == 12.5
    curve = [found["success_curve"][str(mm)] for mm in measured.CURVE_MM]
    assert curve == sorted(curve)
    assert found["success_curve"]["20"] == found["success_2cm"]
    assert curve[-1] == 0.75  # what was pushed away stays so


def test_a_refused_goal_is_a_failure_and_what_never_happened_has_no_median():
    found = measured.MpcReport((ended(), ended(goal_doubt="009_gelatin_box: hidden")), ()).to_json()
    assert (found["success_tight"], found["success_tight_overruled"], found["refused"]) == (0.5, 1.0, 1)
    assert found["final_mm_mean"] == 52.5
    assert found["seconds_robot_median"] == 6.0
    rejected = {"no room": 1, "not at rest": 4}
    refused = ended(plan_s=None, estimate_s=None, goal_doubt="009_gelatin_box: hidden", rejected=rejected)
    found = measured.MpcReport((refused,), ()).to_json()
    assert found["replan_s_median"] is found["estimate_s_median"] is found["seconds_robot_median"] is None
    found = measured.MpcReport((refused, ended(plan_s=3.0, rejected={"no room": 2})), ()).to_json()
    assert found["replan_s_median"] == 3.0
    assert found["rejected_layouts"] == {"no room": 3, "not at rest": 4}


def test_pictures_show_tasks_and_the_oracle_has_its_own_curve(tmp_path):
    charts = []
    for name, oracle in (("with", ORACLE), ("without", ())):
        measured.write_pictures(tmp_path / name, measured.MpcReport(OURS, oracle))
        charts.append((tmp_path / name / "mpc.svg").read_text())
        sheet = cv2.imread(str(tmp_path / name / "mpc_tasks.png"))
        assert {40, 200} <= set(np.unique(sheet))  # goals and what was reached
    assert ["told the truth" in text for text in charts] == [True, False]
