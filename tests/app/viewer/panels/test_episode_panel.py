"""The folder in the panel, with episodes that are told by the test."""

import contextlib
import io
import threading
import time
from types import SimpleNamespace

import numpy as np
import pytest
import viser

from app.jobs.job import Job, JobChanged, JobSeen, State
from app.processes.messages import CurrentScene, SceneChanged
from app.services.goals import Draft, DraftChanged
from app.viewer.nodes.episode_nodes import EpisodeDrawing
from app.viewer.nodes.scene_nodes import SceneDrawing
from app.viewer.panels.episode_panel import DRAW_INTERVAL_S, EpisodeView
from app.viewer.viewer import LoopbackViser
from osfcore.control.events import Acted, Finished, GoalFound, Noticed, Stepped
from osfcore.geometry.cameras import goal_camera
from osfcore.planning.pose_cost import PoseGoal
from tests.app.conftest import until
from tests.app.storage.test_database import record
from tests.app.viewer.nodes.test_episode_nodes import BOX, NAMES, estimated, look, poses, sketch


def job(state: State = "running", scene="s", name="a", **changes):
    params = {"scene": scene, "names": list(NAMES), "goal": {"id": "g", "poses": None}, "seed": 0, "settings": {}}
    return Job(name, "episode", params, state, **{"done": 3, "total": 12, "note": "Pushing", **changes})


def found(x=0.3):
    return GoalFound(PoseGoal(NAMES, poses(x)), np.zeros((16, 16, 3)), goal_camera(16), None)


def stepped(x=0.1, doubt=""):
    offsets = np.array([0.034, 0.01]), np.array([0.2, 0.0])
    return Stepped(3, 12, estimated(x, doubt), *offsets, 0.002, np.zeros((4, 4, 3)), {})


class Room:
    """A view whose service is made of air."""

    def __init__(self, server, library):
        self.server = server
        self.ordered, self.rooms_made = [], 0
        self.table = SceneDrawing(server, library, lambda *_: None, lambda *_: None)
        self.drawing = EpisodeDrawing(server, library)
        self.view = EpisodeView(server, (self.table, self.drawing), self, self.obey, self.make_room)

    def obey(self, command, client):
        command()

    def make_room(self):
        self.rooms_made += 1

    def pause(self, job):
        self.ordered.append(("pause", job))

    def resume(self, job):
        self.ordered.append(("resume", job))

    def step(self, job):
        self.ordered.append(("step", job))

    def cancel(self, job):
        self.ordered.append(("cancel", job))

    def see(self, what, of=None):
        self.view.note(JobSeen(of or job(), what))
        self.drawn()

    def hear(self, event):
        self.view.note(event)
        self.drawn()

    def drawn(self):
        """Wait until the thread has drawn what it was told, if it is of this scene."""
        until(lambda: self.view._thread.is_idle)
        seen = self.view._told
        until(lambda: self.view._drawn is seen or not self.view._is_here(seen))

    def press(self, label):
        handles = self.server.gui._gui_input_handle_from_uuid.values()
        (button,) = (h for h in handles if isinstance(h, viser.GuiButtonHandle) and h.label == label)
        (callback,) = button._impl.update_cb
        callback(SimpleNamespace(client=None, target=button))  # pyright: ignore[reportArgumentType]

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
    room.view.start("s")
    yield room
    room.view.stop()
    room.view.stop()
    server.gui.reset()
    server.scene.reset()


def test_what_an_episode_tells_is_drawn_and_the_panel_tells_how_far_it_is(room):
    room.see(look())
    assert not room.drawing._now.is_empty
    room.see(found())
    assert set(room.drawing._goal) == set(NAMES)
    room.see(sketch())
    assert room.drawing._ways.visible
    room.see(stepped(0.2))
    np.testing.assert_allclose(room.drawing._now._guesses[BOX].batched_positions, [[0.2, 0, 0.1]], atol=1e-6)
    room.see(Acted(3, np.zeros(3)))
    room.says("Pushing · at most 34 mm and 11° to go")
    assert room.view._bar.visible
    assert room.view._bar.value == 25
    assert room.drawing._ways.visible
    room.see(Noticed(3, "lamp", "The <lamp> was moved."))
    assert room.view._notice.visible
    assert "Step 3: The &lt;lamp&gt; was moved." in room.view._notice.content


