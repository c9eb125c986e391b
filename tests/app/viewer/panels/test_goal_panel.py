"""Composing a goal by hand, with drafts that are kept by the test."""

import asyncio
import contextlib
import io
import threading
from concurrent.futures import ThreadPoolExecutor
from types import SimpleNamespace

import numpy as np
import pytest
import viser
from PIL import Image

from app.processes.messages import CurrentScene
from app.services.goals import Draft, DraftChanged, NoDraft
from app.viewer.nodes.episode_nodes import GOAL
from app.viewer.panels.goal_panel import NAME, WRONG, GoalView
from app.viewer.viewer import LoopbackViser
from osfcore.errors import OsfError
from osfcore.geometry.poses import Pose, quaternion_exp, quaternion_multiply, rotation_angle
from tests.app.conftest import until
from tests.app.storage.test_database import record

BOX, CAN = "003_cracker_box", "005_tomato_soup_can"
LYING = np.array([0.5**0.5, 0.5**0.5, 0, 0])
SOMEBODY = object()


def png(grey):
    data = io.BytesIO()
    Image.new("RGB", (8, 8), (grey, grey, grey)).save(data, "PNG")
    return data.getvalue()


def quarter():
    return quaternion_exp(np.array([0, 0, np.pi / 2]))


class Room:
    """A view whose goals are made of air, and which refuses what lies beyond x = 1 m; the simulation may take long."""

    def __init__(self, server, library):
        self.server = server
        self.draft, self.kept, self.moved, self.refused = None, [], [], []
        self.answers = threading.Event()
        self.answers.set()
        self.commands = ThreadPoolExecutor(1)
        self.view = GoalView(server, library, self, self.commands, self.obey)

    def obey(self, command, client):
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
        if pose.position[0] > 1:
            raise OsfError("It would lie beside the table.")
        laid = {**dict(self.draft.poses), **dict(poses)}
        problem = "The box and the can would overlap." if pose.position[0] > 0.5 else ""
        self.set(Draft("s", tuple(laid.items()), problem, self.draft.revision + 1))

    def drop_draft(self):
        self.set(None)

    def keep_draft(self, name):
        self.kept.append(name)
        self.drop_draft()

    def draft_image(self):
        if self.draft is None:
            raise NoDraft
        return png(10 * self.draft.revision)

    def set(self, draft):
        self.draft = draft
        self.view.note(DraftChanged(draft))

    def press(self, label):
        handles = self.server.gui._gui_input_handle_from_uuid.values()
        (button,) = (h for h in handles if isinstance(h, viser.GuiButtonHandle) and h.label == label)
        (callback,) = button._impl.update_cb
        callback(SimpleNamespace(client=SOMEBODY, target=button))  # pyright: ignore[reportArgumentType]

    def drag(self, name, position=None, turn=None, *, phase="end", begins=True):
        """As a browser does, which may send anything."""
        gizmo = self.view._copies[name]._gizmo
        gizmo._impl.position = np.array(gizmo.position if position is None else position, float)
        gizmo._impl.wxyz = np.array(gizmo.wxyz if turn is None else turn, float)
        (callback,) = gizmo._impl_aux.update_cb
        for each in ("start", phase) if begins else (phase,):
            event = SimpleNamespace(client=SOMEBODY, target=gizmo, phase=each)
            asyncio.run(callback(event))  # pyright: ignore[reportArgumentType]

    def at(self, name):
        """Where a copy is shown."""
        copy = self.view._copies[name]
        turn = quaternion_multiply(np.array(copy._gizmo.wxyz), np.array(copy._shape.wxyz))
        return Pose(np.array(copy._gizmo.position), turn)

    def colours(self):
        return {tuple(copy._shape.color) for copy in self.view._copies.values()}


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
    room.answers.set()
    room.commands.shutdown()
    room.view.stop()
    room.view.stop()
    server.gui.reset()
    server.scene.reset()


@pytest.fixture
def composing(room):
    room.press("Compose a goal")
    until(lambda: set(room.view._copies) == {BOX, CAN})
    until(lambda: room.view._image.visible)
    return room


def same(a, b):
    return np.allclose(a.position, b.position, atol=1e-6) and rotation_angle(a.quaternion, b.quaternion) < 1e-6


def test_a_draft_is_shown_as_golden_copies_with_handles_for_the_table_plane(composing):
    assert all(same(composing.at(name), pose) for name, pose in composing.draft.poses)
    assert composing.colours() == {GOAL}
    for copy in composing.view._copies.values():
        assert tuple(copy._gizmo.active_axes) == (True, True, False)
        assert copy._shape.name.startswith(f"{copy._gizmo.name}/")
    assert composing.view._begin_button.disabled
    assert not composing.view._keep_button.disabled
    assert composing.view.is_composing


