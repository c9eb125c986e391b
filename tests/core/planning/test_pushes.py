from dataclasses import replace
from itertools import pairwise, permutations

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st

from osfcore.dynamics.rollout import load_push_model, load_shapes
from osfcore.dynamics.shapes import ShapeTable, part_outlines
from osfcore.fields.field_library import FieldLibrary
from osfcore.geometry.poses import Pose, quaternion_exp, quaternion_multiply, quaternion_to_matrix, rotation_angle
from osfcore.geometry.rollouts import Rollouts
from osfcore.geometry.workspace import MAX_SPEED_M_S, PUSHER_RADIUS_M, PUSHER_REACH_M, STEP_S, WORKSPACE_HALF_M
from osfcore.planning.costs import PoseCost, PoseGoal, object_costs
from osfcore.planning.paths import CLEARANCE_M, FreeSpace, actions_along
from osfcore.planning.pushes import (
    ObjectPushes,
    PushProposals,
    push_orders,
    push_outcomes,
    push_stages,
    recombined,
    silhouette,
    straight_pushes,
)
from tests.core.dynamics.scenes import BOX, CAN, GELATIN, scene
from tests.support.rendered_scenes import state

# Push order


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
    long_wall = outlines_of((SQUARE, SQUARE), (0.01, 0.34))  # with no room for a detour
    assert [places(order) for order in orders_of(now, [*goals, now[1]], long_wall)] == [[(0, 0.12, 0.0)]]


# Push outcomes


CENTRE = np.array([0.0, 0.0, 0.01])
STATE = state({"box": (0.1, -0.05, 0.02)}, (0, 0, 1), (0.3, 0.3, 0.06))
ORIGIN = STATE.poses.position[0, :2]


def rectangle(half_length: float, half_width: float, place=(0.0, 0.0)):
    return np.array([[1, 1], [-1, 1], [-1, -1], [1, -1]]) * [half_length, half_width] + place


def area(outline) -> float:
    x, y = outline.T
    return float(np.sum(x * np.roll(y, -1) - y * np.roll(x, -1))) / 2


def carried(state, actions, before=None, pushers=None) -> Rollouts:
    """A world in which the object goes along with the pusher, wherever that is."""
    path = np.pad(STEP_S * np.cumsum(actions, axis=1), ((0, 0), (1, 0), (0, 0)))
    positions = state.poses.position + path[:, :, None]
    quaternions = np.broadcast_to(state.poses.quaternion, (*positions.shape[:3], 4))
    return Rollouts(state.names, positions, quaternions, np.pad(pushers, ((0, 0), (0, 1)))[:, None] + path)


def table(predict=carried, halves=(0.05, 0.02)):
    return push_outcomes(predict, STATE, CENTRE, [rectangle(*halves, ORIGIN)])


@pytest.mark.parametrize("gap", [0.004, 0.05])
def test_parts_that_lie_apart_are_all_within_the_silhouette_and_the_loop(gap):
    """A small part beside a large one, with room for the pusher between them or not."""
    parts = [rectangle(0.05, 0.02), rectangle(0.01, 0.01, (0.06 + gap, 0.0))]
    outline = silhouette(parts)  # which runs counterclockwise
    np.testing.assert_allclose(outline.max(axis=0), [0.07 + gap, 0.02], atol=0.002)
    assert area(outline) > 0.1 * 0.04 + 0.02 * 0.02
    outcomes = push_outcomes(carried, STATE, CENTRE, [part + ORIGIN for part in parts])
    for part in parts:
        low, high = part.min(axis=0), part.max(axis=0)
        away = np.maximum(np.maximum(low - outcomes.starts, outcomes.starts - high), 0)
        assert np.linalg.norm(away, axis=1).min() > PUSHER_RADIUS_M
        away = np.maximum(np.maximum(low - outcomes.loop, outcomes.loop - high), 0)
        assert np.linalg.norm(away, axis=1).min() > PUSHER_RADIUS_M


