from dataclasses import replace

import numpy as np
import pytest

from osfcore.dynamics.motion import SLEEP_M, substates
from osfcore.geometry.poses import quaternion_conjugate, quaternion_multiply, rotation_angle
from osfcore.io.push_file import read_pushes
from osfcore.world import collect_pushes as module
from osfcore.world.collect_pushes import CollectPushes, collect_pushes, disturbed
from osfcore.world.physics import body_model


@pytest.fixture(scope="module")
def pushed(library, tmp_path_factory):
    """One episode in which things are pushed around, and the bodies of its objects."""
    out = tmp_path_factory.mktemp("pushed") / "pushes.h5"
    list(collect_pushes(CollectPushes(out, episodes=1, steps=30, policy="directed", seed=3), library))
    episode = read_pushes(out)[0]
    return episode, {name: body_model(library.load(name)) for name in episode.names}


def run(pushed, seed: int = 0, count: int = 1):
    return disturbed(*pushed, np.random.default_rng(seed), count)


def test_every_substep_in_which_something_moves_is_played_as_often_as_asked(pushed):
    once, twice = run(pushed), run(pushed, count=2)
    assert len(once.step) > 20
    assert np.array_equal(np.repeat(once.step, 2), twice.step)
    positions = substates(pushed[0]).position
    moved = np.linalg.norm(np.diff(positions, axis=0), axis=-1).max(axis=1)
    assert (moved[once.step] > SLEEP_M / 2).all()
    assert once.step.min() >= 1
    assert once.step.max() < len(positions) - 1


def test_the_same_seed_gives_the_same_rows_and_another_others(pushed):
    first, again, other = run(pushed), run(pushed), run(pushed, seed=1)
    assert np.array_equal(first.after_positions, again.after_positions)
    assert not np.array_equal(first.linear, other.linear)


def test_what_rests_is_left_alone_and_nothing_is_far_from_what_was_recorded(pushed):
    found, recorded = run(pushed), substates(pushed[0])
    off = np.linalg.norm(found.positions - recorded.position[found.step], axis=-1)
    rests = np.linalg.norm(found.linear, axis=-1) == 0
    assert rests.any()
    assert not rests.all()
    assert off[rests].max() < 1e-6
    assert 1e-4 < off[~rests].mean() < 1e-3
    turn = rotation_angle(found.quaternions.astype(float), recorded.quaternion[found.step])
    assert 1e-4 < turn[~rests].mean() < 0.01
    np.testing.assert_allclose(found.positions[..., 2], recorded.position[found.step][..., 2], atol=1e-6)


@pytest.fixture
def undisturbed(monkeypatch):
    for name in ("_MOST", "_OFF_M", "_OFF_RAD"):
        monkeypatch.setattr(module, name, 0.0)


@pytest.mark.usefixtures("undisturbed")
def test_undisturbed_the_simulator_repeats_what_was_recorded(pushed):
    """But for what poses and mean velocities do not tell of the simulator's state."""
    found, recorded = run(pushed), substates(pushed[0])
    off = np.linalg.norm(found.after_positions - recorded.position[found.step + 1], axis=-1)
    way = np.linalg.norm(found.after_positions - found.positions, axis=-1)
    moving = way > 0.002
    assert np.median(off[moving]) < 5e-4
    assert np.median(off[moving]) < 0.1 * np.median(way[moving])


@pytest.mark.usefixtures("undisturbed")
def test_velocities_are_those_of_the_objects_origins(pushed):
    found, recorded = run(pushed), substates(pushed[0])
    before = recorded.position[found.step - 1]
    turned = quaternion_multiply(
        recorded.quaternion[found.step], quaternion_conjugate(recorded.quaternion[found.step - 1])
    )
    small = (rotation_angle(turned, np.array([1.0, 0, 0, 0])) < 0.05) & (np.linalg.norm(found.linear, axis=-1) > 0)
    np.testing.assert_allclose(found.linear[small], (found.positions - before)[small], atol=2e-4)


def test_where_nothing_moves_there_is_nothing_to_disturb(pushed):
    episode, models = pushed
    still = {name: np.broadcast_to(getattr(episode, name)[:1], getattr(episode, name).shape)
             for name in ("positions", "quaternions")}  # fmt: skip
    within = {
        "sub_positions": np.broadcast_to(episode.positions[0], episode.sub_positions.shape),
        "sub_quaternions": np.broadcast_to(episode.quaternions[0], episode.sub_quaternions.shape),
    }
    found = disturbed(replace(episode, **still, **within), models, np.random.default_rng(0), 3)
    assert found.step.shape == (0,)
    assert found.positions.shape == (0, 3, 3)
    assert found.after_quaternions.shape == (0, 3, 4)
