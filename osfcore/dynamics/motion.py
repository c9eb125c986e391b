"""States of B scenes of N objects while they move: quasi-static pushing, the pusher's path, and recorded episodes."""

from __future__ import annotations

from typing import NamedTuple

import numpy as np
import torch
from jaxtyping import Bool, Float, Int
from torch import Tensor
from torch.nn import functional

from osfcore.dynamics.shapes import ShapeTable
from osfcore.errors import InvalidInput
from osfcore.geometry import torch_rotations as rotations
from osfcore.geometry.polygons import circle
from osfcore.geometry.poses import Pose
from osfcore.geometry.workspace import PUSHER_REACH_M, STEP_S, TABLE_SIDE_M
from osfcore.io.push_file import PushEpisode

# Quasi-static pushing by the ellipsoidal limit surface of friction with the table.
#
# Friction force (f_x, f_y) and moment m of a sliding object satisfy f_x^2 + f_y^2 + (m / c)^2 = f_max^2 (Howe and
# Cutkosky, 1996), c being the moment over force that friction can hold; its velocity is normal to that surface,
# (v_x, v_y, w) proportional to (f_x, f_y, m / c^2). A contact at (x, y) that sticks and moves by (u_x, u_y)
# therefore moves the object by
#
#     v_x = ((c^2 + x^2) u_x + x y u_y) / (c^2 + x^2 + y^2)
#     v_y = (x y u_x + (c^2 + y^2) u_y) / (c^2 + x^2 + y^2)
#     w   = (x v_y - y v_x) / c^2
#
# (Lynch, Maekawa and Tanie, 1992). If the force lies outside the friction cone, the contact slides, and the force
# is that edge of the cone.


FRICTION = 0.25  # between pusher and object, as in the simulator
ARM_RATIO = 1.2  # c over the mean radius of the outline: objects stand on their corners


def friction_arm(outline: Float[Tensor, "*batch K 2"]) -> Float[Tensor, "*batch"]:
    """Return c, the moment over force that friction with the table can hold, from outlines around their centres [m]."""
    return ARM_RATIO * outline.norm(dim=-1).mean(dim=-1)


def push_motion(
    point: Float[Tensor, "B 2"],
    inward: Float[Tensor, "B 2"],
    depth: Float[Tensor, "B"],
    shift: Float[Tensor, "B 2"],
    arm: Float[Tensor, "B"],
) -> Float[Tensor, "B 3"]:
    """Return the motion of an object pushed at a contact: displacement (x, y) [m] and turn about the vertical [rad].

    Args:
        point: point of contact, from the centre of friction [m].
        inward: normal into the object.
        depth: how far the contact must move along the normal [m].
        shift: shift of what pushes; its tangential part drags the contact along while friction holds [m].
        arm: c, moment over force that friction with the table can hold [m].

    Returns:
        (v_x, v_y, w), zero where depth is not positive.
    """
    tangent = torch.stack([-inward[:, 1], inward[:, 0]], dim=1)
    drag = (shift * tangent).sum(dim=1)
    x, y = point.unbind(1)
    velocity = depth[:, None] * inward + drag[:, None] * tangent
    c2 = arm.square()
    vx = (c2 + x * x) * velocity[:, 0] + x * y * velocity[:, 1]
    vy = x * y * velocity[:, 0] + (c2 + y * y) * velocity[:, 1]
    sticking = torch.stack([vx, vy, x * vy / c2 - y * vx / c2], dim=1) / (c2 + x * x + y * y)[:, None]
    force = sticking[:, :2]
    normal, side = (force * inward).sum(dim=1), (force * tangent).sum(dim=1)
    holds = side.abs() <= FRICTION * normal
    edge = inward + FRICTION * side.sign()[:, None] * tangent
    turn = (x * edge[:, 1] - y * edge[:, 0]) / c2
    contact = edge + turn[:, None] * torch.stack([-y, x], dim=1)
    gain = depth / (contact * inward).sum(dim=1).clamp(min=1e-3)
    sliding = gain[:, None] * torch.cat([edge, turn[:, None]], dim=1)
    return torch.where(holds[:, None], sticking, sliding) * (depth > 0)[:, None]


# The path of the pusher: position-controlled, so it follows from the actions alone.


SUBSTEPS = 4  # of one action: the pusher travels 6 cm in one, too far to see contact coming at once


def pusher_path(
    start: Float[np.ndarray, "*#batch 2"], velocity: Float[np.ndarray, "*batch T 2"]
) -> Float[np.ndarray, "*batch S1 2"]:
    """Return the pusher's centre before the first and after each substep [m]. It stops at the border of its reach."""
    place = np.broadcast_to(np.asarray(start, float), (*velocity.shape[:-2], 2))
    reach = np.maximum(PUSHER_REACH_M, np.abs(place))
    path = [place]
    for step in range(velocity.shape[-2]):
        for _ in range(SUBSTEPS):
            place = np.clip(place + velocity[..., step, :] * (STEP_S / SUBSTEPS), -reach, reach)
            path.append(place)
    return np.stack(path, axis=-2)


# Recorded episodes substep by substep, before anything is a tensor.


SLEEP_M = 1e-4  # an object that moves less than this in a substep, and turns less than that, rests
SLEEP_RAD = 2e-3
_SUNK_M = 0.02  # below the table's top: what lies there fell off
_EDGE_M = TABLE_SIDE_M / 2 - 0.05  # what comes nearer to the table's edge may fall: nothing to learn from


