"""The contact graph (paper eq. 8, refined by outlines) and the propagation network on it (eq. 7)."""

from __future__ import annotations

import json
import math
from collections.abc import Iterator, Mapping, Sequence
from importlib.resources import files
from pathlib import Path
from typing import Any, Literal, NamedTuple, TypeVar

import numpy as np
import torch
from jaxtyping import Bool, Float, Int
from safetensors.torch import save
from torch import Tensor, nn
from torch.nn import functional

from osfcore.dynamics.motion import (
    SLEEP_M,
    SLEEP_RAD,
    SUBSTEPS,
    Motion,
    Sweep,
    friction_arm,
    headings,
    lowest_point,
    push_motion,
    pusher_path,
)
from osfcore.dynamics.shapes import (
    PAIR_REACH_M,
    TOUCH_M,
    PairContact,
    PusherContact,
    ShapeTable,
    Solids,
    outlines,
    pair_contact,
    pusher_contact,
    solids,
)
from osfcore.errors import CorruptFile, shown
from osfcore.geometry import torch_rotations as rotations
from osfcore.geometry.polygons import Gap, circle, dot
from osfcore.geometry.workspace import MAX_SPEED_M_S, PUSHER_RADIUS_M, STEP_S
from osfcore.io.checkpoint import load_parameters, read_parameters
from osfcore.io.files import write_atomically

# The contact graph: paper eq. 8, refined by outlines.
#
#     A_ij = 1 if ||p_i - p_j|| < kappa, i != j
#
# Deviation: eq. 8 compares a squared distance with a length. Here the distance of two objects is compared with kappa =
# the longest half-extents of both + one step of pusher travel. Outlines seen from above (`shapes`) then decide which of
# these pairs, and which objects with the pusher, can touch within one substep. Only objects that the pusher can touch,
# that move, or that one of these can touch take part. All others keep their poses exactly.


TRAVEL_M = MAX_SPEED_M_S * STEP_S  # of the pusher in one step, per axis
LOOKUP_M = 0.005  # error of an extent looked up in a single direction


class Graph(NamedTuple):
    """Objects that may move in a substep, in coordinates along the pusher's heading, with its centre as the origin.

    Attributes:
        scene: scene of each of the A objects.
        slot: index of each among the scene's objects.
        number: index of its shape.
        frame: rotation from the world to the heading's frame.
        rotation: rotation from the object's frame to the heading's.
        centre: centre of mass [m].
        linear: displacement of the last substep [m].
        angular: rotation vector of the last substep [rad].
        outline: outline seen from above [m].
        shift: shift of the pusher in this substep [m].
        touched: whether the pusher can touch each object.
        pusher: contact with the pusher, for objects that it can touch.
        receiver, sender: indices among the A objects, for each of the E ordered pairs that can touch.
        pair: contact of each such pair, with its normal out of the receiver.
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
    """Return which objects could collide during a step (paper eq. 8, with the deviation stated above).

    Args:
        position: position of the centres [m].
        half_extent: longest half-extent of each object [m].
        travel_m: travel of the pusher in one step [m].
    """
    distance = (position[:, :, None] - position[:, None]).norm(dim=-1)
    kappa = half_extent[:, :, None] + half_extent[:, None] + travel_m
    return (distance < kappa) & ~torch.eye(position.shape[1], dtype=torch.bool, device=position.device)


def build_graph(table: ShapeTable, number: Int[Tensor, "B N"], motion: Motion, sweep: Sweep) -> Graph:
    """Return the objects that may move in this substep, and the pairs of them that may touch.

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
    """Return which objects the pusher may touch by their extent toward its path: a cheap upper bound."""
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
    """Return pairs that could collide (eq. 8) and are not clear of each other along the line between their centres."""
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
    """Return the horizontal extent of objects from their centres of mass, in one direction each [m]."""
    length = direction.norm(dim=1, keepdim=True)
    unit = torch.where(length > 1e-6, direction / length.clamp(min=1e-6), direction.new_tensor([1.0, 0.0]))
    directions = functional.pad(unit, (0, 1))[:, None]
    return table.extents(number[tuple(rows)], rotations.matrix(motion.quaternion[tuple(rows)]), directions)[:, 0]


def _connected(seed: Bool[Tensor, "B N"], links: Bool[Tensor, "B N N"]) -> Bool[Tensor, "B N"]:
    """Return everything connected to a seed by any number of links."""
    for _ in range(seed.shape[1] - 1):
        seed = seed | (links & seed[:, None]).any(dim=2)
    return seed


