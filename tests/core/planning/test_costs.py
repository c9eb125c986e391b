import numpy as np
import pytest

from osfcore.errors import InvalidInput
from osfcore.fields.field_library import FieldLibrary
from osfcore.geometry.cameras import goal_camera
from osfcore.geometry.light import Light
from osfcore.geometry.poses import Pose, quaternion_exp
from osfcore.geometry.rollouts import Rollouts
from osfcore.geometry.states import SceneState
from osfcore.planning.costs import ImageCost, PoseCost, PoseGoal
from osfcore.render.renderer import SceneRenderer
from osfcore.render.types import SceneBatch
from tests.core.dynamics.scenes import CAN, GELATIN, boxes, scene
from tests.support.errors import about
from tests.support.rendered_scenes import UPRIGHT, state

# Image cost


CAMERA = goal_camera(96)
LIGHT = Light.from_angles(0.5, 1.0)
STEPS = 4


@pytest.fixture(scope="module")
def renderer() -> SceneRenderer:
    fields = FieldLibrary(None)
    return SceneRenderer({name: fields.load(name) for name in (CAN, GELATIN)}, fields.load_table())


@pytest.fixture(scope="module")
def goal() -> SceneState:
    """The fields' frames lie at the middle of things."""
    shapes = {CAN: boxes(((0, 0, 0), (0.03, 0.03, 0.05))), GELATIN: boxes(((0, 0, 0), (0.04, 0.03, 0.015)))}
    state = scene(shapes, {CAN: (0.05, 0.0), GELATIN: (-0.1, 0.08)})
    return SceneState(state.names, state.poses, LIGHT, None)


@pytest.fixture(scope="module")
def cost(renderer, goal) -> ImageCost:
    return ImageCost(renderer, CAMERA, renderer.render(SceneBatch.of(goal), (CAMERA,)).rgb[0, 0], LIGHT)


def futures(goal, shifts) -> Rollouts:
    """One future for each place beside its goal at which the can stays."""
    positions = np.broadcast_to(goal.poses.position, (len(shifts), STEPS + 1, 2, 3)).copy()
    positions[:, :, 0, :2] += np.array(shifts)[:, None]
    quaternions = np.broadcast_to(goal.poses.quaternion, (len(shifts), STEPS + 1, 2, 4))
    return Rollouts(goal.names, positions, quaternions, np.zeros((len(shifts), STEPS + 1, 3)))


@pytest.mark.parametrize("direction", [0.0, 2.0, 4.0])
def test_the_nearer_the_goal_the_cheaper(cost, goal, direction):
    unit = np.array([np.cos(direction), np.sin(direction)])
    costs = cost(futures(goal, [d * unit for d in (0.0, 0.005, 0.01, 0.02, 0.03)]))
    assert (np.diff(costs) > 0).all()
    assert costs[-1] > 2 * costs[0]


def test_costs_are_those_of_each_future_alone_summed_over_the_horizon_without_the_pusher(cost, goal):
    both = futures(goal, [(0.02, 0.01), (0.0, 0.01)])
    half = Rollouts(both.names, both.positions[:, :3], both.quaternions[:, :3], both.pusher[:, :3] + 0.1)
    np.testing.assert_allclose(cost(both), 2 * cost(half))
    np.testing.assert_allclose([cost(both[k])[0] for k in range(2)], cost(both))


# Pose cost


STATE = state({"a": (0.1, 0.0, 0.02), "b": (-0.1, 0.05, 0.03)}, (0, 0, 1), (0, 0, 0.06))
THERE = Pose(np.array([0.1, 0.2, 0.02]), np.array(UPRIGHT))


def futures_by_pose(*last, turn: float = 0.0, steps: int = 3) -> Rollouts:
    """One future for each place that object a comes to at once and stays at."""
    positions = np.broadcast_to(STATE.poses.position, (len(last), steps + 1, 2, 3)).copy()
    positions[:, 1:, 0, :2] = np.array(last)[:, None]
    quaternions = np.broadcast_to(STATE.poses.quaternion, (len(last), steps + 1, 2, 4)).copy()
    quaternions[:, 1:, 0] = quaternion_exp(np.array([0, 0, turn]))
    return Rollouts(STATE.names, positions, quaternions, np.zeros((len(last), steps + 1, 3)))


def test_a_goal_moves_some_objects_of_a_scene_and_leaves_the_rest():
    goal = PoseGoal.of(STATE, {"a": THERE})
    np.testing.assert_allclose(goal.offsets_m(STATE), [[0, 0.2], [0, 0]], atol=1e-12)
    other = SceneState(("b", "a"), STATE.poses[[1, 0]], STATE.light, STATE.pusher)
    np.testing.assert_allclose(goal.offsets_m(other), [[0, 0], [0, 0.2]], atol=1e-12)
    np.testing.assert_array_equal(goal.replaced({}).poses.matrix(), [THERE.matrix(), STATE.pose("b").matrix()])
    with pytest.raises(InvalidInput, check=about("object of the goal")):
        PoseGoal.of(STATE, {"teapot": THERE})


def test_cost_is_the_distance_on_the_way_and_twice_at_the_end():
    cost = PoseCost(PoseGoal.of(STATE, {"a": THERE}))(futures_by_pose((0.1, 0.0), (0.1, 0.1), (0.4, 0.2)))
    np.testing.assert_allclose(cost, [0.6, 0.3, 0.9], atol=1e-12)


@pytest.mark.parametrize(("turn", "counted"), [(0.3, 0.3), (-1.1, 1.1), (np.pi, np.pi), (1.5 * np.pi, 0.5 * np.pi)])
def test_rotations_count_by_an_arm(turn, counted):
    goal = PoseGoal.of(STATE, {"a": THERE})
    assert PoseCost(goal, 0.05)(futures_by_pose((0.1, 0.2), turn=turn)) == pytest.approx(3 * 0.05 * counted)
    assert PoseCost(goal, 0.0)(futures_by_pose((0.1, 0.2), turn=turn)) == pytest.approx(0)
    rollouts = futures_by_pose((0.15, 0.1), turn=turn)
    swapped = Rollouts(("b", "a"), rollouts.positions[:, :, ::-1], rollouts.quaternions[:, :, ::-1], rollouts.pusher)
    np.testing.assert_allclose(PoseCost(goal)(swapped), PoseCost(goal)(rollouts))
