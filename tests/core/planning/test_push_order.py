from itertools import pairwise, permutations

import numpy as np
import pytest

from osfcore.geometry.poses import Pose, quaternion_to_matrix
from osfcore.geometry.workspace import WORKSPACE_HALF_M
from osfcore.planning.pushes import push_orders

UPRIGHT = np.array([1.0, 0, 0, 0])
SQUARE = 0.025  # half a side


def at(*place: float) -> Pose:
    return Pose(np.array([*place, 0.03]), UPRIGHT)


def outlines_of(*halves):
    """Boxes by their half sides."""

    def outlines(n, pose):
        corners = np.array([[1, 1], [-1, 1], [-1, -1], [1, -1]]) * halves[n]
        return [corners @ quaternion_to_matrix(pose.quaternion)[:2, :2].T + pose.position[:2]]

    return outlines


def orders_of(now, goals, outlines=None, seed=0, count=6):
    off = [n for n, (here, there) in enumerate(zip(now, goals, strict=True)) if here is not there]
    outlines = outlines or outlines_of(*[(SQUARE, SQUARE)] * len(now))
    return push_orders(now, goals, off, outlines, count, np.random.default_rng(seed))


def places(order):
    return [(stage.number, *stage.target.position[:2].round(6).tolist()) for stage in order]


def test_objects_in_nobodys_way_are_pushed_in_all_orders():
    now = [at(-0.15, -0.1), at(0.0, -0.1), at(0.15, -0.1)]
    goals = [at(-0.15, 0.1), at(0.0, 0.1), at(0.15, 0.1)]
    orders = orders_of(now, goals)
    assert {tuple(stage.number for stage in order) for order in orders} == set(permutations(range(3)))
    assert all(stage.target is goals[stage.number] for order in orders for stage in order)


def test_who_takes_the_goal_of_another_one_leaves_first():
    now = [at(-0.15, 0.0), at(0.0, 0.0), at(0.15, 0.15)]
    goals = [at(0.01, 0.0), at(0.0, -0.15), at(-0.1, 0.15)]
    orders = orders_of(now, goals)
    assert orders
    for order in orders:
        numbers = [stage.number for stage in order]
        assert numbers.index(1) < numbers.index(0)


@pytest.mark.parametrize("seed", range(3))
def test_of_two_that_swap_places_one_goes_to_a_free_place_first(seed):
    now = [at(-0.1, 0.0), at(0.1, 0.0), at(0.0, 0.15)]
    goals = [at(0.1, 0.0), at(-0.1, 0.0), now[2]]
    orders = orders_of(now, goals, seed=seed)
    assert orders
    for order in orders:
        first, others = order[0], order[1:]
        taken = [*now, *goals]
        gaps = [np.abs(first.target.position[:2] - pose.position[:2]).max() - 2 * SQUARE for pose in taken]
        assert min(gap for gap, pose in zip(gaps, taken, strict=True) if pose is not now[first.number]) > 0
        assert np.abs(first.target.position[:2]).max() <= WORKSPACE_HALF_M
        last = {stage.number: stage.target for stage in others}
        assert last == {0: goals[0], 1: goals[1]}
        assert next(stage.number for stage in others) != first.number


def test_an_object_is_pushed_around_a_wall():
    now, goals = [at(-0.12, 0.0), at(0.0, -0.05)], [at(0.12, 0.0)]
    outlines = outlines_of((SQUARE, SQUARE), (0.01, 0.12))
    around, straight = orders_of(now, [*goals, now[1]], outlines)
    assert places(straight) == [(0, 0.12, 0.0)]
    assert 2 <= len(around) <= 4
    way = np.array([now[0].position[:2], *[stage.target.position[:2] for stage in around]])
    along = np.concatenate([np.linspace(a, b, 50) for a, b in pairwise(way)])
    distance = np.linalg.norm(np.maximum(np.abs(along - [0.0, -0.05]) - [0.01, 0.12], 0), axis=1)
    assert distance.min() > 0.01  # its corner may graze
    assert along[:, 1].max() > 0.07


def test_where_there_is_no_room_for_a_detour_the_way_is_straight():
    now = [at(-0.12, 0.0), at(0.0, 0.0)]
    outlines = outlines_of((SQUARE, SQUARE), (0.01, 0.34))
    assert [places(order) for order in orders_of(now, [at(0.12, 0.0), now[1]], outlines)] == [[(0, 0.12, 0.0)]]


def test_many_objects_give_as_many_orders_as_asked_and_the_same_for_the_same_seed():
    now = [at(x, -0.15) for x in np.linspace(-0.2, 0.2, 6)]
    goals = [at(x, 0.1) for x in np.linspace(-0.2, 0.2, 6)]
    one, other = (orders_of(now, goals, seed=4, count=5) for _ in range(2))
    assert len(one) == 5
    assert [places(order) for order in one] == [places(order) for order in other]