def _gather(
    table: ShapeTable, number: Int[Tensor, "B N"], motion: Motion, sweep: Sweep, chosen: Bool[Tensor, "B N"]
) -> tuple[Graph, Solids]:
    """Return the chosen objects side by side, without pairs yet, and their convex parts."""
    scene, slot = chosen.nonzero().unbind(1)
    frame = rotations.facing(sweep.heading[scene])
    rotation = frame @ rotations.matrix(motion.quaternion[scene, slot])
    origin = functional.pad(motion.pusher[scene], (0, 1))
    position, linear, angular = (part[scene, slot] for part in (motion.centre, motion.linear, motion.angular))
    vectors = [position - origin, linear, angular, functional.pad(sweep.shift[scene], (0, 1))]
    centre, linear, angular, shift = (frame @ torch.stack(vectors, dim=2)).unbind(2)
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
    """Return some rows of a tensor, or of every tensor in a named tuple."""
    if isinstance(values, Tensor):
        return values[rows]  # pyright: ignore[reportReturnType]
    assert isinstance(values, tuple)
    return type(values)(*(_select_rows(part, rows) for part in values))


def _keep(graph: Graph, first: Tensor, second: Tensor, contact: PairContact, kept: Bool[Tensor, "A"]) -> Graph:
    """Return the objects kept, and the pairs among them in both orders."""
    renumbered = kept.long().cumsum(0) - 1
    both = kept[first] & kept[second]
    first, second = renumbered[first[both]], renumbered[second[both]]
    gap, first_face, second_face = _select_rows(contact, both)
    opposite = gap.point + gap.distance[:, None] * gap.normal
    twice = ((gap.distance, gap.distance), (gap.normal, -gap.normal), (gap.point, opposite))
    faces = ((first_face, second_face), (second_face, first_face))
    pair = PairContact(Gap(*map(torch.cat, twice)), *map(torch.cat, faces))
    objects = [_select_rows(part, kept) for part in graph[:-3]]
    return Graph._make([*objects, torch.cat([first, second]), torch.cat([second, first]), pair])


# Features of a graph, along each object's own direction of push and from its centre of mass.
#
# Every object has a frame of its own: x points along the normal of the contact that pushes it most directly, z up.
# All input vectors of an object and its output are in this frame, so that a turned or shifted scene gives the same
# numbers.


AROUND = 16  # horizontal directions in which an object's extent is a feature
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
    """Features of a graph.

    Attributes:
        nodes: features of each object.
        edges: features of the edges from the pusher to the objects it can touch, then between objects.
        receiver: object at the end of each edge.
        sender: object at the beginning of each edge between objects.
        frame: rotation from the world to each object's frame.
        quasistatic: quasi-static sliding of each object under the pusher: x, y, turn, in units of the output.
    """

    nodes: Float[Tensor, "A F"]
    edges: Float[Tensor, "E G"]
    receiver: Int[Tensor, "E"]
    sender: Int[Tensor, "S"]
    frame: Float[Tensor, "A 3 3"]
    quasistatic: Float[Tensor, "A 3"]


def inputs(table: ShapeTable, graph: Graph) -> Inputs:
    """Return the features of a graph."""
    turn = rotations.facing(_directions(graph))
    quasistatic = _quasistatic_sliding(graph, graph.pusher.after, turn)
    pushed = graph.touched.nonzero()[:, 0]
    edges = torch.cat([_from_pusher(graph, pushed, turn), _between(graph, turn)])
    nodes = _nodes(table, graph, turn, quasistatic)
    return Inputs(nodes, edges, torch.cat([pushed, graph.receiver]), graph.sender, turn @ graph.frame, quasistatic)


def corrections(features: Inputs) -> Float[Tensor, "A 6"]:
    """Return the quasi-static sliding that the network corrects, as displacement and rotation vector."""
    flat = torch.zeros_like(features.quasistatic)
    return torch.cat([features.quasistatic[:, :2], flat, features.quasistatic[:, 2:]], dim=1)


