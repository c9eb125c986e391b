"""Training the propagation network on recorded pushes.

Deviations from the paper (section 4.3), measured in docs/notes/dynamics.md:

- An action is predicted in four substeps.
- The loss is a distance of centre of mass and orientation together, and not its square, so that a few toppling objects
  do not outweigh all that slide.
- Half of the samples are reflected.
- Most of the training is on single substeps from true states, which cost a fraction. Only at its end does the loss run
  over three actions with gradients through all of them, as in the paper.
"""

from __future__ import annotations

import copy
import hashlib
import itertools
import math
import shlex
from abc import ABC, abstractmethod
from collections.abc import Callable, Collection, Iterable, Iterator, Mapping, Sequence
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

# Objects and episodes that are held out of training, for measurements.


_PAIRS_ONE_IN = 16
_EPISODES_ONE_IN = 12


def is_held_out_pair(first: str, second: str) -> bool:
    """Return whether two objects never meet in training: one pair in 16, by their names alone."""
    text = "+".join(sorted((first, second)))
    return int.from_bytes(hashlib.sha256(text.encode()).digest()[:8], "big") % _PAIRS_ONE_IN == 0


def has_held_out_pair(names: Iterable[str]) -> bool:
    """Return whether any two of the objects never meet in training."""
    return any(is_held_out_pair(a, b) for a, b in itertools.combinations(names, 2))


def is_for_validation(number: int) -> bool:
    """Return whether the episode of this number is held out to decide when training stops."""
    return number % _EPISODES_ONE_IN == 0


# Optimizers of training: Muon for the weight matrices, AdamW for biases, norms and the last layer.
#
# Muon makes every update of a matrix about as large in all its directions. On pushes, 3,000 steps with it come
# within 2 % of what takes AdamW 16,000, for a fifth more time a step (docs/notes/dynamics.md).


_OTHER_RATE = 0.5  # of the matrices' rate
_DECAY, _OTHER_DECAY = 0.1, 1e-4
_CLIP = 5.0
_AVERAGING = 0.998  # of the weights that are kept, from step to step


class Optimizers:
    """A network in training, and the exponential moving average of its weights.

    Attributes:
        network: the network with its current weights.
        average: the network with weights averaged over a few hundred steps, which has smaller errors.
    """

    def __init__(self, network: PropagationNetwork, rate: float) -> None:
        """Start with a network.

        Args:
            network: network to train.
            rate: highest learning rate.
        """
        self.network, self.average = network, copy.deepcopy(network)
        is_inner = [p.ndim == 2 and p is not network.decoder[-1].weight for p in network.parameters()]
        inner = list(itertools.compress(network.parameters(), is_inner))
        others = [p for p, chosen in zip(network.parameters(), is_inner, strict=True) if not chosen]
        self._rates = (rate, _OTHER_RATE * rate)
        self._optimisers = (
            torch.optim.Muon(inner, lr=rate, weight_decay=_DECAY, ns_steps=4, adjust_lr_fn="match_rms_adamw"),
            torch.optim.AdamW(others, lr=self._rates[1], weight_decay=_OTHER_DECAY),
        )

    def step(self, loss: Tensor, share: float, done: int) -> None:
        """Make one step.

        Args:
            loss: loss to minimise.
            share: share of the highest learning rate.
            done: number of earlier steps. At the beginning, the average forgets faster.
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

    def state_dict(self) -> dict[str, Any]:
        """Return everything that is needed to go on."""
        return {
            "network": self.network.state_dict(),
            "average": self.average.state_dict(),
            "optimisers": [optimiser.state_dict() for optimiser in self._optimisers],
        }

    def load_state_dict(self, state: dict[str, Any]) -> None:
        """Go on from there."""
        self.network.load_state_dict(state["network"])
        self.average.load_state_dict(state["average"])
        for optimiser, kept in zip(self._optimisers, state["optimisers"], strict=True):
            optimiser.load_state_dict(kept)


# Parts of recorded pushes as tensors, which training and evaluation roll out and compare with.


_MOVED_M = 1e-3


@dataclass(frozen=True, eq=False, slots=True)
class Recording:
    """Episodes of one length and number of objects, substep by substep.

    Attributes:
        number: shape of each object.
        centre: centres of mass before the first substep and after each one [m].
        quaternion: orientations at the same instants.
        pusher: centre of the pusher at the same instants [m].
        velocity: commanded velocity in each action [m/s].
        starts: episode and action at which windows of `length` actions may start.
        is_busy: whether something moves or is touched in such a window.
        length: length of the windows [actions].
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
    def eventful(self) -> Int[np.ndarray, "chosen"]:
        """Indices of the windows in which something happens; of all windows if nothing ever does."""
        busy = np.flatnonzero(self.is_busy)
        return busy if len(busy) else np.arange(len(self.starts))


