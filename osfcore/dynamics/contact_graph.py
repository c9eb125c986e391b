"""The contact graph: paper eq. 8, refined by outlines.

    A_ij = 1 if ||p_i - p_j|| < kappa, i != j

Deviation: eq. 8 compares a squared distance with a length; we compare the distance of two objects with
kappa = the longest half-extents of both + one step of pusher travel. Among the pairs that pass, and between pusher and
objects, outlines seen from above (`contact_geometry`) then decide which can touch within one substep. Only objects
that the pusher can touch, or that move, or that can be touched by one of these, take part; all others stay exactly
where they are.
"""

from __future__ import annotations

from collections.abc import Sequence
from typing import NamedTuple, TypeVar

import torch
from jaxtyping import Bool, Float, Int
from torch import Tensor

from osfcore.dynamics.contact_geometry import (
    PAIR_REACH_M,
    TOUCH_M,
    PairContact,
    PusherContact,
    Solids,
    outlines,
    pair_contact,
    pusher_contact,
    solids,
)
from osfcore.dynamics.motion import Motion, Sweep
from osfcore.dynamics.shapes.object_shapes import ShapeTable
from osfcore.geometry import torch_rotations as rotations
from osfcore.geometry.polygons import Gap, dot
from osfcore.geometry.workspace import MAX_SPEED_M_S, PUSHER_RADIUS_M, STEP_S

TRAVEL_M = MAX_SPEED_M_S * STEP_S  # of the pusher in one step, per axis
LOOKUP_M = 0.005  # error of an extent looked up in a single direction


class Graph(NamedTuple):
    """Objects that may move in a substep, in coordinates along the pusher's heading, with its centre as the origin.

    Attributes:
        scene: scene of each of the A objects.
        slot: its place among the scene's objects.
        number: its shape.
        frame: rotation from the world to the heading's frame.
        rotation: from the object's frame to the heading's.
        centre: of mass [m].
        linear: displacement of the last substep [m].
        angular: rotation vector of the last substep [rad].
        outline: seen from above [m].
        shift: of the pusher in this substep [m].
        touched: which objects the pusher can touch.
        pusher: where, if so.
        receiver, sender: numbers among the A objects, for each of the E ordered pairs that can touch.
        pair: where each such pair can touch, out of the receiver.
    """

    scene: Int[Tensor, "A"]
    slot: Int[Tensor, "A"]
    number: Int[Tensor, "A"]
    frame: Float[Tensor, "A 3 3"]
    rotation: Float[Tensor, "A 3 3"]
    centre: Float[Tensor, "A 3"]
    linear: Float[Tensor, "A 3"]
    angular: Float[Tensor, "A 3"]
    outline: Float[Tensor, "A K 2"]
    shift: Float[Tensor, "A 2"]
    touched: Bool[Tensor, "A"]
    pusher: PusherContact
    receiver: Int[Tensor, "E"]
    sender: Int[Tensor, "E"]
    pair: PairContact


def adjacency(
    position: Float[Tensor, "B N 3"], half_extent: Float[Tensor, "B N"], travel_m: float = TRAVEL_M
) -> Bool[Tensor, "B N N"]:
    """Which objects could collide during a step (paper eq. 8, see the module for the deviation).

    Args:
        position: of the centres [m].
        half_extent: longest half-extent of each object [m].
        travel_m: of the pusher in one step [m].
    """
    distance = (position[:, :, None] - position[:, None]).norm(dim=-1)
    kappa = half_extent[:, :, None] + half_extent[:, None] + travel_m
    return (distance < kappa) & ~torch.eye(position.shape[1], dtype=torch.bool, device=position.device)


def build_graph(table: ShapeTable, number: Int[Tensor, "B N"], motion: Motion, sweep: Sweep) -> Graph:
    """The objects that may move in this substep, and the pairs of them that may touch.

    Args:
        table: shapes of the objects.
        number: which of them each object is.
        motion: B scenes of N objects each.
        sweep: motion of the pusher.
    """
    moving = (motion.linear.abs().amax(dim=2) > 0) | (motion.angular.abs().amax(dim=2) > 0)
    seeds = _near_pusher(table, number, motion, sweep) | moving
    busy = seeds.any(dim=1).nonzero()[:, 0]  # in all other scenes nothing happens
    number, seeds, moving = number[busy], seeds[busy], moving[busy]
    motion, sweep = Motion(*(part[busy] for part in motion)), Sweep(*(part[busy] for part in sweep))
    couples = _candidate_pairs(table, number, motion)
    possible = _connected(seeds, couples)
    graph, parts = _gather(table, number, motion, sweep, possible)
    index = possible.new_full(possible.shape, 0, dtype=torch.long)
    index[graph.scene, graph.slot] = torch.arange(len(graph.scene), device=index.device)
    scene, i, j = (couples & possible[:, :, None] & possible[:, None]).triu().nonzero().unbind(1)
    first, second = index[scene, i], index[scene, j]
    contact = pair_contact(parts, graph.outline, first, second)
    close = contact.gap.distance < PAIR_REACH_M
    first, second, contact = first[close], second[close], _select_rows(contact, close)
    touching = torch.zeros_like(couples)
    touching[graph.scene[first], graph.slot[first], graph.slot[second]] = True
    awake = torch.zeros_like(possible)
    awake[graph.scene, graph.slot] = graph.touched | moving[graph.scene, graph.slot]
    awake = _connected(awake, touching | touching.transpose(1, 2))
    kept = _keep(graph, first, second, contact, awake[graph.scene, graph.slot])
    return kept._replace(scene=busy[kept.scene])


