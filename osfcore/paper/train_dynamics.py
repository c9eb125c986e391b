"""Training the paper's model (its section 4.3): mean squared error of poses, unrolled over three actions.

Windows of a push file are drawn evenly; nothing is reflected, weighted, disturbed or smoothed. The paper names neither
optimiser nor schedule: here they are AdamW, a short warm-up and a rate that falls along a cosine. A thousand episodes
are soon learned by heart: without the decay of weights, 3,000 steps of a longer run leave an error of 8 mm on episodes
that were learned from and of 22 mm on others. One in twelve episodes is held out, and the weights with the least error
of position on them after four actions are kept.
"""

from __future__ import annotations

import os
import platform
import shlex
from collections.abc import Iterator, Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any, Literal, NamedTuple

import numpy as np
import torch
from jaxtyping import Float, Int
from torch import Tensor

from osfcore.dynamics.train import (
    MEASURED_WINDOW,
    MOVED_M,
    MOVED_RAD,
    UNROLLED,
    PushTraining,
    command_of,
    fingerprint_of,
    prepare,
    share_of_rate,
    split_episodes,
    window_starts,
)
from osfcore.fields.train_osf import descend
from osfcore.io.push_file import PushEpisode
from osfcore.paper.dynamics import GraphNetwork, Scenes, network_bytes, squared_error, unroll
from osfcore.progress import Progress

# Recorded pushes as tensors, action by action: what the paper's model learns from and is measured on.


@dataclass(frozen=True, eq=False, slots=True)
class Recording:
    """E episodes of T actions and N objects.

    Attributes:
        number: of each object, as the network numbers them.
        kappa: of each object [m].
        position: of the objects, before the first and after each action [m].
        quaternion: likewise.
        pusher: its centre, likewise [m].
        action: velocity of the pusher [m/s].
        starts: episode and action at which windows of `length` actions may start.
        length: of the windows [actions].
    """

    number: Int[Tensor, "E N"]
    kappa: Float[Tensor, "E N"]
    position: Float[Tensor, "E T1 N 3"]
    quaternion: Float[Tensor, "E T1 N 4"]
    pusher: Float[Tensor, "E T1 3"]
    action: Float[Tensor, "E T 3"]
    starts: Int[np.ndarray, "W 2"]
    length: int


class Windows(NamedTuple):
    """B pieces of a recording.

    Attributes:
        number: of each object, as the network numbers them.
        kappa: of each object [m].
        start: the scenes before the first action.
        action: velocities of the pusher [m/s].
        pusher: its centre before the first and after each action [m].
        position: of the objects after each action [m].
        quaternion: likewise.
    """

    number: Int[Tensor, "B N"]
    kappa: Float[Tensor, "B N"]
    start: Scenes
    action: Float[Tensor, "B T 3"]
    pusher: Float[Tensor, "B T1 3"]
    position: Float[Tensor, "B T N 3"]
    quaternion: Float[Tensor, "B T N 4"]


def record(
    episodes: Sequence[PushEpisode], network: GraphNetwork, kappas: Mapping[str, float], length: int
) -> Recording:
    """Return episodes as tensors, with the windows in which nothing falls off the table.

    Args:
        episodes: recorded pushes.
        network: that numbers their objects.
        kappas: longest axes of all of them, by name [m].
        length: of the windows [actions].

    Raises:
        InvalidInput: if the episodes differ in length or number of objects, or hold no such window.
    """

    def stacked(name: str) -> Tensor:
        return torch.as_tensor(np.stack([getattr(e, name) for e in episodes]), dtype=torch.float32)

    return Recording(
        number=torch.tensor([[network.number(name) for name in e.names] for e in episodes]),
        kappa=torch.tensor([[kappas[name] for name in e.names] for e in episodes]),
        position=stacked("positions"),
        quaternion=stacked("quaternions"),
        pusher=stacked("pusher"),
        action=stacked("actions"),
        starts=window_starts(episodes, length),
        length=length,
    )


