"""Training the propagation network on recorded pushes.

Deviations from the paper (section 4.3), measured in docs/dynamics.md: an action is predicted in four substeps; the loss
is a distance rather than its square, of the centre of mass and the orientation together, so that a few objects that
topple do not outweigh all that slide; half of all is reflected. As in the paper, the loss runs over three
actions, with gradients through all of them, but only at the end: most of the training is on single substeps from true
states, which cost a fraction.
"""

from __future__ import annotations

import copy
import hashlib
import itertools
import math
import shlex
from collections.abc import Iterable, Iterator, Mapping, Sequence
from dataclasses import asdict, dataclass
from pathlib import Path
from typing import Any, Literal, NamedTuple

import numpy as np
import torch
from jaxtyping import Bool, Float, Int
from torch import Tensor, nn

from osfcore.dynamics.graph import (
    SHIFT_M,
    TURN_RAD,
    Graph,
    Inputs,
    PropagationNetwork,
    build_graph,
    corrections,
    inputs,
    mirrored,
    network_bytes,
    unroll,
)
from osfcore.dynamics.motion import (
    SUBSTEPS,
    Motion,
    Sweep,
    headings,
    is_on_table,
    lowest_point,
    pusher_path,
    sleeping,
    substates,
)
from osfcore.dynamics.shapes import ObjectShape, ShapeTable
from osfcore.errors import InvalidInput, check_ranges, check_seed
from osfcore.fields.devices import pick_device
from osfcore.geometry import torch_rotations as rotations
from osfcore.geometry.poses import quaternion_conjugate, quaternion_log, quaternion_multiply, rotate
from osfcore.io.checkpoint import resume_from, write_checkpoint
from osfcore.io.files import write_atomically, write_json
from osfcore.io.output_paths import check_weights_place
from osfcore.io.push_file import Disturbed, PushEpisode, read_sound_pushes
from osfcore.progress import Progress

# What training never sees, so that there is something left to measure on.


_ONE_IN = 16  # pairs
_EPISODES_ONE_IN = 12


def is_held_out_pair(first: str, second: str) -> bool:
    """Whether two objects never meet in training: one pair in 16, by their names alone."""
    text = "+".join(sorted((first, second)))
    return int.from_bytes(hashlib.sha256(text.encode()).digest()[:8], "big") % _ONE_IN == 0


def has_held_out_pair(names: Iterable[str]) -> bool:
    """Whether any two of the objects never meet in training."""
    return any(is_held_out_pair(a, b) for a, b in itertools.combinations(names, 2))


def is_for_validation(number: int) -> bool:
    """Whether training stops by the episode of that number rather than learning from it."""
    return number % _EPISODES_ONE_IN == 0


# Optimizers of training: Muon for the weight matrices, AdamW for biases, norms and the last layer.
#
# Muon makes every update of a matrix about as large in all its directions. On pushes, 3,000 steps with it come
# within 2 % of what takes AdamW 16,000, for a fifth more time a step (docs/dynamics.md).


_OTHER_RATE = 0.5  # of the matrices' rate
_DECAY, _OTHER_DECAY = 0.1, 1e-4
_CLIP = 5.0
_AVERAGING = 0.998  # of the weights that are kept, from step to step


