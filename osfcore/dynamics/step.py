"""One substep of many scenes: graph, features, network, and what physics allows of its answer."""

from __future__ import annotations

import torch
from jaxtyping import Bool, Float, Int
from torch import Tensor

from osfcore.dynamics import turns
from osfcore.dynamics.features import SHIFT_M, TURN_RAD, edge_features, mirrored, node_features
from osfcore.dynamics.graph import build_graph
from osfcore.dynamics.motion import Motion, Sweep, lowest_point
from osfcore.dynamics.network import PropagationNetwork
from osfcore.dynamics.shapes import ShapeTable

SUBSTEPS = 4  # of one action: the pusher travels 6 cm in one, too far to see contact coming at once
SLEEP_M = 1e-4  # an object that moves less than this in a substep, and turns less than that, rests
SLEEP_RAD = 2e-3


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
        mirror: scenes to be seen in a mirror along the heading, in training.
    """
    pusher = motion.pusher + sweep.shift
    graph = build_graph(table, number, motion, sweep)
    rest = motion._replace(
        linear=torch.zeros_like(motion.linear), angular=torch.zeros_like(motion.angular), pusher=pusher
    )
    if not len(graph.scene):
        return rest
    nodes = node_features(table, graph)
    edges, receiver = edge_features(graph)
    if mirror is None:
        answer = network(nodes, edges, receiver, graph.sender)
    else:
        flags = mirror[graph.scene]
        nodes, edges = mirrored(nodes, flags, "node"), mirrored(edges, flags[receiver], "edge")
        answer = mirrored(network(nodes, edges, receiver, graph.sender), flags, "motion")
    scale = answer.new_tensor([SHIFT_M] * 3 + [TURN_RAD] * 3)
    vectors = (answer * scale).view(-1, 2, 3) @ graph.frame
    linear, angular = vectors.unbind(1)
    awake = (linear.norm(dim=1) > SLEEP_M) | (angular.norm(dim=1) > SLEEP_RAD)
    linear, angular = linear * awake[:, None], angular * awake[:, None]
    place = (graph.scene, graph.slot)
    quaternion = motion.quaternion[place]
    quaternion = torch.where(
        awake[:, None], turns.unit(turns.multiply(turns.exponential(angular), quaternion)), quaternion
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