def windows(recording: Recording, chosen: Int[np.ndarray, "B"], device: torch.device | str = "cpu") -> Windows:
    """Return some windows of a recording.

    Args:
        recording: that holds them.
        chosen: numbers in `recording.starts`.
        device: of the tensors.
    """
    episode, first = (torch.as_tensor(column) for column in recording.starts[chosen].T)
    rows, times = episode[:, None], first[:, None] + torch.arange(recording.length + 1)
    places = (recording.position, recording.quaternion, recording.pusher)
    position, quaternion, pusher = (part[rows, times].to(device) for part in places)
    number, kappa = recording.number[episode].to(device), recording.kappa[episode].to(device)
    start = Scenes(position[:, 0], quaternion[:, 0], pusher[:, 0])
    action = recording.action[rows, times[:, :-1]].to(device)
    return Windows(number, kappa, start, action, pusher, position[:, 1:], quaternion[:, 1:])


# Errors of the paper's network on held-out windows, as ours are measured, beside those of predicting no motion.


_TOGETHER = 512  # windows


@dataclass(frozen=True, slots=True)
class Validation:
    """Errors after four actions of objects that truly moved; of all objects where none did.

    Attributes:
        windows: how many objects in windows truly moved.
        mm_4: median error of position [mm].
        deg_4: median error of orientation [deg].
        mean_mm_4: mean error of position [mm]; training keeps the weights with the least.
        constant_mm_4: median error of position when nothing is predicted to move [mm].
        constant_deg_4: median error of orientation, likewise [deg].
    """

    windows: int
    mm_4: float
    deg_4: float
    mean_mm_4: float
    constant_mm_4: float
    constant_deg_4: float


@torch.inference_mode()
def validate(network: GraphNetwork, recording: Recording, device: torch.device | str = "cpu") -> Validation:
    """Return the errors on all held-out windows.

    Args:
        network: to measure, on `device`.
        recording: of episodes that nothing was learned from, with windows of four actions.
        device: that computes.
    """
    count = len(recording.starts)
    chunks = np.array_split(np.arange(count), range(_TOGETHER, count, _TOGETHER))
    parts = [_errors(network, windows(recording, rows, device)) for rows in chunks]
    shift, turn, way, turned = torch.cat(parts, dim=1)
    moved = (way > MOVED_M) | (turned > MOVED_RAD)
    chosen = moved if bool(moved.any()) else torch.ones_like(moved)
    shift, turn, way, turned = (part[chosen] for part in (1e3 * shift, turn.rad2deg(), 1e3 * way, turned.rad2deg()))
    medians = [float(part.median()) for part in (shift, turn, way, turned)]
    return Validation(int(moved.sum()), medians[0], medians[1], float(shift.mean()), medians[2], medians[3])


def _errors(network: GraphNetwork, pieces: Windows) -> Float[Tensor, "four B N"]:
    """Return how far and by what angle predictions end from the truth, then beginnings likewise [m, rad]."""
    *_, end = unroll(network, pieces.number, pieces.kappa, pieces.start, pieces.action, pieces.pusher)
    errors = []
    for scenes in (end, pieces.start):
        cosine = (scenes.quaternion * pieces.quaternion[:, -1]).sum(dim=-1).abs().double().clamp(max=1)
        errors += [(scenes.position - pieces.position[:, -1]).norm(dim=-1), 2 * torch.acos(cosine).float()]
    return torch.stack(errors)


# The training run.


_MEASURE_EVERY = 500  # iterations


@dataclass(frozen=True, slots=True)
class TrainPaperDynamics:
    """A training run.

    Attributes:
        data: push files; one in twelve episodes is held out.
        out: file to write, FILE.safetensors; metrics go beside it to FILE.json.
        iterations: steps of descent, at most.
        batch: windows of three actions in each.
        hidden: width of the network.
        propagations: L, steps of propagation.
        rate: of learning, at its highest.
        weight_decay: of AdamW.
        patience: measurements on held-out episodes without a better one after which training stops.
        device: "auto", "cpu" or "cuda".
        seed: of everything random.
    """

    data: tuple[Path, ...]
    out: Path
    iterations: int = 2_000
    batch: int = 256
    hidden: int = 128
    propagations: int = 3
    rate: float = 1e-3
    weight_decay: float = 0.5
    patience: int = 12
    device: Literal["auto", "cpu", "cuda"] = "auto"
    seed: int = 0

    @property
    def command(self) -> str:
        """How to do it again."""
        choices = ("hidden", "propagations", "rate", "weight_decay", "patience", "seed")
        return shlex.join(command_of(self, ("iterations", "batch", *choices), "--method", "paper"))