class Optimizers:
    """A network in training, and the exponential moving average of its weights.

    Attributes:
        network: with its current weights.
        average: with weights averaged over a few hundred steps, which validates better.
    """

    def __init__(self, network: PropagationNetwork, rate: float) -> None:
        """Begin with a network as it is.

        Args:
            network: to train.
            rate: of learning, at its highest.
        """
        self.network, self.average = network, copy.deepcopy(network)
        last = network.decoder[-1]
        assert isinstance(last, nn.Linear)
        inner = [p for p in network.parameters() if p.ndim == 2 and p is not last.weight]
        held = {id(p) for p in inner}
        others = [p for p in network.parameters() if id(p) not in held]
        other_rate = _OTHER_RATE * rate
        self._optimisers = (
            torch.optim.Muon(inner, lr=rate, weight_decay=_DECAY, ns_steps=4, adjust_lr_fn="match_rms_adamw"),
            torch.optim.AdamW(others, lr=other_rate, weight_decay=_OTHER_DECAY),
        )
        self._rates = (rate, other_rate)

    def step(self, loss: Tensor, share: float, done: int) -> None:
        """One optimization step.

        Args:
            loss: to minimise.
            share: of the highest rate.
            done: steps before this one; at the beginning the average forgets faster.
        """
        for optimiser, rate in zip(self._optimisers, self._rates, strict=True):
            optimiser.zero_grad(set_to_none=True)
            for group in optimiser.param_groups:
                group["lr"] = share * rate
        loss.backward()
        torch.nn.utils.clip_grad_norm_(self.network.parameters(), _CLIP)
        for optimiser in self._optimisers:
            optimiser.step()
        kept_share = min(_AVERAGING, done / (done + 10))
        with torch.no_grad():
            for kept, new in zip(self.average.parameters(), self.network.parameters(), strict=True):
                kept.lerp_(new, 1 - kept_share)

    def state(self) -> dict[str, Any]:
        """Everything that is needed to go on."""
        return {
            "network": self.network.state_dict(),
            "average": self.average.state_dict(),
            "optimisers": [optimiser.state_dict() for optimiser in self._optimisers],
        }

    def restore(self, state: dict[str, Any]) -> None:
        """Go on from there."""
        self.network.load_state_dict(state["network"])
        self.average.load_state_dict(state["average"])
        for optimiser, kept in zip(self._optimisers, state["optimisers"], strict=True):
            optimiser.load_state_dict(kept)


# Pieces of recorded pushes as tensors: what training and evaluation roll out and compare with.


_MOVED_M = 1e-3


class Targets(NamedTuple):
    """Where the objects of B windows truly are after each substep.

    Attributes:
        centre: centres of mass [m].
        quaternion: orientations.
    """

    centre: Float[Tensor, "S B N 3"]
    quaternion: Float[Tensor, "S B N 4"]


@dataclass(frozen=True, eq=False, slots=True)
class Recording:
    """Episodes of one length and number of objects, substep by substep.

    Attributes:
        number: shape of each object.
        centre: centres of mass before the first substep and after each one [m].
        quaternion: orientations, likewise.
        pusher: its centre, likewise [m].
        velocity: commanded in each action [m/s].
        starts: episode and action at which windows of `length` actions may start.
        is_busy: whether something moves or is touched in such a window.
        length: of the windows [actions].
    """

    number: Int[Tensor, "E N"]
    centre: Float[Tensor, "E S1 N 3"]
    quaternion: Float[Tensor, "E S1 N 4"]
    pusher: Float[Tensor, "E S1 2"]
    velocity: Float[Tensor, "E T 2"]
    starts: Int[np.ndarray, "W 2"]
    is_busy: Bool[np.ndarray, "W"]
    length: int

    @property
    def telling(self) -> Int[np.ndarray, "chosen"]:
        """Numbers of the windows in which something happens; of all where nothing ever does."""
        busy = np.flatnonzero(self.is_busy)
        return busy if len(busy) else np.arange(len(self.starts))


def record(episodes: Sequence[PushEpisode], shapes: Mapping[str, ObjectShape], length: int) -> Recording:
    """Episodes as tensors, with the windows that can be learned from.

    Args:
        episodes: recorded with poses within their actions.
        shapes: of all objects in them, by name; numbered by sorted names.
        length: of the windows [actions].

    Raises:
        InvalidInput: if the episodes were recorded without substeps, differ in length or number of objects, or are
            shorter than a window.
    """
    order = {name: number for number, name in enumerate(sorted(shapes))}
    sizes = {(len(e.actions), len(e.names)) for e in episodes}
    if len(sizes) != 1 or min(sizes)[0] < length:
        raise InvalidInput("steps and objects of the episodes", sorted(sizes), f"equal, with at least {length} steps")
    number = np.array([[order[name] for name in e.names] for e in episodes])
    poses = [substates(e) for e in episodes]
    position, quaternion = np.stack([p.position for p in poses]), np.stack([p.quaternion for p in poses])
    centres = np.array([shapes[name].centre for name in sorted(shapes)])
    centre = position + rotate(quaternion, centres[number][:, None])
    velocity = np.stack([e.actions[:, :2] for e in episodes])
    pusher = np.stack([pusher_path(e.pusher[0, :2], e.actions[:, :2]) for e in episodes])
    starts, is_busy = _windows(episodes, length)

    def tensor(array: np.ndarray) -> Tensor:
        return torch.as_tensor(np.ascontiguousarray(array), dtype=torch.float32)

    return Recording(torch.as_tensor(number), tensor(centre), tensor(quaternion), tensor(pusher), tensor(velocity),
                     starts, is_busy, length)  # fmt: skip


