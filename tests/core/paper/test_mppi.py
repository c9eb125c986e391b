import numpy as np
import pytest

from osfcore.errors import InvalidInput
from osfcore.geometry.rollouts import Rollouts
from osfcore.geometry.workspace import MAX_SPEED_M_S, STEP_S
from osfcore.paper.mppi import GaussianMPPI, GaussianPlanSettings
from tests.support.rendered_scenes import state

STATE = state({"a": (0, 0, 0)}, pusher=(0, 0, 0))


def free_pusher(state, actions, before):
    """Nothing is touched; the pusher goes where it is sent."""
    assert before is None
    count, horizon = actions.shape[:2]
    path = np.concatenate([np.zeros((count, 1, 3)), STEP_S * np.cumsum(actions, axis=1)], axis=1)
    still = np.broadcast_to(state.poses.position, (count, horizon + 1, 1, 3))
    return Rollouts(state.names, still, np.broadcast_to(state.poses.quaternion, (*still.shape[:3], 4)), path)


def to_the_right(rollouts):
    return -rollouts.pusher[:, -1, 0]


def test_plans_follow_the_cost_within_the_limits():
    planner = GaussianMPPI(free_pusher)
    rng = np.random.default_rng(0)
    ends = []
    for _ in range(6):
        round_ = planner.plan(STATE, to_the_right, rng)
        ends.append(STEP_S * round_.actions[:, 0].sum())
    assert ends[-1] > ends[0] > 0
    assert ends[-1] > 0.7 * STEP_S * MAX_SPEED_M_S * 10
    assert np.abs(round_.actions).max() <= MAX_SPEED_M_S
    assert not round_.actions[:, 2].any()


def test_a_low_temperature_takes_the_best_sample_and_a_high_one_the_mean():
    for temperature, pick in ((1e-6, "best"), (1e6, "mean")):
        planner = GaussianMPPI(free_pusher, GaussianPlanSettings(samples=50, temperature=temperature))
        seen = []

        def cost(rollouts, seen=seen):
            seen.append(np.diff(rollouts.pusher, axis=1) / STEP_S)
            return to_the_right(rollouts)

        round_ = planner.plan(STATE, cost, np.random.default_rng(1))
        expected = seen[0][round_.costs.argmin()] if pick == "best" else seen[0].mean(axis=0)
        np.testing.assert_allclose(round_.actions, expected, atol=1e-6)


def test_the_next_plan_begins_after_the_executed_action():
    planner = GaussianMPPI(free_pusher)
    before = planner.plan(STATE, to_the_right, np.random.default_rng(0)).actions
    planner.shift()
    planner.settings = GaussianPlanSettings(samples=2, noise_m_s=0.0)
    after = planner.plan(STATE, to_the_right, np.random.default_rng(0)).actions
    np.testing.assert_allclose(after[:-1], before[1:], atol=1e-12)
    assert not after[-1].any()


def test_settings_out_of_range_are_refused():
    for change in ({"samples": 1}, {"horizon": 0}, {"noise_m_s": 1.0}, {"temperature": 0.0}):
        with pytest.raises(InvalidInput):
            GaussianPlanSettings(**change)
