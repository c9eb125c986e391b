"""What the network sees of a graph: numbers along each object's own direction of push, from its centre of mass.

Every object has a frame of its own: x points along the normal of the contact that pushes it most directly, z up. All
vectors that reach an object are told in its frame and so is its answer, so a scene that is turned or shifted gives the
same numbers.
"""

from __future__ import annotations

import math
from typing import Literal, NamedTuple

import torch
from jaxtyping import Float, Int
from torch import Tensor
from torch.nn import functional

from osfcore.dynamics.contact_graph import Graph
from osfcore.dynamics.limit_surface import friction_arm, push_motion
from osfcore.dynamics.shapes.object_shapes import ShapeTable
from osfcore.geometry import torch_rotations as rotations
from osfcore.geometry.polygons import Gap, dot
from osfcore.geometry.workspace import PUSHER_RADIUS_M

AROUND = 16  # horizontal directions in which an object's extent is told
SLANTED = 8  # directions 45 deg below and above the horizon
FOOT = 8  # directions close to straight down, in which lies what an object stands on
FOOT_ANGLE = math.radians(12)  # off the vertical
LENGTH_M = 0.05  # that becomes 1
SHIFT_M = 0.01  # displacement that becomes 1
TURN_RAD = 0.1  # rotation that becomes 1
MAGNIFIED = 5  # heights over the table: millimetres matter there
GAP_M = 0.004  # near contact, gaps count in these
CLOSE_M = 0.01  # an object this close gives the direction, rather than the motion
NODE_FEATURES = AROUND + 2 * SLANTED + 2 + 1 + 3 + 3 + 2 + 3 + 3 * FOOT + 1
EDGE_FEATURES = 35


class Inputs(NamedTuple):
    """A graph in numbers.

    Attributes:
        nodes: of each object.
        edges: from the pusher to the objects it can touch, then between objects.
        receiver: object at the end of each edge.
        sender: object at the beginning of each edge between objects.
        frame: rotation from the world to each object's frame.
        quasistatic: how the pusher would make each object slide without inertia: x, y, turn, in units of the answer.
    """

    nodes: Float[Tensor, "A F"]
    edges: Float[Tensor, "E G"]
    receiver: Int[Tensor, "E"]
    sender: Int[Tensor, "S"]
    frame: Float[Tensor, "A 3 3"]
    quasistatic: Float[Tensor, "A 3"]


def inputs(table: ShapeTable, graph: Graph) -> Inputs:
    """All that the network needs."""
    turn = rotations.facing(_directions(graph))
    quasistatic = _quasistatic_sliding(graph, graph.pusher.after, turn)
    pushed = graph.touched.nonzero()[:, 0]
    edges = torch.cat([_from_pusher(graph, pushed, turn), _between(graph, turn)])
    nodes = _nodes(table, graph, turn, quasistatic)
    return Inputs(nodes, edges, torch.cat([pushed, graph.receiver]), graph.sender, turn @ graph.frame, quasistatic)


def corrections(features: Inputs) -> Float[Tensor, "A 6"]:
    """What the network's answer is added to: the sliding that is guessed, as displacement and rotation vector."""
    flat = torch.zeros_like(features.quasistatic)
    return torch.cat([features.quasistatic[:, :2], flat, features.quasistatic[:, 2:]], dim=1)


def _directions(graph: Graph) -> Float[Tensor, "A 2"]:
    """Where each object is being pushed to: by the pusher, else by the closest object, else where it is moving."""
    flat = graph.linear[:, :2]
    speed = flat.norm(dim=1, keepdim=True)
    moving = torch.where(speed > 1e-6, flat / speed.clamp(min=1e-6), flat.new_tensor([1.0, 0.0]))
    closest = speed.new_full((len(speed),), 1.0).scatter_reduce(0, graph.receiver, graph.pair.gap.distance, "amin")
    is_closest = graph.pair.gap.distance <= closest[graph.receiver]
    neighbour = moving.index_put((graph.receiver[is_closest],), -graph.pair.gap.normal[is_closest])
    by_neighbour = (closest < CLOSE_M)[:, None] | ((closest < 1.0)[:, None] & (speed <= 1e-6))
    direction = torch.where(by_neighbour, neighbour, moving)
    return torch.where(graph.touched[:, None], -graph.pusher.after.normal, direction)


