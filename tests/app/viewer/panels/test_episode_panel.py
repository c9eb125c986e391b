"""Episodes in the 3D view, told by the test."""

import threading
import time

import numpy as np
import pytest

from app.jobs.job import Job, JobChanged, JobView, State
from app.processes.messages.scene_messages import SceneChanged
from app.services.event_hub import CurrentScene
from app.services.goals.goals import Draft, DraftChanged
from app.viewer.nodes.episode_nodes import PARTS, EpisodeNodes
from app.viewer.nodes.estimate_nodes import TRACKED
from app.viewer.nodes.scene_nodes import SceneNodes
from app.viewer.panels.episode_panel import DRAW_INTERVAL_S, EpisodePanel
from osfcore.control.events import ActionExecuted, Finished, GoalFound, Stepped
from osfcore.geometry.cameras import goal_camera
from osfcore.planning.costs import PoseGoal
from tests.app.conftest import until
from tests.app.storage.test_database import record
from tests.app.viewer.conftest import ViewerDriver
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
        self.gui = ViewerDriver(server)
        self.rooms_made = 0
        self.table = SceneNodes(server, library, lambda *_: None, lambda *_: None)
        self.drawing = EpisodeNodes(server, library)
        self.panel = EpisodePanel(server, (self.table, self.drawing), self.make_room)

    def make_room(self):
        self.rooms_made += 1

    def see(self, what, of=None):
        self.hear(JobView(of or job(), what))

    def hear(self, event):
        self.panel.show(event)
        until(lambda: self.panel.is_idle)

    def estimate(self, name=BOX):
        """Where an object is believed to be; None where nothing is believed."""
        paths = [f"/episode/estimate/{part}/{name}" for part in ("guess", TRACKED)]
        node = next((self.gui.node(path) for path in paths if self.gui.shows(path)), None)
        return None if node is None else node.batched_positions

    def goal(self):
        """Objects whose goal is drawn."""
        return self.gui.below("/episode/goal/where")

    def shows_plan(self):
        return self.gui.shows("/episode/plan/ways")


@pytest.fixture
def room(server, library):
    room = Room(server, library)
    room.panel.start(record("s"))
    until(lambda: room.panel.is_idle)
    yield room
    room.panel.close()
    room.panel.close()


def test_what_an_episode_tells_is_drawn(room):
    room.see(look())
    assert room.estimate() is not None
    room.see(found())
    assert room.goal() == set(NAMES)
    room.see(sketch())
    assert room.shows_plan()
    room.see(stepped(0.2))
    np.testing.assert_allclose(room.estimate(), [[0.2, 0, 0.1]], atol=1e-6)
    room.see(ActionExecuted(3, np.zeros(3)))
    assert room.shows_plan()


def test_no_goal_is_lost_however_much_comes_at_once(room, monkeypatch):
    room.see(look())
    at, go_on = threading.Event(), threading.Event()
    show_look = room.drawing.show_look

    def slowly(seen):
        at.set()
        go_on.wait(10)
        show_look(seen)

    monkeypatch.setattr(room.drawing, "show_look", slowly)
    room.panel.show(JobView(job(), look(x=0.2)))
    assert at.wait(10)
    for seen in (found(), *(look(x=0.01 * n) for n in range(50)), stepped(), sketch(), sketch()):
        room.panel.show(JobView(job(), seen))
    go_on.set()
    until(lambda: room.panel.is_idle)
    assert room.goal() == set(NAMES)
    assert room.shows_plan()


def test_glances_between_two_actions_are_drawn_only_while_something_is_looked_for(room):
    room.see(stepped(0.1))
    room.see(look("next", x=0.3))
    np.testing.assert_allclose(room.estimate(), [[0.1, 0, 0.1]], atol=1e-6)
    room.see(look("next", x=0.3, candidates=poses()[None]))
    np.testing.assert_allclose(room.estimate(), [[0.3, 0, 0.1]], atol=1e-6)


def test_while_a_plan_is_on_view_its_future_is_played(room, monkeypatch):
    played = []
    monkeypatch.setattr(room.drawing, "play", played.append)
    room.see(stepped())
    assert played == []
    room.see(sketch())
    until(lambda: len(played) >= 5)
    assert np.diff(played).min() > 0.5 * DRAW_INTERVAL_S
    room.hear(JobChanged(1, job("done")))
    assert not room.shows_plan()
    count = len(played)
    time.sleep(2.5 * DRAW_INTERVAL_S)
    assert len(played) == count


