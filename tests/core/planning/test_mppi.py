from dataclasses import replace

import numpy as np
import pytest

from osfcore.dynamics.rollout import load_shapes
from osfcore.errors import InvalidInput
from osfcore.fields.field_library import FieldLibrary
from osfcore.geometry.poses import Pose
from osfcore.geometry.rollouts import Rollouts
from osfcore.geometry.states import SceneState
from osfcore.geometry.workspace import MAX_SPEED_M_S, STEP_S
from osfcore.planning.costs import PoseCost, PoseGoal
from osfcore.planning.mppi import MPPIPlanner, PlanSettings
from osfcore.planning.pushes import PushProposals
from tests.core.dynamics.scenes import APPLE, CAN, scene
from tests.support.errors import about

FIELDS = FieldLibrary(None)
SMALL = PlanSettings(samples=64, horizon=12)


@pytest.fixture(scope="module")
def shapes():
    return load_shapes(None, FIELDS, (APPLE, CAN))


@pytest.fixture(scope="module")
def start(shapes) -> SceneState:
    return scene(shapes, {CAN: (0.0, 0.0), APPLE: (0.2, 0.2)}, pusher=(0.0, -0.1))


def goal_of(state, shift) -> PoseGoal:
    pose = state.pose(CAN)
    return PoseGoal.of(state, {CAN: Pose(pose.position + [*shift, 0.0], pose.quaternion)})


def carried(state, actions, before=None) -> Rollouts:
    """A world in which the first object is carried along with the pusher."""
    path = np.concatenate([np.zeros_like(actions[:, :1]), STEP_S * np.cumsum(actions, axis=1)], axis=1)
    positions = np.broadcast_to(state.poses.position, (*path.shape[:2], *state.poses.position.shape)).copy()
    positions[:, :, 0] += path
    quaternions = np.broadcast_to(state.poses.quaternion, (*positions.shape[:3], 4))
    return Rollouts(state.names, positions, quaternions, state.pusher + path)


def planned(planner, state, goal, seed: int = 0):
    return list(planner.plan(state, goal, PoseCost(goal, 0.0), np.random.default_rng(seed)))


def test_a_plan_leads_toward_the_goal(shapes, start):
    goal = goal_of(start, (0.12, -0.08))
    rounds = planned(MPPIPlanner(carried, PushProposals(shapes), SMALL), start, goal)
    assert [r.number for r in rounds] == [0, 1]
    actions = rounds[-1].actions
    assert actions.shape == (12, 3)
    assert np.abs(actions).max() <= MAX_SPEED_M_S
    end = STEP_S * actions.sum(axis=0)
    assert np.linalg.norm(end[:2] - [0.12, -0.08]) < 0.12  # from 0.144; proposals walk around the object first
    for r in rounds:
        assert len(r.costs) == len(r.rollouts.positions) >= 60
        np.testing.assert_array_equal(r.best.positions[0], r.rollouts.positions[r.costs.argmin()])
    with pytest.raises(InvalidInput, check=about("pusher")):
        planned(MPPIPlanner(carried, PushProposals(shapes), SMALL), replace(start, pusher=None), goal)


def test_planning_on_comes_closer_and_draws_proposals_in_every_third_plan_and_when_there_is_none(shapes, start):
    goal, planner = goal_of(start, (0.12, -0.08)), MPPIPlanner(carried, PushProposals(shapes), SMALL)
    plans = [planned(planner, start, goal, seed) for seed in range(7)]
    assert [len(rounds) for rounds in plans] == [2, 1, 1, 2, 1, 1, 2]
    assert plans[-2][-1].costs.min() < 0.8 * plans[0][-1].costs.min()
    planner.reset()
    again = planned(planner, start, goal, 0)
    np.testing.assert_array_equal(again[-1].actions, plans[0][-1].actions)
    assert len(again) == 2


@pytest.mark.parametrize("seed", range(3))
def test_the_second_round_looks_less_far_leaves_the_rest_alone_and_costs_no_more(shapes, start, seed):
    goal, settings = goal_of(start, (0.12, -0.08)), replace(SMALL, refined=6)
    first, second = planned(MPPIPlanner(carried, PushProposals(shapes), settings), start, goal, seed)
    assert first.rollouts.positions.shape[1] == 12 + 1
    assert second.rollouts.positions.shape[1] == 6 + 1
    np.testing.assert_array_equal(second.actions[6:], first.actions[6:])
    assert PoseCost(goal, 0.0)(carried(start, second.actions[None]))[0] <= first.costs.min() + 1e-12


@pytest.mark.parametrize(("refined", "every"), [(6, 3), (8, 2), (10, 5)])
def test_noise_vanishes_where_the_refined_part_begins_and_ends(shapes, start, refined, every):
    """The goal is met, so that the best plan is to rest and paths are nothing but noise."""
    settings = replace(SMALL, knot_every=every, refined=refined)
    goal = PoseGoal.of(start, {})
    first, second = planned(MPPIPlanner(carried, PushProposals(shapes), settings), start, goal)
    np.testing.assert_array_equal(first.actions, 0)
    noise = second.rollouts.pusher[..., :2] - start.pusher[:2]
    np.testing.assert_array_equal(noise[0], 0)  # one sample is the plan itself
    np.testing.assert_array_equal(noise[:, 0], 0)
    np.testing.assert_allclose(noise[:, -1], 0, atol=1e-12)
    np.testing.assert_allclose(every * noise[:, 1], noise[:, every], atol=1e-12)  # straight lines between knots
    assert noise[1:, every].std() == pytest.approx(settings.noise_m, rel=0.3)


