"""Single substeps of recorded pushes as graphs, ready for the network: features are computed once, not in every step.

The true state goes in, the true motion is the target: no errors add up, but a step of training costs a fraction of one
over whole windows.
"""

from __future__ import annotations

import itertools
from collections.abc import Iterable, Iterator, Mapping, Sequence
from dataclasses import dataclass
from typing import NamedTuple

import numpy as np
import torch
from jaxtyping import Bool, Float, Int
from torch import Tensor

from osfcore.dynamics.contact_graph import Graph, build_graph
from osfcore.dynamics.features import SHIFT_M, TURN_RAD, Inputs, corrections, inputs, mirrored
from osfcore.dynamics.motion import Motion, Sweep, headings, sleeping
from osfcore.dynamics.pusher_path import SUBSTEPS, pusher_path
from osfcore.dynamics.shapes.object_shapes import ObjectShape, ShapeTable
from osfcore.dynamics.training.windows import Recording, turn_between
from osfcore.errors import InvalidInput
from osfcore.geometry.poses import rotate
from osfcore.io.push_file import Disturbed, PushEpisode

_CHUNK = 4096  # scenes per batch
_TOGETHER = 24  # episodes of disturbed states per batch


class Sample(NamedTuple):
    """Some graphs, numbered through.

    Attributes:
        nodes: features of the objects.
        edges: features of the edges, those from the pusher first.
        receiver: object at the end of each edge.
        sender: object at the beginning of each edge between objects.
        target: residual motion that the network should predict for each object.
    """

    nodes: Float[Tensor, "A F"]
    edges: Float[Tensor, "E G"]
    receiver: Int[Tensor, "E"]
    sender: Int[Tensor, "S"]
    target: Float[Tensor, "A 6"]


class Substeps(NamedTuple):
    """Single substeps of B scenes.

    Attributes:
        number: shape of each object.
        motion: before.
        velocity: commanded [m/s].
        shift: of the pusher [m].
        centre: centres of mass, after [m].
        quaternion: orientations, after.
    """

    number: Int[Tensor, "B N"]
    motion: Motion
    velocity: Float[Tensor, "B 2"]
    shift: Float[Tensor, "B 2"]
    centre: Float[Tensor, "B N 3"]
    quaternion: Float[Tensor, "B N 4"]


@dataclass(frozen=True, eq=False, slots=True)
class _Rows:
    """Rows of many graphs one after the other.

    Attributes:
        values: the rows.
        first: of each graph.
        count: of each graph.
    """

    values: Tensor
    first: Int[Tensor, "G"]
    count: Int[Tensor, "G"]

    @staticmethod
    def of(values: Tensor, count: Int[Tensor, "G"]) -> _Rows:
        return _Rows(values, count.cumsum(0) - count, count)

    def take(self, graphs: Int[Tensor, "B"]) -> Tensor:
        """The rows of some graphs."""
        return self.values[_ranges(self.first[graphs], self.count[graphs])]

    def to(self, device: torch.device | str) -> _Rows:
        """On another device."""
        return _Rows(self.values.to(device), self.first.to(device), self.count.to(device))


@dataclass(frozen=True, eq=False, slots=True)
class Samples:
    """All substeps of a recording in which something can move.

    Attributes:
        nodes: features and targets of the objects, side by side.
        pushed: features of edges from the pusher, the receiver as a last column.
        paired: features of edges between objects, receiver and sender as last columns.
    """

    nodes: _Rows
    pushed: _Rows
    paired: _Rows

    def __len__(self) -> int:
        """Number of graphs."""
        return len(self.nodes.count)

    def to(self, device: torch.device | str) -> Samples:
        """On another device."""
        return Samples(self.nodes.to(device), self.pushed.to(device), self.paired.to(device))

    def draw(self, graphs: Int[Tensor, "B"], flipped: Bool[Tensor, "B"]) -> Sample:
        """Some graphs, those with a flag reflected."""
        count = self.nodes.count[graphs]
        first = count.cumsum(0) - count
        nodes, pushed, paired = (rows.take(graphs) for rows in (self.nodes, self.pushed, self.paired))
        base, other = (first.repeat_interleave(rows.count[graphs]) for rows in (self.pushed, self.paired))
        receiver = torch.cat([base + pushed[:, -1].long(), other + paired[:, -2].long()])
        sender = other + paired[:, -1].long()
        flags = flipped.repeat_interleave(count)
        edges = torch.cat([pushed[:, :-1], paired[:, :-2]])
        return Sample(
            mirrored(nodes[:, :-6], flags, "node"),
            mirrored(edges, flags[receiver], "edge"),
            receiver,
            sender,
            mirrored(nodes[:, -6:], flags, "motion"),
        )


def _ranges(first: Int[Tensor, "B"], count: Int[Tensor, "B"]) -> Int[Tensor, "R"]:
    """first, first + 1, ..., first + count - 1 of each, one after the other."""
    before = count.cumsum(0) - count
    return (first - before).repeat_interleave(count) + torch.arange(int(count.sum()), device=count.device)


def samples(
    recording: Recording, table: ShapeTable, device: torch.device | str = "cpu", others: Iterable[Substeps] = ()
) -> Samples:
    """Every substep in which something can move.

    Args:
        recording: in windows of one action.
        table: shapes of the objects.
        device: that computes.
        others: further substeps, such as disturbed states.

    Raises:
        InvalidInput: if there is none.
    """
    pieces = itertools.chain(_recorded(recording), others)
    graphs = (_graph_and_target(piece, table, device) for piece in pieces)
    parts = [_sample(*graph) for graph in graphs if graph is not None]
    if not parts:
        raise InvalidInput("number of steps in which an object could move", 0, "at least 1: collect more pushes")
    columns = list(zip(*parts, strict=True))
    return Samples(*(_Rows.of(torch.cat(columns[k]), torch.cat(columns[k + 1])) for k in (0, 2, 4)))


