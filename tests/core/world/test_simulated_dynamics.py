import contextlib
from dataclasses import replace

import numpy as np
import pytest

from osfcore.errors import InvalidInput
from osfcore.geometry.poses import rotation_angle
from osfcore.geometry.workspace import PUSHER_REACH_M, STEP_S
from osfcore.world.scenes import SceneRequest
from osfcore.world.simulated_dynamics import SimulatedPushes
from osfcore.world.tabletop import Tabletop
from tests.support.errors import about

BOX, CAN, GELATIN = NAMES = ("003_cracker_box", "005_tomato_soup_can", "009_gelatin_box")


@pytest.fixture(scope="module")
def world(library):
    with contextlib.closing(Tabletop(library, request=SceneRequest(names=NAMES))) as tabletop:
        tabletop.arrange(0)
        yield tabletop


@pytest.fixture(scope="module")
def start(world):
    return world.truth()


@pytest.fixture
def simulated(world):
    with contextlib.closing(SimulatedPushes(world.assets)) as model:
        yield model


def push(state, name: str, after: int = 2) -> np.ndarray:
    """Straight at an object and 4 cm on, then rest."""
    way = state.pose(name).position[:2] - state.pusher[:2]
    way *= 1 + 0.04 / np.linalg.norm(way)
    count = int(np.ceil(np.abs(way).max() / (0.25 * STEP_S)))
    return np.pad(np.tile(way / (count * STEP_S), (count, 1)), ((0, after), (0, 1)))


@pytest.mark.parametrize(("name", "off_m", "off_rad"), [(BOX, 1e-3, 0.02), (GELATIN, 1e-3, 0.02), (CAN, 2e-3, 0.1)])
def test_pushes_go_as_on_the_table(world, start, simulated, name, off_m, off_rad):
    """The can lies on its side and rolls, which tiny differences decide."""
    actions = push(start, name)
    predicted = simulated.rollout(start, actions[None])
    world.restore(start)
    for t, action in enumerate(actions):
        world.act(action)
        truth = world.truth()
        np.testing.assert_allclose(predicted.positions[0, t + 1], truth.poses.position, atol=off_m)
        assert rotation_angle(predicted.quaternions[0, t + 1], truth.poses.quaternion).max() < off_rad
        np.testing.assert_allclose(predicted.pusher[0, t + 1], truth.pusher, atol=1e-9)
    assert np.abs(predicted.positions[0, -1] - start.poses.position).max() > 0.02


def test_what_the_pusher_walks_past_stays_exactly_where_it_is(start, simulated):
    way = start.pusher[:2] - start.poses.position[:, :2].mean(axis=0)  # out of everything's way
    actions = np.tile([*(0.1 * way / np.abs(way).max()), 0.0], (6, 1))
    told = simulated.rollout(start, actions[None])
    for t in range(len(actions) + 1):
        np.testing.assert_array_equal(told.positions[0, t], start.poses.position)
        np.testing.assert_array_equal(told.quaternions[0, t], start.poses.quaternion)
    path = start.pusher + STEP_S * np.pad(np.cumsum(actions, axis=0), ((1, 0), (0, 0)))
    path[:, :2] = path[:, :2].clip(-PUSHER_REACH_M, PUSHER_REACH_M)
    np.testing.assert_allclose(told.pusher[0], path, atol=1e-12)


def test_sequences_do_not_influence_each_other(world, start, simulated):
    one = push(start, CAN, 0)
    other = np.resize(push(start, BOX, 0), one.shape)
    together = simulated.rollout(start, np.stack([one, other, one]))
    with contextlib.closing(SimulatedPushes(world.assets)) as fresh:
        alone = fresh.rollout(start, one[None])
    for k in (0, 2):
        np.testing.assert_allclose(together.positions[k], alone.positions[0], atol=2e-3)
    np.testing.assert_array_equal(together.positions[:, 0], np.broadcast_to(start.poses.position, (3, 3, 3)))


def test_actions_beyond_the_limits_and_states_without_pusher_are_refused(start, simulated):
    with pytest.raises(InvalidInput, check=about("action 1 of sequence 0")):
        simulated.rollout(start, np.array([[[0, 0, 0], [0.31, 0, 0]]]))
    with pytest.raises(InvalidInput, check=about("pusher")):
        simulated.rollout(replace(start, pusher=None), np.zeros((1, 1, 3)))
