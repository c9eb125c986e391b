"""One substep of many scenes: contact graph, features, network, then sleeping and contact with the floor."""

from __future__ import annotations

from collections.abc import Iterator

import numpy as np
import torch
from jaxtyping import Bool, Float, Int
from torch import Tensor

from osfcore.dynamics.contact_graph import build_graph
from osfcore.dynamics.features import SHIFT_M, TURN_RAD, Inputs, corrections, inputs, mirrored
from osfcore.dynamics.motion import Motion, Sweep, headings, lowest_point
from osfcore.dynamics.propagation_network import PropagationNetwork
from osfcore.dynamics.pusher_path import SUBSTEPS, pusher_path
from osfcore.dynamics.recorded_states import SLEEP_M, SLEEP_RAD
from osfcore.dynamics.shapes.object_shapes import ShapeTable
from osfcore.geometry import torch_rotations as rotations


def advance(
    network: PropagationNetwork,
    table: ShapeTable,
    number: Int[Tensor, "B N"],
    motion: Motion,
    sweep: Sweep,
    mirror: Bool[Tensor, "B"] | None = None,
) -> Motion:
    """The scenes one substep later.

    Args:
        network: predicts the motion of what can move.
        table: shapes of the objects.
        number: which of them each object is.
        motion: the scenes.
        sweep: what the pusher does.
        mirror: scenes to reflect along the heading, in training.
    """
    pusher = motion.pusher + sweep.shift
    graph = build_graph(table, number, motion, sweep)
    rest = motion._replace(
        linear=torch.zeros_like(motion.linear), angular=torch.zeros_like(motion.angular), pusher=pusher
    )
    if not len(graph.scene):
        return rest
    features = inputs(table, graph)
    linear, angular = _predict_motion(network, features, None if mirror is None else mirror[graph.scene])
    awake = (linear.norm(dim=1) > SLEEP_M) | (angular.norm(dim=1) > SLEEP_RAD)
    linear, angular = linear * awake[:, None], angular * awake[:, None]
    place = (graph.scene, graph.slot)
    quaternion = motion.quaternion[place]
    quaternion = torch.where(
        awake[:, None], rotations.unit(rotations.multiply(rotations.exponential(angular), quaternion)), quaternion
    )
    centre = motion.centre[place] + linear
    sunk = motion.floor[place] - lowest_point(table, graph.number, centre, quaternion)
    lift = sunk.clamp(min=0) * awake
    linear = linear + torch.nn.functional.pad(lift[:, None], (2, 0))
    centre = motion.centre[place] + linear
    return Motion(
        centre=motion.centre.index_put(place, centre),
        quaternion=motion.quaternion.index_put(place, quaternion),
        linear=rest.linear.index_put(place, linear),
        angular=rest.angular.index_put(place, angular),
        pusher=pusher,
        floor=motion.floor,
    )


def _predict_motion(
    network: PropagationNetwork, features: Inputs, mirror: Bool[Tensor, "M"] | None
) -> tuple[Float[Tensor, "M 3"], Float[Tensor, "M 3"]]:
    """Translations [m] and rotation vectors [rad] in the world that the network predicts for M objects.

    The network's output is a residual over the quasi-static correction, in units of typical motions, in each object's
    own frame along the heading; with `mirror`, it sees reflected features and its output is reflected back.
    """
    if mirror is None:
        residual = network(features.nodes, features.edges, features.receiver, features.sender)
    else:
        nodes = mirrored(features.nodes, mirror, "node")
        edges = mirrored(features.edges, mirror[features.receiver], "edge")
        residual = mirrored(network(nodes, edges, features.receiver, features.sender), mirror, "motion")
    motion = residual + corrections(features)
    scale = motion.new_tensor([SHIFT_M] * 3 + [TURN_RAD] * 3)
    linear, angular = ((motion * scale).view(-1, 2, 3) @ features.frame).unbind(1)
    return linear, angular


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
