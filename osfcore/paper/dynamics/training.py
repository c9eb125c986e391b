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
from collections.abc import Iterator, Mapping
from dataclasses import asdict, dataclass
from pathlib import Path
from typing import Any, Literal

import numpy as np
import torch
from torch import Tensor

from osfcore.dynamics.training.holdout import is_for_validation
from osfcore.errors import InvalidInput, check_ranges, check_seed
from osfcore.fields.devices import pick_device
from osfcore.io.files import write_atomically, write_json
from osfcore.io.output_paths import check_weights_place
from osfcore.io.push_file import PushEpisode, read_sound_pushes
from osfcore.io.training_checkpoint import resume_from, write_checkpoint
from osfcore.paper.dynamics.graph_network import GraphNetwork
from osfcore.paper.dynamics.prediction import squared_error, unroll
from osfcore.paper.dynamics.recordings import record, windows
from osfcore.paper.dynamics.validation import MEASURED_WINDOW, Validation, validate
from osfcore.paper.dynamics.weights import network_bytes
from osfcore.progress import Progress

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
