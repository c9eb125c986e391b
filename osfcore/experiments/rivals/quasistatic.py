"""Pushing without learning: quasi-static sliding with an ellipsoidal limit surface.

Objects are their outlines seen from above and slide so slowly that friction with the table balances every push (Mason
1986). Friction force and moment lie on an ellipsoid (Howe and Cutkosky 1996), so that a push through a contact decides
the whole motion, sticking or sliding along the contact (Lynch, Maekawa and Tanie 1992). Nothing rolls, tilts, topples
or goes on by itself. An object pushed by another one is moved out of its way along the contact's normal.
"""

from __future__ import annotations

import itertools
from collections.abc import Iterator

import torch
from jaxtyping import Float, Int
from torch import Tensor
from torch.nn import functional

from osfcore.dynamics.motion import Motion, friction_arm, push_motion
from osfcore.dynamics.shapes import ShapeTable, outlines
from osfcore.geometry import torch_rotations as rotations
from osfcore.geometry.polygons import dot, gap_between, gap_to_point
from osfcore.geometry.workspace import PUSHER_RADIUS_M

_FACE_M = 0.001  # corners that are not farther back than this belong to the face of an outline
_STRETCH_M = 0.0025  # the pusher travels at most this far between two looks at contacts


def push(
    table: ShapeTable, number: Int[Tensor, "B N"], motion: Motion, shifts: Float[Tensor, "S B 2"]
) -> Iterator[Motion]:
    """Yield the scenes after each of the pusher's displacements.

    Args:
        table: shapes of objects.
        number: of each object in the table.
        motion: the scenes at the start, in world coordinates; how they moved before plays no part.
        shifts: displacements of the pusher, one after the other [m].
    """
    rotation = rotations.matrix(motion.quaternion.flatten(0, 1))
    around = outlines(table, number.flatten(), rotation, torch.zeros_like(rotation[:, 0]))
    outline = around.unflatten(0, number.shape)  # around the centres of mass
    arm = friction_arm(outline)
    for shift in shifts:
        parts = max(int(torch.ceil(shift.norm(dim=1).max() / _STRETCH_M)), 1)
        for _ in range(parts):
            motion, outline = _stretch(motion, outline, arm, shift / parts)
        yield motion


def _stretch(motion: Motion, outline: Tensor, arm: Tensor, shift: Tensor) -> tuple[Motion, Tensor]:
    """Move the pusher a short way: first what it touches gives way, then what these touch."""
    pusher = motion.pusher + shift
    radius = outline.square().sum(dim=-1).amax(dim=-1).sqrt()
    count = motion.centre.shape[1]
    pushed = torch.zeros_like(arm, dtype=torch.bool)
    for i in range(count):
        away = pusher - motion.centre[:, i, :2]
        rows = (away.norm(dim=1) < radius[:, i] + PUSHER_RADIUS_M).nonzero()[:, 0]
        if not len(rows):
            continue
        gap = gap_to_point(outline[rows, i], away[rows])
        depth = PUSHER_RADIUS_M - gap.distance
        pushed[rows, i] = depth > 0
        way = push_motion(gap.point, -gap.normal, depth.clamp(min=0), shift[rows], arm[rows, i])
        motion, outline = _moved(motion, outline, (rows, i), way)
    for _ in range(count - 1):
        before = pushed.clone()
        for i, j in itertools.permutations(range(count), 2):
            motion, outline = _shove(motion, outline, arm, (i, j), before, pushed, radius)
    return motion._replace(pusher=pusher), outline


def _shove(
    motion: Motion, outline: Tensor, arm: Tensor, pair: tuple[int, int], before: Tensor, pushed: Tensor, radius: Tensor
) -> tuple[Motion, Tensor]:
    """Move object j out of the way of a pushed object i, and mark it as pushed."""
    i, j = pair
    offset = motion.centre[:, i, :2] - motion.centre[:, j, :2]
    meets = before[:, i] & ~before[:, j] & (offset.norm(dim=1) < radius[:, i] + radius[:, j])
    rows = meets.nonzero()[:, 0]
    if not len(rows):
        return motion, outline
    other = outline[rows, i] + offset[rows, None]
    gap = gap_between(outline[rows, j], other)
    depth = (-gap.distance).clamp(min=0)
    pushed[rows, j] |= depth > 0
    point = _meeting(outline[rows, j], other, gap.normal)
    way = push_motion(point, -gap.normal, depth, torch.zeros_like(gap.normal), arm[rows, j])
    return _moved(motion, outline, (rows, j), way)


def _meeting(
    first: Float[Tensor, "B K 2"], second: Float[Tensor, "B K 2"], normal: Float[Tensor, "B 2"]
) -> Float[Tensor, "B 2"]:
    """Return the middle of where the faces of two outlines meet, the normal pointing out of the first."""
    tangent = torch.stack([-normal[:, 1], normal[:, 0]], dim=1)
    ends = []
    for outline, out in ((first, normal), (second, -normal)):
        height, along = (dot(outline, direction[:, None]) for direction in (out, tangent))
        off = torch.where(height > height.amax(dim=1, keepdim=True) - _FACE_M, 0.0, 1.0)
        ends.append(((along + off).amin(dim=1), (along - off).amax(dim=1)))
    middle = (torch.maximum(ends[0][0], ends[1][0]) + torch.minimum(ends[0][1], ends[1][1])) / 2
    reach = dot(first, normal[:, None]).amax(dim=1)
    return middle[:, None] * tangent + reach[:, None] * normal


def _moved(
    motion: Motion, outline: Tensor, place: tuple[Int[Tensor, "R"], int], way: Float[Tensor, "R 3"]
) -> tuple[Motion, Tensor]:
    """Slide and turn one object of some scenes."""
    centre, quaternion, outline = motion.centre.clone(), motion.quaternion.clone(), outline.clone()
    centre[place] = centre[place] + functional.pad(way[:, :2], (0, 1))
    turn = functional.pad(way[:, 2:], (2, 0))
    quaternion[place] = rotations.unit(rotations.multiply(rotations.exponential(turn), quaternion[place]))
    cosine, sine = way[:, 2].cos()[:, None], way[:, 2].sin()[:, None]
    x, y = outline[place].unbind(-1)
    outline[place] = torch.stack([cosine * x - sine * y, sine * x + cosine * y], dim=-1)
    return motion._replace(centre=centre, quaternion=quaternion), outline
