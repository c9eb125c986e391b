"""Where objects touch: outlines of their convex parts against the pusher and against each other.

Seen from above, an object touches with whichever of its convex parts is nearest; most objects are one part. What is
wholly above the pusher's top cannot meet it, nor can parts meet that lie one well above the other.
"""

from __future__ import annotations

from typing import NamedTuple

import numpy as np
import torch
from jaxtyping import Float, Int
from torch import Tensor

from osfcore.dynamics.shapes.object_shapes import ShapeTable
from osfcore.geometry.polygons import Gap, circle, direction_index, dot, gap_between, gap_to_point
from osfcore.geometry.poses import Pose, quaternion_to_matrix
from osfcore.geometry.workspace import PUSHER_CENTRE_Z_M, PUSHER_HEIGHT_M, PUSHER_RADIUS_M

OUTLINE = 64  # corners of an outline
TOUCH_M = 0.008  # a substep's sweep is sampled at three points: nothing nearer than this is missed
PAIR_REACH_M = 0.025  # objects closer than this may touch within a substep
PAIR_STRIDE = 2  # pairs are compared with every second corner
PUSHER_TOP_M = PUSHER_CENTRE_Z_M + PUSHER_HEIGHT_M / 2
CLEAR_M = 0.02  # parts this far above others are not met within a substep
FAR_M = 1.0  # distance that stands for never
SLACK_M = 0.006  # by how much the bound of the nearest parts may exceed that of others


class Solids(NamedTuple):
    """The R convex parts of A objects, those of each side by side.

    Attributes:
        owner: object of each part.
        first: number of each object's first part.
        many: how many parts each object has.
        outline: seen from above [m].
        low, high: heights of the lowest and the highest point [m].
    """

    owner: Int[Tensor, "R"]
    first: Int[Tensor, "A"]
    many: Int[Tensor, "A"]
    outline: Float[Tensor, "R K 2"]
    low: Float[Tensor, "R"]
    high: Float[Tensor, "R"]


class PusherContact(NamedTuple):
    """Gaps between A objects and the pusher's rim, if nothing moved.

    Attributes:
        before, halfway, after: at the pusher's start, halfway and at its end.
        face: both ends of the side that faces the pusher at its start [m].
    """

    before: Gap
    halfway: Gap
    after: Gap
    face: Float[Tensor, "A 2 2"]


class PairContact(NamedTuple):
    """Gaps between E pairs of objects.

    Attributes:
        gap: out of the first one.
        first_face, second_face: both ends of the sides that face each other [m].
    """

    gap: Gap
    first_face: Float[Tensor, "E 2 2"]
    second_face: Float[Tensor, "E 2 2"]


def outlines(
    table: ShapeTable, body: Int[Tensor, "A"], rotation: Float[Tensor, "A 3 3"], centre: Float[Tensor, "A 3"]
) -> Float[Tensor, "A K 2"]:
    """Outlines of bodies seen from above [m], in the frame of `centre`.

    Args:
        table: shapes.
        body: rows of the table: whole objects or convex parts.
        rotation: of each body.
        centre: of mass of each body's object [m].
    """
    flat = torch.nn.functional.pad(circle(OUTLINE, centre.device), (0, 1))
    return table.farthest(body, rotation, flat)[..., :2] + centre[:, None, :2]


def part_outlines(table: ShapeTable, number: int, pose: Pose) -> Float[np.ndarray, "R K 2"]:
    """Outlines of one object's convex parts, seen from above in the world [m].

    Args:
        table: shapes, on the CPU.
        number: which of them the object is.
        pose: T_world_object.
    """
    body = table.first_part[number] + torch.arange(int(table.part_count[number]))
    rotation = torch.as_tensor(quaternion_to_matrix(pose.quaternion), dtype=torch.float32)
    centre = torch.as_tensor(pose.apply(table.centre[number].numpy()), dtype=torch.float32)
    return outlines(table, body, rotation.expand(len(body), 3, 3), centre.expand(len(body), 3)).numpy()


def solids(
    table: ShapeTable,
    number: Int[Tensor, "A"],
    rotation: Float[Tensor, "A 3 3"],
    centre: Float[Tensor, "A 3"],
    outline: Float[Tensor, "A K 2"],
) -> Solids:
    """All convex parts of some objects.

    Args:
        table: shapes.
        number: shape of each object.
        rotation: of each object.
        centre: of mass [m].
        outline: of the whole objects, which serves those of one part [m].
    """
    count = table.part_count[number]
    first = count.cumsum(0) - count
    owner = torch.arange(len(number), device=number.device).repeat_interleave(count)
    body = table.first_part[number][owner] + torch.arange(len(owner), device=number.device) - first[owner]
    shown = outline[owner]
    rows = (count[owner] > 1).nonzero()[:, 0]
    if len(rows):
        parts = owner[rows]
        shown = shown.index_put((rows,), outlines(table, body[rows], rotation[parts], centre[parts]))
    vertical = centre.new_tensor([[0.0, 0.0, -1.0], [0.0, 0.0, 1.0]])
    reach = table.extents(body, rotation[owner], vertical)
    height = centre[owner, 2]
    return Solids(owner, first, count, shown, height - reach[:, 0], height + reach[:, 1])


