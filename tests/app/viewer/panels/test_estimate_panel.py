"""The folder in the panel, with estimates that are told by the test."""

import contextlib
import io
from concurrent.futures import Future
from types import SimpleNamespace

import numpy as np
import pytest
import viser
from PIL import Image

from app.jobs.job import Job, JobChanged, JobSeen
from app.processes.messages import CurrentScene
from app.processes.neural_messages import Comparison
from app.viewer.nodes.estimate_nodes import EstimateDrawing
from app.viewer.nodes.scene_nodes import SceneDrawing
from app.viewer.panels.estimate_panel import EstimateView
from app.viewer.viewer import LoopbackViser
from osfcore.estimation.steps import EstimateStep
from osfcore.geometry.estimated_state import EstimatedState
from osfcore.geometry.light import Light
from osfcore.geometry.poses import Pose
from osfcore.geometry.states import SceneState
from osfcore.progress import Progress
from tests.app.conftest import until
from tests.app.storage.test_database import record

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


class Renderer:
    def __init__(self):
        self.orders = []

    def submit(self, order):
        self.orders.append((order, Future()))
        return self.orders[-1][1]


class Room:
    """A view whose service is made of air."""

    def __init__(self, server, library):
        self.server = server
        self.asked, self.cancelled = [], []
        self.table = SceneDrawing(server, library, lambda *_: None, lambda *_: None)
        self.drawing = EstimateDrawing(server, library)
        self.renderer = Renderer()
        estimates = SimpleNamespace(of_scene=self.asked.append, comparison=lambda job, view: (job.id, view))
        self.view = EstimateView(
            server, (self.table, self.drawing), estimates, self.renderer, lambda command, _: command(),
            self.cancelled.append,
        )  # fmt: skip

    def see(self, of, what):
        self.view.note(JobSeen(of, what))
        until(lambda: self.view._steps == [] and self.view._thread.is_idle)


@pytest.fixture(scope="module")
def server():
    with contextlib.redirect_stdout(io.StringIO()):
        server = LoopbackViser(host="127.0.0.1", port=0, verbose=False)
    yield server
    with contextlib.redirect_stdout(io.StringIO()):
        server.stop()


@pytest.fixture
def room(server, library):
    room = Room(server, library)
    room.view.start("s")
    yield room
    room.view.stop()
    room.view.stop()
    server.gui.reset()
    server.scene.reset()


def press(button):
    (callback,) = button._impl.update_cb
    callback(SimpleNamespace(client=None, target=button))


def test_steps_are_drawn_and_the_panel_tells_how_far_it_is(room):
    room.see(job(), step())
    until(lambda: not room.drawing.is_empty)
    until(lambda: room.view._status.value == "Looking")
    assert room.view._bar.visible
    assert room.view._bar.value == 50
    assert not room.view._stop_button.disabled
    room.see(job(), step(2, x=0.2))
    until(lambda: np.allclose(room.drawing._guesses[BOX].batched_positions, [[0.3, 0, 0.1]]))
    until(lambda: len(room.view._plot.data[0]) == 3)  # two steps and the gap behind them


def test_buttons_ask_and_cancel(room):
    handles = room.server.gui._gui_input_handle_from_uuid.values()
    buttons = {handle.label: handle for handle in handles if isinstance(handle, viser.GuiButtonHandle)}
    press(buttons["Estimate from cameras"])
    assert [asked.mode for asked in room.asked] == ["first"]
    press(buttons["Cancel"])
    assert room.cancelled == []  # there is nothing to cancel
    room.see(job(), step())
    press(buttons["Cancel"])
    assert room.cancelled == ["a"]
    press(buttons["Clear"])
    assert not room.drawing.is_empty  # it still runs
    room.view.note(JobChanged(1, job("done", result={"trusted": True})))
    until(lambda: room.view._status.value == "Done, trusted")
    press(buttons["Clear"])
    until(lambda: room.drawing.is_empty)


