import contextlib
from dataclasses import replace

import numpy as np
import pytest

from osfcore.errors import InvalidInput, NoRoom, OverlappingObjects, UnknownName
from osfcore.geometry.poses import Pose
from osfcore.geometry.workspace import TABLE_SIDE_M
from osfcore.world import tasks
from osfcore.world.scenes import SceneRequest
from osfcore.world.tabletop import Tabletop
from osfcore.world.tasks import arranged_goal, random_goal

CAN, BOX, BOTTLE = NAMES = ("005_tomato_soup_can", "009_gelatin_box", "006_mustard_bottle")


@pytest.fixture
def table(library):
    with contextlib.closing(Tabletop(library, request=SceneRequest(names=NAMES))) as world:
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

    monkeypatch.setattr(tasks, "draw_goal", none)
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
