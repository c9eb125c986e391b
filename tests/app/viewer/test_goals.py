"""Composing a goal by hand, with drafts that are kept by the test."""

import threading
from concurrent.futures import ThreadPoolExecutor
from types import SimpleNamespace

import numpy as np
import pytest

from app.services.event_hub import CurrentScene
from app.services.goals import Draft, DraftChanged, NoDraft
from app.viewer.goal_panel import WRONG, GoalPanel
from app.viewer.nodes.episode_nodes import GOAL
from osfcore.errors import OsfError
from osfcore.geometry.poses import Pose, quaternion_exp, quaternion_multiply, rotation_angle
from tests.app.conftest import until
from tests.app.storage.test_database import record
from tests.app.viewer.conftest import ViewerDriver

BOX, CAN = "003_cracker_box", "005_tomato_soup_can"
LYING = np.array([0.5**0.5, 0.5**0.5, 0, 0])
SOMEBODY = SimpleNamespace()


def quarter():
    return quaternion_exp(np.array([0, 0, np.pi / 2]))


class Room:
    """A view whose goals are made of air, and which refuses what lies beyond x = 0.5 m; simulating may take long."""

    def __init__(self, server, library):
        self.gui = ViewerDriver(server, SOMEBODY)
        self.draft, self.moved, self.refused = None, [], []
        self.answers = threading.Event()
        self.answers.set()
        self.commands = ThreadPoolExecutor(1)
        self.panel = GoalPanel(server, library, self, self.commands, self.run)

    def run(self, command, client):
        try:
            command()
        except OsfError as error:
            self.refused.append((str(error), client))

    def begin_draft(self):
        self.set(
            Draft("s", ((BOX, Pose(np.array([0.1, 0, 0.1]), LYING)), (CAN, Pose(np.array([0.2, 0.2, 0.05]), LYING))))
        )

    def move_draft(self, poses):
        self.answers.wait(10)
        self.moved.append(dict(poses))
        if self.draft is None:
            raise NoDraft
        ((_, pose),) = poses
        if pose.position[0] > 0.5:
            raise OsfError("It would lie beside the table.")
        laid = {**dict(self.draft.poses), **dict(poses)}
        problem = f"{BOX} and {CAN} would overlap." if pose.position[0] > 0.4 else ""
        self.set(Draft("s", tuple(laid.items()), problem, self.draft.revision + 1))

    def drop_draft(self):
        self.set(None)

    def set(self, draft):
        self.draft = draft
        self.panel.show(DraftChanged(draft))

    def drag(self, name, x, y, *phases):
        """Take hold of a copy near its top, seen from above, and lead it over the table."""
        grip = self.at(name).position + [0.01, 0.0, 0.04]
        to = np.array([x + 0.01, y, grip[2]])
        self.gui.drag_body(f"/goal/objects/{name}/shape", to + [0.0, 0.0, 1.0], grip, to, *phases)

    def turn(self, name, turn, position=None):
        self.gui.drag(f"/goal/objects/{name}", position, turn, "start", "end")

    def copies(self):
        return self.gui.below("/goal/objects")

    def at(self, name):
        """Where a copy is shown."""
        handles = self.gui.node(f"/goal/objects/{name}")
        turn = quaternion_multiply(np.array(handles.wxyz), np.array(self.gui.node(f"{handles.name}/shape").wxyz))
        return Pose(np.array(handles.position), turn)

    def colours(self):
        return {tuple(self.gui.node(f"/goal/objects/{name}/shape").color) for name in self.copies()}


@pytest.fixture
def room(server, library):
    room = Room(server, library)
    room.panel.start(record("s"))
    yield room
    room.answers.set()
    room.commands.shutdown()
    room.panel.close()
    room.panel.close()


@pytest.fixture
def composing(room):
    room.begin_draft()
    until(lambda: room.panel.is_idle)
    assert room.copies() == {BOX, CAN}
    return room


def same(a, b):
    return np.allclose(a.position, b.position, atol=1e-6) and rotation_angle(a.quaternion, b.quaternion) < 1e-6


def test_a_draft_is_shown_as_golden_copies_to_drag_with_rings_to_turn(composing):
    assert all(same(composing.at(name), pose) for name, pose in composing.draft.poses)
    assert composing.colours() == {GOAL}
    for name in (BOX, CAN):
        ring = composing.gui.node(f"/goal/objects/{name}")
        assert tuple(ring.active_axes) == (True, True, False)
        assert ring.disable_axes
        assert ring.disable_sliders
        assert composing.gui.is_draggable(f"/goal/objects/{name}/shape")
    assert composing.panel.is_composing


