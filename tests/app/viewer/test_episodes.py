"""Episodes in the 3D view: goal, estimate, plan and future, and when they are drawn."""

import threading
import time
from dataclasses import replace

import numpy as np
import pytest

from app.jobs.job import Job, JobChanged, JobView, State
from app.processes.messages.scene_messages import SceneChanged
from app.services.event_hub import CurrentScene
from app.services.goals import Draft, DraftChanged
from app.viewer.job_panels import EPISODE_INTERVAL_S, EpisodePanel
from app.viewer.nodes.episode_nodes import GOAL, PLAY_S, REST_S, EpisodeNodes, cost_colours
from app.viewer.nodes.estimate_nodes import TRACKED
from app.viewer.nodes.ghosts import FutureNodes, FutureStyle, along_way
from app.viewer.nodes.room import AT
from osfcore.control.events import ActionExecuted, Finished, GoalFound, Look, Looking, Stepped
from osfcore.estimation.steps import EstimateStep
from osfcore.geometry.cameras import goal_camera
from osfcore.geometry.light import Light
from osfcore.geometry.poses import Pose, quaternion_exp
from osfcore.geometry.rollouts import Rollouts
from osfcore.geometry.states import EstimatedState, SceneState
from osfcore.planning.costs import PoseGoal
from osfcore.planning.mppi import PlanSketch
from osfcore.progress import Progress
from tests.app.conftest import until
from tests.app.storage.test_database import record
from tests.app.viewer.conftest import ViewerDriver

BOX, CAN = "003_cracker_box", "005_tomato_soup_can"
NAMES = (BOX, CAN)
LIGHT = Light(np.array([0.6, 0, 0.8]))
TURNS = np.tile([1.0, 0, 0, 0], (2, 1))


@pytest.fixture
def drawing(server, library):
    return EpisodeNodes(server, library)


def poses(x=0.1):
    return Pose(np.array([[x, 0, 0.1], [0.2, 0.2, 0.05]]), TURNS)


def goal_at(x=0.1):
    return {name: poses(x)[n] for n, name in enumerate(NAMES)}


def state(x=0.1):
    return SceneState(NAMES, poses(x), LIGHT, None)


def estimated(x=0.1, doubt=""):
    return EstimatedState(state(x), np.full(2, 0.001), np.full(2, 0.01), 0.01, (doubt, ""), doubt)


def look(kind: Look = "first", x=0.1, candidates=None):
    step = EstimateStep(Progress(1, 2, ""), "objects", state(x), candidates)
    return Looking(0, kind, step)


def sketch(ways=5, moments=11, goes_m=0.1):
    """The box is pushed along +x by the cheapest way; the can stays."""
    positions = np.tile(poses(0.0).position, (1, moments, 1, 1))
    positions[0, :, 0, 0] = np.linspace(0, goes_m, moments)
    pusher = np.linspace([-0.2, 0, 0.06], [0.0, 0, 0.06], moments)[None]
    best = Rollouts(NAMES, positions, np.tile(TURNS, (1, moments, 1, 1)), pusher)
    rng = np.random.default_rng(0)
    return PlanSketch(3, rng.uniform(-0.3, 0.3, (ways, moments, 2)), np.arange(ways) * 0.1 + 1, best)


def is_green(colour):
    return colour[1] > 2 * max(colour[0], colour[2])


def is_red(colour):
    return colour[0] > 2 * max(colour[1], colour[2])


def guess(driver, name=BOX, of="estimate"):
    return driver.node(f"/episode/{of}/guess/{name}")


def shows_plan(driver):
    future = driver.below("/episode/plan/future")
    return any(driver.shows(f"/episode/plan/{name}") for name in ("ways", "best", *(f"future/{n}" for n in future)))


def goals(driver):
    where = "/episode/goal/where"
    return {name: driver.node(f"{where}/{name}") for name in driver.below(where)}


def test_the_goal_is_drawn_in_one_colour_and_stays_the_same_nodes(drawing, driver):
    drawing.show_goal(goal_at())
    before = goals(driver)
    assert set(before) == set(NAMES)
    np.testing.assert_allclose(before[BOX].position, [0.1, 0, 0.1], atol=1e-6)
    assert {tuple(node.color) for node in before.values()} == {GOAL}
    drawing.show_goal(dict(reversed(goal_at().items())))
    assert goals(driver) == before
    drawing.show_goal(goal_at(0.3))
    assert goals(driver) == before
    np.testing.assert_allclose(before[BOX].position, [0.3, 0, 0.1], atol=1e-6)
    drawing.show_goal({BOX: goal_at()[BOX]})
    assert set(goals(driver)) == {BOX}
    assert goals(driver)[BOX] is not before[BOX]


