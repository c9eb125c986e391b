"""The folder in the panel, with predictions and pushes that are told by the test."""

from concurrent.futures import Future
from dataclasses import replace
from types import SimpleNamespace

import numpy as np
import pytest

from app.processes.messages.neural_messages import Predicted
from app.processes.messages.scene_messages import SceneChanged, SceneRecord
from app.processes.process_client import ProcessUnavailable
from app.services.event_hub import CurrentScene, Notice
from app.services.fields import MissingFields
from app.services.pushes import MAX_ACTIONS
from app.services.scenes import SceneHeld
from app.viewer.nodes.push_nodes import PushNodes
from app.viewer.panels.push_controls import PATH
from app.viewer.panels.push_panel import PushPanel
from osfcore.errors import OsfError
from osfcore.geometry.light import Light
from osfcore.geometry.poses import Pose
from osfcore.geometry.rollouts import Rollouts
from osfcore.geometry.states import SceneState
from osfcore.geometry.workspace import PUSHER_CENTRE_Z_M
from tests.app.conftest import until
from tests.app.viewer.conftest import ViewerDriver

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
        self.panel = PushPanel(server, library, self, self.act, self.run)
        self.gui = ViewerDriver(server, SOMEBODY)

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
        self.panel.show(SceneChanged(self.record, states, 0.1))

    def run(self, command, client):
        try:
            command()
        except OsfError as error:
            self.refused.append((str(error), client))

    def answer(self, goes_m=0.04, number=-1):
        asked = self.asked[number]
        asked.answer.set_result(Predicted(rollouts_of(asked.actions[0], goes_m), 0.02))

    def predict(self, goes_m=0.04):
        self.gui.press("Predict")
        self.answer(goes_m)
        self.gui.says("predicted in")

    def moving(self):
        """Objects with a ghost."""
        return self.gui.below("/push/ghost")

    def ghost_x(self):
        return self.gui.node(f"/push/ghost/{BOX}").batched_positions[0, 0]


@pytest.fixture
def room(server, library):
    room = Room(server, library)
    room.panel.start(RECORD)
    until(lambda: room.panel.is_idle)
    yield room
    room.panel.close()
    room.panel.close()


def test_it_begins_with_a_push_that_reaches_the_nearest_object_and_draws_nothing(room):
    assert room.gui.element("Heading, °").value == 0
    assert room.gui.element("Steps").value == 3  # 10 cm, and 5 more
    assert not room.gui.shows("/push/plan")
    assert room.gui.element("Execute").disabled


def test_from_a_direction_to_ghosts_and_from_there_to_the_error(room):
    room.gui.press("Direction", "↑")
    until(lambda: room.gui.element("Heading, °").value == 90)
    until(lambda: room.gui.shows("/push/plan"))
    room.is_warm = False
    room.gui.press("Predict")
    room.gui.says("Loading the network")
    (asked,) = room.asked
    np.testing.assert_allclose(asked.actions, np.tile([0, 0.25, 0], (1, 3, 1)), atol=1e-9)
    assert asked.state is RECORD.state
    room.answer()
    room.gui.says("1 object will move; predicted in 20 ms")
    assert room.moving() == {BOX}
    assert "40 mm" in room.gui.text()
    until(lambda: not room.gui.element("Execute").disabled)
    room.gui.press("Execute")
    room.gui.says("Executed")
    ((scene, actions),) = room.acted
    assert scene == "s"
    np.testing.assert_array_equal(actions, asked.actions[0])
    until(lambda: "Off by" in room.gui.text())
    assert "<b>10 mm<br>0.0°</b>" in room.gui.text()
    assert room.moving() == {BOX}  # the ghosts stay
    assert room.gui.shows("/push/true_ways")
    until(lambda: room.gui.element("Execute").disabled)
    room.gui.press("Clear")
    until(lambda: room.moving() == set())
    assert "push-report" not in room.gui.text()


def test_waypoints_become_actions(room):
    room.gui.set("Push", PATH)
    until(lambda: room.gui.shows("/push/waypoints/2"))
    assert not room.gui.element("Heading, °").visible
    for number, place in enumerate([(-0.1, 0.05, 0), (0.0, 0.05, 0)]):
        room.gui.node(f"/push/waypoints/{number}").position = place
    room.gui.set("Waypoints", 2)
    until(lambda: not room.gui.shows("/push/waypoints/2"))
    room.gui.press("Predict")
    np.testing.assert_allclose(room.asked[0].actions, [[[0, 0.25, 0], [0.25, 0, 0], [0.25, 0, 0]]], atol=1e-9)