def _windows(episodes: Sequence[PushEpisode], length: int) -> tuple[np.ndarray, np.ndarray]:
    """Starts of windows in which nothing falls off the table, and whether anything happens in them."""
    starts, busy = [], []
    for number, e in enumerate(episodes):
        last = len(e.actions) - length
        safe = is_on_table(e)
        moved = np.linalg.norm(np.diff(e.positions, axis=0), axis=-1).max(axis=1) > _MOVED_M
        happens = moved | e.contact.any(axis=1)
        for start in range(last + 1):
            if safe[start : start + length + 1].all():
                starts.append((number, start))
                busy.append(happens[start : start + length].any())
    return np.array(starts, int).reshape(-1, 2), np.array(busy, bool)


class Batch(NamedTuple):
    """B windows ready to be rolled out.

    Attributes:
        number: shape of each object.
        motion: at their start.
        velocity: commanded in each action [m/s].
        targets: the truth.
    """

    number: Int[Tensor, "B N"]
    motion: Motion
    velocity: Float[Tensor, "T B 2"]
    targets: Targets


def batch(
    recording: Recording,
    table: ShapeTable,
    windows: Int[np.ndarray, "B"],
    device: torch.device | str = "cpu",
    coarse: Bool[np.ndarray, "B"] | None = None,
) -> Batch:
    """Windows of a recording, ready to be rolled out. Velocities at their starts are those of the substep before.

    Args:
        recording: that holds them.
        table: shapes, on `device`.
        windows: numbers in `recording.starts`.
        device: of the tensors.
        coarse: windows that start with means over the action before instead, all that a rollout from observed states
            knows; by default none.
    """
    episode, start = (torch.as_tensor(column) for column in recording.starts[windows].T)
    first = start * SUBSTEPS
    steps = first[:, None] + torch.arange(recording.length * SUBSTEPS + 1)
    centre, quaternion = recording.centre[episode[:, None], steps], recording.quaternion[episode[:, None], steps]
    back = torch.ones_like(first) if coarse is None else torch.where(torch.as_tensor(coarse), SUBSTEPS, 1)
    back = torch.minimum(back, first)
    share = 1 / back.clamp(min=1)[:, None, None]
    linear = share * (centre[:, 0] - recording.centre[episode, first - back])
    angular = share * turn_between(recording.quaternion[episode, first - back], quaternion[:, 0])
    actions = start[:, None] + torch.arange(recording.length)
    number = recording.number[episode].to(device)

    def put(tensor: Tensor) -> Tensor:
        return tensor.to(device)

    lowest = lowest_point(
        table, number.flatten(), put(centre[:, 0].flatten(0, 1)), put(quaternion[:, 0].flatten(0, 1))
    ).view(number.shape)
    start = (centre[:, 0], quaternion[:, 0], linear, angular, recording.pusher[episode, first])
    motion = sleeping(Motion(*[put(part) for part in start], floor=lowest.clamp(max=0)))
    targets = Targets(put(centre[:, 1:].transpose(0, 1)), put(quaternion[:, 1:].transpose(0, 1)))
    return Batch(number, motion, put(recording.velocity[episode[:, None], actions].transpose(0, 1)), targets)


