import numpy as np
import pytest

import osfcore.experiments.rearrangement.tasks as module
from osfcore.errors import MissingAssets, NoRoom
from osfcore.experiments.estimation.tasks import SHIFT_M
from osfcore.experiments.rearrangement.tasks import mpc_task
from osfcore.geometry.poses import Pose, rotation_angle
from osfcore.geometry.workspace import PUSHER_REACH_M, WORKSPACE_HALF_M
from osfcore.objects.asset_library import AssetLibrary
from osfcore.world.goal_layouts import draw_goal
from osfcore.world.placing import GAP_M
from osfcore.world.tabletop import Tabletop

NAMES = ("003_cracker_box", "005_tomato_soup_can", "006_mustard_bottle", "009_gelatin_box")
NUMBERS = range(6)
RESTS_M, RESTS_RAD = 0.004, 0.06  # what a let go may change, twice: at the start and at the goal


@pytest.fixture(scope="module")
def tasks(library):
    return [mpc_task(library, NAMES, 3, 0, number) for number in NUMBERS]


def same(a, b):
    assert a.names == b.names
    np.testing.assert_array_equal(a.poses.position, b.poses.position)
    np.testing.assert_array_equal(a.poses.quaternion, b.poses.quaternion)
    np.testing.assert_array_equal(a.light.direction, b.light.direction)


def test_a_task_is_the_same_again_without_the_others(library, tasks):
    again = mpc_task(library, NAMES, 3, 0, 4)
    same(again.start, tasks[4].start)
    same(again.goal, tasks[4].goal)
    assert (again.number, again.moved) == (4, tasks[4].moved)
    other = mpc_task(library, NAMES, 3, 1, 4)
    assert np.abs(other.start.light.direction - again.start.light.direction).max() > 1e-3


def test_one_two_and_three_objects_move_in_turn(library, tasks):
    assert [task.number for task in tasks] == list(NUMBERS)
    assert [len(set(task.moved)) for task in tasks] == [1, 2, 3, 1, 2, 3]
    assert len({task.start.light.direction[0] for task in tasks}) == len(tasks)
    assert [len(mpc_task(library, NAMES, 2, 0, number).moved) for number in range(3)] == [1, 2, 1]
    assert len(mpc_task(library, NAMES, 1, 0, 5).moved) == 1


def test_what_moves_lies_elsewhere_on_the_same_side_and_the_rest_stays(tasks):
    for task in tasks:
        for name in task.start.names:
            here, there = task.start.pose(name), task.goal.pose(name)
            shift = np.linalg.norm((there.position - here.position)[:2])
            assert rotation_angle(here.quaternion, there.quaternion) < RESTS_RAD
            assert there.position[2] == pytest.approx(here.position[2], abs=RESTS_M)
            if name in task.moved:
                assert SHIFT_M[0] - RESTS_M < shift < SHIFT_M[1] + RESTS_M
                assert np.abs(there.position[:2]).max() < WORKSPACE_HALF_M + RESTS_M
            else:
                assert shift < RESTS_M


def test_a_goal_shows_no_pusher_under_the_same_light(tasks):
    assert SHIFT_M == (0.075, 0.2)
    for task in tasks:
        assert task.goal.pusher is None
        assert task.goal.names == task.start.names
        np.testing.assert_array_equal(task.goal.light.direction, task.start.light.direction)
        assert np.abs(task.start.pusher[:2]).max() <= PUSHER_REACH_M


def test_a_goal_can_be_put_on_the_table_and_rests_there_without_overlap(library, tasks):
    world = Tabletop(library)
    try:
        for task in tasks[:3]:
            world.load(task.goal)  # refuses what overlaps
            before = world.truth()
            for _ in world.settle():
                pass
            after = world.truth()
            assert np.linalg.norm(after.poses.position - before.poses.position, axis=1).max() < RESTS_M
            assert min(world.gap_m(name) for name in task.moved) > GAP_M - RESTS_M
    finally:
        world.close()


def test_drawing_a_goal_leaves_the_world_as_the_goal(library, tasks):
    world = Tabletop(library)
    try:
        world.restore(tasks[2].start)
        found = draw_goal(world, 2, np.random.default_rng(3))
        assert found is not None
        goal, moved = found
        left = world.truth()
        np.testing.assert_allclose(left.poses.position, goal.poses.position, atol=1e-12)
        np.testing.assert_allclose(left.poses.quaternion, goal.poses.quaternion, atol=1e-12)
        assert len(moved) == 2
    finally:
        world.close()


def test_where_there_is_no_room_or_no_rest_other_layouts_are_tried(library, monkeypatch):
    real, tried = module.draw_goal, []

    def picky(world, count, rng):
        tried.append(world.truth().poses.position)
        return real(world, count, rng) if len(tried) == 3 else None

    monkeypatch.setattr(module, "draw_goal", picky)
    task = mpc_task(library, NAMES[3:], 1, 0, 0)
    assert len(tried) == 3
    assert len({place.tobytes() for place in tried}) == 3
    np.testing.assert_array_equal(task.start.poses.position, tried[-1])
    monkeypatch.setattr(module, "_LAYOUTS", 2)
    tried.clear()
    with pytest.raises(NoRoom):
        mpc_task(library, NAMES[3:], 1, 0, 0)


def test_a_goal_that_does_not_rest_is_refused(library, tasks, monkeypatch):
    def tumbling(self):
        name = self.names[0]
        pose = self.truth().pose(name)
        self.move_object(name, Pose(pose.position + [0, 0, 0.01], pose.quaternion))
        return iter(())

    world = Tabletop(library)
    try:
        world.restore(tasks[0].start)
        monkeypatch.setattr(Tabletop, "settle", tumbling)
        assert draw_goal(world, 1, np.random.default_rng(0)) is None
    finally:
        world.close()


def test_an_object_without_a_mesh_is_told(tmp_path):
    with pytest.raises(MissingAssets, match=NAMES[0]):
        mpc_task(AssetLibrary(tmp_path), NAMES[:1], 1, 0, 0)
