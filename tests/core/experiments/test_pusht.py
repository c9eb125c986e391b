import json
import subprocess
import sys

import numpy as np
import pytest
import torch

from osfcore.dynamics.shapes import ShapeTable, part_outlines
from osfcore.errors import InvalidInput
from osfcore.experiments import pusht
from osfcore.geometry.workspace import MAX_SPEED_M_S, PUSHER_CENTRE_Z_M, STEP_S
from tests.support.errors import about

# Comparison


@pytest.mark.parametrize(
    ("change", "subject"),
    [({"tasks": 0}, "tasks"), ({"samples": 18}, "samples"), ({"horizon": 201}, "horizon"), ({"steps": 0}, "steps")],
)
def test_settings_out_of_range_are_refused(change, subject):
    with pytest.raises(InvalidInput, check=about(subject)):
        pusht.BenchPlanner(**change)


def test_three_planners_do_the_same_tasks():
    pytest.importorskip("gym_pusht")
    pytest.importorskip("pytorch_mppi")
    config = pusht.BenchPlanner(tasks=2, samples=20, horizon=3, steps=2, seed=5)
    before = torch.random.get_rng_state()
    steps = list(pusht.bench_planner(config))
    assert torch.equal(before, torch.random.get_rng_state())
    assert [step.done for step in steps] == [0, *range(6), 6]
    assert all(step.total == 6 for step in steps)
    report = steps[-1].report
    rows = report["episodes"]
    assert [(row["planner"], row["seed"]) for row in rows] == [
        (name, seed) for seed in (5, 6) for name in ("ours", "paper", "pytorch_mppi")
    ]
    assert all(row["coverage"] >= row["start"] and row["steps"] == 2 for row in rows)
    assert len({row["start"] for row in rows if row["seed"] == 5}) == 1
    assert all(figures["own_s_mean"] > 0 for figures in report["planners"].values())
    *_, again = pusht.bench_planner(config)
    assert again.report["episodes"] == rows


# Environment


# The pusher at rest 5 px left of the stem, at the height of the centre of mass; and one that meets nothing.
BESIDE = np.array([221.0, 301.0, 0.0, 0.0, 256.0, 256.0, 0.0])
APART = np.array([60.0, 60.0, 0.0, 0.0, 300.0, 300.0, 0.5])


@pytest.fixture
def live() -> pusht.PushT:
    pytest.importorskip("gym_pusht")
    return pusht.PushT()


@pytest.fixture
def step() -> pusht.Simulation:
    pytest.importorskip("gym_pusht")
    return pusht.Simulation()


def test_the_pusher_keeps_its_velocity(step):
    velocity = np.array([[0.11, 0.23]])
    moving = step(APART[None], velocity)
    after = step(moving, velocity)
    np.testing.assert_allclose((after - moving)[0, :2], STEP_S * velocity[0] / pusht.PX_M, rtol=0.01)
    np.testing.assert_array_equal(after[0, 4:], APART[4:])


def test_futures_depend_on_states_alone(step):
    states = np.stack([BESIDE, APART, BESIDE])
    velocities = np.array([[0.3, 0.1], [-0.1, 0.2], [0.3, 0.1]])
    for _ in range(3):
        together, alone = step(states, velocities), step(states[:1], velocities[:1])
        np.testing.assert_array_equal(together[0], together[2])
        np.testing.assert_array_equal(together[0], alone[0])
        states = together


def test_the_simulation_foretells_the_environment(live, step):
    """But for the warm start of contacts, which matters where the T is jammed against a wall."""
    errors, moved = [], 0.0
    for seed in range(4):
        live.reset(seed)
        for _ in range(6):
            before = live.state
            towards = before[4:6] - before[:2]
            velocity = 0.25 * towards / np.abs(towards).max()
            live.act(velocity)
            foretold = step(before[None], velocity[None])[0]
            np.testing.assert_allclose(foretold[:4], live.state[:4], atol=1e-6)
            errors.append(np.abs(foretold - live.state)[4:6].max())
            moved += float(np.abs(live.state[4:6] - before[4:6]).max())
    assert moved > 100 * np.median(errors)
    assert np.median(errors) < 1.0


@pytest.mark.slow
def test_nothing_is_printed_and_nobody_is_warned():
    pytest.importorskip("gym_pusht")
    code = f"from {pusht.PushT.__module__} import PushT; PushT().reset(0)"
    done = subprocess.run([sys.executable, "-W", "error", "-c", code], capture_output=True, text=True)
    assert (done.returncode, done.stdout, done.stderr) == (0, "", "")


# Planners


START = np.array([150.0, 256.0, 0.0, 0.0, 240.0, 196.0, 0.0])  # the pusher is left of the T
GOAL = np.array([320.0, 196.0, 0.0])
REACH_PX = 76.0


def bulldozed(states, velocities):
    """The T is a disc that gives way to the pusher."""
    after = pusht.drift(states, velocities)
    away = after[:, 4:6] + (0.0, 60.0) - after[:, :2]
    distance = np.linalg.norm(away, axis=1, keepdims=True).clip(1e-9)
    after[:, 4:6] += away / distance * (REACH_PX - distance).clip(0)
    return after


