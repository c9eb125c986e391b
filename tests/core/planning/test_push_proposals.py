from itertools import permutations

import numpy as np
import pytest

from osfcore.dynamics.rollout import load_push_model, load_shapes
from osfcore.fields.field_library import FieldLibrary
from osfcore.geometry.poses import Pose, quaternion_exp, quaternion_multiply, rotation_angle
from osfcore.geometry.workspace import MAX_SPEED_M_S, PUSHER_RADIUS_M, PUSHER_REACH_M, STEP_S
from osfcore.planning.costs import PoseGoal
from osfcore.planning.pushes import PushProposals
from tests.core.dynamics.scenes import BOX, CAN, GELATIN, boxes, scene

FIELDS = FieldLibrary(None)
HORIZON = 24


@pytest.fixture(scope="module")
def shapes():
    return load_shapes(None, FIELDS, (BOX, CAN, GELATIN))


@pytest.fixture(scope="module")
def model():
    return load_push_model(None, FIELDS, (BOX, CAN, GELATIN))


def moved(state, name: str, shift) -> PoseGoal:
    return all_moved(state, {name: shift})


def all_moved(state, shifts) -> PoseGoal:
    return PoseGoal.of(
        state, {n: Pose(state.pose(n).position + [*d, 0.0], state.pose(n).quaternion) for n, d in shifts.items()}
    )


def test_pushes_go_around_the_object_and_bring_it_nearer_to_its_goal(shapes, model):
    """The pusher stands between the can and its goal: it has to walk around it first."""
    state = scene(shapes, {CAN: (0.05, 0.05), BOX: (-0.2, -0.2)}, pusher=(-0.03, 0.05))
    goal = moved(state, CAN, (-0.15, 0.0))
    actions = PushProposals(shapes).draw(state, goal, 24, HORIZON, np.random.default_rng(0))
    assert 12 <= len(actions) <= 24
    assert np.abs(actions).max() <= MAX_SPEED_M_S + 1e-9
    futures = model.rollout(state, actions)
    left = np.linalg.norm(futures.positions[:, -1, 0, :2] - goal.poses.position[0, :2], axis=1)
    assert np.median(left) < 0.1
    assert left.min() < 0.03
    early = np.linalg.norm(futures.positions[:, 2, 0, :2] - state.poses.position[0, :2], axis=1)
    assert early.max() < 5e-3  # not the wrong way at first


def test_pushes_start_behind_the_object_and_lead_past_it(shapes):
    state = scene(shapes, {CAN: (0.0, 0.0)}, pusher=(0.0, -0.2))
    actions = PushProposals(shapes).draw(state, moved(state, CAN, (0.0, 0.1)), 16, HORIZON, np.random.default_rng(1))
    path = np.array([0.0, -0.2]) + STEP_S * np.cumsum(actions[..., :2], axis=1)
    radius = float(shapes[CAN].half_extents[:2].mean())
    assert np.abs(path).max() <= PUSHER_REACH_M + 1e-9
    assert (path[:, -1, 1] > -radius - PUSHER_RADIUS_M + 0.03).all()


def test_what_is_where_it_should_be_is_left_alone(shapes):
    state = scene(shapes, {CAN: (0.0, 0.0), BOX: (0.2, 0.1)}, pusher=(0.0, -0.2))
    goal = PoseGoal.of(state, {})
    assert PushProposals(shapes).draw(state, goal, 8, HORIZON, np.random.default_rng(0)).shape == (0, HORIZON, 3)


def test_where_there_is_no_room_for_the_pusher_nothing_is_proposed():
    beside, across = ((boxes(((0.0, 0.0, 0.0), size))) for size in ((0.02, 0.07, 0.02), (0.07, 0.02, 0.02)))
    walled = {"a": boxes(((0.0, 0.0, 0.0), (0.02, 0.02, 0.02))), "b": beside, "c": beside, "d": across, "e": across}
    places = {"a": (0.0, 0.0), "b": (0.045, 0.0), "c": (-0.045, 0.0), "d": (0.0, 0.045), "e": (0.0, -0.045)}
    state = scene(walled, places, pusher=(0.2, 0.2))
    goal = moved(state, "a", (-0.2, 0.0))
    assert len(PushProposals(walled).draw(state, goal, 8, HORIZON, np.random.default_rng(0))) == 0