def train_paper_dynamics(config: TrainPaperDynamics, kappas: Mapping[str, float]) -> Iterator[Progress]:
    """Train a network and write it; a killed run goes on from its last checkpoint.

    Args:
        config: what to train on.
        kappas: longest axes of all objects with a field, by name [m]; episodes with other objects are left out.

    Raises:
        InvalidInput: if a number is out of range, the device is not there, or nothing is left to learn from.
        CorruptFile: if a push file cannot be read, or the checkpoint of a killed run cannot be gone on from.
        CannotWrite: if the output cannot be written, which is tried first.
    """
    device = prepare(
        config, ("steps of propagation", config.propagations, 1, 100), ("weight decay", config.weight_decay, 0, 1000)
    )
    yield Progress(0, config.iterations, "Reading the pushes")
    yield from _Run(config, kappas, device).run()


class _Run(PushTraining):
    measurement, score = Validation, "mean_mm_4"

    def __init__(self, config: TrainPaperDynamics, kappas: Mapping[str, float], device: torch.device) -> None:
        self._config, self._device = config, device
        # unlike in the training of our network, pairs of objects are not held out
        learned, kept = split_episodes(config.data, kappas, lambda _: True, "collect more")
        self._episodes = len(learned)
        names = sorted({name for episode in learned for name in episode.names})
        torch.manual_seed(config.seed)
        self._network = GraphNetwork(names, config.hidden, config.propagations).to(device)
        self._optimiser = torch.optim.AdamW(
            self._network.parameters(), lr=config.rate, weight_decay=config.weight_decay
        )
        self._recording = record(learned, self._network, kappas, UNROLLED)
        self._validation = record(kept, self._network, kappas, MEASURED_WINDOW)
        super().__init__(
            self._network, {"network": self._network, "optimiser": self._optimiser},
            repr(("paper", fingerprint_of(config), self._episodes, len(self._recording.starts))), out=config.out,
            total=config.iterations, patience=config.patience, seed=config.seed,
        )  # fmt: skip

    def is_due(self) -> bool:
        return self.done % _MEASURE_EVERY == 0 or self.done == self.total

    def iterate(self) -> str:
        chosen = self.rng.integers(len(self._recording.starts), size=self._config.batch)
        pieces = windows(self._recording, chosen, self._device)
        scenes = unroll(self._network, pieces.number, pieces.kappa, pieces.start, pieces.action, pieces.pusher)
        # The mean over three actions of the error that is summed across objects.
        losses = [squared_error(s, pieces.position[:, t], pieces.quaternion[:, t]) for t, s in enumerate(scenes)]
        rate = self._config.rate * share_of_rate(self.done, self.total)
        loss = descend(self._optimiser, torch.stack(losses).mean(), rate)
        self.done += 1
        return f"loss {loss:.4f}; {self.note}"

    def measured(self) -> tuple[Validation, GraphNetwork]:
        return validate(self._network, self._validation, self._device), self._network

    def described(self) -> tuple[bytes, dict[str, Any]]:
        config, data = self._config, network_bytes(self._network)
        return data, {
            "iterations": self.done, "seed": config.seed, "device": str(self._device),
            "machine": f"{platform.system()} {platform.machine()}, {os.cpu_count()} cores",
            "threads": torch.get_num_threads(), "bytes": len(data),
            "episodes": self._episodes, "windows": len(self._recording.starts),
            "data": [path.name for path in config.data], "command": config.command,
        }  # fmt: skip
