"""Tasks: rearrangement tasks, goal layouts."""

import contextlib
from collections import Counter
from dataclasses import replace

import numpy as np
import pytest

import osfcore.world.tasks as module
from osfcore.errors import InvalidInput, MissingAssets, NoRoom, OverlappingObjects, UnknownName
from osfcore.geometry.poses import Pose, rotate, rotation_angle
from osfcore.geometry.workspace import PUSHER_REACH_M, TABLE_SIDE_M, WORKSPACE_HALF_M
from osfcore.objects.asset_library import AssetLibrary
from osfcore.world.scenes import GAP_M, SceneRequest
from osfcore.world.tabletop import Tabletop
from osfcore.world.tasks import FAMILIES, MIN_SHIFT_M, TURN_DEG, TaskSet, arranged_goal, draw_task, random_goal

# Rearrangement tasks


NAMES = ("003_cracker_box", "005_tomato_soup_can", "006_mustard_bottle", "009_gelatin_box")
NUMBERS = range(6)
UP = np.array([0.0, 0.0, 1.0])
RESTS_M, RESTS_RAD = 0.004, 0.06  # what a let go may change, twice: at the start and at the goal


def tasks_of(library, family, objects=3, seed=0, names=NAMES, numbers=NUMBERS):
    return [draw_task(library, TaskSet(names, family, objects, seed), number).task for number in numbers]


@pytest.fixture(scope="module")
def families(library):
    return {family: tasks_of(library, family) for family in FAMILIES}


def same(a, b):
    assert a.names == b.names
    np.testing.assert_array_equal(a.poses.position, b.poses.position)
    np.testing.assert_array_equal(a.poses.quaternion, b.poses.quaternion)
    np.testing.assert_array_equal(a.light.direction, b.light.direction)


def shift(task, name):
    return np.linalg.norm((task.goal.pose(name).position - task.start.pose(name).position)[:2])


def turn(task, name):
    return rotation_angle(task.start.pose(name).quaternion, task.goal.pose(name).quaternion)


@pytest.mark.slow
def test_a_task_is_the_same_again_without_the_others(library, families):
    (again,) = tasks_of(library, "shifted", numbers=[4])
    expected = families["shifted"][4]
    same(again.start, expected.start)
    same(again.goal, expected.goal)
    assert (again.number, again.moved) == (4, expected.moved)
    (other,) = tasks_of(library, "shifted", seed=1, numbers=[4])
    assert np.abs(other.start.light.direction - again.start.light.direction).max() > 1e-3


@pytest.mark.slow
def test_one_two_and_three_objects_move_in_turn(library, families):
    for family in ("shifted", "turned", "relit"):
        assert [len(set(task.moved)) for task in families[family]] == [1, 2, 3, 1, 2, 3]
    assert [len(task.moved) for task in families["crowded"]] == [2, 2, 3, 2, 2, 3]
    assert [len(task.moved) for task in tasks_of(library, "shifted", 2, numbers=range(3))] == [1, 2, 1]
    assert [len(task.moved) for task in tasks_of(library, "crowded", 2, numbers=range(3))] == [2, 2, 2]
    assert len(tasks_of(library, "shifted", 1, numbers=[5])[0].moved) == 1


@pytest.mark.slow
@pytest.mark.parametrize("family", FAMILIES)
def test_what_moves_lies_elsewhere_in_the_workspace_and_the_rest_stays(families, family):
    for task in families[family]:
        for name in task.start.names:
            here, there = task.start.pose(name), task.goal.pose(name)
            assert there.position[2] == pytest.approx(here.position[2], abs=RESTS_M)
            if name in task.moved:
                assert np.abs(there.position[:2]).max() < WORKSPACE_HALF_M + RESTS_M
                assert family == "crowded" or shift(task, name) > MIN_SHIFT_M - RESTS_M
            else:
                assert shift(task, name) < RESTS_M
            if family != "turned" or name not in task.moved:
                assert turn(task, name) < RESTS_RAD


