"""Training the paper's model (its section 4.3): mean squared error of poses, unrolled over three actions.

Windows of a push file are drawn evenly; nothing is reflected, weighted, disturbed or smoothed. The paper names neither
optimiser nor schedule: here they are AdamW, a short warm-up and a rate that falls along a cosine. A thousand episodes
are soon learned by heart: without the decay of weights, 3,000 steps of a longer run leave an error of 8 mm on episodes
that were learned from and of 22 mm on others. One in twelve episodes is held out, and the weights with the least error
of position on them after four actions are kept.
"""

from __future__ import annotations

import math
import os
import platform
import shlex
from collections.abc import Iterator, Mapping, Sequence
from dataclasses import asdict, dataclass
from pathlib import Path
from typing import Any, Literal, NamedTuple

import numpy as np
import torch
from jaxtyping import Float, Int
from torch import Tensor

from osfcore.dynamics.motion import is_on_table
from osfcore.dynamics.train import is_for_validation
from osfcore.errors import InvalidInput, check_ranges, check_seed
from osfcore.fields.devices import pick_device
from osfcore.io.checkpoint import resume_from, write_checkpoint
from osfcore.io.files import write_atomically, write_json
from osfcore.io.output_paths import check_weights_place
from osfcore.io.push_file import PushEpisode, read_sound_pushes
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
    """Episodes as tensors, with the windows in which nothing falls off the table.

    Args:
        episodes: recorded pushes.
        network: that numbers their objects.
        kappas: longest axes of all of them, by name [m].
        length: of the windows [actions].

    Raises:
        InvalidInput: if the episodes differ in length or number of objects, or hold no such window.
    """
    sizes = {(len(e.actions), len(e.names)) for e in episodes}
    if len(sizes) != 1 or min(sizes)[0] < length:
        raise InvalidInput("steps and objects of the episodes", sorted(sizes), f"equal, with at least {length} steps")
    starts = np.array([place for n, e in enumerate(episodes) for place in _starts(n, e, length)], int).reshape(-1, 2)
    if not len(starts):
        what = f"windows of {length} actions in which all objects stay on the table"
        raise InvalidInput(what, 0, "at least 1: collect more pushes")

    def stacked(name: str) -> Tensor:
        return torch.as_tensor(np.stack([getattr(e, name) for e in episodes]), dtype=torch.float32)

    return Recording(
        number=torch.tensor([[network.number(name) for name in e.names] for e in episodes]),
        kappa=torch.tensor([[kappas[name] for name in e.names] for e in episodes]),
        position=stacked("positions"),
        quaternion=stacked("quaternions"),
        pusher=stacked("pusher"),
        action=stacked("actions"),
        starts=starts,
        length=length,
    )


def _starts(number: int, episode: PushEpisode, length: int) -> list[tuple[int, int]]:
    safe = is_on_table(episode)
    return [(number, at) for at in range(len(safe) - length) if safe[at : at + length + 1].all()]


def windows(recording: Recording, chosen: Int[np.ndarray, "B"], device: torch.device | str = "cpu") -> Windows:
    """Some windows of a recording.

    Args:
        recording: that holds them.
        chosen: numbers in `recording.starts`.
        device: of the tensors.
    """
    episode, first = (torch.as_tensor(column) for column in recording.starts[chosen].T)
    rows, times = episode[:, None], first[:, None] + torch.arange(recording.length + 1)
    position, quaternion = recording.position[rows, times].to(device), recording.quaternion[rows, times].to(device)
    pusher = recording.pusher[rows, times].to(device)
    start = Scenes(position[:, 0], quaternion[:, 0], pusher[:, 0])
    number, kappa = recording.number[episode].to(device), recording.kappa[episode].to(device)
    action = recording.action[rows, times[:, :-1]].to(device)
    return Windows(number, kappa, start, action, pusher, position[:, 1:], quaternion[:, 1:])


# Errors of the paper's network on held-out windows, as ours are measured, beside those of predicting no motion.


MEASURED_WINDOW = 4  # actions
_MOVED_M, _MOVED_RAD = 0.01, math.radians(5)  # what counts as truly moved within a window
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
    """Roll out all held-out windows.

    Args:
        network: to measure, on `device`.
        recording: of episodes that nothing was learned from, with windows of four actions.
        device: that computes.
    """
    count = len(recording.starts)
    parts = [_errors(network, windows(recording, rows, device)) for rows in _chunks(count)]
    shift, turn, way, turned = torch.cat(parts, dim=1)
    moved = (way > _MOVED_M) | (turned > _MOVED_RAD)
    chosen = moved if bool(moved.any()) else torch.ones_like(moved)
    shift, turn, way, turned = (part[chosen] for part in (1e3 * shift, turn.rad2deg(), 1e3 * way, turned.rad2deg()))
    medians = [float(part.median()) for part in (shift, turn, way, turned)]
    return Validation(int(moved.sum()), medians[0], medians[1], float(shift.mean()), medians[2], medians[3])


