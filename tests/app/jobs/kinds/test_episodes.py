import contextlib
import json
from dataclasses import replace

import numpy as np
import pytest

import osfcore.control.closed_loop as core
from app.episodes.file_names import (
    CSV_FILE,
    FRAMES_FOLDER,
    GOAL_FILE,
    RECORDING_FILE,
    REPORT_FILE,
    TRAJECTORY_FILE,
    VIDEO_FILE,
)
from app.jobs.context import JobContext, JobControl, RunJob
from app.jobs.job import INPUTS
from app.jobs.kinds import KINDS
from app.jobs.kinds.episodes import EpisodeJobProgress, EpisodeParams, episode_job
from app.jobs.worker import run_job
from osfcore.control import estimators
from osfcore.control.events import ActionExecuted, Looking, Observed, Planning, Stepped
from osfcore.geometry.cameras import goal_camera
from osfcore.geometry.light import Light
from osfcore.geometry.poses import Pose, quaternion_exp, quaternion_multiply
from osfcore.geometry.states import SceneState
from osfcore.io.image_file import to_uint8, write_png
from osfcore.io.scene_file import camera_to_json
from osfcore.paper import stages
from osfcore.paper.estimation import PaperEstimationConfig, estimate_first
from osfcore.planning.mppi import PlanSketch
from osfcore.progress import Progress
from tests.app.jobs.kinds.test_remote_world import NAMES, Stage, stage  # noqa: F401  a fixture
from tests.support.tabletop_scenes import perfect_fit, sure

SMALL = {"steps": 3, "samples": 16, "horizon": 6}


class Told:
    """Orders of a service that changes its mind after some actions."""

    def __init__(self, stage: Stage) -> None:  # noqa: F811
        self.ask, self.told = stage, []

    def changes(self):
        told, self.told = self.told, []
        return told


@pytest.fixture
def place(data_dir, tmp_path, stage):  # noqa: F811
    folder = tmp_path / "job"
    folder.mkdir()
    return JobContext(data_dir, folder, Told(stage))


@pytest.fixture
def sighted(monkeypatch, stage):  # noqa: F811
    """Estimators that are told the truth: what they find is measured elsewhere."""

    def found(*_, **__):
        state = stage.world.truth()
        yield core.EstimateStep(Progress(1, 1, "Done"), "done", state, estimate=sure(state))

    for name in ("estimate_first", "estimate_next"):
        monkeypatch.setattr(estimators, name, found)
    monkeypatch.setattr(core, "expected_fit", lambda *_: perfect_fit(len(NAMES)))


def entries(state):
    poses = state.poses
    return [
        {"name": name, "position": poses.position[n].tolist(), "quaternion": poses.quaternion[n].tolist()}
        for n, name in enumerate(state.names)
    ]


def params(stage, shift=0.06, settings=SMALL, method=None, **goal):  # noqa: F811
    """The gelatin box has to go a little to the left; where it truly should be is known unless it is said otherwise."""
    poses = entries(stage.world.truth())
    poses[1]["position"][0] -= shift
    goal = {"id": None, "camera": None, "poses": poses, "truth": poses} | goal
    given = {"scene": "s1", "names": list(NAMES), "seed": 0, "settings": settings, "goal": goal}
    return EpisodeParams.from_json(given | ({} if method is None else {"method": method}))


def report_of(place):
    return json.loads((place.folder / REPORT_FILE).read_text())


@pytest.mark.slow
def test_an_episode_pushes_what_is_on_the_scene_and_leaves_its_files(place, stage, sighted):  # noqa: F811
    before = stage.world.truth()
    *steps, last = list(episode_job(params(stage), place))
    assert all(isinstance(step, EpisodeJobProgress) for step in steps)
    assert [step.view.number for step in steps if isinstance(step.view, ActionExecuted)] == [1, 2, 3]
    assert sum(step.ends_round for step in steps) == 4
    assert stage.world.time_s == pytest.approx(0.6)
    assert not np.array_equal(stage.world.truth().pusher, before.pusher)
    assert report_of(place)["steps_done"] == 3
    files = {path.name for path in place.folder.iterdir()}
    assert files == {REPORT_FILE, CSV_FILE, GOAL_FILE, TRAJECTORY_FILE, VIDEO_FILE, RECORDING_FILE, FRAMES_FOLDER}
    assert (last.outcome, last.text) == ("out of steps", report_of(place)["text"])
    assert last.note == last.text