def planner(name, step):
    if name == "pytorch_mppi":
        pytest.importorskip("pytorch_mppi")
        torch.manual_seed(0)
    return pusht.PLANNERS[name](pusht.Problem(pusht.goal_of(GOAL), step, 48, 6), np.random.default_rng(0))


@pytest.fixture(autouse=True)
def _torch_is_left_as_it_was():
    with torch.random.fork_rng(devices=[]):
        yield


@pytest.mark.parametrize("name", pusht.PLANNERS)
def test_each_brings_the_tee_closer_within_its_budget(name):
    calls = []

    def counted(states, velocities):
        calls.append(len(states))
        assert np.abs(velocities).max() <= MAX_SPEED_M_S
        return bulldozed(states, velocities)

    plan, state, seen = planner(name, counted), START, []
    for _ in range(8):
        calls.clear()
        velocity = plan(state)
        seen.append(sum(calls))
        assert velocity.shape == (2,)
        assert np.abs(velocity).max() <= MAX_SPEED_M_S
        state = bulldozed(state[None], velocity[None])[0]
    assert 0.9 * 48 * 6 < seen[0] <= max(seen) <= 48 * 6
    assert np.linalg.norm(state[4:6] - GOAL[:2]) < 0.6 * np.linalg.norm(START[4:6] - GOAL[:2])


# Report


def episode(planner, seed, coverage, *, seconds=(0.5, 1.5)):
    return pusht.PushTEpisode(planner, seed, 0.1, coverage, coverage > 0.95, 2, seconds, (0.01, 0.03))


def test_figures_hold_shares_means_and_tails():
    episodes = [episode("ours", n, c) for n, c in enumerate((0.97, 0.5, 0.96, 0.9))]
    episodes += [episode("other", n, c, seconds=(0.2, 0.2)) for n, c in enumerate((0.2, 0.5, 0.96, 0.1))]
    result = json.loads(json.dumps(pusht.report_json(episodes)))
    assert result["tasks"] == 4
    assert result["start_mean"] == pytest.approx(0.1)
    ours, other = result["planners"]["ours"], result["planners"]["other"]
    low, high = ours["success_interval"]
    assert 0 < low < ours["success"] == 0.5 < high < 1
    assert ours["coverage_mean"] == pytest.approx(0.8325)
    assert ours["coverage_least"] == 0.5 <= ours["coverage_p10"] <= ours["coverage_median"] == pytest.approx(0.93)
    assert (ours["plan_hz"], ours["plan_s_most"], ours["own_hz"]) == pytest.approx((1.0, 1.5, 50.0))
    assert other["plan_hz"] == pytest.approx(5.0)
    against = result["against"]["other"]
    assert against["success"]["difference"] == pytest.approx(0.25)
    assert against["coverage"]["difference"] == pytest.approx((0.77 + 0.8) / 4)


# Table


STATE = np.array([100.0, 356.0, 5.0, -5.0, 256.0, 196.0, 0.0])


def outlines(tee):
    return part_outlines(ShapeTable((pusht.tee_shape(),)), 0, pusht.pose_of(np.array(tee)))


def test_a_millimetre_is_a_pixel_and_the_middle_is_the_middle():
    scene = pusht.scene_of(STATE)
    np.testing.assert_allclose(scene.poses.position[0, :2], 0, atol=1e-12)  # of the box around the T, 120 px each way
    np.testing.assert_allclose(scene.pusher, [-0.156, 0.1, PUSHER_CENTRE_Z_M], atol=1e-12)


def test_the_tee_lies_where_the_environment_draws_it():
    envs = pytest.importorskip("gym_pusht.envs.pusht")
    env = envs.PushTEnv()
    env.reset(seed=4)
    tee = (*env.block.position, env.block.angle)
    for shape in env.block.shapes:
        theirs = (np.array([env.block.local_to_world(v) for v in shape.get_vertices()]) - 256) / 1000
        ours = min(outlines(tee), key=lambda part: np.linalg.norm(part.mean(axis=0) - theirs.mean(axis=0)))
        nearest = np.linalg.norm(theirs[:, None] - ours, axis=-1).min(axis=1)
        np.testing.assert_allclose(nearest, 0, atol=1e-6)


def test_futures_and_scenes_agree_and_the_goal_costs_nothing():
    states = np.tile(STATE, (2, 4, 1))
    states[1, :, 4:] += (30.0, 0.0, 0.5)
    futures = pusht.rollouts_of(states)
    scene = pusht.scene_of(STATE)
    np.testing.assert_allclose(futures.positions[0, 2], scene.poses.position, atol=1e-12)
    np.testing.assert_allclose(futures.pusher[1, 3], scene.pusher, atol=1e-12)
    costs = pusht.cost_of(pusht.goal_of(STATE[4:]))(futures)
    assert costs[0] == pytest.approx(0, abs=1e-6)
    assert costs[1] > 0.03
