"""The state of B scenes of N objects while they are rolled out, and what the pusher does in them."""

from __future__ import annotations

from typing import NamedTuple

import torch
from jaxtyping import Float, Int
from torch import Tensor
from torch.nn import functional

from osfcore.dynamics.pusher_path import SUBSTEPS
from osfcore.dynamics.recorded_states import SLEEP_M, SLEEP_RAD
from osfcore.dynamics.shapes.object_shapes import ShapeTable
from osfcore.geometry import torch_rotations as rotations
from osfcore.geometry.polygons import circle

_MOVED_M, _MOVED_RAD = 1e-3, 0.02  # during an action: less is taken for rest
ASIDE = 0.035  # about a cell of the map of directions [rad]


class Motion(NamedTuple):
    """Where everything is and how it moved last, in world coordinates.

    Attributes:
        centre: centres of mass [m].
        quaternion: orientations, unit.
        linear: displacement of the centres during the last substep [m].
        angular: rotation vectors of the last substep [rad].
        pusher: horizontal position of the pusher's centre [m].
        floor: how low the lowest point of each object may come: 0, or less where it was estimated lower [m].
    """

    centre: Float[Tensor, "B N 3"]
    quaternion: Float[Tensor, "B N 4"]
    linear: Float[Tensor, "B N 3"]
    angular: Float[Tensor, "B N 3"]
    pusher: Float[Tensor, "B 2"]
    floor: Float[Tensor, "B N"]


class Sweep(NamedTuple):
    """What the pusher does in one substep.

    Attributes:
        heading: unit vector of its commanded velocity; any where it stands still.
        shift: its displacement [m]; shorter than commanded where its reach ends.
    """

    heading: Float[Tensor, "B 2"]
    shift: Float[Tensor, "B 2"]


def lowest_point(
    table: ShapeTable, number: Int[Tensor, "A"], centre: Float[Tensor, "A 3"], quaternion: Float[Tensor, "A 4"]
) -> Float[Tensor, "A"]:
    """Height of the lowest point of each object over the table's top [m].

    The lowest of what is farthest straight down and in directions around it: one alone may find the wrong end of a face
    that hardly tilts.

    Args:
        table: shapes of the objects.
        number: which of them each object is.
        centre: of mass, in the world [m].
        quaternion: orientations in the world, unit.
    """
    around = functional.pad(ASIDE * circle(8, centre.device), (0, 1), value=-1.0)
    down = torch.cat([centre.new_tensor([[0.0, 0.0, -1.0]]), around])
    return centre[:, 2] + table.farthest(number, rotations.matrix(quaternion), down)[..., 2].amin(dim=1)


def headings(velocity: Float[Tensor, "B 2"], motion: Motion) -> Float[Tensor, "B 2"]:
    """Directions of the pusher's velocities; where it stands still, of the fastest object, so that nothing else counts.

    Everything the network sees is turned into this direction: turning the scene turns the prediction.
    """
    speed = velocity.norm(dim=1, keepdim=True)
    fastest = motion.linear[..., :2].norm(dim=2).argmax(dim=1)
    rows = torch.arange(len(velocity), device=velocity.device)
    other = motion.linear[rows, fastest, :2]
    other = other / other.norm(dim=1, keepdim=True).clamp(min=1e-9)
    other = torch.where(other.norm(dim=1, keepdim=True) > 0.5, other, other.new_tensor([1.0, 0.0]))
    return torch.where(speed > 1e-6, velocity / speed.clamp(min=1e-6), other)


def going_on(former: Motion, motion: Motion) -> Motion:
    """The scenes with velocities by how things moved since the former ones, one action ago.

    The mean over the action stands for its last substep. (To predict that action again and take its last substep is
    less exact, see docs/dynamics.md.) What moved by less than an estimate may err is at rest.
    """
    opposite = former.quaternion * former.quaternion.new_tensor([1.0, -1.0, -1.0, -1.0])
    turn = rotations.logarithm(rotations.multiply(motion.quaternion, opposite))
    shift = motion.centre - former.centre
    moved = (shift.norm(dim=-1, keepdim=True) > _MOVED_M) | (turn.norm(dim=-1, keepdim=True) > _MOVED_RAD)
    return motion._replace(linear=shift * moved / SUBSTEPS, angular=turn * moved / SUBSTEPS)


def sleeping(motion: Motion) -> Motion:
    """The same with objects that hardly move at rest."""
    awake = (motion.linear.norm(dim=-1) > SLEEP_M) | (motion.angular.norm(dim=-1) > SLEEP_RAD)
    return motion._replace(linear=motion.linear * awake[..., None], angular=motion.angular * awake[..., None])