def record(episodes: Sequence[PushEpisode], shapes: Mapping[str, ObjectShape], length: int) -> Recording:
    """Return episodes as tensors, with the windows that can be learned from.

    Args:
        episodes: episodes with poses within their actions.
        shapes: shapes of all their objects, by name. Shapes are numbered by sorted names.
        length: length of the windows [actions].

    Raises:
        InvalidInput: if the episodes were recorded without substeps, differ in length or number of objects, or hold no
            such window.
    """
    order = {name: number for number, name in enumerate(sorted(shapes))}
    starts = window_starts(episodes, length)
    number = np.array([[order[name] for name in e.names] for e in episodes])
    poses = [substates(e) for e in episodes]
    position, quaternion = np.stack([p.position for p in poses]), np.stack([p.quaternion for p in poses])
    centres = np.array([shapes[name].centre for name in sorted(shapes)])
    centre = position + rotate(quaternion, centres[number][:, None])
    velocity = np.stack([e.actions[:, :2] for e in episodes])
    pusher = np.stack([pusher_path(e.pusher[0, :2], e.actions[:, :2]) for e in episodes])
    way = np.linalg.norm(np.diff(np.stack([e.positions for e in episodes]), axis=1), axis=-1).max(axis=2)
    happens = (way > _MOVED_M) | np.stack([e.contact for e in episodes]).any(axis=2)
    is_busy = np.array([happens[e, t : t + length].any() for e, t in starts])
    places = (_float32(array) for array in (centre, quaternion, pusher, velocity))
    return Recording(torch.as_tensor(number), *places, starts=starts, is_busy=is_busy, length=length)


def window_starts(episodes: Sequence[PushEpisode], length: int) -> Int[np.ndarray, "W 2"]:
    """Return episode and first action of every window of `length` actions in which all objects stay on the table.

    Raises:
        InvalidInput: if the episodes differ in length or number of objects, or there is no such window.
    """
    sizes = {(len(e.actions), len(e.names)) for e in episodes}
    if len(sizes) != 1 or min(sizes)[0] < length:
        raise InvalidInput("steps and objects of the episodes", sorted(sizes), f"equal, with at least {length} steps")
    stays = [is_on_table(e) for e in episodes]
    last = min(sizes)[0] - length
    starts = [(n, t) for n, safe in enumerate(stays) for t in range(last + 1) if safe[t : t + length + 1].all()]
    if not starts:
        what = f"windows of {length} actions in which all objects stay on the table"
        raise InvalidInput(what, 0, "at least 1: collect more pushes")
    return np.array(starts)


def _float32(array: np.ndarray) -> Tensor:
    return torch.as_tensor(np.ascontiguousarray(array), dtype=torch.float32)


class Batch(NamedTuple):
    """B windows ready to be rolled out.

    Attributes:
        number: shape of each object.
        motion: motion at the start of each window.
        velocity: commanded velocity in each action [m/s].
        centre: true centres of mass after each substep [m].
        quaternion: true orientations after each substep.
    """

    number: Int[Tensor, "B N"]
    motion: Motion
    velocity: Float[Tensor, "T B 2"]
    centre: Float[Tensor, "S B N 3"]
    quaternion: Float[Tensor, "S B N 4"]