def test_turned_objects_are_turned_about_the_vertical_by_what_is_said(families):
    turns = []
    for task in families["turned"]:
        for name in task.moved:
            turns.append(np.rad2deg(turn(task, name)))
            up = [
                rotate(pose.quaternion * [1, -1, -1, -1], UP) for pose in (task.start.pose(name), task.goal.pose(name))
            ]
            np.testing.assert_allclose(up[0], up[1], atol=RESTS_RAD)  # the object's own vertical
    assert TURN_DEG[0] - 4 < min(turns) < 80 < max(turns) <= TURN_DEG[1] + 4


def test_the_place_of_an_object_is_taken_by_another_one_where_it_is_crowded(families):
    for kind, task in enumerate(families["crowded"]):
        first, second = task.moved[:2]
        gap = np.linalg.norm((task.goal.pose(first).position - task.start.pose(second).position)[:2])
        assert gap < RESTS_M
        back = np.linalg.norm((task.goal.pose(task.moved[-1]).position - task.start.pose(first).position)[:2])
        assert (back < RESTS_M) == (kind % 3 > 0)  # a swap, or a ring of three


def test_a_relit_goal_is_a_shifted_one_under_another_light(families):
    for task, relit in zip(families["shifted"], families["relit"], strict=True):
        same(task.start, relit.start)
        assert task.moved == relit.moved
        np.testing.assert_array_equal(task.goal.poses.position, relit.goal.poses.position)
        assert task.goal.light.angle_to(task.start.light) == pytest.approx(0, abs=1e-6)
        assert relit.goal.light.angle_to(relit.start.light) > 0.01


@pytest.mark.slow
def test_goals_lie_anywhere_and_not_along_the_light(library):
    """Where goal and light shared their random numbers, eight of twenty shifts pointed along the light."""
    tasks = tasks_of(library, "shifted", 2, names=NAMES[1:], numbers=range(40))
    shifts = np.array([(t.goal.pose(n).position - t.start.pose(n).position)[:2] for t in tasks for n in t.moved])
    lights = np.array([t.start.light.direction[:2] for t in tasks for _ in t.moved])
    angles = np.arctan2(*(shifts.T)) - np.arctan2(*(lights.T))
    along = np.abs((angles + np.pi) % (2 * np.pi) - np.pi) < np.deg2rad(9)  # 1 in 20 by chance
    assert along.mean() < 0.15
    assert (np.sign(shifts) > 0).mean() == pytest.approx(0.5, abs=0.15)
    places = np.array([t.goal.pose(n).position[:2] for t in tasks for n in t.moved])
    assert np.abs(places.mean(axis=0)).max() < 0.06
    assert places.std(axis=0) == pytest.approx(2 * WORKSPACE_HALF_M / np.sqrt(12), rel=0.25)  # that of a uniform one


def test_lights_come_down_to_five_degrees():
    elevations = []
    for number in range(300):
        draw = module.draw_scene(NAMES, 1, 0, number, module.Stream.TASK_SCENE, module.MIN_ELEVATION_DEG)
        elevations.append(np.rad2deg(np.arcsin(draw.light.direction[2])))
    assert 5 <= min(elevations) < 7


def test_a_goal_shows_no_pusher(families):
    for tasks in families.values():
        for task in tasks:
            assert task.goal.pusher is None
            assert task.goal.names == task.start.names
            assert np.abs(task.start.pusher[:2]).max() <= PUSHER_REACH_M


@pytest.mark.parametrize("family", FAMILIES)
def test_a_goal_can_be_put_on_the_table_and_rests_there_without_overlap(library, families, family):
    world = Tabletop(library)
    try:
        for task in families[family][:3]:
            world.load(task.goal)  # refuses what overlaps
            before = world.truth()
            for _ in world.settle():
                pass
            after = world.truth()
            assert np.linalg.norm(after.poses.position - before.poses.position, axis=1).max() < RESTS_M
            assert min(world.gap_m(name) for name in task.moved) > GAP_M - RESTS_M
    finally:
        world.close()


