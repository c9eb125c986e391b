import numpy as np
import pytest

from osfcore.errors import InvalidInput
from osfcore.geometry.light import Light
from osfcore.geometry.poses import Pose, quaternion_exp
from osfcore.geometry.rollouts import Rollouts
from osfcore.geometry.states import SceneState
from osfcore.planning.costs import PoseCost, PoseGoal

UPRIGHT = np.array([1.0, 0, 0, 0])
STATE = SceneState(
    ("a", "b"),
    Pose(np.array([[0.1, 0.0, 0.02], [-0.1, 0.05, 0.03]]), np.stack([UPRIGHT, UPRIGHT])),
    Light(np.array([0.0, 0, 1])),
    np.array([0.0, 0.0, 0.06]),
)
THERE = Pose(np.array([0.1, 0.2, 0.02]), UPRIGHT)


def futures(*last, turn: float = 0.0, steps: int = 3) -> Rollouts:
    """One future for each place that object a comes to at once and stays at."""
    positions = np.broadcast_to(STATE.poses.position, (len(last), steps + 1, 2, 3)).copy()
    positions[:, 1:, 0, :2] = np.array(last)[:, None]
    quaternions = np.broadcast_to(STATE.poses.quaternion, (len(last), steps + 1, 2, 4)).copy()
    quaternions[:, 1:, 0] = quaternion_exp(np.array([0, 0, turn]))
    return Rollouts(STATE.names, positions, quaternions, np.zeros((len(last), steps + 1, 3)))


def test_what_is_not_moved_is_to_stay():
    goal = PoseGoal.of(STATE, {"a": THERE})
    np.testing.assert_allclose(goal.offsets_m(STATE), [[0, 0.2], [0, 0]], atol=1e-12)
    other = SceneState(("b", "a"), STATE.poses[[1, 0]], STATE.light, STATE.pusher)
    np.testing.assert_allclose(goal.offsets_m(other), [[0, 0], [0, 0.2]], atol=1e-12)


def test_an_object_that_is_not_there_is_told():
    with pytest.raises(InvalidInput, match="teapot"):
        PoseGoal.of(STATE, {"teapot": THERE})


def test_each_object_has_its_goal():
    goal = PoseGoal.of(STATE, {"a": THERE})
    np.testing.assert_array_equal(goal.pose("a").matrix(), THERE.matrix())
    np.testing.assert_array_equal(goal.pose("b").matrix(), STATE.pose("b").matrix())


def test_a_replaced_goal_is_another_one_with_the_rest_as_it_was():
    goal = PoseGoal.of(STATE, {"a": THERE})
    turned = Pose(np.array([-0.2, 0.0, 0.03]), quaternion_exp(np.array([0, 0, 1.0])))
    other = goal.replaced({"b": turned})
    assert other.names == goal.names
    np.testing.assert_array_equal(other.poses.matrix(), [THERE.matrix(), turned.matrix()])
    np.testing.assert_array_equal(goal.pose("b").matrix(), STATE.pose("b").matrix())
    np.testing.assert_array_equal(goal.replaced({}).poses.matrix(), goal.poses.matrix())


def test_a_goal_that_is_met_costs_nothing():
    assert PoseCost(PoseGoal.of(STATE, {"a": THERE}))(futures((0.1, 0.2))) == pytest.approx(0)


def test_cost_is_the_distance_on_the_way_and_twice_at_the_end():
    cost = PoseCost(PoseGoal.of(STATE, {"a": THERE}))(futures((0.1, 0.0), (0.1, 0.1), (0.4, 0.2)))
    np.testing.assert_allclose(cost, [0.6, 0.3, 0.9], atol=1e-12)


@pytest.mark.parametrize(("turn", "counted"), [(0.3, 0.3), (-1.1, 1.1), (np.pi, np.pi), (1.5 * np.pi, 0.5 * np.pi)])
def test_rotations_count_by_an_arm(turn, counted):
    goal = PoseGoal.of(STATE, {"a": THERE})
    assert PoseCost(goal, 0.05)(futures((0.1, 0.2), turn=turn)) == pytest.approx(3 * 0.05 * counted)
    assert PoseCost(goal, 0.0)(futures((0.1, 0.2), turn=turn)) == pytest.approx(0)


def test_objects_in_another_order_cost_the_same():
    cost, told = PoseCost(PoseGoal.of(STATE, {"a": THERE})), futures((0.15, 0.1), turn=0.4)
    swapped = Rollouts(("b", "a"), told.positions[:, :, ::-1], told.quaternions[:, :, ::-1], told.pusher)
    np.testing.assert_allclose(cost(swapped), cost(told))