def test_a_look_at_the_goal_image_is_drawn_beside_the_table_until_the_goal_is_known(drawing, driver):
    drawing.show_look(state())
    drawing.show_look(state(0.4), of_goal=True)
    now, goal = guess(driver), guess(driver, of="goal/look")
    np.testing.assert_allclose(now.batched_positions, [[0.1, 0, 0.1]], atol=1e-6)
    np.testing.assert_allclose(goal.batched_positions, [[0.4, 0, 0.1]], atol=1e-6)
    assert not np.array_equal(goal.batched_colors, now.batched_colors)
    assert driver.node("/episode/goal/look/light") is None  # a second green cube would be taken for the table's
    drawing.show_goal(goal_at())
    assert guess(driver, of="goal/look") is None
    assert guess(driver) is not None


def test_estimates_follow_without_words_and_doubted_objects_have_another_colour(drawing, driver):
    drawing.show_look(state(), Pose(np.zeros((4, 2, 3)), np.tile(TURNS, (4, 1, 1))))
    assert driver.shows(f"/episode/estimate/tried/{BOX}")
    drawing.show_estimate(state(0.2), ("it is hardly visible", ""))
    assert not driver.shows(f"/episode/estimate/guess/{BOX}")
    box, can = (driver.node(f"/episode/estimate/{TRACKED}/{name}") for name in (BOX, CAN))
    assert box.visible
    np.testing.assert_allclose(box.batched_positions, [[0.2, 0, 0.1]], atol=1e-6)
    assert not driver.shows(f"/episode/estimate/tried/{BOX}")
    assert not np.array_equal(box.batched_colors, can.batched_colors)
    assert driver.below(f"/episode/estimate/verdict/{BOX}") == set()
    light = driver.node(f"/episode/estimate/{TRACKED}/light")
    assert not driver.shows("/episode/estimate/light")  # that of the search
    np.testing.assert_allclose(light.position, AT * LIGHT.position, atol=1e-12)


def test_ways_are_one_node_with_a_colour_for_each_and_the_best_one_is_another(drawing, driver):
    drawing.show_plan(sketch(ways=5, moments=11))
    ways, best = driver.node("/episode/plan/ways"), driver.node("/episode/plan/best")
    assert ways.points.shape == ways.colors.shape == (50, 2, 3)
    assert is_green(ways.colors[0, 0])
    assert is_red(ways.colors[-1, 1])
    assert ways.points[0, 0, 2] > ways.points[-1, 0, 2]  # cheap ones lie above dear ones
    np.testing.assert_allclose(ways.points[0, 1], ways.points[1, 0], atol=1e-12)
    np.testing.assert_allclose(best.points[[0, -1], [0, 1], 0], [-0.2, 0.0], atol=1e-6)
    assert best.points[..., 2].max() < 0.02  # on the table
    drawing.show_plan(sketch(ways=3, moments=4))
    assert driver.node("/episode/plan/ways") is ways
    assert ways.points.shape == ways.colors.shape == (9, 2, 3)


def test_the_best_future_is_played_again_and_again_and_stands_at_its_end(drawing, driver):
    drawing.play(1.0)  # nothing to play yet
    drawing.show_plan(sketch(moments=11))
    box = driver.node(f"/episode/plan/future/{BOX}")
    places = []
    for seconds in (0.0, 0.25 * PLAY_S, 0.5 * PLAY_S, PLAY_S, PLAY_S + 0.9 * REST_S, 1.5 * PLAY_S + REST_S):
        drawing.play(seconds)
        places.append(box.batched_positions[-1, 0])
    np.testing.assert_allclose(places, [0, 0.025, 0.05, 0.1, 0.1, 0.05], atol=1e-6)
    drawing.show_plan(None)
    drawing.play(0.0)
    assert not shows_plan(driver)


def test_everything_can_be_removed(drawing, driver):
    drawing.show_goal(goal_at())
    drawing.show_look(state(), of_goal=True)
    drawing.show_estimate(state(), ("", ""))
    drawing.show_plan(sketch())
    drawing.clear()
    assert driver.node("/episode/estimate/light") is driver.node(f"/episode/estimate/{TRACKED}/light") is None
    assert goals(driver) == {}
    assert guess(driver) is None
    assert guess(driver, of="goal/look") is None
    assert not shows_plan(driver)


