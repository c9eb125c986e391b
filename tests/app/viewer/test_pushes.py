"""Pushes that are tried, in the 3D view: what is drawn of them, and the hand that chooses one."""

from concurrent.futures import ThreadPoolExecutor
from dataclasses import replace

import numpy as np
import pytest

from app.services.event_hub import Notice
from app.services.fields import MissingFields
from app.services.pushes import Push, PushChanged
from app.viewer.nodes.push_nodes import TRAIL, PushNodes
from app.viewer.push_panel import PushPanel
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
LIGHT = Light(np.array([0, 0, 1.0]))


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


def moving(driver):
    """Objects with a ghost."""
    names = driver.below("/push/future") - {"pusher"}
    return {name for name in names if driver.shows(f"/push/future/{name}")}


def ghost(driver, name):
    """Where the ghost is that goes along."""
    node = driver.node(f"/push/future/{name}")
    return np.asarray(node.batched_positions)[-1], np.asarray(node.batched_wxyzs)[-1]


def test_what_moves_gets_a_ghost_at_the_end_and_a_way(drawing, driver, rollouts):
    drawing.show(rollouts)
    assert moving(driver) == {BOX, GONE}
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
    turns = np.tile([1.0, 0, 0, 0], (2, 1))
    states = [
        SceneState((BOX, CAN), Pose(np.array([[x, 0, 0], [0, 0.2, 0]]), turns), LIGHT, None) for x in (0.0, 0.05, 0.1)
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
    assert moving(driver) == set()
    assert not driver.shows("/push/future/pusher")
    assert not driver.shows("/push/ways")
    assert driver.shows("/push/plan")
    drawing.plan(None)
    assert not driver.shows("/push/plan")
    drawing.at(3)  # there is nothing to move


SOMEBODY = object()
RECORD = record(revision=7)
ACTIONS = np.tile([0.25, 0, 0], (COUNT - 1, 1))


class Room:
    """A view, and a service that notes which push is asked for."""

    def __init__(self, server, library):
        self.asked, self.refused, self.current, self.refusal = [], [], None, None
        self.pusher = server.scene.add_cylinder("/pusher", position=(-0.1, 0, PUSHER_CENTRE_Z_M))
        self.panel = PushPanel(server, library, self.pusher, self, ThreadPoolExecutor(1), self.run)
        self.view = ViewerDriver(server, SOMEBODY)

    def predict(self, target):
        self.asked.append(target)
        if self.refusal:
            raise self.refusal

    def run(self, command, client):
        try:
            command()
        except OsfError as error:
            self.refused.append(str(error))

    def show(self, push):
        self.panel.show(PushChanged(push))

    def drag(self, *to, grip=(0.0, 0.0)):
        """Drag the pusher, which is seen from above, to a place on the table."""
        at = np.array(self.pusher.position) + np.array([*grip, 0])
        self.view.drag_body("/pusher", np.array([*at[:2], 1.0]), at, np.array([*to, at[2]]))


@pytest.fixture
def room(server, library):
    room = Room(server, library)
    room.panel.start(RECORD)
    until(lambda: room.panel.is_idle)
    assert not room.view.shows("/push/plan")
    yield room
    room.panel.close()
    room.panel.close()


def test_a_drag_of_the_pusher_asks_for_a_push(room):
    room.drag(-0.1, 0.15)
    until(lambda: room.asked)
    np.testing.assert_allclose(room.asked[0], [-0.1, 0.15], atol=1e-9)
    room.drag(0.1, 0.0, grip=(0.01, 0.01))  # taken hold of beside its middle
    until(lambda: len(room.asked) == 2)
    np.testing.assert_allclose(room.asked[1], [0.09, -0.01], atol=1e-9)


def test_a_refused_drag_is_told_and_its_way_goes(room):
    room.refusal = MissingFields(["my_thing"])
    room.drag(-0.1, 0.15)
    until(lambda: room.refused == [str(room.refusal)])
    until(lambda: not room.view.shows("/push/plan"))


def test_a_prediction_plays_once_and_the_truth_comes_beside_it(room, rollouts):
    push = Push(RECORD, ACTIONS)
    room.show(push)
    until(lambda: room.view.shows("/push/plan"))
    np.testing.assert_allclose(room.view.node("/push/plan").points[0, :, :2], push.way, atol=1e-6)
    predicted = replace(push, state="predicted", rollouts=rollouts)
    room.show(predicted)
    until(lambda: moving(room.view) == {BOX, GONE})
    until(lambda: np.allclose(ghost(room.view, BOX)[0], [0.12, 0, 0], atol=1e-6))
    states = [
        SceneState((BOX,), Pose(np.array([[x, 0, 0.1]]), np.array([[1.0, 0, 0, 0]])), LIGHT, None) for x in (0, 0.05)
    ]
    room.show(replace(predicted, state="executed", truth=tuple(states)))
    until(lambda: room.view.shows("/push/true_ways"))
    assert moving(room.view) == {BOX, GONE}  # the ghosts stay
    until(lambda: not room.view.shows("/push/plan"))  # it would only lead on from there
    room.show(push.without_prediction("outdated", "The table has changed."))
    until(lambda: moving(room.view) == set())
    assert not room.view.shows("/push/true_ways")
    room.panel.show(Notice("info", "of no concern here"))


def test_a_defect_in_drawing_does_not_end_the_view(room, rollouts, monkeypatch):
    predicted = Push(RECORD, ACTIONS, "predicted", rollouts=rollouts)
    with monkeypatch.context() as broken:
        broken.setattr(PushNodes, "show", lambda *_: 1 / 0)
        room.show(predicted)
        until(lambda: room.panel.is_idle)
    room.show(None)
    room.show(predicted)
    until(lambda: moving(room.view) == {BOX, GONE})
