import json
import pickle
from dataclasses import replace

import numpy as np
import pytest

import osfcore.experiments.rearrangement.evaluation as module
from osfcore.control.episode_settings import EpisodeSettings
from osfcore.control.events import ActionExecuted, Finished, GoalFound, Noticed, Stepped
from osfcore.errors import InvalidInput, MissingAssets, UnknownName
from osfcore.experiments.rearrangement.evaluation import REPORT_FILE, EvaluateMpc, evaluate_mpc
from osfcore.experiments.rearrangement.runs import Ended
from osfcore.fields.field_library import FieldLibrary
from osfcore.geometry.cameras import goal_camera
from osfcore.geometry.estimated_state import EstimatedState
from osfcore.planning.mppi import PlanSettings
from osfcore.planning.pose_cost import PoseGoal

NAME = "005_tomato_soup_can"
QUICK = EpisodeSettings(steps=2, plan=PlanSettings(samples=8, horizon=4), despite_doubts=True)
PAPER = np.full((16, 16, 3), 0.5)


def config(folder, **changes) -> EvaluateMpc:
    given = EvaluateMpc(folder / "out", folder / "data", tasks=1, objects=1, names=(NAME,), settings=QUICK)
    return replace(given, **changes)


def last(steps):
    *_, step = steps
    return step


def refuse(*_args, **_more):
    raise AssertionError("this was measured before")


@pytest.fixture
def runs(monkeypatch):
    """Runs that cost nothing: ours reach the goal, the oracle's leave everything as it is. Tells which were made."""
    made = []

    def ours(task, _assets, _models, settings, _rng):
        made.append(("ours", task.number, settings.cost))
        one = np.full(len(task.start.names), 1e-3)
        estimate = EstimatedState(task.goal, one, one, 1e-3, ("",) * len(one), "hidden")
        yield GoalFound(PoseGoal(task.goal.names, task.goal.poses), PAPER, goal_camera(16), estimate)
        yield Noticed(0, "goal", "The goal image is not explained well: hidden.")
        yield Stepped(0, 2, estimate, 0 * one, 0 * one, 0.0, PAPER, {"first": 8.0, "goal": 20.0})
        for number, plan_s in ((1, 1.0), (2, 3.0)):
            yield ActionExecuted(number, np.zeros(3))
            yield Stepped(number, 2, estimate, 0 * one, 0 * one, 0.0, PAPER, {"plan": plan_s, "estimate": 0.5})
        yield Finished(2, "reached", "The table looks like the goal.", task.goal)
        yield Ended(task.goal, PAPER, PAPER)

    def told(task, _assets, _models, settings, _rng):
        made.append(("oracle", task.number, settings.plan.samples))
        return Ended(task.start, PAPER, PAPER)

    monkeypatch.setattr(module, "run_from_images", ours)
    monkeypatch.setattr(module, "run_told_the_truth", told)
    monkeypatch.setattr(module, "load_scene_models", lambda *_: None)
    return made


@pytest.fixture(scope="module")
def evaluated(library, tmp_path_factory):
    """One real task, with everything in it but few pushes."""
    asked = config(tmp_path_factory.mktemp("mpc"))
    return asked, list(evaluate_mpc(asked, FieldLibrary(None), library))


@pytest.mark.slow
def test_a_real_task_is_measured_and_reported(evaluated):
    asked, steps = evaluated
    report = steps[-1].report
    assert json.loads((asked.folder / REPORT_FILE).read_text()) == report
    assert (report["tasks"], report["objects"], report["seed"], report["cost"]) == (1, 1, 0, "pose")
    assert report["start_mm_mean"] > 70
    assert report["noaction_success_2cm"] == 0
    assert report["goal_mm_median"] < 20  # the only object is found in the goal image
    assert report["steps_median"] == 2
    assert all(report[f"{stage}_s_median"] > 0 for stage in ("first", "goal", "estimate", "replan", "episode"))
    assert report["oracle_final_mm_mean"] is not None
    for name in ("mpc.png", "mpc_tasks.png"):
        assert (asked.folder / name).exists()


@pytest.mark.slow
def test_progress_grows_and_only_the_last_step_reports(evaluated):
    _, steps = evaluated
    done = [step.done for step in steps]
    assert done == sorted(done)
    assert (done[0], done[-1]) == (0, 2)
    assert {step.total for step in steps} == {2}
    assert [step.report is None for step in steps] == [True] * (len(steps) - 1) + [False]
    notes = dict.fromkeys(step.note for step in steps)
    task = "Task 1 of 1"
    assert list(notes) == [
        "Told the truth",
        "Told the truth (1 of 1)",
        f"{task} (preparing)",
        f"{task} (looking at the first frame)",
        f"{task} (looking at the goal)",
        f"{task} (action 1)",
        f"{task} (action 2)",
        "Everything is measured",
    ]


