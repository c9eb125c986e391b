"""Predicted pushes in the 3D view: what is drawn, what is chosen, and what came of them."""

from concurrent.futures import Future, ThreadPoolExecutor
from dataclasses import replace
from types import SimpleNamespace

import numpy as np
import pytest

from app.processes.client import ProcessUnavailable
from app.processes.messages.neural_messages import Predicted
from app.processes.messages.scene_messages import SceneChanged, SceneRecord
from app.services.event_hub import CurrentScene, Notice
from app.services.fields import MissingFields
from app.services.pushes import MAX_ACTIONS, Outcome
from app.services.scenes import SceneHeld
from app.viewer.nodes.push_nodes import TRAIL, PushNodes
from app.viewer.push_panel import PushPanel, PushPrediction, report
from osfcore.errors import OsfError
from osfcore.geometry.light import Light
from osfcore.geometry.poses import Pose
from osfcore.geometry.rollouts import Rollouts
from osfcore.geometry.states import SceneState
from osfcore.geometry.workspace import PUSHER_CENTRE_Z_M
from tests.app.conftest import until
from tests.app.storage.test_database import record
from tests.app.viewer.conftest import ViewerDriver

BOX, CAN, GONE = "003_cracker_box", "005_tomato_soup_can", "my_thing"
COUNT = 11
PREDICT = "Predict toward the nearest"


@pytest.fixture
def drawing(server, library):
    return PushNodes(server, library)


@pytest.fixture
def rollouts():
    """Of three objects the first slides from its fourth action on, the second stays, the third turns by 90 degrees."""
    positions = np.zeros((1, COUNT, 3, 3))
    positions[0, :, 0, 0] = 0.02 * np.maximum(np.arange(COUNT) - 4, 0)
    positions[0, :, 1:, 1] = [0.2, -0.2]
    quaternions = np.tile([1.0, 0, 0, 0], (1, COUNT, 3, 1))
    half = np.linspace(0, np.pi / 4, COUNT)
    quaternions[0, :, 2] = np.stack([np.cos(half), 0 * half, 0 * half, np.sin(half)], axis=1)
    quaternions[0, 1::2, 2] *= -1  # the same rotations
    pusher = np.linspace([-0.2, 0, 0.06], [0.1, 0, 0.06], COUNT)[None]
    return Rollouts((BOX, CAN, GONE), positions, quaternions, pusher)


def ghost(driver, name):
    """Where the ghost is that goes along."""
    node = driver.node(f"/push/future/{name}")
    return np.asarray(node.batched_positions)[-1], np.asarray(node.batched_wxyzs)[-1]


def test_what_moves_gets_a_ghost_at_the_end_and_a_way(drawing, driver, rollouts):
    drawing.show(rollouts)
    assert drawing.moving == (BOX, GONE)
    np.testing.assert_allclose(ghost(driver, BOX)[0], [0.12, 0, 0], atol=1e-6)
    np.testing.assert_allclose(driver.node("/push/future/pusher").position, [0.1, 0, 0.06], atol=1e-6)
    assert driver.shows("/push/ways")
    assert driver.node("/push/ways").points.shape == (2 * (COUNT - 1), 2, 3)
    assert driver.node("/push/ways").points[0, 0, 2] > 0.1  # above the box


def test_the_trail_is_spread_over_the_way_and_not_over_the_wait(drawing, driver, rollouts):
    drawing.show(rollouts)
    x = np.asarray(driver.node(f"/push/future/{BOX}").batched_positions)[:TRAIL, 0]
    assert len(np.unique(x)) == TRAIL
    assert x.min() > 0.01
    assert x.max() < 0.12


def test_ghosts_move_with_time_by_the_shorter_way(drawing, driver, rollouts):
    drawing.show(rollouts)
    drawing.at(5.5)
    position, _ = ghost(driver, BOX)
    np.testing.assert_allclose(position, [0.03, 0, 0], atol=1e-6)
    _, quaternion = ghost(driver, GONE)
    half = np.pi / 4 * 5.5 / 10
    np.testing.assert_allclose(np.abs(quaternion), [np.cos(half), 0, 0, np.sin(half)], atol=1e-4)
    for step, x in ((-3, 0.0), (99, 0.12)):
        drawing.at(step)
        np.testing.assert_allclose(ghost(driver, BOX)[0][0], x, atol=1e-6)