def turn_between(first: Tensor, second: Tensor) -> Tensor:
    """Rotation vectors from one orientation to another [rad]."""
    a, b = first.double().numpy(), second.double().numpy()
    return torch.as_tensor(quaternion_log(quaternion_multiply(b, quaternion_conjugate(a))), dtype=torch.float32)


# Single substeps of recorded pushes as graphs, ready for the network: features are computed once, not in every
# step.
#
# The true state goes in, the true motion is the target: no errors add up, but a step of training costs a fraction
# of one over whole windows.


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


# Errors of a network on held-out windows, and the distance that training minimises.


MEASURED_WINDOW = 4
MOVED_M = 0.01
MOVED_RAD = math.radians(5)  # what counts as truly moved within a window
_ARM_M = 0.05  # a rotation by an angle counts as the angle times this
_MEASURED = 2000  # windows


@dataclass(frozen=True, slots=True)
class Validation:
    """Errors on held-out windows of four actions, of objects that truly moved.

    Attributes:
        windows: how many objects in windows truly moved.
        mm_4: median error of position after four actions [mm].
        deg_4: median error of orientation [deg].
        mean_mm_4: mean error of position [mm].
        loss: mean distance over all substeps [mm]; training keeps the weights with the least.
        constant_mm_4: median distance these objects travel, the error of predicting no motion [mm].
    """

    windows: int
    mm_4: float
    deg_4: float
    mean_mm_4: float
    loss: float
    constant_mm_4: float


def distance(motion: Motion, pieces: Batch, step: int) -> Tensor:
    """How far every object is from the truth after a substep (B, N) [m], its orientation included.

    Args:
        motion: predicted.
        pieces: the windows, with the truth.
        step: which substep, from 0.
    """
    shift = motion.centre - pieces.targets.centre[step]
    turn = 2 * _sine(motion.quaternion, pieces.targets.quaternion[step])
    return (shift.square().sum(dim=-1) + (_ARM_M * turn).square() + 1e-8).sqrt()


def _sine(a: Tensor, b: Tensor) -> Tensor:
    """Sine of half the angle between orientations."""
    between = rotations.multiply(b * b.new_tensor([1.0, -1.0, -1.0, -1.0]), a)
    return (between[..., 1:].square().sum(dim=-1) + 1e-12).sqrt()


@torch.inference_mode()
def validate(
    network: PropagationNetwork, table: ShapeTable, recording: Recording, device: torch.device | str = "cpu"
) -> Validation:
    """Errors on windows in which something happens, or on all where nothing ever does.

    Args:
        network: to measure.
        table: shapes of the recorded objects, on `device`.
        recording: held out, with one or more windows of four actions; of the busy ones 2000 at most are measured.
        device: that computes.
    """
    chosen = np.random.default_rng(0).permutation(recording.telling)[:_MEASURED]
    pieces = batch(recording, table, chosen, device)
    loss, motion = 0.0, pieces.motion
    for step, motion in enumerate(unroll(network, table, pieces.number, pieces.motion, pieces.velocity)):
        loss += float(distance(motion, pieces, step).sum()) * 1e3 / len(chosen) / len(pieces.targets.centre)
    travel = (pieces.motion.centre - pieces.targets.centre[-1]).norm(dim=-1)
    turned = 2 * torch.asin(_sine(pieces.motion.quaternion, pieces.targets.quaternion[-1]).clamp(max=1))
    moved = (travel > MOVED_M) | (turned > MOVED_RAD)
    error = 1e3 * (motion.centre - pieces.targets.centre[-1]).norm(dim=-1)[moved]
    angle = torch.rad2deg(2 * torch.asin(_sine(motion.quaternion, pieces.targets.quaternion[-1]).clamp(max=1)))[moved]
    if not len(error):
        return Validation(0, 0.0, 0.0, 0.0, loss, 0.0)
    medians = [float(values.median()) for values in (error, angle, 1e3 * travel[moved])]
    return Validation(len(error), medians[0], medians[1], float(error.mean()), loss, medians[2])