def _graph_and_target(
    piece: Substeps, table: ShapeTable, device: torch.device | str
) -> tuple[Graph, Inputs, Float[Tensor, "A 6"]] | None:
    """Graphs of many scenes together, features and residual targets; None if everything rests."""
    sweep = Sweep(headings(piece.velocity, piece.motion), piece.shift)
    motion, sweep = Motion(*(p.to(device) for p in piece.motion)), Sweep(*(p.to(device) for p in sweep))
    graph = build_graph(table, piece.number.to(device), motion, sweep)
    if not len(graph.scene):
        return None
    features = inputs(table, graph)
    place = (graph.scene.cpu(), graph.slot.cpu())
    shift = piece.centre[place] - piece.motion.centre[place]
    turn = turn_between(piece.motion.quaternion[place], piece.quaternion[place])
    truth = torch.stack([shift / SHIFT_M, turn / TURN_RAD], dim=1).to(device)
    return graph, features, (truth @ features.frame.transpose(1, 2)).flatten(1) - corrections(features)


def _recorded(recording: Recording) -> Iterator[Substeps]:
    """The substeps of a recording as they truly are and move."""
    starts = torch.as_tensor(recording.starts).repeat_interleave(SUBSTEPS, dim=0)
    steps = starts[:, 1] * SUBSTEPS + torch.arange(SUBSTEPS).repeat(len(recording.starts))
    for e, s in zip(starts[:, 0].split(_CHUNK), steps.split(_CHUNK), strict=True):
        before = (s - 1).clamp(min=0)
        centre, quaternion = recording.centre[e, s], recording.quaternion[e, s]
        linear = centre - recording.centre[e, before]
        angular = turn_between(recording.quaternion[e, before], quaternion)
        pusher, velocity = recording.pusher[e, s], recording.velocity[e, s // SUBSTEPS]
        yield _substeps(recording.number[e], (centre, quaternion, linear, angular, pusher), velocity,
                        recording.pusher[e, s + 1] - pusher,
                        recording.centre[e, s + 1], recording.quaternion[e, s + 1])  # fmt: skip


def disturbed_substeps(episodes: Sequence[PushEpisode], shapes: Mapping[str, ObjectShape]) -> Iterator[Substeps]:
    """What is recorded of disturbed states of episodes with the same number of objects."""
    order = {name: number for number, name in enumerate(sorted(shapes))}
    disturbed = [(e, e.disturbed) for e in episodes if e.disturbed is not None and len(e.disturbed.step)]
    for first in range(0, len(disturbed), _TOGETHER):
        columns = zip(
            *(_disturbed(e, rows, shapes, order) for e, rows in disturbed[first : first + _TOGETHER]), strict=True
        )
        number, *start, velocity, shift, centre, quaternion = (torch.cat(column) for column in columns)
        yield _substeps(number, tuple(start), velocity, shift, centre, quaternion)


def _disturbed(
    episode: PushEpisode, rows: Disturbed, shapes: Mapping[str, ObjectShape], order: Mapping[str, int]
) -> list[Tensor]:
    """What `_substeps` needs, of one episode."""
    to_centre = np.broadcast_to([shapes[name].centre for name in episode.names], rows.positions.shape)
    before, after = (rotate(q.astype(float), to_centre) for q in (rows.quaternions, rows.after_quaternions))
    path = pusher_path(episode.pusher[0, :2], episode.actions[:, :2])
    arrays = (
        *(rows.positions + before, rows.quaternions, rows.linear + np.cross(rows.angular, before), rows.angular),
        *(path[rows.step], episode.actions[rows.step // SUBSTEPS, :2], path[rows.step + 1] - path[rows.step]),
        *(rows.after_positions + after, rows.after_quaternions),
    )
    number = torch.tensor([order[name] for name in episode.names]).expand(len(rows.step), -1)
    return [number, *(torch.as_tensor(np.ascontiguousarray(array), dtype=torch.float32) for array in arrays)]


def _substeps(
    number: Tensor, start: tuple[Tensor, ...], velocity: Tensor, shift: Tensor, centre: Tensor, quaternion: Tensor
) -> Substeps:
    motion = Motion(*start, floor=torch.zeros(number.shape))  # the floor plays no part: nothing is moved here
    return Substeps(number, sleeping(motion), velocity, shift, centre, quaternion)


def _sample(graph: Graph, features: Inputs, target: Float[Tensor, "A 6"]) -> tuple[Tensor, ...]:
    """Rows of objects, of edges from the pusher and of edges between objects, each with its counts by graph."""
    _, which, count = torch.unique_consecutive(graph.scene, return_inverse=True, return_counts=True)
    first = count.cumsum(0) - count
    from_pusher = len(features.receiver) - len(features.sender)
    owner = which[features.receiver]
    local = (features.receiver - first[owner])[:, None]
    pushed = torch.cat([features.edges, local], dim=1)[:from_pusher]
    sender = (features.sender - first[owner[from_pusher:]])[:, None]
    paired = torch.cat([features.edges, local], dim=1)[from_pusher:]
    paired = torch.cat([paired, sender], dim=1)
    rows = [torch.cat([features.nodes, target], dim=1).cpu(), count.cpu()]
    for edges, owners in ((pushed, owner[:from_pusher]), (paired, owner[from_pusher:])):
        order = owners.argsort(stable=True)
        rows += [edges[order].cpu(), torch.bincount(owners, minlength=len(count)).cpu()]
    return tuple(rows)
