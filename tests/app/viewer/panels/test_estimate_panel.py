"""Estimates in the 3D view, told by the test."""

import numpy as np
import pytest

from app.jobs.job import Job, JobChanged, JobView
from app.services.event_hub import CurrentScene
from app.viewer.nodes.estimate_nodes import EstimateNodes
from app.viewer.nodes.scene_nodes import SceneNodes
from app.viewer.panels.estimate_panel import EstimatePanel
from osfcore.estimation.steps import EstimateStep
from osfcore.geometry.light import Light
from osfcore.geometry.poses import Pose
from osfcore.geometry.states import EstimatedState, SceneState
from osfcore.progress import Progress
from tests.app.conftest import until
from tests.app.storage.test_database import record
from tests.app.viewer.conftest import ViewerDriver

BOX = "003_cracker_box"
STATE = SceneState(
    (BOX,), Pose(np.array([[0.1, 0, 0.1]]), np.array([[1.0, 0, 0, 0]])), Light(np.array([1.0, 0, 1])), None
)


def job(state="running", scene="s", name="a", **changes):
    params = {"mode": "first", "seed": 0, "of": {"scene": scene}, "names": [BOX], "cameras": ["0", "1"]}
    return Job(name, "estimate", params, state, **{"done": 3, "total": 6, "note": "Looking", **changes})


def step(number=1, estimate=None, x=0.1):
    moved = SceneState((BOX,), Pose(STATE.poses.position + [[x, 0, 0]], STATE.poses.quaternion), STATE.light, None)
    return EstimateStep(Progress(number, 6, ""), "objects", moved, losses=(1 / number,), estimate=estimate)


class Room:
    """A view whose service is made of air."""

    def __init__(self, server, library):
        self.gui = ViewerDriver(server)
        self.table = SceneNodes(server, library, lambda *_: None, lambda *_: None)
        self.drawing = EstimateNodes(server, library)
        self.panel = EstimatePanel(server, (self.table, self.drawing))

    def see(self, of, what):
        self.panel.show(JobView(of, what))
        until(lambda: self.panel.is_idle)

    def guess(self):
        node = self.gui.node(f"/estimate/guess/{BOX}")
        return None if node is None else node.batched_positions


@pytest.fixture
def room(server, library):
    room = Room(server, library)
    room.panel.start(record("s"))
    until(lambda: room.panel.is_idle)
    yield room
    room.panel.close()
    room.panel.close()


def test_steps_are_drawn(room):
    room.see(job(), step())
    until(lambda: not room.drawing.is_empty)
    room.see(job(), step(2, x=0.2))
    until(lambda: np.allclose(room.guess(), [[0.3, 0, 0.1]]))


def test_what_an_estimate_has_drawn_is_cleared_once_it_is_over(room):
    room.see(job(), step())
    room.gui.press("Clear")
    assert not room.drawing.is_empty  # it still runs
    room.panel.show(JobChanged(1, job("done", result={"trusted": True})))
    until(lambda: room.panel.is_idle)
    room.gui.press("Clear")
    until(lambda: room.drawing.is_empty)


def test_the_true_light_is_told_on_demand_only_and_is_back_when_the_estimate_is_gone(room):
    assert room.gui.shows("/light")
    room.see(job(), step())
    until(lambda: not room.gui.shows("/light"))
    room.gui.set("Show true light", True)
    until(lambda: room.gui.shows("/light"))
    assert room.gui.shows("/light_name")
    assert room.gui.node("/light_name").text == "true light"
    assert tuple(room.gui.node("/light").colors) != tuple(room.gui.node("/estimate/light").colors)
    room.panel.show(JobChanged(1, job("cancelled")))
    until(lambda: room.drawing.is_empty)
    until(lambda: not room.gui.shows("/light_name"))
    assert room.gui.shows("/light")


def test_only_what_is_about_the_scene_on_view_is_drawn(room):
    room.see(job(scene="other"), step())
    assert room.drawing.is_empty
    room.see(job(scene=None, name="upload"), step())
    until(lambda: not room.drawing.is_empty)
    room.panel.show(JobChanged(1, job("done", scene=None, name="upload", result={"trusted": False})))
    until(lambda: room.panel.is_idle)
    room.see(job(), step())
    assert not room.drawing.is_empty
    room.panel.show(CurrentScene(record()))
    until(lambda: room.drawing.is_empty)


def test_one_that_waits_does_not_take_the_view_from_one_that_runs(room):
    room.see(job(), step())
    room.panel.show(JobChanged(1, job("queued", name="b")))
    until(lambda: room.panel.is_idle)
    assert not room.drawing.is_empty


def test_steps_of_jobs_of_other_kinds_are_not_drawn(room):
    other = Job("e", "episode", {"scene": "s", "names": [BOX]}, "running")
    room.panel.show(JobView(other, step()))
    room.panel.show(JobChanged(1, other))
    assert room.panel.is_idle
    assert room.drawing.is_empty


def test_of_one_that_failed_nothing_stays(room):
    room.see(job(), step())
    room.panel.show(JobChanged(1, job("failed", error="mask of x is empty.")))
    until(lambda: room.drawing.is_empty)


def test_a_defect_in_drawing_does_not_end_the_view(room, monkeypatch):
    with monkeypatch.context() as broken:
        broken.setattr(room.drawing, "show", lambda _: 1 / 0)
        room.see(job(), step())
    room.see(job(), step(2, EstimatedState(STATE, np.ones(1), np.ones(1), 0.1, ("",), "")))
    until(lambda: room.gui.below(f"/estimate/verdict/{BOX}"))