def batch(
    recording: Recording,
    table: ShapeTable,
    windows: Int[np.ndarray, "B"],
    device: torch.device | str = "cpu",
    coarse: Bool[np.ndarray, "B"] | None = None,
) -> Batch:
    """Return windows of a recording, ready to be rolled out.

    Velocities at their starts are those of the substep before.

    Args:
        recording: recording with the windows.
        table: shapes, on `device`.
        windows: indices in `recording.starts`.
        device: device of the tensors.
        coarse: windows whose initial velocities are means over the action before, as in a rollout from observed states;
            none by default.
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
    begins = (centre[:, 0], quaternion[:, 0], linear, angular, recording.pusher[episode, first])
    velocity = recording.velocity[episode[:, None], start[:, None] + torch.arange(recording.length)]
    number, *begins = (part.to(device) for part in (recording.number[episode], *begins))
    lowest = lowest_point(table, number.flatten(), *(part.flatten(0, 1) for part in begins[:2])).view(number.shape)
    motion = sleeping(Motion(*begins, floor=lowest.clamp(max=0)))
    after = (part.transpose(0, 1).to(device) for part in (velocity, centre[:, 1:], quaternion[:, 1:]))
    return Batch(number, motion, *after)


def turn_between(first: Tensor, second: Tensor) -> Tensor:
    """Return the rotation vectors from one orientation to another [rad]."""
    a, b = first.double().numpy(), second.double().numpy()
    return torch.as_tensor(quaternion_log(quaternion_multiply(b, quaternion_conjugate(a))), dtype=torch.float32)


# Single substeps of recorded pushes as graphs, ready for the network: features are computed once, not in every
# step.
#
# The input is the true state, and the target the true motion. Errors do not add up, but a step of training costs a
# fraction of one over whole windows.


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
        motion: motion before the substep.
        velocity: commanded velocity [m/s].
        shift: shift of the pusher [m].
        centre: centres of mass after the substep [m].
        quaternion: orientations after the substep.
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
        first: index of the first row of each graph.
        count: number of rows of each graph.
    """

    values: Tensor
    first: Int[Tensor, "G"]
    count: Int[Tensor, "G"]

    def take(self, graphs: Int[Tensor, "B"]) -> Tensor:
        """Return the rows of some graphs."""
        count = self.count[graphs]
        skipped = self.first[graphs] - (count.cumsum(0) - count)
        return self.values[skipped.repeat_interleave(count) + torch.arange(int(count.sum()), device=count.device)]


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
        """Return the number of graphs."""
        return len(self.nodes.count)

    def draw(self, graphs: Int[Tensor, "B"], flipped: Bool[Tensor, "B"]) -> Sample:
        """Return some graphs; those with a flag are reflected."""
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


def samples(
    recording: Recording, table: ShapeTable, device: torch.device | str = "cpu", others: Iterable[Substeps] = ()
) -> Samples:
    """Return every substep in which something can move, on the device.

    Args:
        recording: recording in windows of one action.
        table: shapes of the objects.
        device: PyTorch device.
        others: further substeps, such as disturbed states.

    Raises:
        InvalidInput: if there is none.
    """
    pieces = itertools.chain(_recorded(recording), others)
    graphs = (_graph_and_target(piece, table, device) for piece in pieces)
    parts = [_sample(*graph) for graph in graphs if graph is not None]
    if not parts:
        raise InvalidInput("number of steps in which an object could move", 0, "at least 1: collect more pushes")
    columns = [torch.cat(column).to(device) for column in zip(*parts, strict=True)]
    return Samples(*(_Rows(columns[k], columns[k + 1].cumsum(0) - columns[k + 1], columns[k + 1]) for k in (0, 2, 4)))