def test_letting_go_moves_the_draft(composing):
    composing.drag(BOX, 0.3, -0.1)
    until(lambda: composing.moved)
    pose = composing.moved[0][BOX]
    np.testing.assert_allclose(pose.position, [0.3, -0.1, 0.1], atol=1e-9)
    assert rotation_angle(pose.quaternion, LYING) < 1e-6
    until(lambda: same(composing.at(BOX), pose))
    composing.turn(BOX, quarter())
    until(lambda: len(composing.moved) == 2)
    assert rotation_angle(composing.moved[1][BOX].quaternion, quaternion_multiply(quarter(), LYING)) < 1e-6
    ring = composing.gui.node(f"/goal/objects/{BOX}")
    until(lambda: np.allclose(ring.wxyz, [1, 0, 0, 0]))  # it lies along the table's axes
    composing.turn(BOX, quarter())
    until(lambda: len(composing.moved) == 3)
    turned = quaternion_exp(np.array([0, 0, np.pi]))
    assert rotation_angle(composing.moved[2][BOX].quaternion, quaternion_multiply(turned, LYING)) < 1e-6


def test_a_copy_stays_on_the_table(composing):
    before = composing.at(BOX)
    composing.drag(BOX, 5.0, 0.0)
    until(lambda: composing.moved)
    assert same(composing.moved[0][BOX], before)


@pytest.mark.parametrize("turn", [quaternion_exp(np.array([1.0, 0, 0])), np.zeros(4), np.full(4, np.nan)])
def test_whatever_a_browser_sends_height_and_tilt_stay(composing, turn):
    composing.turn(BOX, turn, (0.3, 0.0, 7.0))
    until(lambda: composing.moved)
    pose = composing.moved[0][BOX]
    np.testing.assert_allclose(pose.position, [0.3, 0.0, 0.1], atol=1e-12)
    assert rotation_angle(pose.quaternion, LYING) < 1e-6
    until(lambda: same(composing.at(BOX), pose))
    composing.turn(BOX, None, (np.inf, 0.0, 0.1))
    until(lambda: len(composing.moved) == 2)
    assert same(composing.moved[1][BOX], composing.moved[0][BOX])


def test_what_is_held_by_somebody_who_may_hold_it_no_longer_goes_back(composing):
    before = composing.at(BOX)
    composing.drag(BOX, 0.3, 0.3, "start", "update")
    assert not same(composing.at(BOX), before)
    composing.panel.put_handles_back()
    until(lambda: same(composing.at(BOX), before))


def test_a_problem_is_told_in_red_until_it_is_gone(composing):
    composing.drag(BOX, 0.45, 0.0)
    until(lambda: composing.colours() == {WRONG})
    assert composing.gui.shows("/goal/problem")
    assert composing.gui.node("/goal/problem").text == "Cracker box and Tomato soup can would overlap."
    composing.drag(BOX, 0.2, 0.0)
    until(lambda: composing.colours() == {GOAL})
    until(lambda: not composing.gui.shows("/goal/problem"))


def test_what_is_refused_goes_back_and_whoever_did_it_is_told(composing):
    before = composing.at(CAN)
    composing.drag(CAN, 0.55, 0.0)
    until(lambda: composing.refused == [("It would lie beside the table.", SOMEBODY)])
    until(lambda: same(composing.at(CAN), before))


def test_what_a_hand_holds_follows_the_hand_until_its_move_is_answered(composing):
    composing.drag(BOX, 0.3, 0.3, "start", "update")
    composing.drag(CAN, 0.0, -0.2)
    until(lambda: len(composing.moved) == 1)
    until(lambda: composing.panel.is_idle)
    np.testing.assert_allclose(composing.at(BOX).position, [0.3, 0.3, 0.1], atol=1e-9)  # not where the draft has it
    composing.answers.clear()
    composing.drag(BOX, 0.3, 0.2, "end")
    composing.drag(BOX, 0.3, 0.1, "start", "update")  # grabbed again, before the first move is answered
    composing.answers.set()
    until(lambda: composing.draft.revision == 2)
    until(lambda: composing.panel.is_idle)
    np.testing.assert_allclose(composing.at(BOX).position, [0.3, 0.1, 0.1], atol=1e-9)
    composing.drag(BOX, 0.3, 0.0, "end")
    until(lambda: composing.draft.revision == 3)
    elsewhere = Pose(np.array([0.0, 0.1, 0.1]), LYING)
    composing.set(Draft("s", ((BOX, elsewhere), (CAN, dict(composing.draft.poses)[CAN])), "", 4))
    until(lambda: same(composing.at(BOX), elsewhere))  # nobody holds it any more


def test_composing_ends_and_everything_goes(composing):
    composing.drop_draft()
    until(lambda: composing.copies() == set())
    assert not composing.panel.is_composing


def test_a_draft_is_shown_on_its_own_table_only(composing):
    composing.panel.show(CurrentScene(record("other")))
    until(lambda: composing.copies() == set())
    assert not composing.panel.is_composing
    composing.panel.show(CurrentScene(record("s")))
    until(lambda: composing.copies() == {BOX, CAN})


def test_a_defect_in_drawing_does_not_end_the_view(composing, monkeypatch):
    with monkeypatch.context() as broken:
        broken.setattr(composing.gui.server, "atomic", lambda: 1 / 0)
        composing.drag(BOX, 0.3, 0.0)
        until(lambda: composing.draft.revision == 1)
        until(lambda: composing.panel.is_idle)
    composing.drop_draft()
    until(lambda: composing.copies() == set())
