"""Compiled rollouts against those of torch."""

from dataclasses import replace

import numpy as np
import pytest
import torch

from osfcore.dynamics.graph import unroll
from osfcore.dynamics.motion import SUBSTEPS, going_on
from osfcore.dynamics.rollout import PushModel
from osfcore.dynamics.shapes import ShapeTable
from osfcore.geometry.poses import Pose, quaternion_exp, quaternion_multiply, rotate, rotation_angle
from osfcore.geometry.states import SceneState
from tests.core.dynamics.scenes import APPLE, BOX, CAN, GELATIN, angle_bracket, network, scene, start

MANY = 90  # more than one thread takes


@pytest.fixture(scope="module")
def known(shapes):
    """Real objects, and two hollow ones."""
    return {**shapes, "bracket": angle_bracket(), "other bracket": angle_bracket()}


def by_torch(net, known, state: SceneState, actions, before: SceneState | None = None) -> Pose:
    table = ShapeTable(tuple(known[name] for name in sorted(known)))
    number, motion = start(table, known, state)
    if before is not None:
        motion = going_on(start(table, known, replace(before, pusher=state.pusher))[1], motion)
    motion = type(motion)(*(part.expand(len(actions), *part.shape[1:]) for part in motion))
    velocity = torch.as_tensor(actions[..., :2], dtype=torch.float32).transpose(0, 1)
    with torch.inference_mode():
        motions = list(unroll(net, table, number.expand(len(actions), -1), motion, velocity))[SUBSTEPS - 1 :: SUBSTEPS]
    turned = np.stack([m.quaternion.numpy() for m in motions], axis=1)
    centres = np.stack([m.centre.numpy() for m in motions], axis=1)
    return Pose(centres - rotate(turned, np.array([known[name].centre for name in state.names])), turned)


def tables(known):
    """Objects beside each other before the pusher, in order of name, which is the model's; none lies quite flat,

    for directions on the border between two cells of the map of shapes are decided by rounding.
    """
    return {
        "one": scene(known, {CAN: (0.05, 0.004, (0.004, 0.006, 0.4))}),
        "several": scene(known, {BOX: (-0.25, 0.2, (0.005, 0.004, 0.2)), CAN: (0.15, 0.0, (0.004, 0.0, 0.4)),
                                 GELATIN: (0.1, 0.1, (0.003, -0.005, 1.0)), APPLE: (0.07, 0.01, (0.1, 0.2, 0.3))}),
        "hollow": scene(known, {CAN: (0.11, 0.06, (0.005, 0.002, 0.0)), "bracket": (0.06, -0.01, (0.01, 0.007, 0.3)),
                                "other bracket": (0.16, 0.1, (0.006, -0.008, 3.3))}),
    }  # fmt: skip


def pushes(seed: int) -> np.ndarray:
    """Three actions, some of them none."""
    rng = np.random.default_rng(seed)
    velocity = rng.uniform(-0.1, 0.3, (MANY, 3, 3)) * np.array([1.0, 0.5, 0.0])
    velocity[:10, 1:] = 0
    return velocity


def both(net, known, state: SceneState, actions, before: SceneState | None = None):
    """Positions after each action, compiled and by torch, and where everything was."""
    found = PushModel(net, known).rollout(state, actions, before)
    return found.positions[:, 1:], by_torch(net, known, state, actions, before).position, state.poses.position


@pytest.mark.parametrize(("name", "hidden"), [("several", 16), ("hollow", 32), ("one", 18)])
def test_they_are_the_same(known, name, hidden):
    found, expected, start = both(network(3, hidden), known, tables(known)[name], pushes(hidden))
    assert np.abs(expected - start).max() > 0.01  # something is pushed
    error = np.abs(found - expected).max(axis=(2, 3))
    assert np.quantile(error[:, 0], 0.7) < 1e-6
    assert np.median(error) < 1e-4  # rounding decides which cell of the map of shapes is read


def test_orientations_are_the_same(known):
    net, state, actions = network(3, 16), tables(known)["several"], pushes(2)[:, :1]
    found, expected = PushModel(net, known).rollout(state, actions), by_torch(net, known, state, actions)
    assert rotation_angle(expected.quaternion, state.poses.quaternion).max() > 0.01
    assert np.median(rotation_angle(found.quaternions[:, 1:], expected.quaternion)) < 1e-3


def test_what_was_moving_goes_on(known):
    state, actions = tables(known)["several"], 0.0 * pushes(0)[:4]
    earlier = state.poses.position.copy()
    earlier[-1, :2] -= [0.012, 0.004]
    turn = quaternion_exp(np.array([0.0, 0.0, -0.2]))
    before = replace(state, poses=Pose(earlier, quaternion_multiply(turn, state.poses.quaternion)))
    found, expected, start = both(network(3, 32), known, state, actions, before)
    assert np.abs(found[:, 0] - start).max() > 1e-3
    np.testing.assert_allclose(found[:, 0], expected[:, 0], atol=1e-6)