def test_one_way_that_goes_badly_wrong_does_not_paint_the_others_green():
    colours = cost_colours(np.array([1.0, 2.0, 3.0, 4.0, 1000.0]))
    assert is_green(colours[0])
    assert is_red(colours[-1])
    assert len(np.unique(colours, axis=0)) == 5
    assert np.all(np.diff(colours[:, 1].astype(int)) <= 0)
    assert all(is_green(colour) for colour in cost_colours(np.ones(4)))


@pytest.fixture
def future(server, library):
    return FutureNodes(server.scene, library, "/future", FutureStyle((190, 50, 210)))


def test_what_moves_is_drawn_at_its_end_paler_on_the_way_and_once_more_where_it_begins(future, driver):
    future.show(sketch().best)
    box, can = (driver.node(f"/future/{name}") for name in (BOX, CAN))
    assert box.visible
    assert not can.visible  # it stays
    x = box.batched_positions[:, 0]
    assert len(x) == FutureStyle((0, 0, 0)).on_the_way + 2
    assert np.all(np.diff(x[:-1]) > 0)
    assert x[0] > 0.01
    np.testing.assert_allclose(x[-2:], [0.1, 0.0], atol=1e-6)
    assert np.all(box.batched_opacities[:3] < box.batched_opacities[-1])
    future.show(sketch(goes_m=0.0).best)
    assert driver.node(f"/future/{BOX}") is box
    assert not box.visible
    future.show(None)
    assert not any(driver.shows(f"/future/{name}") for name in driver.below("/future"))


def test_one_copy_and_the_pusher_go_along_and_the_others_stay(future, driver):
    future.at(2.0)  # nothing is shown yet
    assert future.steps == 0
    future.show(sketch(moments=11).best)
    assert future.steps == 10
    before = driver.node(f"/future/{BOX}").batched_positions.copy()
    for step, x in ((5.0, 0.05), (7.5, 0.075), (10.0, 0.1), (99.0, 0.1)):
        future.at(step)
        after = driver.node(f"/future/{BOX}").batched_positions
        np.testing.assert_allclose(after[:-1], before[:-1], atol=1e-12)
        assert after[-1, 0] == pytest.approx(x)
        assert driver.node("/future/pusher").position[0] == pytest.approx(2 * x - 0.2)


def test_another_scene_has_other_ghosts(future, driver):
    future.show(sketch().best)
    future.show(replace(sketch().best, names=("004_sugar_box", CAN)))
    assert driver.node(f"/future/{BOX}") is None
    assert driver.below("/future") == {"004_sugar_box", CAN, "pusher"}


def test_ghosts_on_the_way_are_spread_over_the_way_and_not_over_the_wait():
    x = 0.02 * np.maximum(np.arange(11) - 6, 0)
    waits = Pose(np.stack([x, 0 * x, 0 * x], axis=1), np.tile(TURNS[0], (11, 1)))
    rows = along_way(waits, 3)
    assert rows == sorted(rows)
    assert x[rows].min() > 0.01
    angles = np.linspace(0, 1, 11)
    turns = Pose(np.zeros((11, 3)), quaternion_exp(angles[:, None] * np.array([0, 0, 1.0])))
    np.testing.assert_allclose(angles[along_way(turns, 3)], [0.25, 0.5, 0.75], atol=0.1)
    assert along_way(waits[:2], 3) == [1, 1, 1]


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
        self.drawing = EpisodeNodes(server, library)
        self.panel = EpisodePanel(self.drawing, self.make_room)

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

    def slowly(*seen, **options):
        at.set()
        go_on.wait(10)
        show_look(*seen, **options)

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
    assert np.diff(played).min() > 0.5 * EPISODE_INTERVAL_S
    room.hear(JobChanged(1, job("done")))
    assert not room.shows_plan()
    count = len(played)
    time.sleep(2.5 * EPISODE_INTERVAL_S)
    assert len(played) == count


def test_when_it_is_done_the_goal_stays_and_the_plan_goes(room):
    for seen in (
        found(),
        sketch(),
        stepped(),
        Finished(12, "reached", "The table looks like the goal.", estimated().state),
    ):
        room.see(seen)
    room.hear(JobChanged(1, job("done")))
    assert room.goal() == set(NAMES)
    assert not room.shows_plan()
    assert room.estimate() is not None


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


def test_another_scene_clears_the_view_and_coming_back_shows_a_running_episode_again(room):
    for seen in (found(), stepped(), sketch()):
        room.see(seen)
    assert room.rooms_made == 1
    room.hear(CurrentScene(record("other")))
    until(lambda: room.goal() == set())
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