def test_pushes_begin_clear_of_the_object_on_all_sides_and_lead_into_it():
    outcomes = table()
    moved = outcomes.lengths[:, None] * outcomes.directions[:, None]
    np.testing.assert_allclose(outcomes.centres, moved, atol=1e-12)  # of mass, for every length
    outside = np.linalg.norm(np.maximum(np.abs(outcomes.starts) - [0.05, 0.02], 0), axis=1)
    assert outside.min() > PUSHER_RADIUS_M
    np.testing.assert_allclose(np.linalg.norm(outcomes.directions, axis=1), 1, atol=1e-12)
    sides = [outcomes.starts[:, axis] * sign > half for axis, half in ((0, 0.05), (1, 0.02)) for sign in (-1, 1)]
    assert all(side.sum() >= 10 for side in sides)
    path = outcomes.starts[:, None] + outcomes.lengths[:, None] * outcomes.directions[:, None]
    nearest = np.linalg.norm(np.maximum(np.abs(path) - [0.05, 0.02], 0), axis=2).min(axis=1)
    assert (nearest < PUSHER_RADIUS_M).all()


# Push primitives


angle = st.floats(-np.pi, np.pi)
half = st.floats(0.01, 0.1)
seeds = st.integers(0, 10**6)


def turned(points, by: float) -> np.ndarray:
    c, s = np.cos(by), np.sin(by)
    return points @ np.array([[c, s], [-s, c]])


def box(length: float, width: float) -> np.ndarray:
    """Points all around a box, given by half its sides."""
    at = np.linspace(-1, 1, 41)
    sides = [np.stack([at, np.full(41, s)], axis=1) for s in (-1, 1)]
    return np.concatenate([*sides, *(side[:, ::-1] for side in sides)]) * [length, width]


def offset_of(direction: float, distance: float) -> np.ndarray:
    return distance * np.array([np.cos(direction), np.sin(direction)])


@given(length=half, width=half, direction=angle, by=angle, distance=st.floats(0.005, 0.3), seed=seeds)
def test_pushes_begin_clear_of_the_object_and_lead_through_it(length, width, direction, by, distance, seed):
    outline = turned(box(length, width), by)
    starts, ends = straight_pushes(outline, offset_of(direction, distance), 20, np.random.default_rng(seed))
    gaps = np.linalg.norm(np.maximum(np.abs(turned(starts, -by)) - [length, width], 0), axis=1)
    assert gaps.min() > PUSHER_RADIUS_M + CLEARANCE_M
    along = ends - starts
    lengths = np.linalg.norm(along, axis=1)
    side = np.stack([-along[:, 1], along[:, 0]], axis=1) / lengths[:, None]
    across = outline @ side.T - (starts * side).sum(axis=1)
    assert (across.min(axis=0) < 1e-9).all()
    assert (across.max(axis=0) > -1e-9).all()
    assert (lengths > CLEARANCE_M + 0.6 * distance).all()
    assert (lengths < CLEARANCE_M + 0.005 + 1.15 * distance).all()


# Push proposals


FIELDS = FieldLibrary(None)
HORIZON = 24


@pytest.fixture(scope="module")
def shapes():
    return load_shapes(None, FIELDS, (BOX, CAN, GELATIN))


@pytest.fixture(scope="module")
def model():
    return load_push_model(None, FIELDS, (BOX, CAN, GELATIN))


def all_moved(state, shifts) -> PoseGoal:
    return PoseGoal.of(
        state, {n: Pose(state.pose(n).position + [*d, 0.0], state.pose(n).quaternion) for n, d in shifts.items()}
    )


