"""Poses after each action by the paper's network, and the loss that it is trained with.

The network predicts the change of a pose, which is added to it; the quaternion is normalised afterwards (eq. 7 leaves
open how the next pose comes about). The pusher goes where its actions take it: a robot knows its hand.
"""

from __future__ import annotations

from collections.abc import Iterator

import torch
from jaxtyping import Float, Int
from torch import Tensor
from torch.nn import functional

from osfcore.paper.dynamics.graph import LENGTH_M, Scenes, adjacency, node_features, node_numbers
from osfcore.paper.dynamics.graph_network import GraphNetwork


def unroll(
    network: GraphNetwork,
    number: Int[Tensor, "B N"],
    kappa: Float[Tensor, "B N"],
    start: Scenes,
    actions: Float[Tensor, "B T 3"],
    pusher: Float[Tensor, "B T1 3"],
) -> Iterator[Scenes]:
    """The scenes after each action, each predicted from the one before.

    Args:
        network: predicts one action.
        number: of each object, as the network numbers them.
        kappa: of each object [m].
        start: the scenes before the first action.
        actions: velocities of the pusher [m/s].
        pusher: its centre before the first and after each action [m].
    """
    scenes, numbers = start, node_numbers(number)
    for step in range(actions.shape[1]):
        features = node_features(scenes, actions[:, step])
        change = network(features, numbers, adjacency(scenes, kappa))[:, 1:]
        # the network was told the quaternion with w >= 0, so its change belongs to that one
        told = features[:, 1:, 3:7]
        position = scenes.position + LENGTH_M * change[..., :3]
        scenes = Scenes(position, functional.normalize(told + change[..., 3:], dim=-1), pusher[:, step + 1])
        yield scenes


def squared_error(
    predicted: Scenes, position: Float[Tensor, "B N 3"], quaternion: Float[Tensor, "B N 4"]
) -> Float[Tensor, ""]:
    """Squared error of position and quaternion, summed across the objects of a scene, mean over the scenes.

    Of the two quaternions of the true orientation the nearer one counts. The paper gives no unit of length; here it is
    `LENGTH_M`.

    Args:
        predicted: by the network.
        position: true [m].
        quaternion: true.
    """
    is_opposite = (predicted.quaternion * quaternion).sum(dim=-1, keepdim=True) < 0
    shift = (predicted.position - position) / LENGTH_M
    turn = predicted.quaternion - torch.where(is_opposite, -quaternion, quaternion)
    return (shift.square().sum(dim=-1) + turn.square().sum(dim=-1)).sum(dim=1).mean()