def test_where_there_is_no_room_or_no_rest_other_layouts_are_tried_and_counted(library, monkeypatch):
    real, tried = module.came_to_rest, []

    def picky(world):
        tried.append(world.truth().poses.position)
        return real(world) if len(tried) == 3 else False

    monkeypatch.setattr(module, "came_to_rest", picky)
    drawn = draw_task(library, TaskSet(NAMES[3:], objects=1), 0)
    assert len({place.tobytes() for place in tried}) == 3
    assert Counter(drawn.rejected) == {"not at rest": 2}


@pytest.mark.slow
def test_what_never_rests_has_no_task(library, monkeypatch):
    monkeypatch.setattr(module, "came_to_rest", lambda _: False)
    with pytest.raises(NoRoom, match=NAMES[3]):
        draw_task(library, TaskSet(NAMES[3:], objects=1), 0)


@pytest.mark.parametrize(
    ("asked", "words"),
    [
        (TaskSet(NAMES, "sorted"), "one of shifted, turned, crowded, relit"),
        (TaskSet(NAMES, "crowded", 1), "objects in a scene is 1"),
        (TaskSet(NAMES, "shifted", 7), "between 1 and 6"),
        (TaskSet(NAMES, "shifted", 5), "is 4, but it must be at least 5"),
    ],
)
def test_senseless_tasks_are_refused(library, asked, words):
    with pytest.raises(InvalidInput, match=words):
        draw_task(library, asked, 0)


def test_an_object_without_a_mesh_is_told(tmp_path):
    with pytest.raises(MissingAssets, match=NAMES[0]):
        draw_task(AssetLibrary(tmp_path), TaskSet(NAMES[:1], objects=1), 0)


# Goal layouts


CAN, BOX, BOTTLE = LAYOUT_NAMES = ("005_tomato_soup_can", "009_gelatin_box", "006_mustard_bottle")


@pytest.fixture
def table(library):
    with contextlib.closing(Tabletop(library, request=SceneRequest(names=LAYOUT_NAMES))) as world:
        world.arrange(3)
        yield world


def away(before, after):
    """Objects that are more than a centimetre from where they were."""
    shift_m = np.linalg.norm(after.poses.position - before.poses.position, axis=1)
    return {name for name, distance in zip(before.names, shift_m, strict=True) if distance > 0.01}


def aside_of(pose, x_m=0.0, z_m=0.0):
    return Pose(pose.position + [x_m, 0, z_m], pose.quaternion)


def aside(state, name, x_m=0.0, z_m=0.0):
    return aside_of(state.pose(name), x_m, z_m)


def test_what_is_put_down_in_the_air_comes_to_rest_and_the_others_stay(table):
    before = table.truth()
    goal = arranged_goal(table, {BOX: aside(before, BOX, z_m=0.03)})
    assert away(before, goal) == set()
    assert goal.pose(BOX).position[2] < before.pose(BOX).position[2] + 0.005
    assert goal.names == before.names


def test_objects_may_swap_their_places(table):
    before = table.truth()
    can, box = before.pose(CAN), before.pose(BOX)
    over = [Pose(np.array([*p.position[:2], own.position[2]]), own.quaternion) for p, own in ((box, can), (can, box))]
    goal = arranged_goal(table, {CAN: over[0], BOX: over[1]})
    assert np.linalg.norm((goal.pose(CAN).position - box.position)[:2]) < 0.01
    assert np.linalg.norm((goal.pose(BOX).position - can.position)[:2]) < 0.01


def test_nothing_asked_for_is_the_table_as_it_is(table):
    before = table.truth()
    assert away(before, arranged_goal(table, {})) == set()


