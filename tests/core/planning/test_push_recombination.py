from itertools import pairwise

import numpy as np
import pytest

from osfcore.geometry.light import Light
from osfcore.geometry.poses import Pose
from osfcore.geometry.rollouts import Rollouts
from osfcore.geometry.states import SceneState
from osfcore.geometry.workspace import MAX_SPEED_M_S, STEP_S
from osfcore.planning.costs import PoseCost, PoseGoal, object_costs
from osfcore.planning.paths import actions_along
from osfcore.planning.pushes import push_stages, recombined

HANDLE = np.array([-0.03, 0.0])  # of an object: at its left
HORIZON = 24
PLACES = {"a": (-0.1, 0.1), "b": (0.0, -0.1)}
STATE = SceneState(
    tuple(PLACES),
    Pose(np.array([[*place, 0.01] for place in PLACES.values()]), np.tile([1.0, 0, 0, 0], (2, 1))),
    Light(np.array([0.0, 0.0, 1.0])),
    np.array([-0.25, 0.0, 0.06]),
)
GOAL = PoseGoal(STATE.names, Pose(STATE.poses.position + [[0.12, 0.0, 0.0], [0.15, 0.0, 0.0]], STATE.poses.quaternion))


def pulled(actions) -> Rollouts:
    """A world in which objects go straight to the right with a pusher that begins an action at their handles."""
    pusher = STATE.pusher + STEP_S * np.pad(np.cumsum(actions, axis=1), ((0, 0), (1, 0), (0, 0)))
    positions = np.broadcast_to(STATE.poses.position, (*pusher.shape[:2], 2, 3)).copy()
    for t in range(actions.shape[1]):
        away = np.linalg.norm(positions[:, t, :, :2] + HANDLE - pusher[:, t, None, :2], axis=-1)
        held = (away < 1e-6) & (actions[:, t, None, 0] > 0) & (np.abs(actions[:, t, None, 1]) < 1e-9)
        step = np.where(held[..., None], STEP_S * actions[:, t, None], 0)
        positions[:, t + 1] = positions[:, t] + step * [1, 0, 0]
    quaternions = np.broadcast_to(STATE.poses.quaternion, (*positions.shape[:3], 4))
    return Rollouts(STATE.names, positions, quaternions, pusher)


def outlines(number: int, pose: Pose):
    return [pose.position[:2] + 0.008 * np.array([[1.0, 1], [-1, 1], [-1, -1], [1, -1]])]


def pulling(*pulls):
    """Actions that pull objects one after another, each by so much [m], stopping at every corner."""
    places, at, parts = {name: np.array(place) for name, place in PLACES.items()}, STATE.pusher[:2], []
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


def test_a_stage_ends_where_it_has_taken_most_from_the_cost():
    rollouts = pulled(np.array([pulling(("a", 0.24))]))  # twice as far as the goal
    (stage,) = push_stages(rollouts, object_costs(rollouts, GOAL))[0]
    np.testing.assert_allclose(stage.start, np.array(PLACES["a"]) + HANDLE, atol=1e-12)
    np.testing.assert_allclose(stage.end, stage.start + STEP_S * stage.actions[:, :2].sum(axis=0), atol=1e-12)
    np.testing.assert_allclose(stage.pose.position, GOAL.pose("a").position, atol=1e-9)
    assert stage.gain == pytest.approx(0.12)


def test_only_what_nothing_moved_before_is_a_stage():
    rollouts = pulled(np.array([pulling(("a", 0.06), ("b", 0.15), ("a", 0.06))]))
    stages = push_stages(rollouts, object_costs(rollouts, GOAL))
    assert [stage.gain for stage in stages[0]] == [pytest.approx(0.06)]
    assert [stage.gain for stage in stages[1]] == [pytest.approx(0.15)]


def test_what_brings_nothing_nearer_is_not_recombined():
    rollouts = pulled(np.array([pulling(("a", 0.3)), np.zeros((HORIZON, 3))])[:, :HORIZON])
    here = PoseGoal(STATE.names, STATE.poses)
    assert push_stages(rollouts, object_costs(rollouts, here)) == {}
    assert recombined(rollouts, object_costs(rollouts, here), outlines, 4).shape == (0, HORIZON, 3)


def test_of_two_orders_the_quicker_one_comes_first():
    """From where the pusher stands b is on the way to nothing, a on the way to b."""
    rollouts = pulled(np.array([pulling(("a", 0.12)), pulling(("b", 0.15))]))
    found = recombined(rollouts, object_costs(rollouts, GOAL), outlines, 2)
    costs = PoseCost(GOAL)(pulled(found))
    assert len(found) == 2
    assert costs[0] <= costs[1]
