from dataclasses import replace

import numpy as np
import pytest

from osfcore.dynamics.rollout import load_push_model, load_shapes
from osfcore.dynamics.shapes import ShapeTable, part_outlines
from osfcore.fields.field_library import FieldLibrary
from osfcore.geometry.poses import Pose, quaternion_exp, quaternion_multiply, rotation_angle
from osfcore.geometry.workspace import PUSHER_REACH_M
from osfcore.planning.paths import FreeSpace, actions_along
from osfcore.planning.pushes import ObjectPushes, around_loop, push_outcomes
from tests.core.dynamics.scenes import BOX, CAN, scene

FIELDS = FieldLibrary(None)
PUSHER = np.array([0.0, -0.2])


@pytest.fixture(scope="module")
def shapes():
    return load_shapes(None, FIELDS, (BOX, CAN))


@pytest.fixture(scope="module")
def model():
    return load_push_model(None, FIELDS, (BOX, CAN))


@pytest.fixture(scope="module")
def pushes(shapes, model):
    return sequences(shapes, model, scene(shapes, {BOX: (0.0, 0.0)}, pusher=PUSHER))


def sequences(shapes, model, state) -> ObjectPushes:
    """Those of the only object of a scene."""
    table = ShapeTable((shapes[state.names[0]],))
    centre = table.centre[0].numpy().astype(float)
    outcomes = push_outcomes(model.rollout, state, centre, list(part_outlines(table, 0, state.poses[0]).astype(float)))
    return ObjectPushes(outcomes, state.poses[0].quaternion, centre)


def turned(pose: Pose, yaw: float, shift=(0.0, 0.0)) -> Pose:
    turn = quaternion_exp(np.array([0.0, 0.0, yaw]))
    return Pose(pose.position + [*shift, 0.0], quaternion_multiply(turn, pose.quaternion))


def test_an_object_that_is_only_turned_is_turned_back(shapes, pushes, model):
    state = scene(shapes, {BOX: (0.0, 0.0)}, pusher=tuple(PUSHER))
    goal = turned(state.pose(BOX), 0.6)
    ways = list(pushes.draw(state.pose(BOX), goal, pushes, FreeSpace([]), PUSHER, 30, np.random.default_rng(0)))
    actions = np.array([actions_along(np.vstack([PUSHER, way]), 30) for way in ways])
    futures = model.rollout(state, actions)
    turn = rotation_angle(futures.quaternions[:, -1, 0], np.broadcast_to(goal.quaternion, (len(ways), 4)))
    shift = np.linalg.norm(futures.positions[:, -1, 0, :2] - goal.position[:2], axis=1)
    assert (turn + shift / 0.1).min() < 0.25


def test_ways_stay_within_the_reach_of_the_pusher(shapes, pushes):
    pose = turned(scene(shapes, {BOX: (0.0, 0.0)}, pusher=PUSHER).pose(BOX), 0.0, (0.27, 0.27))
    goal = turned(pose, 0.5, (0.0, -0.1))
    ways = list(pushes.draw(pose, goal, pushes, FreeSpace([]), PUSHER, 60, np.random.default_rng(0)))
    assert len(ways) > 20
    assert max(np.abs(way).max() for way in ways) <= PUSHER_REACH_M


@pytest.mark.parametrize("yaw", [-0.7, 1.1])
def test_pushes_turn_with_the_scene(shapes, pushes, yaw):
    pose = scene(shapes, {BOX: (0.0, 0.0)}, pusher=PUSHER).pose(BOX)
    goal = turned(pose, 0.4, (0.05, 0.02))
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


def test_the_shorter_way_is_taken_around_an_object():
    angles = 2 * np.pi * np.arange(36) / 36
    loop = np.stack([np.cos(angles), np.sin(angles)], axis=1)
    way = around_loop(loop, loop[3] * 0.9, loop[30] * 1.1)
    np.testing.assert_allclose(way, loop[[3, 2, 1, 0, 35, 34, 33, 32, 31, 30]], atol=1e-12)


def test_a_can_that_has_rolled_is_rolled_on_to_its_goal(shapes, model):
    """Half a turn of the can and 6 cm; slid there it would be off by 3.1 rad."""
    state = scene(shapes, {CAN: (0.0, 0.0, (np.pi / 2, 0.0, 0.0))}, pusher=PUSHER)
    here, over = state.pose(CAN), quaternion_exp(np.array([0.0, np.pi, 0.0]))
    goal = Pose(here.position + [0.06, 0.0, 0.0], quaternion_multiply(over, here.quaternion))
    there = replace(state, poses=Pose.stacked([goal]))
    own, later = sequences(shapes, model, state), sequences(shapes, model, there)
    assert own.yaw(goal) is None
    ways = list(own.draw(here, goal, later, FreeSpace([]), PUSHER, 40, np.random.default_rng(0)))
    futures = model.rollout(state, np.array([actions_along(np.vstack([PUSHER, way]), 60) for way in ways]))
    turn = rotation_angle(futures.quaternions[:, -1, 0], np.broadcast_to(goal.quaternion, (len(ways), 4)))
    shift = np.linalg.norm(futures.positions[:, -1, 0, :2] - goal.position[:2], axis=1)
    assert (turn + shift / 0.1).min() < 1.6


def test_what_lies_on_another_side_needs_another_table(pushes, shapes):
    here = scene(shapes, {BOX: (0.0, 0.0)}, pusher=PUSHER).pose(BOX)
    assert pushes.yaw(turned(here, 0.3)) == pytest.approx(0.3)
    assert pushes.yaw(Pose(here.position, quaternion_exp(np.array([1.0, 0.0, 0.0])))) is None


def test_a_can_on_its_side_is_slid_across_its_axis_rather_than_rolled(shapes, model):
    """Rolled straight to its goal it would turn by 3.6 rad."""
    lying = scene(shapes, {CAN: (0.0, 0.0, (np.pi / 2, 0.0, 0.0))}, pusher=PUSHER)
    goal = turned(lying.pose(CAN), 0.0, (0.12, 0.0))
    own = sequences(shapes, model, lying)
    ways = list(own.draw(lying.pose(CAN), goal, own, FreeSpace([]), PUSHER, 40, np.random.default_rng(0)))
    futures = model.rollout(lying, np.array([actions_along(np.vstack([PUSHER, way]), 50) for way in ways]))
    turn = rotation_angle(futures.quaternions[:, -1, 0], np.broadcast_to(goal.quaternion, (len(ways), 4)))
    shift = np.linalg.norm(futures.positions[:, -1, 0, :2] - goal.position[:2], axis=1)
    assert (turn + shift / 0.1).min() < 0.5
