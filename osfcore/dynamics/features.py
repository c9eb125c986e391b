"""What the network sees of a graph: numbers along the pusher's heading, relative to each object's centre of mass."""

from __future__ import annotations

import math
from typing import Literal

import torch
from jaxtyping import Float
from torch import Tensor

from osfcore.dynamics.graph import OUTLINE, Graph
from osfcore.dynamics.outline import direction_index
from osfcore.dynamics.shapes import ShapeTable
from osfcore.scene import PUSHER_RADIUS_M

_AROUND = 16  # horizontal directions in which an object's extent is told
_SLANTED = 8  # directions 45 deg below and above the horizon
LENGTH_M = 0.05  # that becomes 1
SHIFT_M = 0.01  # displacement that becomes 1
TURN_RAD = 0.1  # rotation that becomes 1
_GAP_M = 0.004  # near contact, gaps count in these
NODE_FEATURES = _AROUND + 2 * _SLANTED + 2 + 1 + 3 + 3 + 2
EDGE_FEATURES = 28


def node_features(table: ShapeTable, graph: Graph) -> Float[Tensor, "A F"]:
    """Of each object: its extent in 34 directions, its height over the table, its motion, the pusher's motion."""
    around = graph.outline[:, :: OUTLINE // _AROUND] - graph.centre[:, None, :2]
    directions = _horizontal(_AROUND, graph.centre)
    extents = (around * directions[:, :2]).sum(dim=-1)
    slanted = _horizontal(_SLANTED, graph.centre)
    vertical = slanted.new_tensor([[0.0, 0.0, -1.0], [0.0, 0.0, 1.0]])
    half = math.sqrt(0.5)
    rest = torch.cat([half * (slanted + vertical[0]), half * (slanted + vertical[1]), vertical])
    farther = (table.farthest(graph.number, graph.rotation, rest) * rest).sum(dim=-1)
    height = graph.centre[:, 2:] - farther[:, -2:-1]
    lengths = torch.cat([extents, farther, 5 * height], dim=1) / LENGTH_M
    return torch.cat([lengths, graph.linear / SHIFT_M, graph.angular / TURN_RAD, graph.shift / SHIFT_M], dim=1)


def _horizontal(count: int, like: Tensor) -> Float[Tensor, "D 3"]:
    angles = torch.arange(count, device=like.device) * (2 * math.pi / count)
    return torch.stack([angles.cos(), angles.sin(), torch.zeros_like(angles)], dim=1)


def edge_features(graph: Graph) -> tuple[Float[Tensor, "E F"], Tensor]:
    """Of each edge: first those from the pusher to the objects it can touch, then those between objects.

    Returns:
        The features, and the receiver of each edge; senders of the latter part are `graph.sender`.
    """
    pushed = graph.touched.nonzero()[:, 0]
    return torch.cat([_from_pusher(graph, pushed), _between(graph)]), torch.cat([pushed, graph.receiver])


def _from_pusher(graph: Graph, pushed: Tensor) -> Tensor:
    centre = graph.centre[pushed]
    before, halfway, after = graph.before, graph.halfway, graph.after
    shift = torch.nn.functional.pad(graph.shift[pushed], (0, 1))
    normal = before.normal[pushed]
    return _edge(
        is_pusher=1.0,
        away=-centre,
        shift=shift,
        turn=torch.zeros_like(shift),
        gaps=(before.distance[pushed], halfway.distance[pushed], after.distance[pushed]),
        normals=(normal, after.normal[pushed]),
        points=(before.point[pushed] - centre[:, :2], after.point[pushed] - centre[:, :2]),
        ends=_face(graph.outline[pushed], normal) - centre[:, None, :2],
        other_ends=(-PUSHER_RADIUS_M * normal - centre[:, :2])[:, None].expand(-1, 2, -1),
    )


def _between(graph: Graph) -> Tensor:
    i, j = graph.receiver, graph.sender
    centre, normal, distance = graph.centre[i], graph.pair.normal, graph.pair.distance
    motion = graph.linear[j] - graph.linear[i]
    later = distance + (motion[:, :2] * normal).sum(dim=-1)
    point = graph.pair.point - centre[:, :2]
    return _edge(
        is_pusher=0.0,
        away=graph.centre[j] - centre,
        shift=graph.linear[j],
        turn=graph.angular[j],
        gaps=(distance, (distance + later) / 2, later),
        normals=(normal, normal),
        points=(point, point + motion[:, :2]),
        ends=_face(graph.outline[i], normal) - centre[:, None, :2],
        other_ends=_face(graph.outline[j], -normal) - centre[:, None, :2],
    )


def _edge(
    *,
    is_pusher: float,
    away: Tensor,
    shift: Tensor,
    turn: Tensor,
    gaps: tuple[Tensor, ...],
    normals: tuple[Tensor, Tensor],
    points: tuple[Tensor, Tensor],
    ends: Tensor,
    other_ends: Tensor,
) -> Tensor:
    gap = torch.stack(gaps, dim=1)
    levers = [p[:, :1] * n[:, 1:] - p[:, 1:] * n[:, :1] for p, n in zip(points, normals, strict=True)]
    lengths = torch.cat([away, *levers, ends.flatten(1), other_ends.flatten(1)], dim=1) / LENGTH_M
    near = (gap / _GAP_M).clamp(-4, 4)
    kind = torch.full_like(gap[:, :1], is_pusher)
    return torch.cat([kind, lengths, near, *normals, shift / SHIFT_M, turn / TURN_RAD, gap[:, 2:] / LENGTH_M], dim=1)


def _face(outline: Tensor, normal: Tensor) -> Float[Tensor, "A 2 2"]:
    """Both ends of the side of an outline that faces a direction; a corner gives about the same point twice."""
    count = outline.shape[1]
    middle = direction_index(normal, count)
    rows = torch.arange(len(outline), device=outline.device)
    return torch.stack([outline[rows, (middle - 1) % count], outline[rows, (middle + 1) % count]], dim=1)


def mirrored(values: Tensor, flags: Tensor, kind: Literal["node", "edge", "motion"]) -> Tensor:
    """Features or answers with those rows reflected along the heading whose flag is set: left becomes right."""
    order, sign = _MIRRORS[kind]
    reflected = values[:, torch.tensor(order, device=values.device)] * values.new_tensor(sign)
    return torch.where(flags[:, None], reflected, values)


def _mirror(*parts: tuple[list[int], list[float]]) -> tuple[list[int], list[float]]:
    """Where each number comes from in the mirror, and with which sign, from those of its parts."""
    order: list[int] = []
    sign: list[float] = []
    for places, signs in parts:
        order += [len(sign) + place for place in places]
        sign += signs
    return order, sign


def _fan(count: int) -> tuple[list[int], list[float]]:
    return [-k % count for k in range(count)], [1.0] * count


_SCALAR, _POLAR, _AXIAL, _PLANE = ([0], [1.0]), ([0, 1, 2], [1.0, -1, 1]), ([0, 1, 2], [-1.0, 1, -1]), ([0, 1], [1.0, -1])
_LEVER = ([0], [-1.0])
_ENDS = ([2, 3, 0, 1], [1.0, -1, 1, -1])
_MIRRORS = {
    "node": _mirror(_fan(_AROUND), _fan(_SLANTED), _fan(_SLANTED), *[_SCALAR] * 3, _POLAR, _AXIAL, _PLANE),
    "edge": _mirror(_SCALAR, _POLAR, _LEVER, _LEVER, _ENDS, _ENDS, *[_SCALAR] * 3, _PLANE, _PLANE, _POLAR, _AXIAL,
                    _SCALAR),
    "motion": _mirror(_POLAR, _AXIAL),
}  # fmt: skip