def test_when_it_is_done_the_goal_stays_and_the_plan_goes(room):
    for seen in (
        found(),
        sketch(),
        stepped(),
        Finished(12, "reached", "The table looks like the goal.", estimated().state),
    ):
        room.see(seen)
    room.gui.press("Clear")
    assert room.goal()  # it still runs
    room.hear(JobChanged(1, job("done")))
    assert room.goal() == set(NAMES)
    assert not room.shows_plan()
    assert room.estimate() is not None
    room.gui.press("Clear")
    until(lambda: room.panel.is_idle)
    until(lambda: room.goal() == set())


@pytest.mark.parametrize("after", ["failed", "interrupted", "cancelled"])
def test_however_it_ends_its_search_is_gone_and_its_goal_stays(room, after):
    room.see(found())
    room.see(look("goal"))
    room.hear(JobChanged(1, job(after)))
    assert room.gui.below("/episode/goal/look/guess") == set()  # candidates of a search that nobody ends
    assert room.goal()


def test_what_hands_or_an_estimate_do_after_the_end_outdates_what_was_believed(room):
    for seen in (found(), stepped()):
        room.see(seen)
    room.hear(SceneChanged(record("s")))
    assert room.estimate() is not None  # the episode's own push
    room.hear(JobChanged(1, job("done")))
    room.hear(SceneChanged(record("s")))
    assert room.estimate() is None
    assert room.goal()
    room.see(stepped(), job(name="b"))
    room.hear(JobChanged(1, job("done", name="b")))
    assert room.estimate() is not None
    room.hear(JobView(Job("c", "estimate", {}), look().step))
    assert room.estimate() is None


def test_a_goal_that_is_being_composed_replaces_that_of_a_former_episode(room):
    draft = DraftChanged(Draft("s", ()))
    room.see(found())
    room.hear(draft)
    assert room.goal()  # of a running one
    room.hear(JobChanged(1, job("done")))
    room.hear(DraftChanged(None))
    assert room.goal()
    room.panel.show(draft)
    until(lambda: room.goal() == set())


def test_the_green_cube_is_the_estimate_while_one_is_on_view(room):
    assert room.gui.shows("/light")
    room.see(stepped())
    assert not room.gui.shows("/light")
    room.gui.set("Show true light", True)
    until(lambda: room.gui.shows("/light"))
    assert room.gui.node("/light_name").text == "true light"
    room.gui.set("Show true light", False)
    room.gui.set("Show estimate", False)
    until(lambda: room.gui.shows("/light"))
    assert not room.gui.shows("/light_name")
    room.gui.set("Show goal", False)
    room.gui.set("Show plan", False)
    assert not any(room.gui.shows(f"/episode/{part}") for part in PARTS)


def test_another_scene_clears_the_view_and_coming_back_shows_a_running_episode_again(room):
    for seen in (found(), stepped(), sketch()):
        room.see(seen)
    assert room.rooms_made == 1
    room.hear(CurrentScene(record("other")))
    until(lambda: room.goal() == set())
    assert room.gui.shows("/light")
    room.panel.show(JobView(job(), found(0.5)))  # goes on unseen
    room.hear(CurrentScene(record("s")))
    until(room.goal)
    np.testing.assert_allclose(room.gui.node(f"/episode/goal/where/{BOX}").position, [0.5, 0, 0.1], atol=1e-6)
    assert room.shows_plan()
    room.hear(JobChanged(1, job("done")))
    room.hear(CurrentScene(None))
    room.hear(CurrentScene(record("s")))
    until(lambda: room.goal() == set())


def test_one_that_waits_does_not_take_the_view_and_the_next_one_begins_anew(room):
    room.see(found())
    room.hear(JobChanged(1, job("queued", name="b")))
    assert room.goal()  # of the one that runs
    room.hear(JobChanged(2, job("done")))
    room.hear(JobChanged(3, job("queued", name="b")))
    until(lambda: room.goal() == set())
    assert room.rooms_made == 2


def test_jobs_of_other_kinds_are_ignored(room):
    room.panel.show(JobView(Job("c", "collect", {}), found()))
    room.panel.show(JobChanged(1, Job("c", "collect", {}, "running")))
    until(lambda: room.panel.is_idle)
    assert room.goal() == set()


def test_a_defect_in_drawing_does_not_end_the_view(room, monkeypatch):
    with monkeypatch.context() as broken:
        broken.setattr(room.drawing, "show_goal", lambda _: 1 / 0)
        room.hear(JobView(job(), found()))
    room.see(stepped())
    assert room.goal()