def _near_pusher(table: ShapeTable, number: Int[Tensor, "B N"], motion: Motion, sweep: Sweep) -> Bool[Tensor, "B N"]:
    """Objects that their extent toward the pusher's path does not rule out as touched: a cheap upper bound."""
    away = motion.pusher[:, None] - motion.centre[..., :2]
    shift = sweep.shift[:, None]
    along = (-dot(away, shift) / (dot(shift, shift) + 1e-12)).clamp(0, 1)
    away = away + along[..., None] * shift
    distance = away.norm(dim=-1) - PUSHER_RADIUS_M - TOUCH_M - LOOKUP_M
    near = distance < table.radius[number]
    rows = near.nonzero().unbind(1)
    reach = _extent(table, number, motion, rows, away[rows])
    return near.index_put(rows, distance[rows] < reach)


def _candidate_pairs(table: ShapeTable, number: Int[Tensor, "B N"], motion: Motion) -> Bool[Tensor, "B N N"]:
    """Pairs that could collide (eq. 8) and are not clear of each other along the line between their centres."""
    radius = table.radius[number]
    couples = adjacency(motion.centre, table.half_extent[number])
    away = motion.centre[:, None, :, :2] - motion.centre[:, :, None, :2]
    distance = away.norm(dim=-1) - PAIR_REACH_M - 2 * LOOKUP_M
    couples &= distance < radius[:, :, None] + radius[:, None]
    scene, i, j = couples.triu().nonzero().unbind(1)
    line = away[scene, i, j]
    reach = _extent(table, number, motion, (scene, i), line) + _extent(table, number, motion, (scene, j), -line)
    close = torch.zeros_like(couples).index_put((scene, i, j), distance[scene, i, j] < reach)
    return close | close.transpose(1, 2)


def _extent(
    table: ShapeTable, number: Tensor, motion: Motion, rows: Sequence[Tensor], direction: Float[Tensor, "R 2"]
) -> Float[Tensor, "R"]:
    """How far some objects reach horizontally from their centres of mass in one direction each [m]."""
    length = direction.norm(dim=1, keepdim=True)
    unit = torch.where(length > 1e-6, direction / length.clamp(min=1e-6), direction.new_tensor([1.0, 0.0]))
    directions = torch.nn.functional.pad(unit, (0, 1))[:, None]
    return table.extents(number[tuple(rows)], rotations.matrix(motion.quaternion[tuple(rows)]), directions)[:, 0]


def _connected(seed: Bool[Tensor, "B N"], links: Bool[Tensor, "B N N"]) -> Bool[Tensor, "B N"]:
    """Everything connected to a seed by any number of links."""
    for _ in range(seed.shape[1] - 1):
        seed = seed | (links & seed[:, None]).any(dim=2)
    return seed


def _gather(
    table: ShapeTable, number: Int[Tensor, "B N"], motion: Motion, sweep: Sweep, chosen: Bool[Tensor, "B N"]
) -> tuple[Graph, Solids]:
    """The chosen objects side by side, without pairs yet, and their convex parts."""
    scene, slot = chosen.nonzero().unbind(1)
    frame = rotations.facing(sweep.heading[scene])
    rotation = frame @ rotations.matrix(motion.quaternion[scene, slot])
    origin = torch.nn.functional.pad(motion.pusher[scene], (0, 1))
    vectors = torch.stack(
        [
            motion.centre[scene, slot] - origin,
            motion.linear[scene, slot],
            motion.angular[scene, slot],
            torch.nn.functional.pad(sweep.shift[scene], (0, 1)),
        ],
        dim=2,
    )
    centre, linear, angular, shift = (frame @ vectors).unbind(2)
    which = number[scene, slot]
    outline = outlines(table, which, rotation, centre)
    parts = solids(table, which, rotation, centre, outline)
    shift = shift[:, :2]
    pusher = pusher_contact(parts, shift)
    touched = torch.stack([gap.distance for gap in pusher[:3]]).amin(dim=0) < TOUCH_M
    none = scene[:0]
    pair = pair_contact(parts, outline, none, none)
    graph = Graph(scene, slot, which, frame, rotation, centre, linear, angular, outline, shift, touched, pusher,
                  none, none, pair)  # fmt: skip
    return graph, parts


_Tensors = TypeVar("_Tensors")


def _select_rows(values: _Tensors, rows: Tensor) -> _Tensors:
    """Some rows of a tensor, or of every tensor in a named tuple."""
    if isinstance(values, Tensor):
        return values[rows]  # pyright: ignore[reportReturnType]
    assert isinstance(values, tuple)
    return type(values)(*(_select_rows(part, rows) for part in values))


def _keep(graph: Graph, first: Tensor, second: Tensor, contact: PairContact, kept: Bool[Tensor, "A"]) -> Graph:
    """The objects kept, and the pairs among them in both orders."""
    renumbered = kept.long().cumsum(0) - 1
    both = kept[first] & kept[second]
    first, second = renumbered[first[both]], renumbered[second[both]]
    gap, first_face, second_face = _select_rows(contact, both)
    opposite = gap.point + gap.distance[:, None] * gap.normal
    pair = PairContact(
        Gap(
            torch.cat([gap.distance, gap.distance]),
            torch.cat([gap.normal, -gap.normal]),
            torch.cat([gap.point, opposite]),
        ),
        torch.cat([first_face, second_face]),
        torch.cat([second_face, first_face]),
    )
    objects = [_select_rows(part, kept) for part in graph[:-3]]
    return Graph._make([*objects, torch.cat([first, second]), torch.cat([second, first]), pair])
