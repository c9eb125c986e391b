"""Time rollouts: many sequences of actions among three objects, as a planner would ask for them."""

from __future__ import annotations

import time
from collections.abc import Mapping
from dataclasses import dataclass

import numpy as np
import torch
from jaxtyping import Float

from osfcore.dynamics.dynamics_model import DynamicsModel
from osfcore.dynamics.shapes import ObjectShape
from osfcore.geometry.light import Light
from osfcore.geometry.poses import Pose
from osfcore.geometry.states import SceneState
from osfcore.geometry.workspace import MAX_SPEED_M_S, PUSHER_CENTRE_Z_M
from osfcore.random_streams import Stream, stream_rng

SEQUENCES, HORIZON = 1000, 10
BENCH_NAMES = ("003_cracker_box", "005_tomato_soup_can", "006_mustard_bottle")
_KNOTS = 4  # of a random path
_REPEATS = 5
_RING_M = 0.09  # from the pusher to the objects around it


@dataclass(frozen=True, slots=True)
class RolloutCosts:
    """Times of rollouts.

    Attributes:
        rollout_s: median time of `SEQUENCES` sequences of `HORIZON` actions among three objects [s].
        rollout_steps_per_s: steps of scenes a second.
        touched_share: share of sequences in which something moves.
        threads: number of threads that computed.
    """

    rollout_s: float
    rollout_steps_per_s: float
    touched_share: float
    threads: int


def bench_rollouts(model: DynamicsModel, shapes: Mapping[str, ObjectShape]) -> RolloutCosts:
    """Time rollouts of three objects that stand around the pusher.

    Args:
        model: predicts, and knows these objects.
        shapes: by name; the first three names are taken.
    """
    state, actions = _scene(tuple(sorted(shapes))[: len(BENCH_NAMES)], shapes), _paths()
    rollouts = model.rollout(state, actions)  # warm
    seconds = []
    for _ in range(_REPEATS):
        start = time.perf_counter()
        rollouts = model.rollout(state, actions)
        seconds.append(time.perf_counter() - start)
    moved = np.abs(rollouts.positions[:, -1] - rollouts.positions[:, 0]).max(axis=(1, 2)) > 0
    median = float(np.median(seconds))
    return RolloutCosts(median, SEQUENCES * HORIZON / median, float(moved.mean()), torch.get_num_threads())


def _scene(names: tuple[str, ...], shapes: Mapping[str, ObjectShape]) -> SceneState:
    """Return objects upright around the pusher, close enough that most paths meet one."""
    angles = 2 * np.pi * np.arange(len(names)) / len(names)
    heights = [float(-shapes[name].support[:, 2].min() - shapes[name].centre[2]) for name in names]
    away = [_RING_M + float(shapes[name].half_extents[:2].max()) for name in names]
    positions = np.stack([away * np.cos(angles), away * np.sin(angles), heights], axis=1)
    poses = Pose(positions, np.tile([1.0, 0.0, 0.0, 0.0], (len(names), 1)))
    return SceneState(names, poses, Light(np.array([0.0, 0.0, 1.0])), np.array([0.0, 0.0, PUSHER_CENTRE_Z_M]))


def _paths() -> Float[np.ndarray, "K T 3"]:
    """Return smooth random velocities: a few knots, joined by lines [m/s]."""
    rng = stream_rng(0, Stream.BENCHMARK)
    knots = rng.uniform(-MAX_SPEED_M_S, MAX_SPEED_M_S, (SEQUENCES, _KNOTS, 2))
    at = np.linspace(0, _KNOTS - 1, HORIZON)
    low = np.minimum(at.astype(int), _KNOTS - 2)
    share = (at - low)[:, None]
    flat = knots[:, low] * (1 - share) + knots[:, low + 1] * share
    return np.concatenate([flat, np.zeros((SEQUENCES, HORIZON, 1))], axis=2)