def _quasistatic_sliding(graph: Graph, gap: Gap, turn: Float[Tensor, "A 3 3"]) -> Float[Tensor, "A 3"]:
    """Sliding at a contact, so far that the pusher's last position is free."""
    centre = graph.centre[:, :2]
    depth = (-graph.pusher.after.distance).clamp(min=0)
    way = push_motion(
        gap.point - centre, -gap.normal, depth, graph.shift, friction_arm(graph.outline - centre[:, None])
    )
    along = (turn[:, :2, :2] @ way[:, :2, None])[..., 0]
    return torch.cat([along / SHIFT_M, way[:, 2:] / TURN_RAD], dim=1)


def _nodes(table: ShapeTable, graph: Graph, turn: Tensor, quasistatic: Tensor) -> Float[Tensor, "A F"]:
    """Extents in 34 directions, height over the table, motion, the pusher's motion, how it would slide, its foot."""
    slanted = functional.pad(_fan_of(SLANTED, turn), (0, 1))
    vertical = slanted.new_tensor([[0.0, 0.0, -1.0], [0.0, 0.0, 1.0]])
    half = math.sqrt(0.5)
    flat = functional.pad(_fan_of(AROUND, turn), (0, 1))
    directions = torch.cat([flat, half * (slanted + vertical[0]), half * (slanted + vertical[1]), vertical])
    extents = table.extents(graph.number, turn @ graph.rotation, directions)
    height = graph.centre[:, 2:] - extents[:, -2:-1]
    motion = torch.stack([graph.linear, graph.angular, functional.pad(graph.shift, (0, 1))], dim=2)
    linear, angular, shift = (turn @ motion).unbind(2)
    lengths = torch.cat([extents, MAGNIFIED * height], dim=1) / LENGTH_M
    motions = [linear / SHIFT_M, angular / TURN_RAD, shift[:, :2] / SHIFT_M]
    return torch.cat([lengths, *motions, quasistatic, _foot(table, graph, turn)], dim=1)


def _foot(table: ShapeTable, graph: Graph, turn: Tensor) -> Float[Tensor, "A 25"]:
    """What an object stands on, for friction acts there: its lowest points all around, and their mean distance."""
    fan = math.sin(FOOT_ANGLE) * _fan_of(FOOT, turn)
    downward = functional.pad(fan, (0, 1), value=-math.cos(FOOT_ANGLE))
    points = table.farthest(graph.number, turn @ graph.rotation, downward)
    height = MAGNIFIED * (points[..., 2] + graph.centre[:, None, 2])
    distance = points[..., :2].norm(dim=2).mean(dim=1, keepdim=True)
    return torch.cat([points[..., 0], points[..., 1], height, distance], dim=1) / LENGTH_M


def _fan_of(count: int, like: Tensor) -> Float[Tensor, "D 2"]:
    angles = torch.arange(count, device=like.device) * (2 * math.pi / count)
    return torch.stack([angles.cos(), angles.sin()], dim=1)


def _from_pusher(graph: Graph, pushed: Tensor, turn: Tensor) -> Tensor:
    centre = graph.centre[pushed]
    before, halfway, after = (Gap(*(part[pushed] for part in gap)) for gap in graph.pusher[:3])
    shift = functional.pad(graph.shift[pushed], (0, 1))
    rim = -PUSHER_RADIUS_M * before.normal - centre[:, :2]
    return _edge(
        turn[pushed],
        is_pusher=1.0,
        slide=_quasistatic_sliding(graph, graph.pusher.before, turn)[pushed],
        away=-centre,
        motion=(shift, torch.zeros_like(shift)),
        gaps=(before.distance, halfway.distance, after.distance),
        points=[
            *(before.point - centre[:, :2], after.point - centre[:, :2]),
            *(graph.pusher.face[pushed] - centre[:, None, :2]).unbind(1),
            *(rim, rim),
        ],
        directions=[before.normal, after.normal, shift[:, :2] / SHIFT_M],
    )