def test_truth_is_drawn_beside_it_and_all_goes_again(drawing, driver, rollouts):
    drawing.show(rollouts)
    light, turns = Light(np.array([0, 0, 1.0])), np.tile([1.0, 0, 0, 0], (2, 1))
    states = [
        SceneState((BOX, CAN), Pose(np.array([[x, 0, 0], [0, 0.2, 0]]), turns), light, None) for x in (0.0, 0.05, 0.1)
    ]
    drawing.show_truth(states)
    assert driver.shows("/push/true_ways")
    assert driver.node("/push/true_ways").points.shape == (2, 2, 3)
    np.testing.assert_allclose(
        driver.node("/push/true_ways").points[0, 0, 2], driver.node("/push/ways").points[0, 0, 2]
    )
    drawing.show_truth(())
    assert not driver.shows("/push/true_ways")
    drawing.plan(np.array([[0, 0], [0.1, 0.1]]))
    drawing.clear()
    assert drawing.moving == ()
    assert not driver.shows("/push/future/pusher")
    assert not driver.shows("/push/ways")
    assert driver.shows("/push/plan")
    drawing.plan(None)
    assert not driver.shows("/push/plan")
    drawing.at(3)  # there is nothing to move


NOTHING = Rollouts(("x", "y"), np.zeros((1, 3, 2, 3)), np.zeros((1, 3, 2, 4)), np.zeros((1, 3, 3)))


def trial():
    return PushPrediction(record(revision=5), np.zeros((2, 3)), NOTHING, 0.1)


def test_it_follows_its_own_execution_action_by_action():
    new = trial()
    first = new.after(record(revision=6), (record().state,), new)
    assert not first.is_executed
    assert len(first.truth) == 3  # the start, the way, the end
    done = first.after(record(revision=7), (), new)
    assert done.is_executed
    assert len(done.truth) == 4
    assert done.after(record(revision=7), (), None) is done
    assert done.after(record(revision=8), (), None) is None


def test_any_other_change_ends_it_and_old_news_do_not():
    new = trial()
    assert new.after(record(revision=5), (), None) is new
    assert new.after(record(revision=6), (), None) is None
    assert new.after(record(revision=6), (), replace(new, rollouts=replace(NOTHING))) is None
    assert new.after(record(revision=8), (), new) is None


def test_nothing_is_no_table():
    assert report((), {}) == ""


def test_before_and_after():
    before = report([Outcome("a", 12.34, 5.0)], {"a": "A box"})
    assert "A box" in before
    assert "12 mm<br>5.0°" in before
    assert "Off by" not in before
    after = report([Outcome("a", 12.34, 5.0, 9.96, 0.0, 2.4, 5.0), Outcome("b", 0, 0, 0, 0, 0, 0)], {})
    assert "<b>2.4 mm<br>5.0°</b>" in after
    assert "10 mm<br>0.0°" in after
    assert "still" in after


def test_what_users_name_is_escaped():
    assert "<script" not in report([Outcome("<script>", 1, 1)], {})
    assert "&lt;b&gt;" in report([Outcome("a", 1, 1)], {"a": "<b>"})


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
        pusher = server.scene.add_cylinder("/pusher", position=RECORD.state.pusher)
        self.commands = ThreadPoolExecutor(1)
        self.panel = PushPanel(server, library, pusher, self, self.commands, self.act, self.run)
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

    def drag(self, to):
        """Drag the pusher, which is seen from above, to a place on the table."""
        at = RECORD.state.pusher
        self.gui.drag_body("/pusher", np.array([*at[:2], 1.0]), at, np.array([*to, at[2]]))

    def predict(self, goes_m=0.04):
        self.gui.press(PREDICT)
        self.answer(goes_m)
        self.gui.says("predicted in")

    def moving(self):
        """Objects with a ghost."""
        names = self.gui.below("/push/future") - {"pusher"}
        return {name for name in names if self.gui.shows(f"/push/future/{name}")}

    def ghost_x(self):
        return self.gui.node(f"/push/future/{BOX}").batched_positions[-1, 0]


@pytest.fixture
def room(server, library):
    room = Room(server, library)
    room.panel.start(RECORD)
    until(lambda: room.panel.is_idle)
    yield room
    room.panel.close()
    room.panel.close()


def test_nothing_is_drawn_or_pushed_before_a_push_is_chosen(room):
    assert not room.gui.shows("/push/plan")
    assert room.gui.element("Push").disabled