@pytest.mark.slow
def test_what_is_told_rises_and_names_every_part_of_the_loop(place, stage, sighted):  # noqa: F811
    told = list(episode_job(params(stage), place))
    stages = list(dict.fromkeys(step.stage for step in told))
    assert stages == [None, "first", "plan", "act", "next"]
    for counts in ([step.done for step in told], [step.steps for step in told]):
        assert counts == sorted(counts)
    assert (told[-1].done, told[-1].steps, told[-1].total) == (3, 4, 3)
    assert [step.outcome for step in told[:-4]] == [None] * (len(told) - 4)
    assert all(step.note for step in told)
    assert not any(isinstance(step.view, Observed | Planning) for step in told)
    assert sum(isinstance(step.view, PlanSketch) for step in told) >= 3


@pytest.mark.slow
def test_what_a_view_must_not_miss_says_so(place, stage, sighted):  # noqa: F811
    for step in episode_job(params(stage), place):
        assert step.must_be_reported == (step.view is not None and not isinstance(step.view, Looking))


def test_pages_are_told_the_stage_and_the_outcome(place, monkeypatch):
    told = []
    steps = [EpisodeJobProgress(1, 2, "Pushing", share=0.5, left_s=9.0, stage="act", steps=1, seconds=31.0)]
    monkeypatch.setitem(
        KINDS, "episode", replace(KINDS["episode"], run=lambda _params, _place: (step for step in steps))
    )
    given = {"scene": "s", "names": [], "seed": 0, "settings": {}, "goal": {"id": None}}
    run_job(RunJob("episode", given, place.data_dir, place.folder), JobControl(told.append), told.append)
    assert told[0].result == {
        "share": 0.5, "left_s": 9.0, "stage": "act", "steps": 1, "seconds": 31.0, "outcome": None, "text": None,
    }  # fmt: skip


@pytest.mark.slow
def test_the_report_is_there_after_every_round(place, stage, sighted):  # noqa: F811
    counts = [len(report_of(place)["steps"]) for step in episode_job(params(stage), place) if step.ends_round]
    assert counts == [1, 2, 3, 4]


@pytest.mark.slow
def test_where_the_true_goal_is_known_the_report_scores_what_had_to_move(place, stage, sighted):  # noqa: F811
    list(episode_job(params(stage), place))
    report = report_of(place)
    assert report["moved"] == [NAMES[1]]
    assert 0 < report["score"]["moved_mm"] < 200
    assert isinstance(report["success_2cm"], bool)
    assert report["steps"][0]["truly_to_goal_mm"] == pytest.approx({NAMES[0]: 0, NAMES[1]: 60}, abs=0.1)


@pytest.mark.slow
def test_where_nobody_knows_the_true_goal_nothing_is_said_of_it(place, stage, sighted):  # noqa: F811
    list(episode_job(params(stage, truth=None), place))
    assert not {"moved", "score", "success_2cm"} & set(report_of(place))


@pytest.mark.parametrize(
    ("shift", "turn", "moved"), [(0, 0, ()), (0.003, 0, ()), (0.01, 0, NAMES[1:]), (0, 1, NAMES[1:])]
)
def test_an_object_that_stays_did_not_have_to_move(place, stage, sighted, shift, turn, moved):  # noqa: F811
    start = stage.world.truth()
    places, turns = start.poses.position.copy(), start.poses.quaternion.copy()
    places[1, 0] += shift
    turns[1] = quaternion_multiply(quaternion_exp(np.array([0, 0, float(turn)])), turns[1])
    truth = entries(replace(start, poses=Pose(places, -turns)))
    with contextlib.closing(episode_job(params(stage, truth=truth), place)) as steps:
        next(step for step in steps if step.ends_round)
    assert report_of(place)["moved"] == list(moved)


@pytest.mark.slow
def test_settings_may_change_on_the_way(place, stage, sighted):  # noqa: F811
    acted = 0
    for step in episode_job(params(stage), place):
        acted += isinstance(step.view, ActionExecuted)
        if acted == 1:
            place.orders.told = [{"settings": {**SMALL, "steps": 2}}]
    assert acted == 2
    assert step.total == 2


def test_a_goal_image_is_read_from_the_inputs_as_its_own_camera_saw_it(place, stage, sighted, monkeypatch):  # noqa: F811
    camera = replace(goal_camera(96), name="mine", height=64)
    image = stage.world.render((camera,), with_pusher=False).images[0]
    write_png(place.folder / INPUTS / GOAL_FILE, to_uint8(image))

    def explained(_models, observation, *_):
        np.testing.assert_allclose(observation.images[0], image, atol=1 / 255)
        assert observation.cameras[0].name == "mine"
        np.testing.assert_allclose(observation.cameras[0].intrinsics, camera.intrinsics, atol=1e-12)
        state = stage.world.truth()
        yield core.EstimateStep(Progress(1, 1, "Done"), "done", state, estimate=sure(state))

    monkeypatch.setattr(core, "estimate_goal", explained)
    monkeypatch.setattr(core, "prefer_current_poses", lambda _models, _goal, found, _now: found)
    goal = {"id": "g", "camera": camera_to_json(camera), "poses": None, "truth": entries(stage.world.truth())}
    told = list(episode_job(params(stage, **goal), place))
    assert (told[-1].outcome, told[-1].done) == ("reached", 0)
    assert "goal" in {step.stage for step in told}
    assert stage.world.time_s == 0
    report = report_of(place)
    assert (report["outcome"], report["moved"]) == ("reached", [])
    assert "score" not in report  # nothing had to move