def test_pushes_go_around_the_object_and_bring_it_nearer_to_its_goal(shapes, model):
    """The pusher stands between the can and its goal: it has to walk around it first."""
    state = scene(shapes, {CAN: (0.05, 0.05), BOX: (-0.2, -0.2)}, pusher=(-0.03, 0.05))
    goal = all_moved(state, {CAN: (-0.15, 0.0)})
    actions = PushProposals(shapes).draw(state, goal, 24, HORIZON, np.random.default_rng(0))
    assert 12 <= len(actions) <= 24
    assert np.abs(actions).max() <= MAX_SPEED_M_S + 1e-9
    futures = model.rollout(state, actions)
    left = np.linalg.norm(futures.positions[:, -1, 0, :2] - goal.poses.position[0, :2], axis=1)
    assert np.median(left) < 0.1
    assert left.min() < 0.03
    early = np.linalg.norm(futures.positions[:, 2, 0, :2] - state.poses.position[0, :2], axis=1)
    assert early.max() < 5e-3  # not the wrong way at first


def test_what_is_there_or_nearly_is_not_pushed_on_purpose(shapes):
    state = scene(shapes, {CAN: (0.0, 0.0), BOX: (0.2, 0.1)}, pusher=(0.0, -0.2))
    draw = PushProposals(shapes).draw
    assert draw(state, PoseGoal.of(state, {}), 8, HORIZON, np.random.default_rng(0)).shape == (0, HORIZON, 3)
    one = draw(state, all_moved(state, {CAN: (0.0, 0.1)}), 6, HORIZON, np.random.default_rng(0))
    goal = all_moved(state, {CAN: (0.0, 0.1), BOX: (0.002, 0.0)})
    np.testing.assert_allclose(draw(state, goal, 6, HORIZON, np.random.default_rng(0)), one, atol=1e-12)


# Push recombination


HANDLE = np.array([-0.03, 0.0])  # of an object: at its left
PLACES = {"a": (-0.1, 0.1), "b": (0.0, -0.1)}
RECOMBINED_STATE = state({name: (*place, 0.01) for name, place in PLACES.items()}, (0, 0, 1), (-0.25, 0.0, 0.06))
GOAL = PoseGoal(
    RECOMBINED_STATE.names,
    Pose(RECOMBINED_STATE.poses.position + [[0.12, 0.0, 0.0], [0.15, 0.0, 0.0]], RECOMBINED_STATE.poses.quaternion),
)


def pulled(actions) -> Rollouts:
    """A world in which objects go straight to the right with a pusher that begins an action at their handles."""
    pusher = RECOMBINED_STATE.pusher + STEP_S * np.pad(np.cumsum(actions, axis=1), ((0, 0), (1, 0), (0, 0)))
    positions = np.broadcast_to(RECOMBINED_STATE.poses.position, (*pusher.shape[:2], 2, 3)).copy()
    for t in range(actions.shape[1]):
        away = np.linalg.norm(positions[:, t, :, :2] + HANDLE - pusher[:, t, None, :2], axis=-1)
        held = (away < 1e-6) & (actions[:, t, None, 0] > 0) & (np.abs(actions[:, t, None, 1]) < 1e-9)
        step = np.where(held[..., None], STEP_S * actions[:, t, None], 0)
        positions[:, t + 1] = positions[:, t] + step * [1, 0, 0]
    quaternions = np.broadcast_to(RECOMBINED_STATE.poses.quaternion, (*positions.shape[:3], 4))
    return Rollouts(RECOMBINED_STATE.names, positions, quaternions, pusher)


def outlines(number: int, pose: Pose):
    return [pose.position[:2] + 0.008 * np.array([[1.0, 1], [-1, 1], [-1, -1], [1, -1]])]


def pulling(*pulls):
    """Actions that pull objects one after another, each by so much [m], stopping at every corner."""
    places, at, parts = ({name: np.array(place) for name, place in PLACES.items()}, RECOMBINED_STATE.pusher[:2], [])
    for name, shift in pulls:
        corners = [at, places[name] + HANDLE, places[name] + HANDLE + [shift, 0.0]]
        for leg in pairwise(corners):
            actions = actions_along(np.array(leg), HORIZON)
            parts.append(actions[actions.any(axis=1)])
        places[name], at = places[name] + [shift, 0.0], corners[-1]
    actions = np.concatenate(parts)
    return np.pad(actions, ((0, HORIZON - len(actions)), (0, 0)))