def _between(graph: Graph, turn: Tensor) -> Tensor:
    i, j = graph.receiver, graph.sender
    centre, normal, distance = graph.centre[i], graph.pair.gap.normal, graph.pair.gap.distance
    motion = graph.linear[j] - graph.linear[i]
    later = distance + dot(motion[:, :2], normal)
    point = graph.pair.gap.point - centre[:, :2]
    return _edge(
        turn[i],
        is_pusher=0.0,
        slide=torch.zeros_like(centre),
        away=graph.centre[j] - centre,
        motion=(graph.linear[j], graph.angular[j]),
        gaps=(distance, (distance + later) / 2, later),
        points=[
            *(point, point + motion[:, :2]),
            *(graph.pair.first_face - centre[:, None, :2]).unbind(1),
            *(graph.pair.second_face - centre[:, None, :2]).unbind(1),
        ],
        directions=[normal, normal, turn[j, 0, :2]],
    )


def _edge(
    turn: Float[Tensor, "E 3 3"],
    *,
    is_pusher: float,
    slide: Tensor,
    away: Tensor,
    motion: tuple[Tensor, Tensor],
    gaps: tuple[Tensor, ...],
    points: list[Tensor],
    directions: list[Tensor],
) -> Tensor:
    gap = torch.stack(gaps, dim=1)
    solid = turn @ torch.stack([away / LENGTH_M, motion[0] / SHIFT_M, motion[1] / TURN_RAD], dim=2)
    flat = turn[:, :2, :2] @ torch.stack([*(p / LENGTH_M for p in points), *directions], dim=2)
    near = (gap / GAP_M).clamp(-4, 4)
    kind = torch.full_like(gap[:, :1], is_pusher)
    parts = [
        kind,
        near,
        gap[:, 2:] / LENGTH_M,
        slide,
        solid.transpose(1, 2).flatten(1),
        flat.transpose(1, 2).flatten(1),
    ]
    return torch.cat(parts, dim=1)


def mirrored(values: Tensor, flags: Tensor, kind: Literal["node", "edge", "motion"]) -> Tensor:
    """Features or answers with some rows reflected along their x axis: left becomes right.

    Args:
        values: one row for each object or edge.
        flags: rows to reflect.
        kind: what a row holds: features of a "node" or an "edge", or a "motion" (displacement and rotation vector).
    """
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


_SCALAR, _PLANE = ([0], [1.0]), ([0, 1], [1.0, -1])
_POLAR, _AXIAL = ([0, 1, 2], [1.0, -1, 1]), ([0, 1, 2], [-1.0, 1, -1])
_SLIDE = ([0, 1, 2], [1.0, -1, -1])
_ENDS = ([2, 3, 0, 1], [1.0, -1, 1, -1])
_FEET = _fan(FOOT)
_ACROSS = (_FEET[0], [-1.0] * FOOT)
_MIRRORS = {
    "node": _mirror(
        *(_fan(AROUND), _fan(SLANTED), _fan(SLANTED), *[_SCALAR] * 3, _POLAR, _AXIAL, _PLANE, _SLIDE),
        *(_FEET, _ACROSS, _FEET, _SCALAR),
    ),
    "edge": _mirror(*[_SCALAR] * 5, _SLIDE, _POLAR, _POLAR, _AXIAL, _PLANE, _PLANE, _ENDS, _ENDS, *[_PLANE] * 3),
    "motion": _mirror(_POLAR, _AXIAL),
}