def pusher_contact(parts: Solids, shift: Float[Tensor, "A 2"]) -> PusherContact:
    """Each object's nearest part to a pusher that starts at the origin."""
    own = shift[parts.owner]
    halfway = _rim_gap(parts.outline, 0.5 * own)
    halfway = halfway._replace(distance=torch.where(parts.low < PUSHER_TOP_M, halfway.distance, FAR_M))
    reached = halfway.distance - 0.5 * own.norm(dim=1) < TOUCH_M  # elsewhere neither end comes near
    before, after = (_gap_where(reached, parts.outline, share * own, halfway) for share in (0.0, 1.0))
    nearest = [_nearest(parts.owner, gap.distance, len(shift)) for gap in (before, halfway, after)]
    gaps = [_rows(gap, rows) for gap, rows in zip((before, halfway, after), nearest, strict=True)]
    return PusherContact(*gaps, face=_face(parts.outline[nearest[0]], gaps[0].normal))


def _rim_gap(outline: Float[Tensor, "A K 2"], centre: Float[Tensor, "A 2"]) -> Gap:
    """From outlines to the pusher's rim."""
    gap = gap_to_point(outline, centre)
    return gap._replace(distance=gap.distance - PUSHER_RADIUS_M)


def _gap_where(chosen: Tensor, outline: Tensor, centre: Float[Tensor, "A 2"], other: Gap) -> Gap:
    """The same for chosen outlines; the others, which are far away, keep another gap."""
    rows = chosen.nonzero()[:, 0]
    gap = _rim_gap(outline[rows], centre[rows])
    return Gap(*(old.index_put((rows,), new) for old, new in zip(other, gap, strict=True)))


def pair_contact(
    parts: Solids, outline: Float[Tensor, "A K 2"], first: Int[Tensor, "E"], second: Int[Tensor, "E"]
) -> PairContact:
    """The nearest parts of pairs of objects.

    Args:
        parts: of all objects.
        outline: of the whole objects [m].
        first: object of each pair.
        second: the other one.
    """
    gap = gap_between(*(outline[place, ::PAIR_STRIDE] for place in (first, second)))
    a, b = parts.first[first], parts.first[second]
    many = ((parts.many[first] * parts.many[second] > 1) & (gap.distance < PAIR_REACH_M)).nonzero()[:, 0]
    if len(many):
        left, right, nearest = _nearest_parts(parts, first[many], second[many])
        gap = Gap(*(old.index_put((many,), new) for old, new in zip(gap, nearest, strict=True)))
        a, b = a.index_put((many,), left), b.index_put((many,), right)
    return PairContact(gap, _face(parts.outline[a], gap.normal), _face(parts.outline[b], -gap.normal))


def _nearest_parts(parts: Solids, first: Int[Tensor, "E"], second: Int[Tensor, "E"]) -> tuple[Tensor, Tensor, Gap]:
    """Among all parts of one object and all of another the two that are nearest, and their gap."""
    width = parts.many[second]
    total = parts.many[first] * width
    pair = torch.arange(len(first), device=first.device).repeat_interleave(total)
    local = torch.arange(len(pair), device=first.device) - (total.cumsum(0) - total)[pair]
    a = parts.first[first][pair] + local // width[pair]
    b = parts.first[second][pair] + local % width[pair]
    bound = _separation_bound(parts, a, b)
    least = bound.new_full((len(first),), torch.inf).scatter_reduce(0, pair, bound, "amin")
    close = (bound <= least[pair] + SLACK_M).nonzero()[:, 0]
    a, b, pair = a[close], b[close], pair[close]
    gap = gap_between(*(parts.outline[place, ::PAIR_STRIDE] for place in (a, b)))
    gap = gap._replace(distance=torch.where(bound[close] < FAR_M, gap.distance, FAR_M))
    best = _nearest(pair, gap.distance, len(first))
    return a[best], b[best], _rows(gap, best)


def _separation_bound(parts: Solids, a: Int[Tensor, "R"], b: Int[Tensor, "R"]) -> Float[Tensor, "R"]:
    """Largest separation of two parts along the directions of outlines; `FAR_M` where one is well above the other [m].

    It is a few millimetres less than their distance at most, and tells which of many pairs are worth comparing exactly:
    two hollow objects side by side have hundreds.
    """
    count = parts.outline.shape[1]
    reach = dot(parts.outline, circle(count, parts.outline.device))
    bound = -(reach[a] + reach.roll(count // 2, dims=1)[b]).amin(dim=1)
    apart = torch.maximum(parts.low[a] - parts.high[b], parts.low[b] - parts.high[a]) > CLEAR_M
    return torch.where(apart, FAR_M, bound)


def _nearest(owner: Int[Tensor, "R"], distance: Float[Tensor, "R"], count: int) -> Int[Tensor, "A"]:
    """Number of the nearest row of each of `count` owners, the first one where several are."""
    rows = torch.arange(len(owner), device=owner.device)
    if len(owner) == count:
        return rows
    least = distance.new_full((count,), torch.inf).scatter_reduce(0, owner, distance.detach(), "amin")
    candidate = torch.where(distance > least[owner], len(owner) - 1, rows)
    return rows.new_full((count,), len(owner) - 1).scatter_reduce(0, owner, candidate, "amin")


def _rows(gap: Gap, rows: Int[Tensor, "E"]) -> Gap:
    return Gap(*(part[rows] for part in gap))


def _face(outline: Float[Tensor, "A K 2"], normal: Float[Tensor, "A 2"]) -> Float[Tensor, "A 2 2"]:
    """Both ends of the side of an outline that faces a direction; a corner gives about the same point twice."""
    count = outline.shape[1]
    middle = direction_index(normal, count)
    rows = torch.arange(len(outline), device=outline.device)
    return torch.stack([outline[rows, (middle + step) % count] for step in (-1, 1)], dim=1)
