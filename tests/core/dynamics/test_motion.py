"""Motion: motion, limit surface, pusher path, recorded states."""

import math
from dataclasses import replace

import numpy as np
import pytest
import torch
from hypothesis import assume, given
from hypothesis import strategies as st

from osfcore.dynamics.motion import (
    FRICTION,
    SLEEP_M,
    SLEEP_RAD,
    SUBSTEPS,
    Motion,
    going_on,
    headings,
    is_on_table,
    lowest_point,
    push_motion,
    pusher_path,
    sleeping,
    substates,
)
from osfcore.geometry import torch_rotations as rotations
from osfcore.geometry.poses import quaternion_exp, rotate
from osfcore.geometry.workspace import PUSHER_REACH_M, STEP_S
from osfcore.world.collect_pushes import SUBSTATES
from osfcore.world.scenes import SceneRequest
from osfcore.world.tabletop import Tabletop
from tests.core.dynamics.scenes import CAN, GELATIN, NAMES, crowd, episode, hull, scene, start

# Motion


def still(count: int = 2, scenes: int = 1) -> Motion:
    zero = torch.zeros(scenes, count, 3)
    quaternion = torch.tensor([1.0, 0, 0, 0]).expand(scenes, count, 4)
    return Motion(zero, quaternion, zero, zero, torch.zeros(scenes, 2), torch.zeros(scenes, count))


@pytest.mark.parametrize("number", range(2))
def test_lowest_point_stands_on_the_table_it_was_put_on(shapes, table, number):
    points = hull(shapes[NAMES[number]])
    q = quaternion_exp(np.random.default_rng(number).normal(size=(50, 3)))
    low = np.array([rotate(one, points)[:, 2].min() for one in q])
    centre = np.zeros((50, 3))
    centre[:, 2] = 0.01 - low
    where = (torch.as_tensor(array, dtype=torch.float32) for array in (centre, q))
    heights = lowest_point(table, torch.full((50,), number), *where)
    assert heights.min() > 0.01 - 1e-6  # of a point of the object
    assert heights.median() < 0.01 + 3e-4


def test_the_heading_is_that_of_the_velocity_or_of_the_fastest_object():
    velocity = torch.tensor([[0.3, 0.0], [0.0, -0.2], [-0.06, 0.08]])
    found = headings(velocity, still(scenes=3))
    torch.testing.assert_close(found, torch.tensor([[1.0, 0], [0, -1], [-0.6, 0.8]]))
    motion = still(3)._replace(linear=torch.tensor([[[0.001, 0, 0.0], [0.0, -0.003, 0.1], [0.0, 0, 0.5]]]))
    torch.testing.assert_close(headings(torch.zeros(1, 2), motion), torch.tensor([[0.0, -1.0]]))
    torch.testing.assert_close(headings(torch.zeros(1, 2), still()).norm(dim=1), torch.ones(1))


@pytest.mark.parametrize("axis", range(3))
def test_only_what_hardly_moves_rests(axis):
    for share in (0.99, 1.01):
        linear, angular = torch.zeros(1, 3, 3), torch.zeros(1, 3, 3)
        linear[0, 0, axis], angular[0, 1, axis] = share * SLEEP_M, share * SLEEP_RAD
        linear[0, 2, axis], angular[0, 2, axis] = 2 * SLEEP_M, 0.1 * SLEEP_RAD
        rested = sleeping(still(3)._replace(linear=linear, angular=angular))
        kept = float(share > 1)
        torch.testing.assert_close(rested.linear[0, 0], kept * linear[0, 0])
        torch.testing.assert_close(rested.angular[0, 1], kept * angular[0, 1])
        torch.testing.assert_close(rested.linear[0, 2], linear[0, 2])  # what moves keeps its slow turn
        torch.testing.assert_close(rested.angular[0, 2], angular[0, 2])