def test_no_goal_is_lost_however_much_comes_at_once(room, monkeypatch):
    room.see(look())
    at, go_on = threading.Event(), threading.Event()
    show_look = room.drawing.show_look

    def slowly(seen):
        at.set()
        go_on.wait(10)
        show_look(seen)

    monkeypatch.setattr(room.drawing, "show_look", slowly)
    room.view.note(JobSeen(job(), look(x=0.2)))
    assert at.wait(10)
    for seen in (found(), *(look(x=0.01 * n) for n in range(50)), stepped(), sketch(), sketch()):
        room.view.note(JobSeen(job(), seen))
    go_on.set()
    room.drawn()
    assert set(room.drawing._goal) == set(NAMES)
    assert room.drawing._ways.visible


def test_glances_between_two_actions_are_drawn_only_while_something_is_looked_for(room):
    room.see(stepped(0.1))
    room.see(look("next", x=0.3))
    np.testing.assert_allclose(room.drawing._now._guesses[BOX].batched_positions, [[0.1, 0, 0.1]], atol=1e-6)
    room.see(look("next", x=0.3, candidates=poses()[None]))
    np.testing.assert_allclose(room.drawing._now._guesses[BOX].batched_positions, [[0.3, 0, 0.1]], atol=1e-6)


def test_while_a_plan_is_on_view_its_future_is_played(room, monkeypatch):
    played = []
    monkeypatch.setattr(room.drawing, "play", played.append)
    room.see(stepped())
    assert played == []
    room.see(sketch())
    until(lambda: len(played) >= 5)
    assert np.diff(played).min() > 0.5 * DRAW_INTERVAL_S
    room.hear(JobChanged(1, job("done")))
    until(lambda: room.view._drawn.plan is None)
    count = len(played)
    time.sleep(2.5 * DRAW_INTERVAL_S)
    assert len(played) == count


def test_buttons_tell_the_job(room):
    view = room.view
    assert view._pause_button.disabled
    room.press("Pause")
    room.press("Step")
    room.press("Cancel")
    assert room.ordered == []  # there is nobody to tell
    room.see(stepped())
    assert (view._pause_button.disabled, view._step_button.disabled, view._cancel_button.disabled) == (
        False,
        True,
        False,
    )
    room.press("Pause")
    room.hear(JobChanged(1, job("paused")))
    room.says("Paused: Pushing")
    assert not view._step_button.disabled
    room.press("Step")
    room.press("Resume")
    room.press("Cancel")
    assert room.ordered == [("pause", "a"), ("step", "a"), ("resume", "a"), ("cancel", "a")]


def test_when_it_is_done_the_goal_stays_and_the_plan_goes(room):
    for seen in (
        found(),
        sketch(),
        stepped(),
        Finished(12, "reached", "The table looks like the goal.", estimated().state),
    ):
        room.see(seen)
    room.press("Clear")
    assert room.drawing._goal  # it still runs
    room.hear(JobChanged(1, job("done")))
    room.says("The table looks like the goal.")
    assert set(room.drawing._goal) == set(NAMES)
    assert not room.drawing._ways.visible
    assert not room.drawing._now.is_empty
    assert not room.view._bar.visible
    assert room.view._cancel_button.disabled
    room.press("Clear")
    room.drawn()
    until(lambda: room.drawing._goal == {})
    room.says("No episode yet")


@pytest.mark.parametrize(
    ("after", "words"),
    [
        (job("failed", error="The job's process ended unexpectedly."), "The job&#x27;s process ended unexpectedly."),
        (job("interrupted", note="The service stopped."), "The service stopped."),
        (job("cancelled", note="Cancelled"), "Cancelled"),
    ],
)
def test_how_else_it_may_end_is_told(room, after, words):
    room.see(found())
    room.see(look("goal"))
    room.hear(JobChanged(1, after))
    room.says(words)
    assert room.drawing._goal_look.is_empty  # candidates of a search that nobody ends
    assert room.drawing._goal