def test_time_is_sought_and_played(room):
    room.predict()
    np.testing.assert_allclose(room.ghost_x(), 0.04, atol=1e-6)
    room.gui.set("Time, s", 0.0)
    until(lambda: np.allclose(room.ghost_x(), 0, atol=1e-6))
    room.gui.press("Play")
    until(lambda: room.gui.elements("Pause"))
    until(lambda: np.allclose(room.ghost_x(), 0.04, atol=1e-6))
    until(lambda: room.gui.elements("Play"))
    assert room.gui.element("Time, s").value == pytest.approx(0.6)
    room.gui.press("Play")  # from the beginning again
    until(lambda: room.gui.elements("Pause"))


def test_a_prediction_is_dropped_when_the_table_changes_or_another_push_is_chosen(room):
    room.predict()
    room.change()
    room.gui.says("has changed")
    until(lambda: room.moving() == set())
    room.gui.press("Predict")
    room.change()
    room.answer()
    room.gui.says("has changed")
    assert room.moving() == set()
    room.predict()
    room.gui.set("Speed, m/s", 0.1)
    until(lambda: room.moving() == set())
    room.predict()
    room.panel.show(CurrentScene(None))
    until(lambda: room.moving() == set())
    until(lambda: not room.gui.shows("/push/plan"))
    room.panel.show(Notice("info", "of no concern here"))


def test_after_the_comparison_another_change_ends_it(room):
    room.predict()
    room.gui.press("Execute")
    room.gui.says("Executed")
    room.change()
    room.gui.says("has changed")
    assert "push-report" not in room.gui.text()


def test_what_somebody_else_does_at_the_same_time_is_not_taken_for_the_push(room):
    room.predict()
    room.jumps_in = True
    room.gui.press("Execute")
    room.gui.says("has changed")
    assert not room.gui.shows("/push/true_ways")


@pytest.mark.parametrize("refusal", [MissingFields(["my_thing"]), SceneHeld("episode")])
def test_refusals_are_told_to_who_asked_and_in_the_panel(room, refusal):
    room.predict()
    room.refusal = refusal
    room.gui.press("Execute" if isinstance(refusal, SceneHeld) else "Predict")
    assert room.refused == [(str(refusal), SOMEBODY)]
    room.gui.says(str(refusal)[:30])


def test_an_answer_may_be_a_refusal_or_overtaken(room):
    room.gui.press("Predict")
    room.gui.press("Predict")
    assert {asked.key for asked in room.asked} == {"viewer"}
    room.asked[0].answer.set_result(None)
    room.asked[1].answer.set_exception(ProcessUnavailable("predictor", "stopped unexpectedly"))
    room.gui.says("stopped unexpectedly")
    assert room.refused[0][1] is SOMEBODY


def test_executing_needs_a_new_prediction(room):
    room.gui.press("Execute")
    assert "Predict first" in room.refused.pop()[0]
    room.predict()
    room.gui.press("Execute")
    assert room.refused == []
    room.gui.press("Execute")
    assert "Predict first" in room.refused.pop()[0]
    assert len(room.acted) == 1


@pytest.mark.parametrize("nonsense", [float("nan"), 1e12, -1e12])
def test_numbers_beyond_the_sliders_do_no_harm(room, nonsense):
    for label in ("Heading, °", "Speed, m/s", "Steps", "Waypoints"):
        room.gui.set(label, nonsense)
    room.gui.press("Direction", "sideways")
    room.gui.press("Predict")
    assert 1 <= room.asked[0].actions.shape[1] <= MAX_ACTIONS
    room.answer()
    room.gui.says("predicted in")
    room.gui.set("Time, s", nonsense)
    until(lambda: np.isfinite(room.ghost_x()))


def test_a_defect_in_drawing_does_not_end_the_view(room, monkeypatch):
    with monkeypatch.context() as broken:
        broken.setattr(PushNodes, "show", lambda *_: 1 / 0)
        room.gui.press("Predict")
        room.answer()
        until(lambda: room.panel.is_idle)
    room.predict()