def test_whoever_stops_it_leaves_its_steps_and_nothing_half_written(place, stage, sighted):  # noqa: F811
    with contextlib.closing(episode_job(params(stage), place)) as steps:
        for step in steps:
            if step.steps == 2:
                break
    assert {path.name for path in place.folder.iterdir()} == {
        REPORT_FILE,
        CSV_FILE,
        GOAL_FILE,
        TRAJECTORY_FILE,
        FRAMES_FOLDER,
    }
    assert len(report_of(place)["steps"]) == 2
    assert step.seconds == report_of(place)["seconds"] > 0


def test_rounds_end_where_a_step_of_the_loop_does():
    state = sure(SceneState((), Pose(np.zeros((0, 3)), np.zeros((0, 4))), Light(np.array([0.0, 0, 1])), None))
    image = np.zeros((16, 16, 3))
    stepped = Stepped(1, 3, state, np.zeros(0), np.zeros(0), 0.0, image, {})
    assert EpisodeJobProgress(1, 3, "Looking", view=stepped).ends_round
    assert not EpisodeJobProgress(1, 3, "Pushing", view=ActionExecuted(1, np.zeros(3))).ends_round
    assert not EpisodeJobProgress(0, 3, "Loading").ends_round
    assert not EpisodeJobProgress(0, 3, "Loading").must_be_reported


# The method as published

FEW = {"steps": 1, "cost": "image", "plan": {"samples": 8, "horizon": 1, "temperature": 0.3}}


def seen_by_the_goal_camera(place, stage, side=16):  # noqa: F811
    """The parameters of a goal image of the table as it is."""
    camera = goal_camera(side)
    inputs = place.folder / INPUTS
    inputs.mkdir()
    write_png(inputs / GOAL_FILE, to_uint8(stage.world.render((camera,), with_pusher=False).images[0]))
    return {"poses": None, "camera": camera_to_json(camera)}


@pytest.mark.slow
def test_the_method_as_published_goes_through_the_same_job(place, stage, monkeypatch):  # noqa: F811
    def found(*_, **__):
        state = stage.world.truth()
        yield core.EstimateStep(Progress(1, 1, "Done"), "done", state, estimate=sure(state))

    for name in ("estimate_first", "estimate_next"):
        monkeypatch.setattr(stages, name, found)
    goal = seen_by_the_goal_camera(place, stage)
    told = list(episode_job(params(stage, settings=FEW, method="paper", **goal), place))
    assert list(dict.fromkeys(step.stage for step in told)) == [None, "first", "plan", "act", "next"]
    assert (told[-1].outcome, told[-1].done, told[-1].steps, told[-1].total) == ("out of steps", 1, 2, 1)
    assert sum(isinstance(step.view, PlanSketch) for step in told) == 1
    assert sum(step.ends_round for step in told) == 2
    report = report_of(place)
    assert (report["method"], report["goal"], report["steps"][0]["to_goal_mm"]) == ("paper", None, None)
    assert report["steps"][0]["truly_to_goal_mm"][NAMES[1]] == pytest.approx(60, abs=1)
    files = {path.name for path in place.folder.iterdir()}
    assert {REPORT_FILE, CSV_FILE, GOAL_FILE, TRAJECTORY_FILE, VIDEO_FILE, RECORDING_FILE, FRAMES_FOLDER} <= files


@pytest.mark.slow
def test_the_method_as_published_runs_on_its_own(place, stage, monkeypatch):  # noqa: F811
    little = PaperEstimationConfig(masked_iterations=1, masked_population=8, joint_iterations=2, joint_population=8)
    monkeypatch.setattr(stages, "estimate_first", lambda *given: estimate_first(*given[:3], little))
    goal = seen_by_the_goal_camera(place, stage)
    *_, last = list(episode_job(params(stage, settings=FEW, method="paper", truth=None, **goal), place))
    assert (last.outcome, last.done) == ("out of steps", 1)
    report = report_of(place)
    assert {"first", "estimate", "plan"} <= set().union(*(step["seconds"] for step in report["steps"]))
    assert all(np.isfinite(step["image_cost"]) for step in report["steps"])