def _chunks(count: int) -> list[np.ndarray]:
    return np.array_split(np.arange(count), range(_TOGETHER, count, _TOGETHER))


def _errors(network: GraphNetwork, pieces: Windows) -> Float[Tensor, "four B N"]:
    """How far and by what angle predictions end from the truth, and beginnings [m, rad]."""
    *_, end = unroll(network, pieces.number, pieces.kappa, pieces.start, pieces.action, pieces.pusher)
    differences = [_difference(scenes, pieces) for scenes in (end, pieces.start)]
    return torch.cat(differences)


def _difference(scenes: Scenes, pieces: Windows) -> Float[Tensor, "two B N"]:
    cosine = (scenes.quaternion * pieces.quaternion[:, -1]).sum(dim=-1).abs().double().clamp(max=1)
    return torch.stack([(scenes.position - pieces.position[:, -1]).norm(dim=-1), 2 * torch.acos(cosine).float()])


UNROLLED = 3  # actions (paper: up to three future steps)
_WARM_UP = 100
_DECAY = 0.5  # of weights
_LAST_RATE = 0.01  # of the first one
_REPORT_EVERY, _MEASURE_EVERY = 20, 500
_OWN_METRICS = ("validation_mm_4", "validation_windows")


@dataclass(frozen=True, slots=True)
class TrainPaperDynamics:
    """A training run.

    Attributes:
        data: push files; one in twelve episodes is held out.
        out: file to write, FILE.safetensors; metrics go beside it to FILE.json.
        iterations: steps of descent, at most.
        batch: windows of three actions in each.
        hidden: width of the network.
        rate: of learning, at its highest.
        patience: measurements on held-out episodes without a better one after which training stops.
        device: "auto", "cpu" or "cuda".
        seed: of everything random.
    """

    data: tuple[Path, ...]
    out: Path
    iterations: int = 2_000
    batch: int = 256
    hidden: int = 128
    rate: float = 1e-3
    patience: int = 12
    device: Literal["auto", "cpu", "cuda"] = "auto"
    seed: int = 0

    @property
    def command(self) -> str:
        """How to do it again."""
        parts = ["osf", "train", "dynamics", "--method", "paper", "--data", *(path.name for path in self.data)]
        parts += ["--out", self.out.name]
        default = TrainPaperDynamics(self.data, self.out)
        for name in ("iterations", "batch", "hidden", "rate", "patience", "seed"):
            if getattr(self, name) != getattr(default, name):
                parts += [f"--{name}", str(getattr(self, name))]
        return shlex.join(parts)


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
    _check(config)
    device = pick_device(config.device)
    check_weights_place(config.out, _OWN_METRICS)
    yield Progress(0, config.iterations, "Reading the pushes")
    run = _Run(config, kappas, device)
    run.resume()
    while not run.is_over:
        note = run.iterate()
        if run.done % _MEASURE_EVERY == 0 or run.done == config.iterations:
            run.measure()
            run.save()
        if run.done % _REPORT_EVERY == 0:
            yield Progress(run.done, config.iterations, note)
    run.finish()
    yield Progress(config.iterations, config.iterations, run.note)


def _check(config: TrainPaperDynamics) -> None:
    check_seed(config.seed)
    check_ranges(
        ("number of iterations", config.iterations, 1, 10_000_000),
        ("batch", config.batch, 1, 100_000),
        ("width of the network", config.hidden, 1, 1024),
        ("patience", config.patience, 1, 1_000_000),
        ("rate of learning", config.rate, 1e-9, 1),
    )