LONG_WINDOW = 3  # actions (paper: up to three future steps)
_BUSY_SHARE = 0.85  # of the windows of a batch: in the others nothing happens
_COARSE_SHARE = 0.5  # of the windows, which start with velocities as little known as in use
_WARM_UP = 100
_LAST_RATE = 0.01  # of the first one
_REPORT_EVERY, _MEASURE_EVERY, _MEASURE_LONG_EVERY = 20, 1000, 100
_LONG_RATE = 0.1
_OWN_METRICS = ("validation_mm_4", "validation_windows")


@dataclass(frozen=True, slots=True)
class TrainDynamics:
    """A training run.

    Attributes:
        data: push files; one in twelve episodes is held out.
        out: file to write, FILE.safetensors; metrics go beside it to FILE.json.
        iterations: on single substeps, at most.
        batch: substeps in each.
        long_iterations: on windows of three actions, after these.
        long_batch: windows in each.
        hidden: width of the network.
        rate: of learning, at its highest; on windows a tenth of it; of what is no matrix half of it.
        patience: measurements on held-out episodes without a better one after which training stops.
        without: objects whose episodes are left out.
        device: "auto", "cpu" or "cuda".
        seed: of everything random.
    """

    data: tuple[Path, ...]
    out: Path
    iterations: int = 26_000
    batch: int = 512
    long_iterations: int = 500
    long_batch: int = 96
    hidden: int = 192
    rate: float = 4e-3
    patience: int = 20
    without: tuple[str, ...] = ()
    device: Literal["auto", "cpu", "cuda"] = "auto"
    seed: int = 0

    @property
    def command(self) -> str:
        """How to do it again."""
        parts = ["osf", "train", "dynamics", "--data", *(path.name for path in self.data), "--out", self.out.name]
        default = TrainDynamics(self.data, self.out)
        for name in ("iterations", "batch", "long_iterations", "long_batch", "hidden", "rate", "patience", "seed"):
            if getattr(self, name) != getattr(default, name):
                parts += [f"--{name.replace('_', '-')}", str(getattr(self, name))]
        return shlex.join([*parts, *(["--without", *self.without] if self.without else [])])


def train_dynamics(config: TrainDynamics, shapes: Mapping[str, ObjectShape]) -> Iterator[Progress]:
    """Train a network and write it; a killed run goes on from its last checkpoint.

    Args:
        config: what to train on.
        shapes: of all objects with a field; episodes with other objects are left out.

    Raises:
        InvalidInput: if a number is out of range, the device is not there, or nothing is left to learn from.
        CorruptFile: if a push file cannot be read, or the checkpoint of a killed run cannot be gone on from.
        CannotWrite: if the output cannot be written, which is tried first.
    """
    _check(config)
    device = pick_device(config.device)
    check_weights_place(config.out, _OWN_METRICS)
    total = config.iterations + config.long_iterations
    yield Progress(0, total, "Reading the pushes")
    run = _Run(config, shapes, device)
    run.resume()
    while run.done < total:
        note = run.iterate()
        if run.done % run.measure_every == 0 or run.done in (config.iterations, total):
            run.measure()
            run.save()
        if run.done % _REPORT_EVERY == 0:
            yield Progress(run.done, total, note)
    run.finish()
    yield Progress(total, total, run.note)


def _check(config: TrainDynamics) -> None:
    check_seed(config.seed)
    check_ranges(
        ("number of iterations", config.iterations, 1, 10_000_000),
        ("number of iterations on windows", config.long_iterations, 0, 10_000_000),
        ("batch", config.batch, 1, 100_000),
        ("batch of windows", config.long_batch, 1, 100_000),
        ("width of the network", config.hidden, 1, 1024),
        ("patience", config.patience, 1, 1_000_000),
        ("rate of learning", config.rate, 1e-9, 1),
    )


