import subprocess
import sys

import numpy as np
import pytest

from osfcore.experiments.pusht import PX_M, MissingPushT, PushT, Simulation, drift
from osfcore.geometry.workspace import STEP_S

# The pusher at rest 5 px left of the stem, at the height of the centre of mass; and one that meets nothing.
BESIDE = np.array([221.0, 301.0, 0.0, 0.0, 256.0, 256.0, 0.0])
APART = np.array([60.0, 60.0, 0.0, 0.0, 300.0, 300.0, 0.5])


def world() -> PushT:
    pytest.importorskip("gym_pusht")
    return PushT()


def simulation() -> Simulation:
    pytest.importorskip("gym_pusht")
    return Simulation()


def test_the_pusher_moves_as_fast_as_it_is_told():
    step, velocity = simulation(), np.array([[0.11, 0.23]])
    moving = step(APART[None], velocity)
    after = step(moving, velocity)
    np.testing.assert_allclose((after - moving)[0, :2], STEP_S * velocity[0] / PX_M, rtol=0.01)
    np.testing.assert_array_equal(after[0, 4:], APART[4:])


def test_a_push_moves_the_tee_along():
    before, step = BESIDE[None], simulation()
    for _ in range(3):
        after = step(before, np.array([[0.2, 0.0]]))
        assert after[0, 4] > before[0, 4]
        before = after
    assert before[0, 4] > BESIDE[4] + 50
    assert before[0, 0] < before[0, 4]  # it stays behind


def test_futures_depend_on_states_alone():
    step, states = simulation(), np.stack([BESIDE, APART, BESIDE])
    velocities = np.array([[0.3, 0.1], [-0.1, 0.2], [0.3, 0.1]])
    for _ in range(3):
        together, alone = step(states, velocities), step(states[:1], velocities[:1])
        np.testing.assert_array_equal(together[0], together[2])
        np.testing.assert_array_equal(together[0], alone[0])
        states = together


def test_the_simulation_foretells_the_environment():
    """But for the warm start of contacts, which matters where the T is jammed against a wall."""
    live, step = world(), simulation()
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


def test_an_episode_begins_with_its_seed_and_stays_on_the_plane():
    live, again = world(), world()
    live.reset(7)
    again.reset(7)
    np.testing.assert_array_equal(live.state, again.state)
    assert live.coverage() == again.coverage()
    for _ in range(12):
        live.act(np.array([-0.3, -0.3]))
    assert (live.state[:2] >= 0).all()
    again.reset(8)
    assert (live.state != again.state).any()


def test_coverage_is_that_of_the_goal():
    live = world()
    live.reset(0)
    assert 0 <= live.coverage() < live.success_coverage == 0.95
    np.testing.assert_allclose(live.goal, [256, 256, np.pi / 4], atol=1e-12)
    here = live.coverage()
    assert live.act(np.zeros(2)) == pytest.approx(here, abs=0.2)


def test_nothing_is_printed_and_nobody_is_warned():
    pytest.importorskip("gym_pusht")
    code = f"from {PushT.__module__} import PushT; PushT().reset(0)"
    done = subprocess.run([sys.executable, "-W", "error", "-c", code], capture_output=True, text=True)
    assert (done.returncode, done.stdout, done.stderr) == (0, "", "")


def test_what_is_missing_is_told(monkeypatch):
    monkeypatch.setitem(sys.modules, "gym_pusht.envs.pusht", None)
    monkeypatch.setitem(sys.modules, "gym_pusht", None)
    for make in (PushT, Simulation):
        with pytest.raises(MissingPushT, match=r"pip install 'osf-manipulation\[pusht\]'"):
            make()


def test_a_drifting_pusher_meets_nothing():
    after = drift(BESIDE[None], np.array([[0.3, -0.1]]))
    np.testing.assert_allclose(after[0, :4], [221 + 60, 301 - 20, 300, -100], atol=1e-12)
    np.testing.assert_array_equal(after[0, 4:], BESIDE[4:])
