from dataclasses import replace

import numpy as np
import pytest

import osfcore.world.tasks as module
from osfcore.errors import InvalidInput, MissingAssets, OverlappingObjects, UnknownName
from osfcore.geometry.poses import Pose, rotate, rotation_angle
from osfcore.geometry.workspace import TABLE_SIDE_M, WORKSPACE_HALF_M
from osfcore.objects.asset_library import AssetLibrary
from osfcore.world.scenes import GAP_M, SceneRequest
from osfcore.world.tasks import FAMILIES, MIN_SHIFT_M, TURN_DEG, TaskSet, arranged_goal, draw_task, random_goal
from tests.support.errors import about
from tests.support.same import assert_same

NAMES = ("003_cracker_box", "005_tomato_soup_can", "006_mustard_bottle", "009_gelatin_box")
CAN, BOX, BOTTLE = LAYOUT_NAMES = ("005_tomato_soup_can", "009_gelatin_box", "006_mustard_bottle")
UP = np.array([0.0, 0.0, 1.0])
RESTS_M, RESTS_RAD = 0.004, 0.06  # what a let go may change, twice: at the start and at the goal


def tasks_of(library, family, objects=3, names=NAMES, numbers=range(3)):
    return [draw_task(library, TaskSet(names, family, objects), number).task for number in numbers]


@pytest.fixture(scope="module")
def families(library):
    return {family: tasks_of(library, family) for family in FAMILIES}


def shift(task, name, other=None):
    return np.linalg.norm((task.goal.pose(name).position - task.start.pose(other or name).position)[:2])


def test_a_task_is_the_same_again_without_the_others_and_a_relit_one_under_another_light(library, families):
    (again,) = tasks_of(library, "shifted", numbers=[2])
    for task, relit in ((again, families["shifted"][2]), *zip(families["shifted"], families["relit"], strict=True)):
        assert_same(replace(task, goal=replace(task.goal, light=relit.goal.light)), relit)
        assert task.goal.light.angle_to(task.start.light) == pytest.approx(0, abs=1e-6)
    assert all(task.goal.light.angle_to(task.start.light) > 0.01 for task in families["relit"])


def test_one_two_and_three_objects_move_in_turn(library, families):
    for family in FAMILIES:
        assert [len(set(task.moved)) for task in families[family]] == [2 if family == "crowded" else 1, 2, 3]
    assert [len(task.moved) for task in tasks_of(library, "crowded", 2)] == [2, 2, 2]


@pytest.mark.parametrize("family", FAMILIES)
def test_what_moves_lies_elsewhere_in_the_workspace_and_the_rest_stays(families, family):
    for task in families[family]:
        assert task.goal.pusher is None
        for name in task.start.names:
            here, there = task.start.pose(name), task.goal.pose(name)
            assert there.position[2] == pytest.approx(here.position[2], abs=RESTS_M)
            if name in task.moved:
                assert np.abs(there.position[:2]).max() < WORKSPACE_HALF_M + RESTS_M
                assert family == "crowded" or shift(task, name) > MIN_SHIFT_M - RESTS_M
            else:
                assert shift(task, name) < RESTS_M
            turn = rotation_angle(here.quaternion, there.quaternion)
            if family == "turned" and name in task.moved:
                assert TURN_DEG[0] - 4 < np.rad2deg(turn) <= TURN_DEG[1] + 4
                up = [rotate(pose.quaternion * [1, -1, -1, -1], UP) for pose in (here, there)]
                np.testing.assert_allclose(up[0], up[1], atol=RESTS_RAD)  # the object's own vertical
            else:
                assert turn < RESTS_RAD


def test_the_place_of_an_object_is_taken_by_another_one_where_it_is_crowded(families):
    for kind, task in enumerate(families["crowded"]):
        first, second, last = task.moved[0], task.moved[1], task.moved[-1]
        assert shift(task, first, second) < RESTS_M
        assert (shift(task, last, first) < RESTS_M) == (kind > 0)  # a swap, or a ring of three


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


@pytest.mark.parametrize("family", FAMILIES)
def test_a_goal_can_be_put_on_the_table_and_rests_there_without_overlap(tables, families, family):
    world = tables()
    for task in families[family]:
        world.load(task.goal)  # refuses what overlaps
        before = world.truth()
        *_, after = world.settle()
        assert np.linalg.norm(after.poses.position - before.poses.position, axis=1).max() < RESTS_M
        assert min(world.gap_m(name) for name in task.moved) > GAP_M - RESTS_M