def test_what_hands_or_an_estimate_do_after_the_end_outdates_what_was_believed(room):
    for seen in (found(), stepped()):
        room.see(seen)
    room.hear(SceneChanged(record("s")))
    assert not room.drawing._now.is_empty  # the episode's own push
    room.hear(JobChanged(1, job("done")))
    room.hear(SceneChanged(record("s")))
    assert room.drawing._now.is_empty
    assert room.drawing._goal
    room.see(stepped(), job(name="b"))
    room.hear(JobChanged(1, job("done", name="b")))
    assert not room.drawing._now.is_empty
    room.hear(JobSeen(Job("c", "estimate", {}), look().step))
    assert room.drawing._now.is_empty


def test_a_goal_that_is_being_composed_replaces_that_of_a_former_episode(room):
    draft = DraftChanged(Draft("s", ()))
    room.see(found())
    room.hear(draft)
    assert room.drawing._goal  # of a running one
    room.hear(JobChanged(1, job("done")))
    room.hear(DraftChanged(None))
    assert room.drawing._goal
    room.view.note(draft)
    until(lambda: room.drawing._goal == {})


def test_the_green_cube_is_the_estimate_while_one_is_on_view(room):
    assert room.table._cube.visible
    room.see(stepped())
    assert not room.table._cube.visible
    room.view._wants_truth.value = True
    until(lambda: room.table._cube.visible)
    assert room.table._lamp_name.text == "true light"
    room.view._wants_truth.value = False
    handles = room.server.gui._gui_input_handle_from_uuid.values()
    shown = {box.label: box for box in handles if isinstance(box, viser.GuiCheckboxHandle)}
    shown["Show estimate"].value = False
    until(lambda: room.table._cube.visible)
    assert not room.table._lamp_name.visible
    shown["Show goal"].value = shown["Show plan"].value = False
    assert not any(root.visible for root in room.drawing._roots.values())


def test_another_scene_clears_the_view_and_coming_back_shows_a_running_episode_again(room):
    for seen in (found(), stepped(), sketch()):
        room.see(seen)
    assert room.rooms_made == 1
    room.hear(CurrentScene(record("other")))
    until(lambda: room.drawing._goal == {})
    assert room.table._cube.visible
    room.view.note(JobSeen(job(), found(0.5)))  # goes on unseen
    room.hear(CurrentScene(record("s")))
    until(lambda: room.drawing._goal)
    np.testing.assert_allclose(room.drawing._goal[BOX].position, [0.5, 0, 0.1], atol=1e-6)
    assert room.drawing._ways.visible
    room.hear(JobChanged(1, job("done")))
    room.hear(CurrentScene(None))
    room.hear(CurrentScene(record("s")))
    until(lambda: room.drawing._goal == {})


def test_one_that_waits_does_not_take_the_view_and_the_next_one_begins_anew(room):
    room.see(found())
    room.hear(JobChanged(1, job("queued", name="b")))
    assert room.view._told.job.id == "a"
    room.hear(JobChanged(2, job("done")))
    room.hear(JobChanged(3, job("queued", name="b")))
    room.says("Waiting for other jobs")
    until(lambda: room.drawing._goal == {})
    assert room.rooms_made == 2


def test_jobs_of_other_kinds_are_ignored(room):
    room.view.note(JobSeen(Job("c", "collect", {}), found()))
    room.view.note(JobChanged(1, Job("c", "collect", {}, "running")))
    assert room.view._told.job is None


def test_a_defect_in_drawing_does_not_end_the_view(room, monkeypatch):
    show = room.drawing.show_goal
    monkeypatch.setattr(room.drawing, "show_goal", lambda _: 1 / 0)
    room.view.note(JobSeen(job(), found()))
    until(lambda: room.view._thread.is_idle)
    monkeypatch.setattr(room.drawing, "show_goal", show)
    room.see(stepped())
    assert room.drawing._goal