class _Run:
    """The state of a training run."""

    def __init__(self, config: TrainPaperDynamics, kappas: Mapping[str, float], device: torch.device) -> None:
        self._config, self._device = config, device
        learned, kept = _episodes(config, frozenset(kappas))
        self._used = len(learned)
        names = sorted({name for episode in learned for name in episode.names})
        torch.manual_seed(config.seed)
        self._rng = np.random.default_rng(config.seed)
        self._network = GraphNetwork(names, config.hidden).to(device)
        self._optimiser = torch.optim.AdamW(self._network.parameters(), lr=config.rate, weight_decay=_DECAY)
        self._recording = record(learned, self._network, kappas, UNROLLED)
        self._validation = record(kept, self._network, kappas, MEASURED_WINDOW)
        self._best: dict[str, Tensor] = {}
        self.best: Validation | None = None
        self.done = self.fruitless = 0

    @property
    def is_over(self) -> bool:
        """Whether there is nothing left to do, or to hope for."""
        return self.done >= self._config.iterations or self.fruitless >= self._config.patience

    @property
    def note(self) -> str:
        """How good it is, for a person."""
        if self.best is None:
            return "not measured yet"
        return f"held out: {self.best.mm_4:.1f} mm, {self.best.deg_4:.1f} deg after 4 steps"

    def iterate(self) -> str:
        """One step of descent."""
        for group in self._optimiser.param_groups:
            group["lr"] = self._config.rate * self._share_of_rate()
        loss = self._loss()
        self._optimiser.zero_grad(set_to_none=True)
        loss.backward()
        self._optimiser.step()
        self.done += 1
        return f"loss {float(loss.detach()):.4f}; {self.note}"

    def _loss(self) -> Tensor:
        """Mean over three actions of the error that is summed across objects."""
        pieces = windows(
            self._recording, self._rng.integers(len(self._recording.starts), size=self._config.batch), self._device
        )
        scenes = unroll(self._network, pieces.number, pieces.kappa, pieces.start, pieces.action, pieces.pusher)
        losses = [squared_error(s, pieces.position[:, t], pieces.quaternion[:, t]) for t, s in enumerate(scenes)]
        return torch.stack(losses).mean()

    def _share_of_rate(self) -> float:
        falling = _LAST_RATE + (1 - _LAST_RATE) * (1 + math.cos(math.pi * self.done / self._config.iterations)) / 2
        return min(1, (self.done + 1) / _WARM_UP) * falling

    def measure(self) -> None:
        """Keep the weights if they are the best so far."""
        result = validate(self._network, self._validation, self._device)
        if self.best is None or result.mean_mm_4 < self.best.mean_mm_4:
            self.best, self.fruitless = result, 0
            self._best = {name: value.detach().cpu().clone() for name, value in self._network.state_dict().items()}
        else:
            self.fruitless += 1

    @property
    def _checkpoint(self) -> Path:
        return self._config.out.with_suffix(".checkpoint")

    def _fingerprint(self) -> str:
        settings = {**asdict(self._config), "data": [path.name for path in self._config.data], "out": "", "device": ""}
        return repr(("paper", settings, self._used, len(self._recording.starts)))

    def save(self) -> None:
        """Everything that is needed to go on."""
        content: dict[str, Any] = {
            "network": self._network.state_dict(),
            "optimiser": self._optimiser.state_dict(),
            "best": self._best,
            "validation": asdict(self.best) if self.best else None,
            "numbers": [self.done, self.fruitless],
            "rng": self._rng.bit_generator.state,
        }
        write_checkpoint(self._checkpoint, self._fingerprint(), content)

    def resume(self) -> None:
        """Go on from the checkpoint of the same run, if there is one."""
        resume_from(self._checkpoint, self._fingerprint(), self._restore)

    def _restore(self, content: dict[str, Any]) -> None:
        self._network.load_state_dict(content["network"])
        self._optimiser.load_state_dict(content["optimiser"])
        self._best = content["best"]
        self.best = Validation(**content["validation"]) if content["validation"] else None
        self.done, self.fruitless = content["numbers"]
        self._rng.bit_generator.state = content["rng"]

    def finish(self) -> None:
        """Write the best weights and what is known of them."""
        assert self.best is not None
        self._network.load_state_dict(self._best)
        data = network_bytes(self._network)
        write_atomically(self._config.out, data)
        metrics = {f"validation_{name}": round(value, 3) for name, value in asdict(self.best).items()}
        own = {
            "iterations": self.done,
            "seed": self._config.seed,
            "device": str(self._device),
            "machine": f"{platform.system()} {platform.machine()}, {os.cpu_count()} cores",
            "threads": torch.get_num_threads(),
            "bytes": len(data),
            "episodes": self._used,
            "windows": len(self._recording.starts),
            "data": [path.name for path in self._config.data],
            "command": self._config.command,
        }
        write_json(self._config.out.with_suffix(".json"), {**metrics, **own})
        self._checkpoint.unlink(missing_ok=True)


def _episodes(config: TrainPaperDynamics, known: frozenset[str]) -> tuple[list[PushEpisode], list[PushEpisode]]:
    """What is learned from, and what is kept to stop by. Unlike ours, pairs of objects are not held out."""
    parts: tuple[list[PushEpisode], list[PushEpisode]] = [], []
    unknown = set[str]()
    for path in config.data:
        for number, episode in enumerate(read_sound_pushes(path)):
            unknown |= set(episode.names) - known
            if set(episode.names) <= known:
                parts[is_for_validation(number)].append(episode)
    if not all(parts):
        what = "episodes to validate on" if parts[0] else "episodes to learn from"
        lacking = f" (objects without a field: {', '.join(sorted(unknown))})" if unknown else ""
        raise InvalidInput(what, f"0{lacking}", "at least 1: collect more")
    return parts