def test_from_a_drag_to_ghosts_and_from_there_to_the_error(room):
    room.is_warm = False
    room.drag((-0.1, 0.15))
    room.gui.says("Loading the network")
    until(lambda: room.gui.shows("/push/plan"))
    (asked,) = room.asked
    np.testing.assert_allclose(asked.actions, np.tile([0, 0.25, 0], (1, 3, 1)), atol=1e-9)
    assert asked.state is RECORD.state
    room.answer()
    room.gui.says("1 object will move; predicted in 20 ms")
    assert room.moving() == {BOX}
    assert "40 mm" in room.gui.text()
    until(lambda: not room.gui.element("Push").disabled)
    room.gui.press("Push")
    room.gui.says("Executed")
    ((scene, actions),) = room.acted
    assert scene == "s"
    np.testing.assert_array_equal(actions, asked.actions[0])
    until(lambda: "Off by" in room.gui.text())
    assert "<b>10 mm<br>0.0°</b>" in room.gui.text()
    assert room.moving() == {BOX}  # the ghosts stay
    assert room.gui.shows("/push/true_ways")
    until(lambda: room.gui.element("Push").disabled)
    room.gui.press("Clear")
    until(lambda: room.moving() == set())
    assert "push-report" not in room.gui.text()


def test_without_a_hand_the_nearest_object_is_pushed(room):
    room.gui.press(PREDICT)
    np.testing.assert_allclose(room.asked[0].actions, np.tile([0.25, 0, 0], (1, 3, 1)), atol=1e-9)  # 10 cm, and 5 more


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
    room.gui.press(PREDICT)
    room.change()
    room.answer()
    room.gui.says("has changed")
    assert room.moving() == set()
    room.predict()
    room.gui.set("Speed, m/s", 0.1)
    until(lambda: room.moving() == set())
    assert np.linalg.norm(room.asked[-1].actions, axis=-1).max() <= 0.1 + 1e-9  # the same push, slower
    room.predict()
    room.panel.show(CurrentScene(None))
    until(lambda: room.moving() == set())
    until(lambda: not room.gui.shows("/push/plan"))
    room.panel.show(Notice("info", "of no concern here"))


def test_after_the_comparison_another_change_ends_it(room):
    room.predict()
    room.gui.press("Push")
    room.gui.says("Executed")
    room.change()
    room.gui.says("has changed")
    assert "push-report" not in room.gui.text()


def test_what_somebody_else_does_at_the_same_time_is_not_taken_for_the_push(room):
    room.predict()
    room.jumps_in = True
    room.gui.press("Push")
    room.gui.says("has changed")
    assert not room.gui.shows("/push/true_ways")


@pytest.mark.parametrize("refusal", [MissingFields(["my_thing"]), SceneHeld("episode")])
def test_refusals_are_told_to_who_asked_and_in_the_panel(room, refusal):
    room.predict()
    room.refusal = refusal
    room.gui.press("Push" if isinstance(refusal, SceneHeld) else PREDICT)
    assert room.refused == [(str(refusal), SOMEBODY)]
    room.gui.says(str(refusal)[:30])


def test_an_answer_may_be_a_refusal_or_overtaken(room):
    room.gui.press(PREDICT)
    room.gui.press(PREDICT)
    assert {asked.key for asked in room.asked} == {"viewer"}
    room.asked[0].answer.set_result(None)
    room.asked[1].answer.set_exception(ProcessUnavailable("predictor", "stopped unexpectedly"))
    room.gui.says("stopped unexpectedly")
    assert room.refused[0][1] is SOMEBODY


def test_executing_needs_a_new_prediction(room):
    room.gui.press("Push")
    assert "drag the pusher first" in room.refused.pop()[0]
    room.predict()
    room.gui.press("Push")
    assert room.refused == []
    room.gui.press("Push")
    assert "drag the pusher first" in room.refused.pop()[0]
    assert len(room.acted) == 1


@pytest.mark.parametrize("nonsense", [float("nan"), 1e12, -1e12])
def test_numbers_beyond_the_slider_do_no_harm(room, nonsense):
    room.gui.set("Speed, m/s", nonsense)
    room.gui.press(PREDICT)
    assert 1 <= room.asked[0].actions.shape[1] <= MAX_ACTIONS
    room.answer()
    room.gui.says("predicted in")
    room.gui.set("Time, s", nonsense)
    until(lambda: np.isfinite(room.ghost_x()))


def test_a_defect_in_drawing_does_not_end_the_view(room, monkeypatch):
    with monkeypatch.context() as broken:
        broken.setattr(PushNodes, "show", lambda *_: 1 / 0)
        room.gui.press(PREDICT)
        room.answer()
        until(lambda: room.panel.is_idle)
    room.predict()
