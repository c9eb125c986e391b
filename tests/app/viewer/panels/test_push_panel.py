"""The folder in the panel, with predictions and pushes that are told by the test."""

import contextlib
import io
from concurrent.futures import Future
from dataclasses import replace
from types import SimpleNamespace

import numpy as np
import pytest
import viser

from app.processes.messages import CurrentScene, Notice, SceneChanged, SceneRecord
from app.processes.neural_client import NeuralUnavailable
from app.processes.neural_messages import Predicted
from app.services.fields import MissingFields
from app.services.pushes import MAX_ACTIONS
from app.services.runner import SceneHeld
from app.viewer.panels.push_panel import PATH, PushView
from app.viewer.viewer import LoopbackViser
from osfcore.errors import OsfError
from osfcore.geometry.light import Light
from osfcore.geometry.poses import Pose
from osfcore.geometry.rollouts import Rollouts
from osfcore.geometry.states import SceneState
from osfcore.geometry.workspace import PUSHER_CENTRE_Z_M
from tests.app.conftest import until

BOX, CAN = "003_cracker_box", "005_tomato_soup_can"
SOMEBODY = object()


def state(x=0.0):
    poses = Pose(np.array([[x, 0, 0.1], [0.2, 0.1, 0.05]]), np.tile([1.0, 0, 0, 0], (2, 1)))
    return SceneState((BOX, CAN), poses, Light(np.array([1.0, 0, 1])), np.array([-0.1, 0, PUSHER_CENTRE_Z_M]))


RECORD = SceneRecord("s", 7, "2026-01-01T00:00:00.000Z", 128, state(), state(), 0.0, 3)


def rollouts_of(actions, goes_m):
    count = len(actions) + 1
    positions = np.tile(state().poses.position, (1, count, 1, 1))
    positions[0, :, 0, 0] = np.linspace(0, goes_m, count)
    pusher = np.tile(state().pusher, (1, count, 1))
    return Rollouts((BOX, CAN), positions, np.tile([1.0, 0, 0, 0], (1, count, 2, 1)), pusher)


class Room:
    """A view whose service is made of air; the simulator moves the box by 5 cm, whatever the push."""

    def __init__(self, server, library):
        self.asked, self.acted, self.refused = [], [], []
        self.record, self.refusal, self.jumps_in, self.is_warm = RECORD, None, False, True
        self.view = PushView(server, library, self, self.act, self.obey)
        self.server = server

    def current(self):
        return self.record

    def submit(self, of, actions, key):
        if self.refusal:
            raise self.refusal
        self.asked.append(SimpleNamespace(state=of, actions=actions, key=key, answer=Future()))
        return self.asked[-1].answer

    def act(self, scene, actions):
        if self.refusal:
            raise self.refusal
        self.acted.append((scene, np.array(actions)))
        if self.jumps_in:
            self.change()
        for number in range(1, len(actions) + 1):
            self.change(state(0.05 * number / len(actions)), (state(0.05 * number / len(actions)),))
        return self.record

    def change(self, to=None, states=()):
        self.record = replace(self.record, state=to or self.record.state, revision=self.record.revision + 1)
        self.view.note(SceneChanged(self.record, states, 0.1))

    def obey(self, command, client):
        try:
            command()
        except OsfError as error:
            self.refused.append((str(error), client))

    def answer(self, goes_m=0.04, number=-1):
        asked = self.asked[number]
        asked.answer.set_result(Predicted(rollouts_of(asked.actions[0], goes_m), 0.02))

    def press(self, label, value=None):
        handles = self.server.gui._gui_input_handle_from_uuid.values()
        (button,) = (h for h in handles if h.label == label and hasattr(h, "on_click"))
        if isinstance(button, viser.GuiButtonHandle) and button.disabled:
            return
        (callback,) = button._impl.update_cb
        callback(SimpleNamespace(client=SOMEBODY, target=button if value is None else SimpleNamespace(value=value)))

    def set(self, handle, value):
        """As a visitor does, who may send anything."""
        handle._impl.value = value
        for callback in handle._impl.update_cb:
            callback(SimpleNamespace(client=SOMEBODY, target=handle))

    def predict(self, goes_m=0.04):
        self.press("Predict")
        self.answer(goes_m)
        self.says("predicted in")

    def says(self, words):
        until(lambda: words in self.view._status.content)


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
    room.view.start(RECORD)
    until(lambda: room.view._laid is not None)
    yield room
    room.view.stop()
    room.view.stop()
    server.gui.reset()
    server.scene.reset()


def test_it_begins_with_a_push_that_reaches_the_nearest_object_and_draws_nothing(room):
    assert room.view._heading.value == 0
    assert room.view._steps.value == 3  # 10 cm, and 5 more
    assert not room.view._drawing._plan.visible
    assert room.view._execute_button.disabled