def test_where_there_is_no_rest_other_layouts_are_tried_and_counted(library, monkeypatch):
    tried = []

    def picky(world):
        tried.append(world.truth().poses.position.tobytes())
        return len(tried) == 3

    monkeypatch.setattr(module, "came_to_rest", picky)
    drawn = draw_task(library, TaskSet(NAMES[3:], objects=1), 0)
    assert len(set(tried)) == 3
    assert drawn.rejected == {"not at rest": 2}


def test_senseless_tasks_are_refused_and_an_object_without_a_mesh_is_named(library, tmp_path):
    for family, objects, subject in (
        ("sorted", 3, "family of tasks"),
        ("crowded", 1, "objects in a scene"),
        ("shifted", 7, "objects in a scene"),
        ("shifted", 5, "number of objects with a field and a mesh"),
    ):
        with pytest.raises(InvalidInput, check=about(subject)):
            draw_task(library, TaskSet(NAMES, family, objects), 0)
    with pytest.raises(MissingAssets, check=about(NAMES[0])):
        draw_task(AssetLibrary(tmp_path), TaskSet(NAMES[:1], objects=1), 0)


# Goal layouts


@pytest.fixture
def table(tables):
    return tables(3, request=SceneRequest(names=LAYOUT_NAMES))


def away(before, after):
    """Objects that are more than a centimetre from where they were."""
    shift_m = np.linalg.norm(after.poses.position - before.poses.position, axis=1)
    return {name for name, distance in zip(before.names, shift_m, strict=True) if distance > 0.01}


def aside_of(pose, x_m=0.0, z_m=0.0):
    return Pose(pose.position + [x_m, 0, z_m], pose.quaternion)


def test_objects_put_down_in_the_air_come_to_rest_and_the_others_stay(table):
    before = table.truth()
    assert away(before, arranged_goal(table, {})) == set()
    goal = arranged_goal(table, {BOX: aside_of(before.pose(BOX), z_m=0.03)})
    assert away(before, goal) == set()
    assert goal.pose(BOX).position[2] < before.pose(BOX).position[2] + 0.005
    assert goal.names == before.names


def test_impossible_goals_are_refused(table):
    state = table.truth()
    on_the_edge = Pose(np.array([TABLE_SIDE_M / 2 - 1e-3, 0.1, 0.15]), state.pose(CAN).quaternion)
    for kind, subject, poses in (
        (UnknownName, "teapot", {"teapot": Pose.identity()}),
        (OverlappingObjects, BOX, {BOX: state.pose(BOTTLE)}),
        (InvalidInput, BOX, {BOX: aside_of(state.pose(BOX), x_m=2.0)}),
        (InvalidInput, CAN, {CAN: on_the_edge}),  # it falls off
    ):
        with pytest.raises(kind, check=about(subject)):
            arranged_goal(table, poses)
        table.restore(state)


@pytest.mark.parametrize("moved", [1, 2, 3])
def test_as_many_objects_as_asked_lie_elsewhere_at_random(table, moved):
    before = table.truth()
    goal, names = random_goal(table, 5, moved)
    assert len(set(names)) == moved
    assert away(before, goal) == set(names)
    assert goal.pusher is None


def test_a_seed_means_one_random_layout(table):
    before, goals = table.truth(), []
    for seed in (1, 1, 2):
        table.restore(before)
        goals.append(random_goal(table, seed, None)[0])
    assert away(goals[0], goals[1]) == set()
    assert away(goals[0], goals[2]) != set()
    for moved in (0, 4):
        with pytest.raises(InvalidInput, check=about("number of objects that move")):
            random_goal(table, 0, moved)


def test_measured_objects_inside_each_other_and_the_table_are_moved_apart_a_little(table):
    before = table.truth()
    bottle, box = before.pose(BOTTLE), before.pose(BOX)
    away = (bottle.position - box.position) * [1, 1, 0] / np.linalg.norm((bottle.position - box.position)[:2])
    for distance in np.arange(0.2, 0.0, -0.002):  # until the box is a few millimetres in the bottle
        into = Pose(bottle.position * [1, 1, 0] - distance * away + box.position * [0, 0, 1], box.quaternion)
        table.restore(replace(before.reordered((BOTTLE, BOX)), poses=Pose.stacked((bottle, into))))
        if table.gap_m(BOX) < -0.006:
            break
    table.restore(before)
    goal = arranged_goal(table, {BOX: aside_of(into, z_m=-0.004)}, is_measured=True)
    assert table.gap_m(BOX) > -1e-3
    for name, asked in ((BOX, into), (BOTTLE, bottle)):
        shift = goal.pose(name).position - asked.position
        assert np.linalg.norm(shift[:2]) < 0.02, name
        assert abs(shift[2]) < 3e-3, name
