"""Many scenes through many substeps (paper eq. 7, open loop)."""

from __future__ import annotations

from collections.abc import Iterator

import numpy as np
import torch
from jaxtyping import Bool, Float, Int
from torch import Tensor

from osfcore.dynamics.motion import Motion, Sweep, headings
from osfcore.dynamics.propagation_network import PropagationNetwork
from osfcore.dynamics.pusher_path import SUBSTEPS, pusher_path
from osfcore.dynamics.shapes.object_shapes import ShapeTable
from osfcore.dynamics.substep import advance


def unroll(
    network: PropagationNetwork,
    table: ShapeTable,
    number: Int[Tensor, "B N"],
    motion: Motion,
    velocity: Float[Tensor, "T B 2"],
    mirror: Bool[Tensor, "B"] | None = None,
) -> Iterator[Motion]:
    """The scenes after each substep of T actions.

    Args:
        network: predicts the motion of what can move.
        table: shapes of the objects.
        number: which of them each object is.
        motion: the scenes before the first action.
        velocity: of the pusher in each action [m/s].
        mirror: scenes to reflect along the heading, in training.
    """
    path = pusher_path(motion.pusher.double().cpu().numpy(), velocity.transpose(0, 1).double().cpu().numpy())
    shifts = torch.as_tensor(np.diff(path, axis=1), dtype=torch.float32, device=number.device)
    for step in range(shifts.shape[1]):
        sweep = Sweep(headings(velocity[step // SUBSTEPS], motion), shifts[:, step])
        motion = advance(network, table, number, motion, sweep, mirror)
        yield motion