def test_from_a_direction_to_ghosts_and_from_there_to_the_error(room):
    room.press("Direction", "↑")
    until(lambda: room.view._heading.value == 90)
    until(lambda: room.view._drawing._plan.visible)
    room.is_warm = False
    room.press("Predict")
    room.says("Loading the network")
    (asked,) = room.asked
    np.testing.assert_allclose(asked.actions, np.tile([0, 0.25, 0], (1, 3, 1)), atol=1e-9)
    assert asked.state is RECORD.state
    room.answer()
    room.says("1 object will move; predicted in 20 ms")
    assert room.view._drawing.moving == (BOX,)
    assert "40 mm" in room.view._report.content
    until(lambda: not room.view._execute_button.disabled)
    room.press("Execute")
    room.says("Executed")
    ((scene, actions),) = room.acted
    assert scene == "s"
    np.testing.assert_array_equal(actions, asked.actions[0])
    until(lambda: "Off by" in room.view._report.content)
    assert "<b>10 mm<br>0.0°</b>" in room.view._report.content
    assert room.view._drawing.moving == (BOX,)  # the ghosts stay
    assert room.view._drawing._true_ways.visible
    until(lambda: room.view._execute_button.disabled)
    room.press("Clear")
    until(lambda: room.view._drawing.moving == ())
    assert not room.view._report.visible


def test_waypoints_become_actions(room):
    room.set(room.view._kind, PATH)
    until(lambda: room.view._waypoints._handles[2].visible)
    assert not room.view._heading.visible
    for number, place in enumerate([(-0.1, 0.05, 0), (0.0, 0.05, 0)]):
        room.view._waypoints._handles[number].position = place
    room.set(room.view._count, 2)
    until(lambda: not room.view._waypoints._handles[2].visible)
    room.press("Predict")
    np.testing.assert_allclose(room.asked[0].actions, [[[0, 0.25, 0], [0.25, 0, 0], [0.25, 0, 0]]], atol=1e-9)


def test_time_is_sought_and_played(room):
    room.predict()
    ghost = room.view._drawing._ghosts[BOX]
    np.testing.assert_allclose(ghost.batched_positions[0, 0], 0.04, atol=1e-6)
    room.set(room.view._time, 0.0)
    until(lambda: np.allclose(ghost.batched_positions[0, 0], 0, atol=1e-6))
    room.press("Play")
    until(lambda: room.view._play.label == "Pause")
    until(lambda: np.allclose(ghost.batched_positions[0, 0], 0.04, atol=1e-6))
    until(lambda: room.view._play.label == "Play")
    assert room.view._time.value == pytest.approx(0.6)
    room.press("Play")  # from the beginning again
    until(lambda: room.view._play.label == "Pause")


def test_a_prediction_is_dropped_when_the_table_changes_or_another_push_is_chosen(room):
    room.predict()
    room.change()
    room.says("has changed")
    until(lambda: room.view._drawing.moving == ())
    room.press("Predict")
    room.change()
    room.answer()
    room.says("has changed")
    assert room.view._drawing.moving == ()
    room.predict()
    room.set(room.view._speed, 0.1)
    until(lambda: room.view._drawing.moving == ())
    room.predict()
    room.view.note(CurrentScene(None))
    until(lambda: room.view._drawing.moving == ())
    until(lambda: not room.view._drawing._plan.visible)
    room.view.note(Notice("info", "of no concern here"))


def test_after_the_comparison_another_change_ends_it(room):
    room.predict()
    room.press("Execute")
    room.says("Executed")
    room.change()
    room.says("has changed")
    assert not room.view._report.visible


def test_what_somebody_else_does_at_the_same_time_is_not_taken_for_the_push(room):
    room.predict()
    room.jumps_in = True
    room.press("Execute")
    room.says("has changed")
    assert not room.view._drawing._true_ways.visible


@pytest.mark.parametrize("refusal", [MissingFields(["my_thing"]), SceneHeld("s", "j")])
def test_refusals_are_told_to_who_asked_and_in_the_panel(room, refusal):
    room.predict()
    room.refusal = refusal
    room.press("Execute" if isinstance(refusal, SceneHeld) else "Predict")
    assert room.refused == [(str(refusal), SOMEBODY)]
    room.says(str(refusal)[:30])


def test_an_answer_may_be_a_refusal_or_overtaken(room):
    room.press("Predict")
    room.press("Predict")
    assert {asked.key for asked in room.asked} == {"viewer"}
    room.asked[0].answer.set_result(None)
    room.asked[1].answer.set_exception(NeuralUnavailable("predictor", "stopped unexpectedly"))
    room.says("stopped unexpectedly")
    assert room.refused[0][1] is SOMEBODY


def test_executing_needs_a_new_prediction(room):
    with pytest.raises(OsfError, match="Predict first"):
        room.view._execute()
    room.predict()
    room.press("Execute")
    with pytest.raises(OsfError, match="Predict first"):
        room.view._execute()
    assert len(room.acted) == 1


@pytest.mark.parametrize("nonsense", [float("nan"), 1e12, -1e12])
def test_numbers_beyond_the_sliders_do_no_harm(room, nonsense):
    for handle in (room.view._heading, room.view._speed, room.view._steps, room.view._count):
        room.set(handle, nonsense)
    room.press("Direction", "sideways")
    room.press("Predict")
    assert 1 <= room.asked[0].actions.shape[1] <= MAX_ACTIONS
    room.answer()
    room.says("predicted in")
    room.set(room.view._time, nonsense)
    until(lambda: np.isfinite(room.view._drawing._ghosts[BOX].batched_positions).all())


def test_a_defect_in_drawing_does_not_end_the_view(room, monkeypatch):
    show = room.view._drawing.show
    monkeypatch.setattr(room.view._drawing, "show", lambda _: 1 / 0)
    room.press("Predict")
    room.answer()
    until(lambda: room.view._thread.is_idle)
    monkeypatch.setattr(room.view._drawing, "show", show)
    room.predict()
