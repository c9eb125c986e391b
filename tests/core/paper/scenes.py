"""Scenes, recordings, networks and fields for tests of the paper's models: the pusher shoves two objects along x."""

import numpy as np
import torch

from osfcore.geometry.light import Light
from osfcore.geometry.poses import Pose, quaternion_exp
from osfcore.geometry.states import SceneState
from osfcore.geometry.workspace import PUSHER_CENTRE_Z_M, STEP_S
from osfcore.io.push_file import PushEpisode
from osfcore.paper.dynamics import GraphNetwork, Scenes
from osfcore.paper.fields import TinyField, first_field, layer_shapes

NAMES = CAN, BOX = ("005_tomato_soup_can", "009_gelatin_box")
KAPPAS = {CAN: 0.1, BOX: 0.08}
LONGEST = 0.12  # kappa of the pusher, its height [m]: larger than theirs
WIDTH, VOXEL = 8, 0.005  # of tiny networks, and of their grids
TOUCHED_M = 0.05  # in recordings, the pusher takes along what is no farther than this


def network(seed: int = 0, *, hidden: int = 16, steps: int = 2, names=NAMES) -> GraphNetwork:
    """A network that has learned nothing, but answers something."""
    torch.manual_seed(seed)
    made = GraphNetwork(names, hidden, steps)
    torch.nn.init.normal_(made.answer.weight, std=0.1)
    torch.nn.init.normal_(made.answer.bias, std=0.1)
    return made.eval()


def scenes(count: int = 3, objects: int = 2, seed: int = 0) -> Scenes:
    """Objects anywhere in the workspace, turned at random."""
    g = torch.Generator().manual_seed(seed)
    quaternion = torch.nn.functional.normalize(torch.randn(count, objects, 4, generator=g), dim=-1)
    position = torch.rand(count, objects, 3, generator=g) * 0.4 - 0.2
    return Scenes(position, quaternion, torch.rand(count, 3, generator=g) * 0.4 - 0.2)


def state(*, pusher=(0.0, 0.0), names=NAMES) -> SceneState:
    """Both objects at rest before the pusher."""
    positions = np.array([[0.08, 0.01, 0.05], [0.17, -0.02, 0.03], [-0.1, 0.1, 0.04]])[: len(names)]
    turned = quaternion_exp(np.array([[0.0, 0, 0.4], [0.1, 0, -2.9], [0, 0, 3.1]]))[: len(names)]
    return SceneState(
        tuple(names), Pose(positions, turned), Light(np.array([0.0, 0, 1])), np.array([*pusher, PUSHER_CENTRE_Z_M])
    )


def episode(seed: int = 0, *, steps: int = 8, names=NAMES, side: float | None = None) -> PushEpisode:
    """The pusher moves along x at its own speed and takes the first object along once it is near; the second rests."""
    rng = np.random.default_rng(seed)
    actions = np.zeros((steps, 3))
    actions[:, 0] = rng.uniform(0.1, 0.3)
    pusher = np.tile([-0.05, rng.uniform(-0.05, 0.05), PUSHER_CENTRE_Z_M], (steps + 1, 1))
    pusher[1:, 0] += np.cumsum(actions[:, 0]) * STEP_S
    positions = np.zeros((steps + 1, len(names), 3))
    positions[..., 2] = 0.04
    positions[:, 1:, 0] = 0.1
    positions[:, 1:, 1] = 0.2
    positions[:, 0, 0] = np.maximum(rng.uniform(-0.03, 0.1), pusher[:, 0] + TOUCHED_M)
    positions[:, 0, 1] = pusher[:, 1] if side is None else side
    quaternions = np.tile([1.0, 0, 0, 0], (steps + 1, len(names), 1))
    contact = np.linalg.norm(np.diff(positions, axis=0), axis=-1) > 0
    return PushEpisode(tuple(names), seed, positions, quaternions, pusher, actions, contact)


# KiloOSFs as published whose answers are known: networks that ignore where they are asked.


def empty_block(shape=(13, 11, 9), *, across: int = 3, seed: int = 0, width: int = WIDTH) -> TinyField:
    """A grid around the origin, occupied but for its outermost corners, with random networks."""
    occupied = np.zeros(shape, bool)
    occupied[1:-1, 1:-1, 1:-1] = True
    origin = (-VOXEL * (np.array(shape) - 1) / 2).astype(np.float32)
    return first_field(origin, VOXEL, occupied, across=across, width=width, most_networks=1000,
                       rng=np.random.default_rng(seed))  # fmt: skip


def uniform_block(rho=(0.8, 0.4, 0.2), sigma: float = 4000.0, **kwargs) -> TinyField:
    """The same, of one density [1/m] and one radiance transfer."""
    field = empty_block(**kwargs)
    parts, at = np.zeros_like(field.networks), 0
    for number, (inputs, outputs) in enumerate(layer_shapes(field.width)):
        biases = slice(at + inputs * outputs, at + (inputs + 1) * outputs)
        if number == 2:
            parts[:, biases.stop - 1] = np.log(np.expm1(sigma / field.density_scale))
        if number == 4:
            parts[:, biases] = np.log(np.array(rho) / (1 - np.array(rho)))
        at = biases.stop
    return TinyField(field.origin, field.voxel, field.occupied, field.cells, parts, field.width)