def test_what_is_in_place_but_turned_is_turned_back(shapes, model):
    state = scene(shapes, {BOX: (0.0, 0.0)}, pusher=(0.0, -0.2))
    here = state.pose(BOX)
    turn = quaternion_exp(np.array([0.0, 0.0, 0.5]))
    goal = PoseGoal.of(state, {BOX: Pose(here.position, quaternion_multiply(turn, here.quaternion))})
    actions = PushProposals(shapes, model.rollout).draw(state, goal, 40, 30, np.random.default_rng(0))
    futures = model.rollout(state, actions)
    left = rotation_angle(futures.quaternions[:, -1, 0], np.broadcast_to(goal.poses.quaternion[0], (len(actions), 4)))
    shift = np.linalg.norm(futures.positions[:, -1, 0, :2] - here.position[:2], axis=1)
    assert left[shift < 0.03].min() < 0.2


def test_the_same_draws_give_the_same_pushes(shapes):
    state = scene(shapes, {CAN: (0.0, 0.0)}, pusher=(0.0, -0.2))
    goal = moved(state, CAN, (0.0, 0.1))
    a, b = (PushProposals(shapes).draw(state, goal, 8, HORIZON, np.random.default_rng(3)) for _ in range(2))
    np.testing.assert_array_equal(a, b)


def test_a_chain_of_pushes_brings_two_objects_nearer_in_either_order(shapes, model):
    state = scene(shapes, {CAN: (0.05, 0.05), BOX: (-0.1, -0.1)}, pusher=(0.0, 0.0))
    goal = all_moved(state, {CAN: (-0.02, 0.13), BOX: (0.1, -0.06)})
    actions = PushProposals(shapes).draw(state, goal, 16, 32, np.random.default_rng(0))
    futures = model.rollout(state, actions)
    off = np.linalg.norm(futures.positions[..., :2] - goal.poses.position[:, :2], axis=-1)  # K x T1 x 2
    assert (off[:, -1] / off[:, 0]).max(axis=1).min() < 0.5
    first = (np.abs(off - off[:, :1]) > 0.01).argmax(axis=1).argmin(axis=1)
    assert set(first.tolist()) == {0, 1}


def test_of_two_that_swap_places_some_sequence_brings_both_nearer_in_the_end(shapes, model):
    state = scene(shapes, {CAN: (-0.08, 0.0), GELATIN: (0.08, 0.0)}, pusher=(0.0, -0.2))
    goal = all_moved(state, {CAN: (0.16, 0.0), GELATIN: (-0.16, 0.0)})
    actions = PushProposals(shapes, model.rollout).draw(state, goal, 60, 60, np.random.default_rng(0))
    futures = model.rollout(state, actions)
    off = np.linalg.norm(futures.positions[:, -1, :, :2] - goal.poses.position[:, :2], axis=-1)
    assert off.max(axis=1).min() < 0.08


def test_objects_are_pushed_in_all_orders():
    cubes = {name: boxes(((0.0, 0.0, 0.0), (0.02, 0.02, 0.02))) for name in "abc"}
    places = {"a": (-0.2, 0.1), "b": (0.0, 0.1), "c": (0.2, 0.1)}
    state = scene(cubes, places, pusher=(0.0, -0.2))
    goal = all_moved(state, dict.fromkeys("abc", (0.0, 0.1)))
    actions = PushProposals(cubes).draw(state, goal, 12, 80, np.random.default_rng(0))
    assert actions.shape == (12, 80, 3)
    corners = state.pusher[:2] + STEP_S * np.cumsum(np.pad(actions[..., :2], ((0, 0), (1, 0), (0, 0))), axis=1)
    times = np.linspace(0, 80, 4001)
    seen = set()
    for corner in corners:
        path = np.stack([np.interp(times, np.arange(81), corner[:, axis]) for axis in range(2)], axis=1)
        gaps = [np.linalg.norm(np.maximum(np.abs(path - place) - 0.02, 0), axis=1) for place in places.values()]
        touched = [gap < PUSHER_RADIUS_M for gap in gaps]
        assert all(touch.any() for touch in touched)
        seen.add(tuple(np.argsort([touch.argmax() for touch in touched]).tolist()))
    assert seen == set(permutations(range(3)))


def test_what_is_nearly_there_is_not_pushed_on_purpose(shapes):
    state = scene(shapes, {CAN: (0.0, 0.0), BOX: (0.2, 0.1)}, pusher=(0.0, -0.2))
    draw = PushProposals(shapes).draw
    one = draw(state, moved(state, CAN, (0.0, 0.1)), 6, HORIZON, np.random.default_rng(0))
    goal = all_moved(state, {CAN: (0.0, 0.1), BOX: (0.002, 0.0)})
    np.testing.assert_allclose(draw(state, goal, 6, HORIZON, np.random.default_rng(0)), one, atol=1e-12)