def _directions(graph: Graph) -> Float[Tensor, "A 2"]:
    """Return the direction of each object's push: by the pusher, or by the closest object, or of its own motion."""
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
    """Return the sliding at a contact, so far that the pusher's last position is free."""
    centre = graph.centre[:, :2]
    depth = (-graph.pusher.after.distance).clamp(min=0)
    point, inward, arm = gap.point - centre, -gap.normal, friction_arm(graph.outline - centre[:, None])
    way = push_motion(point, inward, depth, graph.shift, arm)
    along = (turn[:, :2, :2] @ way[:, :2, None])[..., 0]
    return torch.cat([along / SHIFT_M, way[:, 2:] / TURN_RAD], dim=1)


def _nodes(table: ShapeTable, graph: Graph, turn: Tensor, quasistatic: Tensor) -> Float[Tensor, "A F"]:
    """Return extents in 34 directions, height over the table, motion, the pusher's motion, sliding and foot."""
    slanted = functional.pad(circle(SLANTED, turn.device), (0, 1))
    vertical = slanted.new_tensor([[0.0, 0.0, -1.0], [0.0, 0.0, 1.0]])
    half = math.sqrt(0.5)
    flat = functional.pad(circle(AROUND, turn.device), (0, 1))
    directions = torch.cat([flat, half * (slanted + vertical[0]), half * (slanted + vertical[1]), vertical])
    extents = table.extents(graph.number, turn @ graph.rotation, directions)
    height = graph.centre[:, 2:] - extents[:, -2:-1]
    motion = torch.stack([graph.linear, graph.angular, functional.pad(graph.shift, (0, 1))], dim=2)
    linear, angular, shift = (turn @ motion).unbind(2)
    lengths = torch.cat([extents, MAGNIFIED * height], dim=1) / LENGTH_M
    motions = [linear / SHIFT_M, angular / TURN_RAD, shift[:, :2] / SHIFT_M]
    return torch.cat([lengths, *motions, quasistatic, _foot(table, graph, turn)], dim=1)


def _foot(table: ShapeTable, graph: Graph, turn: Tensor) -> Float[Tensor, "A 25"]:
    """Return the lowest points all around, on which friction acts, and their mean distance from the centre."""
    fan = math.sin(FOOT_ANGLE) * circle(FOOT, turn.device)
    downward = functional.pad(fan, (0, 1), value=-math.cos(FOOT_ANGLE))
    points = table.farthest(graph.number, turn @ graph.rotation, downward)
    height = MAGNIFIED * (points[..., 2] + graph.centre[:, None, 2])
    distance = points[..., :2].norm(dim=2).mean(dim=1, keepdim=True)
    return torch.cat([points[..., 0], points[..., 1], height, distance], dim=1) / LENGTH_M


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
    scalars = [torch.full_like(gap[:, :1], is_pusher), near, gap[:, 2:] / LENGTH_M, slide]
    return torch.cat([*scalars, *(vectors.transpose(1, 2).flatten(1) for vectors in (solid, flat))], dim=1)


def mirrored(values: Tensor, flags: Tensor, kind: Literal["node", "edge", "motion"]) -> Tensor:
    """Return features or answers with some rows reflected along their x axis: left becomes right.

    Args:
        values: one row for each object or edge.
        flags: rows to reflect.
        kind: what a row holds: features of a "node" or an "edge", or a "motion" (displacement and rotation vector).
    """
    order, sign = _MIRRORS[kind]
    reflected = values[:, torch.tensor(order, device=values.device)] * values.new_tensor(sign)
    return torch.where(flags[:, None], reflected, values)


def _mirror(*parts: tuple[list[int], list[float]]) -> tuple[list[int], list[float]]:
    """Return where each number comes from in the mirror and with which sign, from those of its parts."""
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


# The propagation network: message passing with shared encoders and propagators (paper eq. 7).
#
# After Li et al. 2019, "Propagation networks for model-based control under partial observation". With node features
# x_i and edge features r_ij, receiver i and sender j, and h^0_i = E_node(x_i), e^0_ij = E_edge(r_ij):
#
#     e^{l+1}_ij = e^l_ij + P_edge^l(e^l_ij, h^l_i, h^l_j)
#     h^{l+1}_i  = h^l_i + P_node^l(h^0_i, h^l_i, sum_j e^{l+1}_ij)
#     motion_i   = D(h^0_i, h^L_i)


MOTION = 6  # displacement of the centre of mass, rotation vector


