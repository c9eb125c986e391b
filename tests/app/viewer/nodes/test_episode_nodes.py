import numpy as np
import pytest

from app.processes.plan_summary import PlanSketch
from app.viewer.nodes.episode_nodes import GOAL, PARTS, PLAY_S, REST_S, EpisodeNodes, cost_colours
from app.viewer.nodes.estimate_nodes import TRACKED
from app.viewer.nodes.light_marker import AT
from osfcore.control.events import Look, Looking
from osfcore.estimation.steps import EstimateStep
from osfcore.geometry.light import Light
from osfcore.geometry.poses import Pose
from osfcore.geometry.rollouts import Rollouts
from osfcore.geometry.states import EstimatedState, SceneState
from osfcore.planning.costs import PoseGoal
from osfcore.progress import Progress

BOX, CAN = "003_cracker_box", "005_tomato_soup_can"
NAMES = (BOX, CAN)
LIGHT = Light(np.array([0.6, 0, 0.8]))
TURNS = np.tile([1.0, 0, 0, 0], (2, 1))


@pytest.fixture
def drawing(server, library):
    return EpisodeNodes(server, library)


def poses(x=0.1):
    return Pose(np.array([[x, 0, 0.1], [0.2, 0.2, 0.05]]), TURNS)


def estimated(x=0.1, doubt=""):
    state = SceneState(NAMES, poses(x), LIGHT, None)
    return EstimatedState(state, np.full(2, 0.001), np.full(2, 0.01), 0.01, (doubt, ""), doubt)


def look(kind: Look = "first", x=0.1, candidates=None):
    step = EstimateStep(Progress(1, 2, ""), "objects", SceneState(NAMES, poses(x), LIGHT, None), candidates)
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
    drawing.show_goal(PoseGoal(NAMES, poses()))
    before = goals(driver)
    assert set(before) == set(NAMES)
    np.testing.assert_allclose(before[BOX].position, [0.1, 0, 0.1], atol=1e-6)
    assert {tuple(node.color) for node in before.values()} == {GOAL}
    drawing.show_goal(PoseGoal(NAMES[::-1], poses()[::-1]))
    assert goals(driver) == before
    drawing.show_goal(PoseGoal(NAMES, poses(0.3)))
    assert goals(driver) == before
    np.testing.assert_allclose(before[BOX].position, [0.3, 0, 0.1], atol=1e-6)
    drawing.show_goal(PoseGoal((BOX,), poses()[:1]))
    assert set(goals(driver)) == {BOX}
    assert goals(driver)[BOX] is not before[BOX]


def test_a_look_at_the_goal_image_is_drawn_beside_the_table_until_the_goal_is_known(drawing, driver):
    drawing.show_look(look("first"))
    drawing.show_look(look("goal", x=0.4))
    now, goal = guess(driver), guess(driver, of="goal/look")
    np.testing.assert_allclose(now.batched_positions, [[0.1, 0, 0.1]], atol=1e-6)
    np.testing.assert_allclose(goal.batched_positions, [[0.4, 0, 0.1]], atol=1e-6)
    assert not np.array_equal(goal.batched_colors, now.batched_colors)
    assert driver.node("/episode/goal/look/light") is None  # a second green cube would be taken for the table's
    drawing.show_goal(PoseGoal(NAMES, poses()))
    assert guess(driver, of="goal/look") is None
    assert guess(driver) is not None


def test_estimates_follow_without_words_and_doubted_objects_have_another_colour(drawing, driver):
    drawing.show_look(look(candidates=Pose(np.zeros((4, 2, 3)), np.tile(TURNS, (4, 1, 1)))))
    assert driver.shows(f"/episode/estimate/tried/{BOX}")
    drawing.show_estimate(estimated(0.2, "it is hardly visible"))
    assert not driver.shows(f"/episode/estimate/guess/{BOX}")
    box, can = (driver.node(f"/episode/estimate/{TRACKED}/{name}") for name in (BOX, CAN))
    assert box.visible
    np.testing.assert_allclose(box.batched_positions, [[0.2, 0, 0.1]], atol=1e-6)
    assert not driver.shows(f"/episode/estimate/tried/{BOX}")
    assert not np.array_equal(box.batched_colors, can.batched_colors)
    assert driver.below(f"/episode/estimate/verdict/{BOX}") == set()
    np.testing.assert_allclose(driver.node("/episode/estimate/light").position, AT * LIGHT.position, atol=1e-12)


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
    drawing.show_part("plan", False)
    drawing.play(0.0)
    assert box.batched_positions[-1, 0] == pytest.approx(0.05)  # nobody sees it
    drawing.show_plan(None)
    drawing.play(0.0)
    drawing.show_part("plan", True)
    assert not shows_plan(driver)


def test_parts_can_be_hidden_also_before_they_are_drawn(drawing, driver):
    for part in PARTS:
        drawing.show_part(part, False)
    drawing.show_goal(PoseGoal(NAMES, poses()))
    drawing.show_estimate(estimated())
    drawing.show_plan(sketch())
    assert not any(driver.shows(f"/episode/{part}") for part in PARTS)
    assert not driver.shows(f"/episode/goal/where/{BOX}")
    assert not driver.shows(f"/episode/estimate/guess/{BOX}")
    assert not shows_plan(driver)
    assert not drawing.shows_light
    drawing.show_part("estimate", True)
    assert drawing.shows_light
    assert [part for part in PARTS if driver.shows(f"/episode/{part}")] == ["estimate"]


def test_everything_can_be_removed(drawing, driver):
    drawing.show_goal(PoseGoal(NAMES, poses()))
    drawing.show_look(look("goal"))
    drawing.show_estimate(estimated())
    drawing.show_plan(sketch())
    drawing.clear()
    assert not drawing.shows_light
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