def test_velocities_are_means_over_the_action_before(shapes, table):
    _, now = start(table, shapes, crowd(shapes))
    turn = torch.tensor([0.0, 0.0, -0.4])
    before = now._replace(
        centre=now.centre - torch.tensor([0.02, 0.0, 0.0]),
        quaternion=rotations.multiply(rotations.exponential(turn).expand_as(now.quaternion), now.quaternion),
    )
    moving = going_on(before, now)
    torch.testing.assert_close(moving.linear, torch.tensor([0.005, 0.0, 0.0]).expand_as(now.linear), atol=1e-6, rtol=0)
    torch.testing.assert_close(moving.angular, -turn.expand_as(now.angular) / 4, atol=1e-6, rtol=0)
    assert torch.equal(moving.centre, now.centre)
    still = going_on(now._replace(centre=now.centre + 1e-4), now)
    assert not still.linear.any()
    assert not still.angular.any()


# Limit surface


angles = st.floats(-3.1, 3.1)
offsets = st.floats(-0.06, 0.06)
depths = st.floats(1e-5, 0.01)
arms = st.floats(0.01, 0.06)
drags = st.floats(-0.01, 0.01)


def push(point, inward, depth, shift, arm) -> torch.Tensor:
    rows = [torch.tensor([v], dtype=torch.float64) for v in (point, inward, depth, shift, arm)]
    return push_motion(*rows)[0]


def contact_motion(way, point) -> torch.Tensor:
    return way[:2] + way[2] * torch.tensor([-point[1], point[0]])


@given(angle=angles, distance=st.floats(0.01, 0.06), depth=depths, arm=arms)
def test_through_the_centre_it_moves_by_the_depth_and_does_not_turn(angle, distance, depth, arm):
    inward = (math.cos(angle), math.sin(angle))
    point = (-distance * inward[0], -distance * inward[1])
    assert not push(point, inward, -depth, (0.0, 0.0), arm).any()  # it is not touched
    way = push(point, inward, depth, (0.0, 0.0), arm)
    torch.testing.assert_close(way[:2], depth * torch.tensor(inward, dtype=torch.float64), atol=1e-12, rtol=1e-9)
    assert abs(way[2]) < 1e-9


@given(point=st.tuples(offsets, offsets), angle=angles, depth=depths, arm=arms, drag=drags)
def test_the_contact_gives_way_by_the_depth_whatever_slides(point, angle, depth, arm, drag):
    """After a slide, nothing penetrates: the contact has moved along its normal as far as it had to."""
    inward = torch.tensor([math.cos(angle), math.sin(angle)], dtype=torch.float64)
    tangent = torch.tensor([-inward[1], inward[0]])
    assume(float(inward @ torch.tensor(point, dtype=torch.float64)) < 0)  # a contact lies before its object
    assume(abs(float(tangent @ torch.tensor(point, dtype=torch.float64))) < 3 * arm)
    way = push(point, inward.tolist(), depth, (drag * tangent).tolist(), arm)
    assert float(contact_motion(way, point) @ inward) == pytest.approx(depth, rel=1e-6)


@given(point=st.tuples(offsets, offsets), angle=angles, depth=depths, arm=arms, drag=drags)
def test_the_force_stays_within_the_friction_cone_and_on_the_limit_surface(point, angle, depth, arm, drag):
    """Force and displacement are parallel here: the displacement may lean by the angle of friction at most, and turns
    by the force's moment about the centre over the arm squared."""
    inward = torch.tensor([math.cos(angle), math.sin(angle)], dtype=torch.float64)
    tangent = torch.tensor([-inward[1], inward[0]])
    way = push(point, inward.tolist(), depth, (drag * tangent).tolist(), arm)
    normal, side = float(way[:2] @ inward), float(way[:2] @ tangent)
    assert normal > 0
    assert abs(side) <= FRICTION * normal * (1 + 1e-6)
    moment = point[0] * float(way[1]) - point[1] * float(way[0])
    assert float(way[2]) == pytest.approx(moment / arm**2, rel=1e-5, abs=1e-9)