def test_what_succeeded_in_two_futures_is_done_in_one():
    """Each sequence brings one object to its goal and the other one too far."""
    actions = np.array([pulling(("a", 0.12), ("b", 0.3)), pulling(("b", 0.15), ("a", 0.3))])
    rollouts = pulled(actions)
    found = recombined(rollouts, object_costs(rollouts, GOAL), outlines, 4)
    assert 1 <= len(found) <= 4
    assert np.abs(found).max() <= MAX_SPEED_M_S + 1e-9
    future = pulled(found[:1])
    np.testing.assert_allclose(future.positions[0, -1], GOAL.poses.position, atol=0.01)
    cost = PoseCost(GOAL)
    assert cost(future)[0] < cost(rollouts).min()


def test_a_stage_ends_where_it_has_taken_most_from_the_cost_and_begins_with_what_nothing_moved_before():
    rollouts = pulled(np.array([pulling(("a", 0.24))]))  # twice as far as the goal
    (stage,) = push_stages(rollouts, object_costs(rollouts, GOAL))[0]
    np.testing.assert_allclose(stage.start, np.array(PLACES["a"]) + HANDLE, atol=1e-12)
    np.testing.assert_allclose(stage.end, stage.start + STEP_S * stage.actions[:, :2].sum(axis=0), atol=1e-12)
    np.testing.assert_allclose(stage.pose.position, GOAL.pose("a").position, atol=1e-9)
    assert stage.gain == pytest.approx(0.12)
    rollouts = pulled(np.array([pulling(("a", 0.06), ("b", 0.15), ("a", 0.06))]))
    stages = push_stages(rollouts, object_costs(rollouts, GOAL))
    assert [[stage.gain for stage in stages[n]] for n in (0, 1)] == [[pytest.approx(0.06)], [pytest.approx(0.15)]]


def test_what_brings_nothing_nearer_is_not_recombined():
    rollouts = pulled(np.array([pulling(("a", 0.3)), np.zeros((HORIZON, 3))])[:, :HORIZON])
    here = PoseGoal(RECOMBINED_STATE.names, RECOMBINED_STATE.poses)
    assert push_stages(rollouts, object_costs(rollouts, here)) == {}
    assert recombined(rollouts, object_costs(rollouts, here), outlines, 4).shape == (0, HORIZON, 3)


# Push sequences


PUSHER = np.array([0.0, -0.2])


@pytest.fixture(scope="module")
def pushes(shapes, model):
    return sequences(shapes, model, scene(shapes, {BOX: (0.0, 0.0)}, pusher=PUSHER))


def sequences(shapes, model, state) -> ObjectPushes:
    """Those of the only object of a scene."""
    table = ShapeTable((shapes[state.names[0]],))
    centre = table.centre[0].numpy().astype(float)
    outcomes = push_outcomes(model.rollout, state, centre, list(part_outlines(table, 0, state.poses[0]).astype(float)))
    return ObjectPushes(outcomes, state.poses[0].quaternion, centre)


def turned_pose(pose: Pose, yaw: float, shift=(0.0, 0.0)) -> Pose:
    turn = quaternion_exp(np.array([0.0, 0.0, yaw]))
    return Pose(pose.position + [*shift, 0.0], quaternion_multiply(turn, pose.quaternion))