def _graph_and_target(
    piece: Substeps, table: ShapeTable, device: torch.device | str
) -> tuple[Graph, Inputs, Float[Tensor, "A 6"]] | None:
    """Return graphs of many scenes together, features and residual targets; None if everything rests."""
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
    """Yield the substeps of a recording with their true states and motions."""
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
    """Yield the recorded substeps from disturbed states of episodes with the same number of objects."""
    order = {name: number for number, name in enumerate(sorted(shapes))}
    disturbed = [(e, e.disturbed) for e in episodes if e.disturbed is not None and len(e.disturbed.step)]
    for first in range(0, len(disturbed), _TOGETHER):
        parts = [_disturbed(e, rows, shapes, order) for e, rows in disturbed[first : first + _TOGETHER]]
        number, *start, velocity, shift, centre, quaternion = map(torch.cat, zip(*parts, strict=True))
        yield _substeps(number, tuple(start), velocity, shift, centre, quaternion)


def _disturbed(
    episode: PushEpisode, rows: Disturbed, shapes: Mapping[str, ObjectShape], order: Mapping[str, int]
) -> list[Tensor]:
    """Return what `_substeps` needs, of one episode."""
    to_centre = np.broadcast_to([shapes[name].centre for name in episode.names], rows.positions.shape)
    before, after = (rotate(q.astype(float), to_centre) for q in (rows.quaternions, rows.after_quaternions))
    path = pusher_path(episode.pusher[0, :2], episode.actions[:, :2])
    arrays = (
        *(rows.positions + before, rows.quaternions, rows.linear + np.cross(rows.angular, before), rows.angular),
        *(path[rows.step], episode.actions[rows.step // SUBSTEPS, :2], path[rows.step + 1] - path[rows.step]),
        *(rows.after_positions + after, rows.after_quaternions),
    )
    number = torch.tensor([order[name] for name in episode.names]).expand(len(rows.step), -1)
    return [number, *map(_float32, arrays)]


def _substeps(
    number: Tensor, start: tuple[Tensor, ...], velocity: Tensor, shift: Tensor, centre: Tensor, quaternion: Tensor
) -> Substeps:
    motion = Motion(*start, floor=torch.zeros(number.shape))  # the floor is not used: nothing is moved here
    return Substeps(number, sleeping(motion), velocity, shift, centre, quaternion)


def _sample(graph: Graph, features: Inputs, target: Float[Tensor, "A 6"]) -> tuple[Tensor, ...]:
    """Return rows of objects, of edges from the pusher and of edges between objects, each with its counts by graph."""
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
        windows: number of objects in windows that truly moved.
        mm_4: median error of position after four actions [mm].
        deg_4: median error of orientation [deg].
        mean_mm_4: mean error of position [mm].
        loss: mean distance over all substeps [mm]. Training keeps the weights with the least loss.
        constant_mm_4: median distance that these objects travel, which is the error of predicting no motion [mm].
    """

    windows: int
    mm_4: float
    deg_4: float
    mean_mm_4: float
    loss: float
    constant_mm_4: float


def distance(motion: Motion, pieces: Batch, step: int) -> Tensor:
    """Return the distance of every object from the truth after a substep, including its orientation (B, N) [m].

    Args:
        motion: predicted motion.
        pieces: the windows with the truth.
        step: index of the substep, from 0.
    """
    shift = motion.centre - pieces.centre[step]
    turn = 2 * _sine(motion.quaternion, pieces.quaternion[step])
    return (shift.square().sum(dim=-1) + (_ARM_M * turn).square() + 1e-8).sqrt()


def _sine(a: Tensor, b: Tensor) -> Tensor:
    """Return the sine of half the angle between orientations."""
    between = rotations.multiply(b * b.new_tensor([1.0, -1.0, -1.0, -1.0]), a)
    return (between[..., 1:].square().sum(dim=-1) + 1e-12).sqrt()


@torch.inference_mode()
def validate(
    network: PropagationNetwork, table: ShapeTable, recording: Recording, device: torch.device | str = "cpu"
) -> Validation:
    """Return errors on windows in which something happens, or on all windows if nothing ever does.

    Args:
        network: network to measure.
        table: shapes of the recorded objects, on `device`.
        recording: held-out recording with windows of four actions. At most 2000 windows are measured.
        device: PyTorch device.
    """
    chosen = np.random.default_rng(0).permutation(recording.eventful)[:_MEASURED]
    pieces = batch(recording, table, chosen, device)
    loss, motion = 0.0, pieces.motion
    for step, motion in enumerate(unroll(network, table, pieces.number, pieces.motion, pieces.velocity)):
        loss += float(distance(motion, pieces, step).sum()) * 1e3 / len(chosen) / len(pieces.centre)
    travel = (pieces.motion.centre - pieces.centre[-1]).norm(dim=-1)
    turned = 2 * torch.asin(_sine(pieces.motion.quaternion, pieces.quaternion[-1]).clamp(max=1))
    moved = (travel > MOVED_M) | (turned > MOVED_RAD)
    error = 1e3 * (motion.centre - pieces.centre[-1]).norm(dim=-1)[moved]
    angle = torch.rad2deg(2 * torch.asin(_sine(motion.quaternion, pieces.quaternion[-1]).clamp(max=1)))[moved]
    if not len(error):
        return Validation(0, 0.0, 0.0, 0.0, loss, 0.0)
    medians = [float(values.median()) for values in (error, angle, 1e3 * travel[moved])]
    return Validation(len(error), medians[0], medians[1], float(error.mean()), loss, medians[2])


# A training run on push files, of our model or the paper's. A killed run can continue, and the best weights are kept.


UNROLLED = 3  # actions of a window (paper: up to three future steps)
_WARM_UP = 100
_LAST_RATE = 0.01  # of the first one
_REPORT_EVERY = 20
_OWN_METRICS = ("validation_mm_4", "validation_windows")


class PushTraining(ABC):
    """A training run on push files. Subclasses define the steps.

    Args:
        network: network with its initial weights.
        parts: networks and optimisers, by their names in a checkpoint.
        fingerprint: settings and data, which a checkpoint must agree with.
        out: file to write.
        total: iterations.
        patience: measurements without a better one after which training stops.
        seed: seed of everything random.

    Attributes:
        best: the best measurement on held-out episodes; None before the first.
        done: number of finished iterations.
        fruitless: number of measurements since the best one.
    """

    measurement: type[Any]  # with at least `mm_4` and `deg_4`
    score: str  # the field of it of which the least is the best
    counters: tuple[str, ...] = ("done", "fruitless")  # that a checkpoint keeps

    def __init__(
        self, network: nn.Module, parts: Mapping[str, Any], fingerprint: object, *, out: Path, total: int,
        patience: int, seed: int,
    ) -> None:  # fmt: skip
        self.network, self.total, self.rng = network, total, np.random.default_rng(seed)
        self._parts, self._fingerprint, self._out, self._patience = parts, fingerprint, out, patience
        self.best: Any = None
        self._best_weights: dict[str, Tensor] = {}
        self.done = self.fruitless = 0

    @abstractmethod
    def iterate(self) -> str:
        """Make one step of descent and return a note on its loss."""

    @abstractmethod
    def is_due(self) -> bool:
        """Return whether to measure after this iteration."""

    @abstractmethod
    def measured(self) -> tuple[Any, nn.Module]:
        """Return the errors on held-out episodes, and the measured network."""

    @abstractmethod
    def described(self) -> tuple[bytes, dict[str, Any]]:
        """Return the contents of the network's file, and its metrics besides the errors."""

    @property
    def note(self) -> str:
        """The best errors so far, for people."""
        if self.best is None:
            return "not measured yet"
        return f"held out: {self.best.mm_4:.1f} mm, {self.best.deg_4:.1f} deg after 4 steps"

    def run(self) -> Iterator[Progress]:
        """Train, from the checkpoint of a killed run if there is one, and write the best weights."""
        checkpoint = self._out.with_suffix(".checkpoint")
        resume_from(checkpoint, self._fingerprint, self._resume)
        while self.done < self.total and self.fruitless < self._patience:
            note = self.iterate()
            if self.is_due():
                self.measure()
                write_checkpoint(checkpoint, self._fingerprint, self._state())
            if self.done % _REPORT_EVERY == 0:
                yield Progress(self.done, self.total, note)
        self.network.load_state_dict(self._best_weights)
        data, facts = self.described()
        write_atomically(self._out, data)
        metrics = {f"validation_{name}": round(value, 3) for name, value in asdict(self.best).items()}
        write_json(self._out.with_suffix(".json"), {**metrics, **facts})
        checkpoint.unlink(missing_ok=True)
        yield Progress(self.total, self.total, self.note)

    def measure(self) -> None:
        """Keep the weights if they are the best so far."""
        result, network = self.measured()
        if self.best is None or getattr(result, self.score) < getattr(self.best, self.score):
            self.best, self.fruitless = result, 0
            self._best_weights = {name: value.detach().cpu().clone() for name, value in network.state_dict().items()}
        else:
            self.fruitless += 1

    def _state(self) -> dict[str, Any]:
        """Return everything that is needed to go on."""
        return {
            **{name: part.state_dict() for name, part in self._parts.items()},
            "best": self._best_weights,
            "validation": asdict(self.best) if self.best else None,
            "numbers": [getattr(self, name) for name in self.counters],
            "rng": self.rng.bit_generator.state,
        }

    def _resume(self, state: dict[str, Any]) -> None:
        for name, part in self._parts.items():
            part.load_state_dict(state[name])
        self._best_weights = state["best"]
        self.best = self.measurement(**state["validation"]) if state["validation"] else None
        for name, value in zip(self.counters, state["numbers"], strict=True):
            setattr(self, name, value)
        self.rng.bit_generator.state = state["rng"]


def share_of_rate(done: int, total: int, highest: float = 1) -> float:
    """Return the learning rate after a warm-up and along a cosine, as a share of `highest`."""
    falling = _LAST_RATE + (1 - _LAST_RATE) * (1 + math.cos(math.pi * done / total)) / 2
    return highest * min(1, (done + 1) / _WARM_UP) * falling


def prepare(config: Any, *more: tuple[str, float, float, float]) -> torch.device:  # noqa: ANN401
    """Check settings such as `TrainDynamics` and the output, and return the PyTorch device.

    Args:
        config: the settings.
        more: further ranges, as for `check_ranges`.

    Raises:
        InvalidInput: if a number is out of range or the device is not there.
        CannotWrite: if the output cannot be written.
    """
    check_seed(config.seed)
    check_ranges(
        ("number of iterations", config.iterations, 1, 10_000_000),
        ("batch", config.batch, 1, 100_000),
        ("width of the network", config.hidden, 1, 1024),
        ("patience", config.patience, 1, 1_000_000),
        ("rate of learning", config.rate, 1e-9, 1),
        *more,
    )
    device = pick_device(config.device)
    check_weights_place(config.out, _OWN_METRICS)
    return device


def command_of(config: Any, options: Sequence[str], *method: str) -> list[str]:  # noqa: ANN401
    """Return the words of the command that trains with these settings, without options that have their defaults."""
    words = ["osf", "train", "dynamics", *method, "--data", *(path.name for path in config.data)]
    words += ["--out", config.out.name]
    default = type(config)(config.data, config.out)
    for name in options:
        if getattr(config, name) != getattr(default, name):
            words += [f"--{name.replace('_', '-')}", str(getattr(config, name))]
    return words


def fingerprint_of(config: Any) -> dict[str, Any]:  # noqa: ANN401
    """Return the settings, such as of `TrainDynamics`, that a checkpoint must agree with."""
    return {**asdict(config), "data": [path.name for path in config.data], "out": "", "device": ""}


def split_episodes(
    data: Sequence[Path], known: Collection[str], is_wanted: Callable[[tuple[str, ...]], bool], advice: str
) -> tuple[list[PushEpisode], list[PushEpisode]]:
    """Return the episodes to learn from, and the held-out ones that decide when to stop.

    Args:
        data: push files.
        known: names of known objects. Episodes with other objects are left out.
        is_wanted: function from the names of its objects to whether an episode is used.
        advice: what to do if no episode is left, for the error.

    Raises:
        InvalidInput: if no episode is left in either part.
        CorruptFile: if a push file cannot be read.
    """
    parts: tuple[list[PushEpisode], list[PushEpisode]] = [], []
    unknown = set[str]()
    for path in data:
        for number, episode in enumerate(read_sound_pushes(path)):
            strange = set(episode.names) - set(known)
            unknown |= strange
            if not strange and is_wanted(episode.names):
                parts[is_for_validation(number)].append(episode)
    if not all(parts):
        what = "episodes to validate on" if parts[0] else "episodes to learn from"
        lacking = f" (objects without a field: {', '.join(sorted(unknown))})" if unknown else ""
        raise InvalidInput(what, f"0{lacking}", f"at least 1: {advice}")
    return parts


# Training our network: on single substeps first, then on windows of three actions.


_BUSY_SHARE = 0.85  # of the windows of a batch: in the others nothing happens
_COARSE_SHARE = 0.5  # of the windows, which start with velocities as little known as in use
_LONG_RATE = 0.1
_MEASURE_EVERY, _MEASURE_LONG_EVERY = 1000, 100  # iterations


@dataclass(frozen=True, slots=True)
class TrainDynamics:
    """A training run.

    Attributes:
        data: push files; one in twelve episodes is held out.
        out: file to write, FILE.safetensors; metrics go beside it to FILE.json.
        iterations: largest number of iterations on single substeps.
        batch: substeps in each of these iterations.
        long_iterations: number of further iterations, on windows of three actions.
        long_batch: windows in each of these iterations.
        hidden: width of the network.
        rate: highest learning rate; on windows a tenth of it, and for parameters that are no matrices half of it.
        patience: number of measurements without improvement after which training stops.
        without: objects whose episodes are left out.
        device: "auto", "cpu" or "cuda".
        seed: seed of everything random.
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
        options = ("iterations", "batch", "long_iterations", "long_batch", "hidden", "rate", "patience", "seed")
        return shlex.join([*command_of(self, options), *(["--without", *self.without] if self.without else [])])


def train_dynamics(config: TrainDynamics, shapes: Mapping[str, ObjectShape]) -> Iterator[Progress]:
    """Train a network and write it; a killed run goes on from its last checkpoint.

    Args:
        config: what to train on.
        shapes: shapes of all objects with a field; episodes with other objects are left out.

    Raises:
        InvalidInput: if a number is out of range, the device is not there, or nothing is left to learn from.
        CorruptFile: if a push file cannot be read, or the checkpoint of a killed run cannot be gone on from.
        CannotWrite: if the output cannot be written, which is tried first.
    """
    device = prepare(
        config,
        ("number of iterations on windows", config.long_iterations, 0, 10_000_000),
        ("batch of windows", config.long_batch, 1, 100_000),
    )
    yield Progress(0, config.iterations + config.long_iterations, "Reading the pushes")
    yield from _Run(config, shapes, device).run()


class _Run(PushTraining):
    measurement, score = Validation, "loss"
    counters = ("done", "fruitless", "steps")

    def __init__(self, config: TrainDynamics, shapes: Mapping[str, ObjectShape], device: torch.device) -> None:
        self._config, self._device, self.steps = config, device, 0
        self._table = ShapeTable(tuple(shapes[name] for name in sorted(shapes)), device)

        def is_wanted(names: tuple[str, ...]) -> bool:
            return not set(names) & set(config.without) and not has_held_out_pair(names)

        learned, kept = split_episodes(config.data, shapes, is_wanted, "collect more, or leave out fewer objects")
        self._windows = record(learned, shapes, UNROLLED)
        self._samples = samples(record(learned, shapes, 1), self._table, device, disturbed_substeps(learned, shapes))
        self._validation = record(kept, shapes, MEASURED_WINDOW)
        self._episodes = len(learned)
        torch.manual_seed(config.seed)
        self._descent = Optimizers(PropagationNetwork(config.hidden).to(device), config.rate)
        super().__init__(
            self._descent.network, {"descent": self._descent},
            repr((fingerprint_of(config), self._episodes, len(self._samples))), out=config.out,
            total=config.iterations + config.long_iterations, patience=config.patience, seed=config.seed,
        )  # fmt: skip

    def is_due(self) -> bool:
        every = _MEASURE_EVERY if self.done < self._config.iterations else _MEASURE_LONG_EVERY
        return self.done % every == 0 or self.done in (self._config.iterations, self.total)

    def iterate(self) -> str:
        short, long = self._config.iterations, self._config.long_iterations
        if self.done < short:
            loss, share, what = self._loss_of_samples(), share_of_rate(self.done, short), "a substep"
        else:
            loss, share, what = self._loss_of_windows(), share_of_rate(self.done - short, long, _LONG_RATE), "a window"
        self._descent.step(loss, share, self.done)
        self.done += 1
        self.steps += 1
        return f"loss {float(loss.detach()):.2f} mm {what}; {self.note}"

    def _loss_of_samples(self) -> Tensor:
        """Return the mean error of single substeps [mm]."""
        graphs = torch.as_tensor(self.rng.integers(len(self._samples), size=self._config.batch), device=self._device)
        flipped = torch.as_tensor(self.rng.random(len(graphs)) < 0.5, device=self._device)
        sample = self._samples.draw(graphs, flipped)
        residual = self._descent.network(sample.nodes, sample.edges, sample.receiver, sample.sender)
        scale = residual.new_tensor([SHIFT_M] * 3 + [_ARM_M * TURN_RAD] * 3)
        return 1e3 * (((residual - sample.target) * scale).square().sum(dim=1) + 1e-9).sqrt().mean()

    def _loss_of_windows(self) -> Tensor:
        """Return the mean error over the substeps of windows of three actions [mm]; in most of them things happen."""
        count, recording = self._config.long_batch, self._windows
        quiet = self.rng.integers(len(recording.starts), size=count - round(count * _BUSY_SHARE))
        windows = np.concatenate([self.rng.choice(recording.eventful, count - len(quiet)), quiet])
        pieces = batch(recording, self._table, windows, self._device, self.rng.random(count) < _COARSE_SHARE)
        mirror = torch.as_tensor(self.rng.random(count) < 0.5, device=self._device)
        loss = torch.zeros((), device=self._device)
        motions = unroll(self._descent.network, self._table, pieces.number, pieces.motion, pieces.velocity, mirror)
        for step, motion in enumerate(motions):
            loss = loss + distance(motion, pieces, step).sum()
        return loss * (1e3 / count / len(pieces.centre))

    def measured(self) -> tuple[Validation, PropagationNetwork]:
        network = self._descent.average
        return validate(network, self._table, self._validation, self._device), network

    def measure(self) -> None:
        super().measure()
        if self.fruitless >= self._config.patience:  # the rest of this part would gain nothing
            self.done = self._config.iterations if self.done < self._config.iterations else self.total
            self.fruitless = 0

    def described(self) -> tuple[bytes, dict[str, Any]]:
        config, data = self._config, network_bytes(self._descent.network)
        return data, {
            "iterations": self.steps, "seed": config.seed, "device": str(self._device), "bytes": len(data),
            "episodes": self._episodes, "substeps": len(self._samples), "without": list(config.without),
            "threads": torch.get_num_threads(),
            "data": [path.name for path in config.data], "command": config.command,
        }  # fmt: skip