def test_letting_go_moves_the_draft_and_the_picture_follows(composing):
    composing.drag(BOX, (0.3, -0.1, 0.1), quarter())
    until(lambda: composing.moved)
    pose = composing.moved[0][BOX]
    np.testing.assert_allclose(pose.position, [0.3, -0.1, 0.1])
    assert rotation_angle(pose.quaternion, quaternion_multiply(quarter(), LYING)) < 1e-6
    until(lambda: composing.view._image.image[0, 0, 0] == 10)
    until(lambda: same(composing.at(BOX), pose))
    assert np.allclose(composing.view._copies[BOX]._gizmo.wxyz, [1, 0, 0, 0])  # handles lie along the table's axes
    composing.drag(BOX, turn=quarter())
    until(lambda: len(composing.moved) == 2)
    turned = quaternion_exp(np.array([0, 0, np.pi]))
    assert rotation_angle(composing.moved[1][BOX].quaternion, quaternion_multiply(turned, LYING)) < 1e-6


@pytest.mark.parametrize("turn", [quaternion_exp(np.array([1.0, 0, 0])), np.zeros(4), np.full(4, np.nan)])
def test_whatever_a_browser_sends_height_and_tilt_stay(composing, turn):
    composing.drag(BOX, (0.3, 0.0, 7.0), turn)
    until(lambda: composing.moved)
    pose = composing.moved[0][BOX]
    np.testing.assert_allclose(pose.position, [0.3, 0.0, 0.1])
    assert rotation_angle(pose.quaternion, LYING) < 1e-6
    until(lambda: same(composing.at(BOX), pose))
    composing.drag(BOX, (np.inf, 0.0, 0.1))
    until(lambda: len(composing.moved) == 2)
    assert same(composing.moved[1][BOX], composing.moved[0][BOX])


def test_a_problem_is_told_in_red_until_it_is_gone(composing):
    composing.drag(BOX, (0.6, 0.0, 0.1))
    until(lambda: composing.colours() == {WRONG})
    assert composing.view._words.visible
    assert composing.view._words.text == "The box and the can would overlap."
    until(lambda: "would overlap" in composing.view._status.content)
    composing.drag(BOX, (0.2, 0.0, 0.1))
    until(lambda: composing.colours() == {GOAL})
    until(lambda: not composing.view._words.visible)


def test_what_is_refused_goes_back_and_whoever_did_it_is_told(composing):
    before = composing.at(CAN)
    composing.drag(CAN, (1.5, 0.0, 0.05))
    until(lambda: composing.refused == [("It would lie beside the table.", SOMEBODY)])
    until(lambda: same(composing.at(CAN), before))


def test_what_a_hand_holds_follows_the_hand_until_its_move_is_answered(composing):
    composing.drag(BOX, (0.3, 0.3, 0.1), phase="update")
    composing.drag(CAN, (0.0, -0.2, 0.05))
    until(lambda: len(composing.moved) == 1)
    until(lambda: composing.view._image.image[0, 0, 0] == 10)
    np.testing.assert_allclose(composing.at(BOX).position, [0.3, 0.3, 0.1])  # not where the draft has it
    composing.answers.clear()
    composing.drag(BOX, (0.3, 0.2, 0.1), begins=False)
    composing.drag(BOX, (0.3, 0.1, 0.1), phase="update")  # grabbed again, before the first move is answered
    composing.answers.set()
    until(lambda: composing.view._image.image[0, 0, 0] == 20)
    np.testing.assert_allclose(composing.at(BOX).position, [0.3, 0.1, 0.1])
    composing.drag(BOX, (0.3, 0.0, 0.1), begins=False)
    until(lambda: composing.draft.revision == 3)
    until(lambda: not composing.view._copies[BOX]._is_held)


@pytest.mark.parametrize(("label", "kept"), [("Save as goal image", [NAME]), ("Stop composing", [])])
def test_composing_ends_and_everything_goes(composing, label, kept):
    gizmo = composing.view._copies[BOX]._gizmo
    composing.press(label)
    until(lambda: composing.view._copies == {})
    until(lambda: not composing.view._image.visible)
    assert gizmo._impl.removed
    assert composing.kept == kept
    assert not composing.view.is_composing
    assert composing.view._drop_button.disabled
    assert not composing.view._begin_button.disabled


def test_a_draft_is_shown_on_its_own_table_only(composing):
    composing.view.note(CurrentScene(record("other")))
    until(lambda: composing.view._copies == {})
    assert not composing.view.is_composing
    composing.view.note(CurrentScene(record("s")))
    until(lambda: set(composing.view._copies) == {BOX, CAN})


def test_a_draft_that_has_ended_while_it_is_drawn_has_no_picture(room):
    room.view.note(DraftChanged(Draft("s", ((BOX, Pose.identity()),))))  # the room has no draft
    until(lambda: set(room.view._copies) == {BOX})
    assert not room.view._image.visible


def test_a_defect_in_drawing_does_not_end_the_view(composing, monkeypatch):
    monkeypatch.setattr(composing, "draft_image", lambda: 1 / 0)
    composing.drag(BOX, (0.3, 0.0, 0.1))
    until(lambda: composing.draft.revision == 1)
    composing.press("Stop composing")
    until(lambda: composing.view._copies == {})
