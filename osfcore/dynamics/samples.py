"""Single substeps of recorded pushes as graphs, ready for the network: features are computed once, not in every step.

The true state goes in, the true motion is the target: no errors add up, but a step of training costs a fraction of one
over whole windows.
"""

from __future__ import annotations

from collections.abc import Iterator
from dataclasses import dataclass
from typing import NamedTuple

import torch
from jaxtyping import Bool, Float, Int
from torch import Tensor

from osfcore.dynamics.features import SHIFT_M, TURN_RAD, Inputs, corrections, inputs, mirrored
from osfcore.dynamics.graph import Graph, build_graph
from osfcore.dynamics.motion import Motion, Sweep, headings, sleeping
from osfcore.dynamics.pusher import SUBSTEPS
from osfcore.dynamics.shapes import ShapeTable
from osfcore.dynamics.windows import Recording, turn_between

_CHUNK = 4096  # scenes looked at together


class Sample(NamedTuple):
    """Some graphs, numbered through.

    Attributes:
        nodes: features of the objects.
        edges: features of the edges, those from the pusher first.
        receiver: object at the end of each edge.
        sender: object at the beginning of each edge between objects.
        target: what the network should answer for each object.
    """

    nodes: Float[Tensor, "A F"]
    edges: Float[Tensor, "E G"]
    receiver: Int[Tensor, "E"]
    sender: Int[Tensor, "S"]
    target: Float[Tensor, "A 6"]


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

    def draw(self, graphs: Int[Tensor, "B"], flipped: Bool[Tensor, "B"]) -> Sample:
        """Some graphs, those with a flag seen in a mirror."""
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


def samples(recording: Recording, table: ShapeTable, device: torch.device | str = "cpu") -> Samples:
    """Every substep of a recording of windows of one action."""
    parts = [_sample(graph, seen, target) for graph, seen, target in _looked_at(recording, table, device)]
    columns = list(zip(*parts, strict=True))
    return Samples(*(_Rows.of(torch.cat(columns[k]), torch.cat(columns[k + 1])) for k in (0, 2, 4)))


def _looked_at(
    recording: Recording, table: ShapeTable, device: torch.device | str
) -> Iterator[tuple[Graph, Inputs, Float[Tensor, "A 6"]]]:
    """Graphs of many scenes together, what the network sees of them, and what it should answer."""
    starts = torch.as_tensor(recording.starts).repeat_interleave(SUBSTEPS, dim=0)
    step = starts[:, 1] * SUBSTEPS + torch.arange(SUBSTEPS).repeat(len(recording.starts))
    for episode, time in zip(starts[:, 0].split(_CHUNK), step.split(_CHUNK), strict=True):
        motion, number = _motion(recording, episode, time)
        heading = headings(recording.velocity[episode, time // SUBSTEPS], motion)
        sweep = Sweep(heading, recording.pusher[episode, time + 1] - motion.pusher)
        motion, sweep = Motion(*(p.to(device) for p in motion)), Sweep(*(p.to(device) for p in sweep))
        graph = build_graph(table, number.to(device), motion, sweep)
        if not len(graph.scene):
            continue
        seen = inputs(table, graph)
        scene, slot = graph.scene.cpu(), graph.slot.cpu()
        e, s = episode[scene], time[scene]
        shift = recording.centre[e, s + 1, slot] - recording.centre[e, s, slot]
        turn = turn_between(recording.quaternion[e, s, slot], recording.quaternion[e, s + 1, slot])
        truth = torch.stack([shift / SHIFT_M, turn / TURN_RAD], dim=1).to(device)
        target = (truth @ seen.frame.transpose(1, 2)).flatten(1) - corrections(seen)
        yield graph, seen, target


def _motion(recording: Recording, e: Int[Tensor, "B"], s: Int[Tensor, "B"]) -> tuple[Motion, Int[Tensor, "B N"]]:
    """The scenes before some substeps, as they truly are and move."""
    before = (s - 1).clamp(min=0)
    centre, quaternion = recording.centre[e, s], recording.quaternion[e, s]
    linear = centre - recording.centre[e, before]
    angular = turn_between(recording.quaternion[e, before], quaternion)
    number = recording.number[e]
    floor = torch.zeros(number.shape)  # plays no part: nothing is moved here
    return sleeping(Motion(centre, quaternion, linear, angular, recording.pusher[e, s], floor)), number


def _sample(graph: Graph, seen: Inputs, target: Float[Tensor, "A 6"]) -> tuple[Tensor, ...]:
    """Rows of objects, of edges from the pusher and of edges between objects, each with its counts by graph."""
    _, which, count = torch.unique_consecutive(graph.scene, return_inverse=True, return_counts=True)
    first = count.cumsum(0) - count
    from_pusher = len(seen.receiver) - len(seen.sender)
    owner = which[seen.receiver]
    local = (seen.receiver - first[owner])[:, None]
    pushed = torch.cat([seen.edges, local], dim=1)[:from_pusher]
    sender = (seen.sender - first[owner[from_pusher:]])[:, None]
    paired = torch.cat([seen.edges, local], dim=1)[from_pusher:]
    paired = torch.cat([paired, sender], dim=1)
    rows = [torch.cat([seen.nodes, target], dim=1).cpu(), count.cpu()]
    for edges, owners in ((pushed, owner[:from_pusher]), (paired, owner[from_pusher:])):
        order = owners.argsort(stable=True)
        rows += [edges[order].cpu(), torch.bincount(owners, minlength=len(count)).cpu()]
    return tuple(rows)