@pytest.mark.slow
def test_what_was_measured_is_taken_over(evaluated, library, monkeypatch):
    asked, steps = evaluated
    for what in ("run_from_images", "run_told_the_truth"):
        monkeypatch.setattr(module, what, refuse)
    again = list(evaluate_mpc(asked, FieldLibrary(None), library))
    assert again[-1].report == steps[-1].report
    without = last(evaluate_mpc(replace(asked, oracle=False), FieldLibrary(None), library))
    assert without.report["oracle_success_2cm"] is None
    assert without.report["final_mm_mean"] == steps[-1].report["final_mm_mean"]


def test_figures_are_those_of_the_events(library, tmp_path, runs):
    report = last(evaluate_mpc(config(tmp_path, tasks=2), FieldLibrary(None), library)).report
    assert (report["success_2cm"], report["success_2cm_15deg"], report["final_mm_mean"]) == (1, 1, 0)
    assert report["oracle_success_2cm"] == report["noaction_success_2cm"] == 0
    assert report["oracle_final_mm_mean"] == pytest.approx(report["start_mm_mean"], abs=0.1)
    assert (report["replan_s_median"], report["estimate_s_median"]) == (2.0, 0.5)
    assert (report["first_s_median"], report["goal_s_median"], report["steps_median"]) == (8.0, 20.0, 2.0)
    assert (report["goals_doubted"], report["goal_mm_median"]) == (2, 0)
    assert runs == [("oracle", 0, 32), ("oracle", 1, 32), ("ours", 0, "pose"), ("ours", 1, "pose")]


def test_a_killed_evaluation_goes_on(library, tmp_path, runs):
    asked = config(tmp_path, tasks=3, oracle=False)
    for step in evaluate_mpc(asked, FieldLibrary(None), library):
        if step.note.startswith("Task 3"):
            break
    assert len(runs) == 2
    last(evaluate_mpc(asked, FieldLibrary(None), library))
    assert [number for _, number, _ in runs] == [0, 1, 2]


@pytest.mark.slow
@pytest.mark.parametrize(
    ("change", "made"),
    [
        ({}, 0),
        ({"tasks": 2}, 1),
        ({"settings": replace(QUICK, steps=3)}, 1),
        ({"settings": replace(QUICK, plan=PlanSettings(samples=9, horizon=4))}, 1),
        ({"seed": 1}, 1),
        ({"cost": "image"}, 1),
        ({"names": (NAME, "009_gelatin_box")}, 1),
    ],
)
def test_other_circumstances_are_measured_anew(library, tmp_path, runs, change, made):
    asked = config(tmp_path, oracle=False)
    last(evaluate_mpc(asked, FieldLibrary(None), library))
    runs.clear()
    last(evaluate_mpc(replace(asked, **change), FieldLibrary(None), library))
    assert len(runs) == made


def test_both_costs_share_an_oracle(library, tmp_path, runs):
    for cost in ("pose", "image"):
        last(evaluate_mpc(config(tmp_path, cost=cost), FieldLibrary(None), library))
    assert runs == [("oracle", 0, 32), ("ours", 0, "pose"), ("ours", 0, "image")]


def test_the_oracle_may_work_in_other_processes(library, tmp_path, runs):
    class Elsewhere:
        def map(self, work, numbers):
            return map(pickle.loads(pickle.dumps(work)), numbers)

    plain = last(evaluate_mpc(config(tmp_path / "a", tasks=2), FieldLibrary(None), library)).report
    sent = last(evaluate_mpc(config(tmp_path / "b", tasks=2), FieldLibrary(None), library, Elsewhere())).report
    assert {**sent, "episode_s_median": 0} == {**plain, "episode_s_median": 0}


@pytest.mark.parametrize(
    ("changes", "error", "words"),
    [
        ({"tasks": 0}, InvalidInput, "number of tasks is 0"),
        ({"objects": 0}, InvalidInput, "objects in a scene is 0"),
        ({"objects": 7}, InvalidInput, "objects in a scene is 7"),
        ({"seed": -1}, InvalidInput, "seed"),
        ({"objects": 2}, InvalidInput, "number of objects with a field and a mesh is 1"),
        ({"objects": 2, "names": (NAME, NAME)}, InvalidInput, "at least 2"),
        ({"names": ("teapot",)}, UnknownName, "teapot"),
        ({"names": ("011_banana",)}, MissingAssets, "011_banana"),
    ],
)
def test_a_mistake_is_one_sentence(library, tmp_path, changes, error, words):
    with pytest.raises(error, match=words):
        next(evaluate_mpc(config(tmp_path, **changes), FieldLibrary(None), library))
    assert not list(tmp_path.iterdir())