class PropagationNetwork(nn.Module):
    """From the features of a graph to the motion of its nodes, in units of the features' scales.

    Deviation from Li et al.: every step has propagators of its own, and edges have a state; for the same time, both
    are more accurate.

    Args:
        hidden: width of all layers.
        steps: L, propagation steps.
    """

    def __init__(self, hidden: int = 128, steps: int = 3) -> None:
        super().__init__()
        self.hidden, self.steps = hidden, steps
        self.node_encoder = _two_layers(NODE_FEATURES, hidden)
        self.edge_encoder = _two_layers(EDGE_FEATURES, hidden)
        self.edge_propagators = nn.ModuleList(_two_layers(3 * hidden, hidden) for _ in range(steps))
        self.node_propagators = nn.ModuleList(_two_layers(3 * hidden, hidden) for _ in range(steps))
        self.decoder = nn.Sequential(
            *(nn.Linear(2 * hidden, hidden), nn.SiLU(), nn.Linear(hidden, hidden), nn.SiLU()), nn.Linear(hidden, MOTION)
        )

    def forward(
        self,
        nodes: Float[Tensor, "A F"],
        edges: Float[Tensor, "E G"],
        receiver: Int[Tensor, "E"],
        sender: Int[Tensor, "S"],
    ) -> Float[Tensor, "A 6"]:
        """Return the motion of each node.

        Args:
            nodes: features of the objects.
            edges: features of the edges: first those from the pusher, then those between objects.
            receiver: object at the end of each edge.
            sender: object at the beginning of each of the last S edges; the pusher has no state of its own.
        """
        own = self.node_encoder(nodes)
        relation = self.edge_encoder(edges)
        state = own
        silent = own.new_zeros(len(receiver) - len(sender), self.hidden)
        for edge_propagator, node_propagator in zip(self.edge_propagators, self.node_propagators, strict=True):
            senders = torch.cat([silent, state[sender]])
            relation = relation + edge_propagator(torch.cat([relation, state[receiver], senders], dim=1))
            effect = torch.zeros_like(own).index_add(0, receiver, relation)
            state = state + node_propagator(torch.cat([own, state, effect], dim=1))
        return self.decoder(torch.cat([own, state], dim=1))


def _two_layers(inputs: int, hidden: int) -> nn.Sequential:
    """Return two layers and a norm, without which training needs about twice as long for the same error."""
    return nn.Sequential(nn.Linear(inputs, hidden), nn.SiLU(), nn.Linear(hidden, hidden), nn.LayerNorm(hidden))


# Files of trained networks: safetensors with half-precision parameters, checked when read.


FORMAT = "pushes-2"
_MOST_HIDDEN, _MOST_STEPS = 1024, 16


def network_bytes(network: PropagationNetwork) -> bytes:
    """Return a network as the contents of a file."""
    return parameter_bytes(network, {"format": FORMAT, "hidden": str(network.hidden), "steps": str(network.steps)})


def parameter_bytes(network: nn.Module, metadata: Mapping[str, str]) -> bytes:
    """Return the contents of a file with the parameters of a network in half precision."""
    tensors = {name: value.detach().cpu().half().contiguous() for name, value in network.state_dict().items()}
    return save(tensors, dict(metadata))


def write_network(path: Path, network: PropagationNetwork) -> None:
    """Write a network. The file appears only once it is complete.

    Raises:
        CannotWrite: if the disk refuses.
    """
    write_atomically(path, network_bytes(network))


def read_network(path: Path) -> PropagationNetwork:
    """Read a network.

    Raises:
        CorruptFile: if the file is missing, truncated, of another version or no such network.
    """
    metadata, values = read_parameters(path, FORMAT, "network of pushes")
    network = PropagationNetwork(*described_sizes(metadata, path))
    load_parameters(network, values, path)
    return network.eval()


def described_sizes(metadata: Mapping[str, str], path: Path) -> tuple[int, int]:
    """Return the width and propagation steps that a file describes.

    Raises:
        CorruptFile: if they are missing or out of range.
    """
    try:
        hidden, steps = int(metadata["hidden"]), int(metadata["steps"])
    except (KeyError, ValueError) as error:
        raise CorruptFile(path, f"it holds no network for pushes of a known size ({shown(error)})") from error
    if not (1 <= hidden <= _MOST_HIDDEN and 1 <= steps <= _MOST_STEPS):
        raise CorruptFile(path, f"{hidden} units and {steps} steps are out of range")
    return hidden, steps


def shipped(name: str = "pushes") -> Path:
    """Return the file of a network that comes with the package."""
    return Path(str(files("osfcore.dynamics") / "shipped" / f"{name}.safetensors"))


