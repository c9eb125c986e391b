import sys

import numpy as np
import pytest
import torch

from osfcore.experiments.pusht import PLANNERS, MissingPushT, Problem, PytorchMPPI, drift, goal_of
from osfcore.geometry.workspace import MAX_SPEED_M_S

START = np.array([150.0, 256.0, 0.0, 0.0, 240.0, 196.0, 0.0])  # the pusher is left of the T
GOAL = np.array([320.0, 196.0, 0.0])
REACH_PX = 76.0


def bulldozed(states, velocities):
    """The T is a disc that gives way to the pusher."""
    after = drift(states, velocities)
    away = after[:, 4:6] + (0.0, 60.0) - after[:, :2]
    distance = np.linalg.norm(away, axis=1, keepdims=True).clip(1e-9)
    after[:, 4:6] += away / distance * (REACH_PX - distance).clip(0)
    return after


def planner(name, step=bulldozed, samples=48, horizon=6, seed=0):
    if name == "pytorch_mppi":
        pytest.importorskip("pytorch_mppi")
        torch.manual_seed(seed)
    return PLANNERS[name](Problem(goal_of(GOAL), step, samples, horizon), np.random.default_rng(seed))


@pytest.fixture(autouse=True)
def _torch_is_left_as_it_was():
    with torch.random.fork_rng(devices=[]):
        yield


@pytest.mark.parametrize("name", PLANNERS)
def test_each_brings_the_tee_closer(name):
    one, state = planner(name), START
    for _ in range(8):
        velocity = one.plan(state)
        assert velocity.shape == (2,)
        assert np.abs(velocity).max() <= MAX_SPEED_M_S
        state = bulldozed(state[None], velocity[None])[0]
    assert np.linalg.norm(state[4:6] - GOAL[:2]) < 0.6 * np.linalg.norm(START[4:6] - GOAL[:2])


@pytest.mark.parametrize("name", PLANNERS)
def test_the_same_seed_plans_the_same(name):
    first, again, other = (planner(name, seed=seed).plan(START) for seed in (0, 0, 1))
    np.testing.assert_array_equal(first, again)
    assert (first != other).any()


@pytest.mark.parametrize("name", PLANNERS)
def test_no_plan_looks_at_more_than_its_budget(name):
    calls = []

    def counted(states, velocities):
        calls.append(len(states))
        assert np.abs(velocities).max() <= MAX_SPEED_M_S
        return bulldozed(states, velocities)

    planner(name, counted, samples=40, horizon=5).plan(START)
    assert 0.9 * 40 * 5 < sum(calls) <= 40 * 5


def test_a_missing_library_is_told(monkeypatch):
    monkeypatch.setitem(sys.modules, "pytorch_mppi", None)
    with pytest.raises(MissingPushT, match="pytorch-mppi"):
        PytorchMPPI(Problem(goal_of(GOAL), bulldozed, 16, 3), np.random.default_rng(0))
