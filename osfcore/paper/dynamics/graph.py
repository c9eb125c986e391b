"""Who may touch whom, and what the network is told of each (paper eq. 8): objects and the pusher as nodes of a graph.

Node 0 is the pusher, nodes 1 to N are the objects. The input of an object's node is its pose s_t in R^7, as published,
and which object it is. The paper's appendix with the structure of its network is not public; what follows is our
reading of the text:

- which object a node is, is told by an embedding that is learned for each name (`graph_network`);
- the pusher is a node as the objects are, with its position, no rotation and the action a_t; the objects' action is 0;
- positions are in units of `LENGTH_M` and actions in units of the highest speed, so that all inputs are of order one;
- of the two quaternions of an orientation the one with w >= 0 is told, for they mean the same.

Nothing else is told: world coordinates, no velocities, no shapes, no contacts.
"""

from __future__ import annotations

from collections.abc import Iterable
from typing import NamedTuple

import numpy as np
import torch
from jaxtyping import Bool, Float, Int
from torch import Tensor
from torch.nn import functional

from osfcore.fields.field_library import FieldLibrary
from osfcore.geometry.workspace import MAX_SPEED_M_S, PUSHER_HEIGHT_M, PUSHER_RADIUS_M

LENGTH_M = 0.1  # that becomes 1, also in the loss: a centimetre there weighs as much as a turn by 11 deg
POSE, ACTION = 7, 3
NODE_FEATURES = POSE + ACTION
PUSHER_KAPPA_M = max(PUSHER_HEIGHT_M, 2 * PUSHER_RADIUS_M)  # longest axis of the pusher's bounding box
UNKNOWN, PUSHER = 0, 1  # numbers of nodes that are no object with a name; objects have the numbers after these


class Scenes(NamedTuple):
    """Where everything is in B scenes of N objects.

    Attributes:
        position: of the objects [m].
        quaternion: of the objects, unit.
        pusher: its centre [m].
    """

    position: Float[Tensor, "B N 3"]
    quaternion: Float[Tensor, "B N 4"]
    pusher: Float[Tensor, "B 3"]


def longest_axes(fields: FieldLibrary, names: Iterable[str]) -> dict[str, float]:
    """Thresholds kappa of some objects [m]: the longest side of the box, along the object's axes, around what is dense.

    Deviation: dense in our field, at any density, whichever fields are shown.

    Raises:
        UnknownName: if an object has no field.
        CorruptFile: if a field's file is broken.
    """
    return {name: float(np.diff(fields.load(name).extent, axis=0).max()) for name in names}


def adjacency(scenes: Scenes, kappa: Float[Tensor, "B N"]) -> Bool[Tensor, "B A A"]:
    """Which of the A = N + 1 nodes may touch during the action (eq. 8).

        A_ij = 1 where ||p_i - p_j||^2 < kappa and i != j

    The formula is taken as it stands: a squared distance [m^2] is compared with a length [m], so that objects 20 cm
    long are joined up to 45 cm. Of the poses s_i the positions count. The paper has one kappa; here it is the larger
    one of both nodes, so that A is symmetric.

    Args:
        scenes: where everything is.
        kappa: of the objects [m].
    """
    place = torch.cat([scenes.pusher[:, None], scenes.position], dim=1)
    longest = functional.pad(kappa, (1, 0), value=PUSHER_KAPPA_M)
    squared = (place[:, :, None] - place[:, None]).square().sum(dim=-1)
    near = squared < torch.maximum(longest[:, :, None], longest[:, None])
    return near & ~torch.eye(place.shape[1], dtype=torch.bool, device=place.device)


def node_features(scenes: Scenes, action: Float[Tensor, "B 3"]) -> Float[Tensor, "B A F"]:
    """Pose and action of every node.

    Args:
        scenes: where everything is.
        action: velocity of the pusher [m/s].
    """
    upright = torch.zeros_like(scenes.quaternion[:, :1])
    upright[..., 0] = 1
    quaternion = torch.cat([upright, scenes.quaternion], dim=1)
    quaternion = torch.where(quaternion[..., :1] < 0, -quaternion, quaternion)
    position = torch.cat([scenes.pusher[:, None], scenes.position], dim=1) / LENGTH_M
    actions = functional.pad(action[:, None] / MAX_SPEED_M_S, (0, 0, 0, scenes.position.shape[1]))
    return torch.cat([position, quaternion, actions], dim=2)


def node_numbers(objects: Int[Tensor, "B N"]) -> Int[Tensor, "B A"]:
    """What each node is, for its embedding: the pusher first, then the objects as they are numbered."""
    return functional.pad(objects, (1, 0), value=PUSHER)