def read_metrics(path: Path) -> Mapping[str, Any]:
    """Return how a network was trained, from the JSON beside its file; empty if that cannot be read."""
    try:
        content = json.loads(path.with_suffix(".json").read_text(encoding="utf-8"))
    except (OSError, ValueError, RecursionError):
        return {}
    return content if isinstance(content, dict) else {}


# One substep of many scenes: contact graph, features, network, then sleeping and contact with the floor.


def advance(
    network: PropagationNetwork,
    table: ShapeTable,
    number: Int[Tensor, "B N"],
    motion: Motion,
    sweep: Sweep,
    mirror: Bool[Tensor, "B"] | None = None,
) -> Motion:
    """Return the scenes one substep later.

    Args:
        network: predicts the motion of what can move.
        table: shapes of the objects.
        number: which of them each object is.
        motion: the scenes.
        sweep: what the pusher does.
        mirror: scenes to reflect along the heading, in training.
    """
    graph = build_graph(table, number, motion, sweep)
    still = torch.zeros_like(motion.linear)
    rest = motion._replace(linear=still, angular=still, pusher=motion.pusher + sweep.shift)
    if not len(graph.scene):
        return rest
    features = inputs(table, graph)
    linear, angular = _predict_motion(network, features, None if mirror is None else mirror[graph.scene])
    awake = (linear.norm(dim=1) > SLEEP_M) | (angular.norm(dim=1) > SLEEP_RAD)
    linear, angular = linear * awake[:, None], angular * awake[:, None]
    place = (graph.scene, graph.slot)
    quaternion = motion.quaternion[place]
    turned = rotations.unit(rotations.multiply(rotations.exponential(angular), quaternion))
    quaternion = torch.where(awake[:, None], turned, quaternion)
    centre = motion.centre[place] + linear
    sunk = motion.floor[place] - lowest_point(table, graph.number, centre, quaternion)
    lift = sunk.clamp(min=0) * awake
    linear = linear + functional.pad(lift[:, None], (2, 0))
    centre = motion.centre[place] + linear
    moved = (part.index_put(place, new) for part, new in zip(rest, (centre, quaternion, linear, angular), strict=False))
    return Motion(*moved, pusher=rest.pusher, floor=rest.floor)


def _predict_motion(
    network: PropagationNetwork, features: Inputs, mirror: Bool[Tensor, "M"] | None
) -> tuple[Float[Tensor, "M 3"], Float[Tensor, "M 3"]]:
    """Return translations [m] and rotation vectors [rad] in the world that the network predicts for M objects.

    The network's output is a residual over the quasi-static correction, in units of typical motions, in each object's
    own frame along the heading; with `mirror`, it sees reflected features and its output is reflected back.
    """
    if mirror is None:
        residual = network(features.nodes, features.edges, features.receiver, features.sender)
    else:
        nodes = mirrored(features.nodes, mirror, "node")
        edges = mirrored(features.edges, mirror[features.receiver], "edge")
        residual = mirrored(network(nodes, edges, features.receiver, features.sender), mirror, "motion")
    motion = residual + corrections(features)
    scale = motion.new_tensor([SHIFT_M] * 3 + [TURN_RAD] * 3)
    linear, angular = ((motion * scale).view(-1, 2, 3) @ features.frame).unbind(1)
    return linear, angular


def unroll(
    network: PropagationNetwork,
    table: ShapeTable,
    number: Int[Tensor, "B N"],
    motion: Motion,
    velocity: Float[Tensor, "T B 2"],
    mirror: Bool[Tensor, "B"] | None = None,
) -> Iterator[Motion]:
    """Yield the scenes after each substep of T actions.

    Args:
        network: predicts the motion of what can move.
        table: shapes of the objects.
        number: which of them each object is.
        motion: the scenes before the first action.
        velocity: velocity of the pusher in each action [m/s].
        mirror: scenes to reflect along the heading, in training.
    """
    path = pusher_path(motion.pusher.double().cpu().numpy(), velocity.transpose(0, 1).double().cpu().numpy())
    shifts = torch.as_tensor(np.diff(path, axis=1), dtype=torch.float32, device=number.device)
    for step in range(shifts.shape[1]):
        sweep = Sweep(headings(velocity[step // SUBSTEPS], motion), shifts[:, step])
        motion = advance(network, table, number, motion, sweep, mirror)
        yield motion
