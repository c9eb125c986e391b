import contextlib
import json

import numpy as np
import pytest

from app.episodes import request as run
from app.episodes.file_names import RECORDING_FILE, REPORT_FILE
from app.episodes.progress import EpisodeProgress
from app.episodes.request import EpisodeOrder, run_episode
from osfcore.control.events import (
    ActionExecuted,
    EpisodeSettings,
    Finished,
    GoalFound,
    Looking,
    Noticed,
    Observed,
    Planning,
    Stepped,
)
from osfcore.errors import CorruptFile, OsfError, UnknownName
from osfcore.estimation.steps import EstimateStep
from osfcore.geometry.states import EstimatedState
from osfcore.planning.costs import PoseGoal
from osfcore.progress import Progress
from tests.support.errors import about

NAMES = ("009_gelatin_box",)


@pytest.fixture
def order(data_dir, tmp_path):
    return EpisodeOrder(tmp_path / "out", data_dir, NAMES, moved=1, settings=EpisodeSettings(steps=2))


@pytest.fixture
def worlds(monkeypatch):
    """The worlds that were begun with."""
    begun, given = [], run.given

    def noted(order):
        begin = given(order)
        begun.append(begin.world)
        return begin

    monkeypatch.setattr(run, "given", noted)
    return begun


def assert_closed(worlds):
    """One simulation was begun, and it is gone."""
    (world,) = worlds
    with pytest.raises(OsfError, match="table is empty"):
        world.truth()


@pytest.fixture
def told(monkeypatch, worlds):
    """An episode that knows the truth and goes nowhere."""
    monkeypatch.setattr(run, "load_scene_models", lambda names, fields, assets, data_dir, device: (names, device))
    asked = {}

    class Told:
        def __init__(self, world, models, goal, settings, rng, parts):
            self.world, self.goal = world, goal
            asked.update(models=models, settings=settings, draws=rng.random(3).tolist())

        def run(self):
            state = self.world.truth()
            estimate = EstimatedState(state, np.zeros(1), np.zeros(1), 0.0, ("",), "")
            looked = EstimateStep(Progress(1, 1, "Done"), "done", state, estimate=estimate)
            yield Observed(0, self.world.observe())
            for look in ("first", "goal", "next", "search"):
                yield Looking(0, look, EstimateStep(Progress(0, 1, "Trying poses"), "objects", state))
                yield Looking(0, look, looked)
            yield GoalFound(PoseGoal(NAMES, state.poses), self.goal.image, self.goal.camera, None)
            yield Planning(0, None)
            yield ActionExecuted(1, np.zeros(3))
            yield Noticed(1, "lamp", "The lamp was moved.")
            yield Stepped(1, 2, estimate, np.zeros(1), np.zeros(1), 0.0, self.goal.image, {})
            yield Finished(1, "reached", "The table looks like the goal.", state)

    monkeypatch.setattr(run, "Episode", Told)
    return asked


def test_every_step_tells_what_is_being_done(order, told, worlds):
    steps = list(run_episode(order))
    notes = list(dict.fromkeys(step.note for step in steps))
    assert notes == [
        "Loading fields and setting the table",
        "Looking at the first frame: Trying poses",
        "Knows where everything is",
        "Looking at the goal image: Trying poses",
        "Comparing the goal image with the table",
        "Looking at the table: Trying poses",
        "Knows where everything is now",
        "Looking at the lost objects: Trying poses",
        "Knows where everything should be",
        "Planning pushes",
        "Pushing",
        "The lamp was moved.",
        "The table looks like the goal.",
        "Writing video and recording",
    ]
    assert steps[-1].note == "The table looks like the goal."
    done = [step.done for step in steps]
    assert done == sorted(done)
    assert done[-1] == 1
    assert {step.total for step in steps} == {2}
    assert [step.report is None for step in steps] == [True] * (len(steps) - 1) + [False]
    assert steps[-1].report["outcome"] == "reached"
    assert {path.name for path in order.out.iterdir()} >= {REPORT_FILE, RECORDING_FILE}
    assert_closed(worlds)


def test_the_order_reaches_the_episode(order, told):
    list(run_episode(order))
    first = dict(told)
    assert first["models"] == (NAMES, "cpu")
    assert first["settings"] is order.settings
    list(run_episode(order))
    assert told["draws"] == first["draws"]


def test_who_stops_asking_ends_it(order, told, worlds):
    with contextlib.closing(run_episode(order)) as steps:
        while not isinstance(next(steps).event, ActionExecuted):
            pass
        assert worlds[0].truth().names == NAMES
    assert_closed(worlds)
    report = json.loads((order.out / REPORT_FILE).read_text())  # what was done is kept
    assert (report["outcome"], report["steps_done"]) == (None, 0)


def stage_of(event):
    return EpisodeProgress(0, 0, "").after(event).stage


def test_every_part_of_the_loop_has_a_name():
    looked = EstimateStep(Progress(1, 1, "Done"), "done", None)
    for look in ("first", "goal", "next", "search"):
        assert stage_of(Looking(0, look, looked)) == look
    stepped = Stepped(0, 3, None, np.zeros(0), np.zeros(0), 0.0, np.zeros((4, 4, 3)), {})
    assert stage_of(stepped) == stage_of(Planning(0, None)) == "plan"  # what comes next is planned
    assert stage_of(ActionExecuted(1, np.zeros(3))) == "act"
    for event in (Noticed(1, "lamp", "It was moved."), Finished(1, "reached", "Done.", None), Observed(0, None)):
        assert stage_of(event) is None


def test_what_cannot_be_known_leaves_no_world_behind(order, worlds, monkeypatch):
    def broken(*_):
        raise CorruptFile("table.safetensors", "it is broken")

    monkeypatch.setattr(run, "load_scene_models", broken)
    with pytest.raises(CorruptFile):
        list(run_episode(order))
    assert_closed(worlds)
    assert not order.out.exists()


def test_a_mistake_comes_before_any_file(tmp_path, data_dir):
    steps = run_episode(EpisodeOrder(tmp_path / "out", data_dir, ("teapot",)))
    assert next(steps).note
    with pytest.raises(UnknownName, check=about("teapot")):
        next(steps)
    assert not (tmp_path / "out").exists()