class _Run:
    """The state of a training run."""

    def __init__(self, config: TrainDynamics, shapes: Mapping[str, ObjectShape], device: torch.device) -> None:
        self._config, self._device = config, device
        names = tuple(sorted(shapes))
        self._table = ShapeTable(tuple(shapes[name] for name in names), device)
        learned, kept = _episodes(config, frozenset(names))
        self._long = _recording_of(learned, shapes, LONG_WINDOW)
        drawn = samples(_recording_of(learned, shapes, 1), self._table, device, disturbed_substeps(learned, shapes))
        self._samples = drawn.to(device)
        self._validation = _recording_of(kept, shapes, MEASURED_WINDOW)
        self._used = len(learned)
        torch.manual_seed(config.seed)
        self._rng = np.random.default_rng(config.seed)
        self._descent = Optimizers(PropagationNetwork(config.hidden).to(device), config.rate)
        self._best: dict[str, Tensor] = {}
        self.best: Validation | None = None
        self.done = self.fruitless = self.steps = 0

    @property
    def note(self) -> str:
        """How good it is, for a person."""
        if self.best is None:
            return "not measured yet"
        return f"held out: {self.best.mm_4:.1f} mm, {self.best.deg_4:.1f} deg after 4 steps"

    @property
    def measure_every(self) -> int:
        """Iterations between measurements: those on windows take longer."""
        return _MEASURE_EVERY if self.done < self._config.iterations else _MEASURE_LONG_EVERY

    def iterate(self) -> str:
        """One step of descent."""
        loss = self._loss_of_samples() if self.done < self._config.iterations else self._loss_of_windows()
        self._descent.step(loss, self._share_of_rate(), self.done)
        self.done += 1
        self.steps += 1
        what = "a substep" if self.done <= self._config.iterations else "a window"
        return f"loss {float(loss.detach()):.2f} mm {what}; {self.note}"

    def _loss_of_samples(self) -> Tensor:
        """Mean error of single substeps [mm]."""
        graphs = torch.as_tensor(self._rng.integers(len(self._samples), size=self._config.batch), device=self._device)
        flipped = torch.as_tensor(self._rng.random(len(graphs)) < 0.5, device=self._device)
        sample = self._samples.draw(graphs, flipped)
        residual = self._descent.network(sample.nodes, sample.edges, sample.receiver, sample.sender)
        scale = residual.new_tensor([SHIFT_M] * 3 + [_ARM_M * TURN_RAD] * 3)
        return 1e3 * (((residual - sample.target) * scale).square().sum(dim=1) + 1e-9).sqrt().mean()

    def _loss_of_windows(self) -> Tensor:
        """Mean error over the substeps of windows of three actions [mm]."""
        windows = _draw(self._long, self._rng, self._config.long_batch)
        pieces = batch(self._long, self._table, windows, self._device, self._rng.random(len(windows)) < _COARSE_SHARE)
        mirror = torch.as_tensor(self._rng.random(len(windows)) < 0.5, device=self._device)
        loss = torch.zeros((), device=self._device)
        for step, motion in enumerate(self._unroll(pieces, mirror)):
            loss = loss + distance(motion, pieces, step).sum()
        return loss * (1e3 / len(windows) / len(pieces.targets.centre))

    def _unroll(self, pieces: Batch, mirror: Tensor) -> Iterator[Motion]:
        return unroll(self._descent.network, self._table, pieces.number, pieces.motion, pieces.velocity, mirror)

    def _share_of_rate(self) -> float:
        """A warm-up and a cosine for each of both parts."""
        config = self._config
        is_long = self.done >= config.iterations
        done, total = (
            (self.done - config.iterations, config.long_iterations) if is_long else (self.done, config.iterations)
        )
        falling = _LAST_RATE + (1 - _LAST_RATE) * (1 + math.cos(math.pi * done / total)) / 2
        return (_LONG_RATE if is_long else 1) * min(1, (done + 1) / _WARM_UP) * falling

    def measure(self) -> None:
        """Keep the averaged weights if they are the best so far."""
        result = validate(self._descent.average, self._table, self._validation, self._device)
        if self.best is None or result.loss < self.best.loss:
            self.best, self.fruitless = result, 0
            kept = self._descent.average.state_dict()
            self._best = {name: value.detach().cpu().clone() for name, value in kept.items()}
        else:
            self.fruitless += 1
        if self.fruitless >= self._config.patience:  # what is left of this part would be in vain
            self.done, self.fruitless = self._next_part(), 0

    def _next_part(self) -> int:
        """Number of the iteration at which the next part begins."""
        config = self._config
        return config.iterations if self.done < config.iterations else config.iterations + config.long_iterations

    @property
    def _checkpoint(self) -> Path:
        return self._config.out.with_suffix(".checkpoint")

    def _fingerprint(self) -> str:
        settings = {**asdict(self._config), "data": [path.name for path in self._config.data], "out": "", "device": ""}
        return repr((settings, self._used, len(self._samples)))

    def save(self) -> None:
        """Everything that is needed to go on."""
        content: dict[str, Any] = {
            "descent": self._descent.state(),
            "best": self._best,
            "validation": asdict(self.best) if self.best else None,
            "numbers": [self.done, self.fruitless, self.steps],
            "rng": self._rng.bit_generator.state,
        }
        write_checkpoint(self._checkpoint, self._fingerprint(), content)

    def resume(self) -> None:
        """Go on from the checkpoint of the same run, if there is one."""
        resume_from(self._checkpoint, self._fingerprint(), self._restore)

    def _restore(self, content: dict[str, Any]) -> None:
        self._descent.restore(content["descent"])
        self._best = content["best"]
        self.best = Validation(**content["validation"]) if content["validation"] else None
        self.done, self.fruitless, self.steps = content["numbers"]
        self._rng.bit_generator.state = content["rng"]

    def finish(self) -> None:
        """Write the best weights and what is known of them."""
        assert self.best is not None
        network = self._descent.network
        network.load_state_dict(self._best)
        data = network_bytes(network)
        write_atomically(self._config.out, data)
        metrics = {f"validation_{name}": round(value, 3) for name, value in asdict(self.best).items()}
        own = {"iterations": self.steps, "seed": self._config.seed, "device": str(self._device), "bytes": len(data),
               "episodes": self._used, "substeps": len(self._samples), "without": list(self._config.without),
               "threads": torch.get_num_threads(),
               "data": [path.name for path in self._config.data], "command": self._config.command}  # fmt: skip
        write_json(self._config.out.with_suffix(".json"), {**metrics, **own})
        self._checkpoint.unlink(missing_ok=True)