def test_the_true_light_is_told_on_demand_only_and_is_back_when_the_estimate_is_gone(room):
    assert room.table._cube.visible
    room.see(job(), step())
    until(lambda: not room.table._cube.visible)
    room.view._wants_truth.value = True
    until(lambda: room.table._cube.visible)
    assert room.table._lamp_name.visible
    assert room.table._lamp_name.text == "true light"
    assert tuple(room.table._cube.color) != tuple(room.drawing._lamp[0].color)
    room.view.note(JobChanged(1, job("cancelled")))
    until(lambda: room.drawing.is_empty)
    until(lambda: not room.table._lamp_name.visible)
    assert room.table._cube.visible
    assert room.view._status.value == "Cancelled"
    assert room.view._stop_button.disabled


def test_only_what_is_about_the_scene_on_view_is_drawn(room):
    room.see(job(scene="other"), step())
    assert room.drawing.is_empty
    room.see(job(scene=None, name="upload"), step())
    until(lambda: not room.drawing.is_empty)
    room.view.note(JobChanged(1, job("done", scene=None, name="upload", result={"trusted": False})))
    until(lambda: "NOT trusted" in room.view._status.value)
    room.see(job(), step())
    until(lambda: room.view._drawn_job == "a")
    room.view.note(CurrentScene(record()))
    until(lambda: room.drawing.is_empty)


def test_one_that_waits_does_not_take_the_view_from_one_that_runs(room):
    room.see(job(), step())
    until(lambda: room.view._status.value == "Looking")
    room.view.note(JobChanged(1, job("queued", name="b")))
    assert room.view._job.id == "a"
    room.view.note(JobChanged(2, job(note="Looking again")))
    until(lambda: room.view._status.value == "Looking again")


def test_steps_of_jobs_of_other_kinds_are_not_drawn(room):
    other = Job("e", "episode", {"scene": "s", "names": [BOX]}, "running")
    room.view.note(JobSeen(other, step()))
    room.view.note(JobChanged(1, other))
    assert room.view._job is None
    assert room.view._thread.is_idle


def test_why_it_failed_is_told(room):
    room.see(job(), step())
    room.view.note(JobChanged(1, job("failed", error="mask of x is empty.")))
    until(lambda: room.view._status.value == "mask of x is empty.")
    assert room.drawing.is_empty


def test_observed_and_rendered_are_shown_side_by_side_one_order_at_a_time(room, monkeypatch):
    monkeypatch.setattr(room.server, "get_clients", lambda: {7: None})
    room.see(job(), step())
    until(lambda: room.renderer.orders)
    room.see(job(), step(2))
    order, answer = room.renderer.orders[0]
    assert order == ("a", 0)
    assert len(room.renderer.orders) == 1  # the second waits for the first
    buffer = io.BytesIO()
    Image.fromarray(np.repeat(np.arange(12, dtype=np.uint8)[None, :, None] * 20, 4, axis=0).repeat(3, axis=2)).save(
        buffer, "PNG"
    )
    answer.set_result(Comparison(b"", b"", buffer.getvalue(), 30.0))
    until(lambda: room.view._image.visible)
    np.testing.assert_array_equal(room.view._image.image[0, :, 0], np.arange(8) * 20)  # without the difference
    until(lambda: len(room.renderer.orders) == 2)
    room.renderer.orders[1][1].set_exception(RuntimeError("the renderer is gone"))
    room.view._camera.value = "1"
    until(lambda: len(room.renderer.orders) == 3)
    assert room.renderer.orders[2][0] == ("a", 1)


def test_a_defect_in_drawing_does_not_end_the_view(room, monkeypatch):
    show = room.drawing.show
    monkeypatch.setattr(room.drawing, "show", lambda _: 1 / 0)
    room.see(job(), step())
    monkeypatch.setattr(room.drawing, "show", show)
    room.see(job(), step(2, EstimatedState(STATE, np.ones(1), np.ones(1), 0.1, ("",), "")))
    until(lambda: room.drawing._verdicts)
