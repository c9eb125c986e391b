import numpy as np
import pytest

from osfcore.dynamics.library import load_push_model, load_shapes
from osfcore.fields.library import FieldLibrary
from osfcore.plan.goals import PoseGoal
from osfcore.plan.proposals import Proposals
from osfcore.poses import Pose
from osfcore.scene import MAX_SPEED_M_S, PUSHER_RADIUS_M, PUSHER_REACH_M, STEP_S
from tests.core.dynamics.scenes import BOX, CAN, scene

FIELDS = FieldLibrary(None)
HORIZON = 24


@pytest.fixture(scope="module")
def shapes():
    return load_shapes(None, FIELDS, (BOX, CAN))


@pytest.fixture(scope="module")
def model():
    return load_push_model(None, FIELDS, (BOX, CAN))


def moved(state, name: str, shift) -> PoseGoal:
    pose = state.pose(name)
    return PoseGoal.of(state, {name: Pose(pose.position + [*shift, 0.0], pose.quaternion)})


def test_pushes_go_around_the_object_and_bring_it_nearer_to_its_goal(shapes, model):
    """The pusher stands between the can and its goal: it has to walk around it first."""
    state = scene(shapes, {CAN: (0.05, 0.05), BOX: (-0.2, -0.2)}, pusher=(-0.03, 0.05))
    goal = moved(state, CAN, (-0.15, 0.0))
    actions = Proposals(shapes).draw(state, goal, 24, HORIZON, np.random.default_rng(0))
    assert 12 <= len(actions) <= 24
    assert np.abs(actions).max() <= MAX_SPEED_M_S + 1e-9
    futures = model.rollout(state, actions)
    left = np.linalg.norm(futures.positions[:, -1, 0, :2] - goal.poses.position[0, :2], axis=1)
    assert np.median(left) < 0.1
    assert left.min() < 0.03
    early = np.linalg.norm(futures.positions[:, 2, 0, :2] - state.poses.position[0, :2], axis=1)
    assert early.max() < 1e-3  # not the wrong way at first


def test_pushes_start_behind_the_object_and_lead_past_it(shapes):
    state = scene(shapes, {CAN: (0.0, 0.0)}, pusher=(0.0, -0.2))
    actions = Proposals(shapes).draw(state, moved(state, CAN, (0.0, 0.1)), 16, HORIZON, np.random.default_rng(1))
    path = np.array([0.0, -0.2]) + STEP_S * np.cumsum(actions[..., :2], axis=1)
    radius = float(shapes[CAN].half_extents[:2].mean())
    assert np.abs(path).max() <= PUSHER_REACH_M + 1e-9
    assert (path[:, -1, 1] > -radius - PUSHER_RADIUS_M + 0.03).all()


def test_what_is_where_it_should_be_is_left_alone(shapes):
    state = scene(shapes, {CAN: (0.0, 0.0), BOX: (0.2, 0.1)}, pusher=(0.0, -0.2))
    goal = PoseGoal.of(state, {})
    assert Proposals(shapes).draw(state, goal, 8, HORIZON, np.random.default_rng(0)).shape == (0, HORIZON, 3)


def test_where_there_is_no_room_for_the_pusher_nothing_is_proposed(shapes):
    state = scene(shapes, {CAN: (0.33, 0.0)}, pusher=(0.0, 0.0))
    goal = moved(state, CAN, (-0.1, 0.0))
    assert len(Proposals(shapes).draw(state, goal, 8, HORIZON, np.random.default_rng(0))) == 0


def test_the_same_draws_give_the_same_pushes(shapes):
    state = scene(shapes, {CAN: (0.0, 0.0)}, pusher=(0.0, -0.2))
    goal = moved(state, CAN, (0.0, 0.1))
    a, b = (Proposals(shapes).draw(state, goal, 8, HORIZON, np.random.default_rng(3)) for _ in range(2))
    np.testing.assert_array_equal(a, b)