def test_a_table_serves_as_long_as_the_object_lies_on_the_same_side_and_ways_stay_within_reach(shapes, pushes):
    here = scene(shapes, {BOX: (0.0, 0.0)}, pusher=PUSHER).pose(BOX)
    assert pushes.yaw(turned_pose(here, 0.3)) == pytest.approx(0.3)
    assert pushes.yaw(Pose(here.position, quaternion_exp(np.array([1.0, 0.0, 0.0])))) is None
    pose = turned_pose(here, 0.0, (0.27, 0.27))
    goal, rng = turned_pose(pose, 0.5, (0.0, -0.1)), np.random.default_rng(0)
    ways = list(pushes.draw(pose, goal, pushes, FreeSpace([]), PUSHER, 60, rng))
    assert len(ways) > 20
    assert max(np.abs(way).max() for way in ways) <= PUSHER_REACH_M


def test_an_object_that_is_only_turned_is_turned_back(shapes, pushes, model):
    state = scene(shapes, {BOX: (0.0, 0.0)}, pusher=tuple(PUSHER))
    goal = turned_pose(state.pose(BOX), 0.6)
    ways = list(pushes.draw(state.pose(BOX), goal, pushes, FreeSpace([]), PUSHER, 30, np.random.default_rng(0)))
    actions = np.array([actions_along(np.vstack([PUSHER, way]), 30) for way in ways])
    futures = model.rollout(state, actions)
    turn = rotation_angle(futures.quaternions[:, -1, 0], np.broadcast_to(goal.quaternion, (len(ways), 4)))
    shift = np.linalg.norm(futures.positions[:, -1, 0, :2] - goal.position[:2], axis=1)
    assert (turn + shift / 0.1).min() < 0.25


@pytest.mark.parametrize("yaw", [-0.7, 1.1])
def test_pushes_turn_with_the_scene(shapes, pushes, yaw):
    pose = scene(shapes, {BOX: (0.0, 0.0)}, pusher=PUSHER).pose(BOX)
    goal = turned_pose(pose, 0.4, (0.05, 0.02))
    plain = list(pushes.draw(pose, goal, pushes, FreeSpace([]), PUSHER, 5, np.random.default_rng(0)))
    spin = np.array([[np.cos(yaw), -np.sin(yaw)], [np.sin(yaw), np.cos(yaw)]])
    around = quaternion_exp(np.array([0.0, 0.0, yaw]))
    places = (np.array([*spin @ one.position[:2], one.position[2]]) for one in (pose, goal))
    both = [
        Pose(place, quaternion_multiply(around, one.quaternion))
        for place, one in zip(places, (pose, goal), strict=True)
    ]
    other = list(pushes.draw(*both, pushes, FreeSpace([]), spin @ PUSHER, 5, np.random.default_rng(0)))
    for a, b in zip(plain, other, strict=True):
        np.testing.assert_allclose(a @ spin.T, b, atol=1e-9)


def test_a_can_that_has_rolled_is_rolled_on_to_its_goal(shapes, model):
    """Half a turn of the can and 6 cm; slid there it would be off by 3.1 rad."""
    state = scene(shapes, {CAN: (0.0, 0.0, (np.pi / 2, 0.0, 0.0))}, pusher=PUSHER)
    here, over = state.pose(CAN), quaternion_exp(np.array([0.0, np.pi, 0.0]))
    goal = Pose(here.position + [0.06, 0.0, 0.0], quaternion_multiply(over, here.quaternion))
    there = replace(state, poses=Pose.stacked([goal]))
    own, later = (sequences(shapes, model, state), sequences(shapes, model, there))
    assert own.yaw(goal) is None
    ways = list(own.draw(here, goal, later, FreeSpace([]), PUSHER, 40, np.random.default_rng(0)))
    futures = model.rollout(state, np.array([actions_along(np.vstack([PUSHER, way]), 60) for way in ways]))
    turn = rotation_angle(futures.quaternions[:, -1, 0], np.broadcast_to(goal.quaternion, (len(ways), 4)))
    shift = np.linalg.norm(futures.positions[:, -1, 0, :2] - goal.position[:2], axis=1)
    assert (turn + shift / 0.1).min() < 1.6