def touched(state, actions, before=None) -> Rollouts:
    """A world in which the pusher takes the first object along once it is beyond y = 5 cm."""
    future = carried(state, actions)
    positions = np.broadcast_to(state.poses.position, future.positions.shape).copy()
    positions[:, :, 0, 1] += np.maximum(future.pusher[..., 1] - 0.05, 0)
    return Rollouts(state.names, positions, future.quaternions, future.pusher)


def test_a_plan_that_only_walks_is_kept_as_it_is_until_it_will_soon_touch_something(shapes, start):
    planner = MPPIPlanner(touched, PushProposals(shapes), PlanSettings(samples=64, horizon=24, proposals_every=30))
    state = replace(start, pusher=start.pusher + np.array([0.0, -0.25, 0.0]))
    goal = goal_of(start, (0.0, 0.2))
    before = planned(planner, state, goal)[-1].actions
    walk = int(np.argmax(touched(state, before[None]).positions[0, :, 0, 1] > state.poses.position[0, 1])) - 1
    assert walk > 5
    for number in range(1, walk - 3):
        state = replace(state, pusher=state.pusher + STEP_S * planner.nominal(1)[0])
        planner.shift(1)
        (only,) = planned(planner, state, goal, number)
        np.testing.assert_array_equal(only.actions[:-1], before[1:])
        np.testing.assert_allclose(only.best.pusher[0, 0], state.pusher, atol=1e-9)
        before = only.actions
    planner.shift(1)
    assert len(planned(planner, state, goal)[-1].costs) == 64  # which is refined


def test_what_was_executed_is_dropped(shapes, start):
    seen = []

    def recorded(state, actions, before):
        seen.append(actions[0])
        return carried(state, actions)

    planner = MPPIPlanner(recorded, PushProposals(shapes), SMALL)
    goal = goal_of(start, (0.1, 0.0))
    np.testing.assert_array_equal(planner.nominal(3), np.zeros((3, 3)))
    plan = planned(planner, start, goal)[-1].actions
    np.testing.assert_array_equal(planner.nominal(15), np.pad(plan, ((0, 3), (0, 0))))
    planner.shift(3)
    np.testing.assert_array_equal(planner.nominal(12), np.pad(plan[3:], ((0, 3), (0, 0))))
    before = len(seen)
    planned(planner, start, goal)
    np.testing.assert_array_equal(seen[before][:-3], plan[3:])  # the first sample is the last plan itself
    np.testing.assert_array_equal(seen[before][-3:], 0)
    for horizon in (5, 20):
        planner.settings = replace(SMALL, horizon=horizon)
        assert planned(planner, start, goal)[-1].actions.shape == (horizon, 3)


class Straight:
    """Proposes to go along +x at one speed or another [m/s]."""

    def __init__(self, *speeds: float) -> None:
        self._speeds = speeds

    def draw(self, state, goal, count, horizon, rng):
        return np.multiply.outer(np.resize(self._speeds, count), np.broadcast_to([1.0, 0.0, 0.0], (horizon, 3)))

    def recombine(self, goal, rollouts, count):
        return np.zeros((0, rollouts.pusher.shape[1] - 1, 3))


@pytest.mark.parametrize(("begins_m", "speed"), [(0.0, 0.05), (0.003, 0.04)])
def test_a_push_that_works_from_one_place_alone_is_not_chosen_unless_rollouts_are_trusted(start, begins_m, speed):
    """The faster push ends at the goal, but slips off the object where the pusher begins elsewhere."""

    def slippery(state, actions, before=None):
        future = carried(state, actions)
        slips = (actions[:, :, 0] > 0.045).all(axis=1) & (not np.array_equal(state.pusher, start.pusher))
        still = np.broadcast_to(state.poses.position, future.positions.shape)
        positions = np.where(slips[:, None, None, None], still, future.positions)
        return Rollouts(state.names, positions, future.quaternions, future.pusher)

    settings = PlanSettings(samples=64, horizon=12, noise_m=0.0, begins_m=begins_m)
    planner = MPPIPlanner(slippery, Straight(0.05, *[0.04] * 20), settings)
    first = planned(planner, start, goal_of(start, (0.12, 0.0)))[0]
    np.testing.assert_allclose(first.actions, np.broadcast_to([speed, 0.0, 0.0], (12, 3)), atol=1e-12)
    np.testing.assert_allclose(
        first.best.positions[0, -1, 0, 0], start.poses.position[0, 0] + 12 * STEP_S * speed, atol=1e-12
    )


def test_a_plan_that_hesitates_is_hurried(start):
    planner = MPPIPlanner(carried, Straight(0.03), PlanSettings(samples=64, horizon=24))
    goal = goal_of(start, (0.1, 0.0))
    for seed in range(2):
        planned(planner, start, goal, seed)
    assert planner.nominal(1)[0, 0] > 0.2


def test_settings_out_of_range_are_refused():
    for wrong in ({"samples": 0}, {"horizon": 10_000}, {"temperature": np.nan}, {"noise_m": 0.4}, {"begins_m": 0.5}):
        with pytest.raises(InvalidInput):
            PlanSettings(**wrong)