@given(point=st.tuples(offsets, offsets), depth=depths, arm=arms, drag=st.floats(-1, 1))
def test_within_the_cone_the_contact_sticks_to_what_pushes(point, depth, arm, drag):
    shift = (depth, drag * depth)
    way = push(point, (1.0, 0.0), depth, shift, arm)
    if abs(float(way[1])) < FRICTION * float(way[0]) * (1 - 1e-9):
        torch.testing.assert_close(contact_motion(way, point), torch.tensor(shift, dtype=torch.float64))


# Pusher path


speeds = st.lists(st.tuples(st.floats(-0.3, 0.3), st.floats(-0.3, 0.3)), min_size=1, max_size=20)
starts = st.tuples(st.floats(-PUSHER_REACH_M, PUSHER_REACH_M), st.floats(-PUSHER_REACH_M, PUSHER_REACH_M))


@given(start=starts, velocity=speeds)
def test_it_goes_where_it_is_told_and_never_beyond_its_reach(start, velocity):
    velocity = np.array(velocity)
    path = pusher_path(np.array(start), velocity)
    assert path.shape == (SUBSTEPS * len(velocity) + 1, 2)
    np.testing.assert_array_equal(path[0], start)
    assert np.all(np.abs(path) <= PUSHER_REACH_M)
    asked = np.repeat(velocity, SUBSTEPS, axis=0) * STEP_S / SUBSTEPS
    went = np.diff(path, axis=0)
    inside = np.abs(path[1:]) < PUSHER_REACH_M  # per axis: it slides along the border
    np.testing.assert_allclose(went[inside], asked[inside], atol=1e-12)
    assert np.all(np.abs(went) <= np.abs(asked) + 1e-12)


def test_who_stands_outside_is_not_drawn_in_but_goes_no_farther():
    starts = np.array([[0.4, 0.0], [0.0, 0.0]])
    velocity = np.array([[[0.3, 0.0], [-0.3, 0.0]], [[0.1, 0.2], [0.0, 0.0]]])
    paths = pusher_path(starts, velocity)
    np.testing.assert_allclose(paths[0, : SUBSTEPS + 1, 0], 0.4, atol=1e-12)
    assert paths[0, -1, 0] == pytest.approx(0.34)
    np.testing.assert_array_equal(paths[1], pusher_path(starts[1], velocity[1]))


def test_it_is_the_way_of_the_simulated_pusher(library):
    world = Tabletop(library, request=SceneRequest(names=("009_gelatin_box",)))
    world.arrange(0)
    first = world.truth().pusher
    velocity = np.random.default_rng(2).uniform(-0.3, 0.3, (12, 2))
    velocity[5:9] = [0.3, 0.1]  # to the border and along it
    places = [first]
    for action in velocity:
        world.act(np.array([*action, 0.0]))
        places.append(world.truth().pusher)
    world.close()
    path = pusher_path(first[:2], velocity)[::SUBSTEPS]
    np.testing.assert_allclose(path, np.array(places)[:, :2], atol=1e-6)


# Recorded states


@pytest.fixture(scope="module")
def pushed(shapes):
    return episode(shapes, scene(shapes, {CAN: (0.06, 0.0), GELATIN: (0.2, 0.1)}), np.tile([0.2, 0.0, 0.0], (3, 1)))


def test_poses_come_substep_by_substep(pushed):
    assert SUBSTEPS == SUBSTATES
    poses = substates(pushed)
    assert poses.position.shape == (3 * SUBSTEPS + 1, 2, 3)
    np.testing.assert_array_equal(poses.position[::SUBSTEPS], pushed.positions)
    np.testing.assert_array_equal(poses.quaternion[::SUBSTEPS], pushed.quaternions)


@pytest.mark.parametrize(("place", "stays"), [((0.54, 0, 0.05), True), ((0.56, 0, 0.05), False),
                                              ((0, -0.56, 0.05), False), ((0, 0, -0.1), False)])  # fmt: skip
def test_what_nears_the_edge_or_fell_is_not_on_the_table(pushed, place, stays):
    positions = pushed.positions.copy()
    positions[2, 1] = place
    assert is_on_table(replace(pushed, positions=positions)).tolist() == [True, True, stays, True]