def substates(episode: PushEpisode) -> Pose:
    """Return all poses of an episode, substep by substep.

    Raises:
        InvalidInput: if it was recorded without poses of its substeps.
    """
    if episode.sub_positions is None or episode.sub_quaternions is None or episode.sub_positions.shape[1] != SUBSTEPS:
        raise InvalidInput("push file", "without poses within its actions", "one that 'osf collect pushes' wrote")
    positions = np.concatenate([episode.positions[:1], episode.sub_positions.reshape(-1, *episode.positions.shape[1:])])
    turned = episode.sub_quaternions.reshape(-1, *episode.quaternions.shape[1:])
    return Pose(positions, np.concatenate([episode.quaternions[:1], turned]))


def is_on_table(episode: PushEpisode) -> Bool[np.ndarray, "T1"]:
    """Return whether all objects are on the table, away from its edge, before the first and after each action."""
    reach = np.abs(episode.positions[..., :2]).max(axis=(1, 2))
    return (reach < _EDGE_M) & (episode.positions[..., 2].min(axis=1) > -_SUNK_M)


# The state of B scenes of N objects while they are rolled out, and what the pusher does in them.


_MOVED_M, _MOVED_RAD = 1e-3, 0.02  # during an action: an object that moves less counts as resting
ASIDE = 0.035  # about a cell of the map of directions [rad]


class Motion(NamedTuple):
    """State and last motion of all objects, in world coordinates.

    Attributes:
        centre: centres of mass [m].
        quaternion: orientations, unit quaternions (w, x, y, z).
        linear: displacement of the centres during the last substep [m].
        angular: rotation vectors of the last substep [rad].
        pusher: horizontal position of the pusher's centre [m].
        floor: least height of the lowest point of each object [m]: 0, or less if it was estimated lower.
    """

    centre: Float[Tensor, "B N 3"]
    quaternion: Float[Tensor, "B N 4"]
    linear: Float[Tensor, "B N 3"]
    angular: Float[Tensor, "B N 3"]
    pusher: Float[Tensor, "B 2"]
    floor: Float[Tensor, "B N"]


class Sweep(NamedTuple):
    """Motion of the pusher in one substep.

    Attributes:
        heading: unit vector of its commanded velocity; arbitrary if it stands still.
        shift: its displacement [m]. It is shorter than commanded at the border of its reach.
    """

    heading: Float[Tensor, "B 2"]
    shift: Float[Tensor, "B 2"]


def lowest_point(
    table: ShapeTable, number: Int[Tensor, "A"], centre: Float[Tensor, "A 3"], quaternion: Float[Tensor, "A 4"]
) -> Float[Tensor, "A"]:
    """Return the height of the lowest point of each object over the table's top [m].

    It is the lowest of the farthest points straight down and in directions around that. A single direction may find the
    wrong end of a face that hardly tilts.

    Args:
        table: shapes of the objects.
        number: which of them each object is.
        centre: centre of mass, in the world [m].
        quaternion: orientations in the world, unit.
    """
    around = functional.pad(ASIDE * circle(8, centre.device), (0, 1), value=-1.0)
    down = torch.cat([centre.new_tensor([[0.0, 0.0, -1.0]]), around])
    return centre[:, 2] + table.farthest(number, rotations.matrix(quaternion), down)[..., 2].amin(dim=1)


def headings(velocity: Float[Tensor, "B 2"], motion: Motion) -> Float[Tensor, "B 2"]:
    """Return the directions of the pusher's velocities; if it stands still, of the fastest object.

    All features are rotated into this direction, so that rotating the scene rotates the prediction.
    """
    speed = velocity.norm(dim=1, keepdim=True)
    fastest = motion.linear[..., :2].norm(dim=2).argmax(dim=1)
    rows = torch.arange(len(velocity), device=velocity.device)
    other = motion.linear[rows, fastest, :2]
    other = other / other.norm(dim=1, keepdim=True).clamp(min=1e-9)
    other = torch.where(other.norm(dim=1, keepdim=True) > 0.5, other, other.new_tensor([1.0, 0.0]))
    return torch.where(speed > 1e-6, velocity / speed.clamp(min=1e-6), other)


def going_on(former: Motion, motion: Motion) -> Motion:
    """Return the scenes with velocities from the motion since the former ones, one action earlier.

    The mean over the action is used for its last substep. (Predicting the action again and taking its last substep is
    less exact, see docs/notes/dynamics.md.) An object that moved less than the error of an estimate is at rest.
    """
    opposite = former.quaternion * former.quaternion.new_tensor([1.0, -1.0, -1.0, -1.0])
    turn = rotations.logarithm(rotations.multiply(motion.quaternion, opposite))
    shift = motion.centre - former.centre
    moved = (shift.norm(dim=-1, keepdim=True) > _MOVED_M) | (turn.norm(dim=-1, keepdim=True) > _MOVED_RAD)
    return motion._replace(linear=shift * moved / SUBSTEPS, angular=turn * moved / SUBSTEPS)


def sleeping(motion: Motion) -> Motion:
    """Return the scenes with objects that hardly move at rest."""
    awake = (motion.linear.norm(dim=-1) > SLEEP_M) | (motion.angular.norm(dim=-1) > SLEEP_RAD)
    return motion._replace(linear=motion.linear * awake[..., None], angular=motion.angular * awake[..., None])