def _episodes(config: TrainDynamics, known: frozenset[str]) -> tuple[list[PushEpisode], list[PushEpisode]]:
    """What is learned from, and what is kept to stop by; nothing that is held out is in either."""
    parts: tuple[list[PushEpisode], list[PushEpisode]] = [], []
    unknown = set[str]()
    for path in config.data:
        for number, episode in enumerate(read_sound_pushes(path)):
            unknown |= set(episode.names) - known
            left_out = set(episode.names) & set(config.without)
            if set(episode.names) <= known and not left_out and not has_held_out_pair(episode.names):
                parts[is_for_validation(number)].append(episode)
    if not all(parts):
        what = "episodes to learn from" if not parts[0] else "episodes to validate on"
        lacking = f" (objects without a field: {', '.join(sorted(unknown))})" if unknown else ""
        raise InvalidInput(what, f"0{lacking}", "at least 1: collect more, or leave out fewer objects")
    return parts


def _recording_of(episodes: Sequence[PushEpisode], shapes: Mapping[str, ObjectShape], length: int) -> Recording:
    recording = record(episodes, shapes, length)
    if not len(recording.starts):
        what = f"windows of {length} actions in which all objects stay on the table"
        raise InvalidInput(what, 0, "at least 1: collect more pushes")
    return recording


def _draw(recording: Recording, rng: np.random.Generator, count: int) -> np.ndarray:
    """Windows, most of them with something happening."""
    quiet = rng.integers(len(recording.starts), size=count - round(count * _BUSY_SHARE))
    return np.concatenate([rng.choice(recording.telling, count - len(quiet)), quiet])