def test_what_cannot_be_is_told(table):
    state = table.truth()
    edge = TABLE_SIDE_M / 2
    on_the_edge = Pose(np.array([edge - 1e-3, 0.1, 0.15]), state.pose(CAN).quaternion)
    for kind, words, poses in (
        (UnknownName, "teapot", (("teapot", Pose.identity()),)),
        (OverlappingObjects, BOX, ((BOX, state.pose(BOTTLE)),)),
        (InvalidInput, "over the table", ((BOX, aside(state, BOX, x_m=2.0)),)),
        (InvalidInput, "fall off", ((CAN, on_the_edge),)),
    ):
        with pytest.raises(kind, match=words):
            arranged_goal(table, dict(poses))
        table.restore(state)


@pytest.mark.parametrize("moved", [1, 2, 3])
def test_as_many_objects_as_asked_lie_elsewhere_at_random(table, moved):
    before = table.truth()
    goal, names = random_goal(table, 5, moved)
    assert len(set(names)) == moved
    assert away(before, goal) == set(names)
    assert goal.pusher is None


def test_a_seed_means_one_random_layout(table):
    before = table.truth()
    goals = []
    for seed in (1, 1, 2):
        table.restore(before)
        goals.append(random_goal(table, seed, None)[0])
    assert away(goals[0], goals[1]) == set()
    assert away(goals[0], goals[2]) != set()


@pytest.mark.parametrize("moved", [0, 4])
def test_more_or_fewer_objects_than_there_are_cannot_move(table, moved):
    with pytest.raises(InvalidInput, match="between 1 and 3"):
        random_goal(table, 0, moved)


def test_every_try_begins_where_things_are_now_and_there_is_an_end_to_them(table, monkeypatch):
    before = table.truth()
    begun = []

    def none(world, count, _rng):
        begun.append((count, away(before, world.truth())))
        world.move_object(BOX, aside(world.truth(), BOX, z_m=0.3))

    monkeypatch.setattr(module, "draw_goal", none)
    with pytest.raises(NoRoom, match=BOX):
        random_goal(table, 0, 2)
    assert len(begun) > 5
    assert set(map(repr, begun)) == {repr((2, set()))}


def test_measured_objects_inside_each_other_and_the_table_are_moved_apart_a_little(table):
    before = table.truth()
    bottle, box = before.pose(BOTTLE), before.pose(BOX)
    away = (bottle.position - box.position) * [1, 1, 0] / np.linalg.norm((bottle.position - box.position)[:2])
    for distance in np.arange(0.2, 0.0, -0.002):  # until the box is a few millimetres in the bottle
        into = Pose(bottle.position * [1, 1, 0] - distance * away + box.position * [0, 0, 1], box.quaternion)
        poses = Pose(np.array([bottle.position, into.position]), np.array([bottle.quaternion, into.quaternion]))
        table.restore(replace(before.reordered((BOTTLE, BOX)), poses=poses))
        if table.gap_m(BOX) < -0.006:
            break
    table.restore(before)
    goal = arranged_goal(table, {BOX: aside_of(into, z_m=-0.004)}, is_measured=True)
    assert table.gap_m(BOX) > -1e-3
    for name, asked in ((BOX, into), (BOTTLE, bottle)):
        shift = goal.pose(name).position - asked.position
        assert np.linalg.norm(shift[:2]) < 0.02, name
        assert abs(shift[2]) < 3e-3, name


def test_an_object_measured_a_little_inside_the_one_it_lies_on_is_lifted(table):
    before = table.truth()
    box = before.pose(BOX)
    top = Pose(box.position + [0.0, 0.0, 0.04], box.quaternion)
    rests = arranged_goal(table, {BOX: box, CAN: Pose(top.position, before.pose(CAN).quaternion)}, is_measured=True)
    assert np.linalg.norm((rests.pose(BOX).position - box.position)[:2]) < 5e-3  # it was not thrown aside
