"""Training the propagation network on recorded pushes.

Deviations from the paper (section 4.3), measured in docs/dynamics.md: an action is predicted in four substeps; the loss
is a distance rather than its square, of the centre of mass and the orientation together, so that a few objects that
topple do not outweigh all that slide; half of all is reflected. As in the paper, the loss runs over three
actions, with gradients through all of them, but only at the end: most of the training is on single substeps from true
states, which cost a fraction.
"""

from __future__ import annotations

import math
import shlex
from collections.abc import Iterator, Mapping, Sequence
from dataclasses import asdict, dataclass
from pathlib import Path
from typing import Any, Literal

import numpy as np
import torch
from torch import Tensor

from osfcore.dynamics.features import SHIFT_M, TURN_RAD
from osfcore.dynamics.motion import Motion
from osfcore.dynamics.network_weights import network_bytes
from osfcore.dynamics.propagation_network import PropagationNetwork
from osfcore.dynamics.shapes.object_shapes import ObjectShape, ShapeTable
from osfcore.dynamics.substep import unroll
from osfcore.dynamics.training.holdout import has_held_out_pair, is_for_validation
from osfcore.dynamics.training.optimizers import Optimizers
from osfcore.dynamics.training.samples import disturbed_substeps, samples
from osfcore.dynamics.training.validation import _ARM_M, MEASURED_WINDOW, Validation, distance, validate
from osfcore.dynamics.training.windows import Batch, Recording, batch, record
from osfcore.errors import InvalidInput, check_ranges, check_seed
from osfcore.fields.devices import pick_device
from osfcore.io.files import write_atomically, write_json
from osfcore.io.output_paths import check_weights_place
from osfcore.io.push_file import PushEpisode, read_sound_pushes
from osfcore.io.training_checkpoint import resume_from, write_checkpoint
from osfcore.progress import Progress

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
        self._long = _recorded(learned, shapes, LONG_WINDOW)
        drawn = samples(_recorded(learned, shapes, 1), self._table, device, disturbed_substeps(learned, shapes))
        self._samples = drawn.to(device)
        self._validation = _recorded(kept, shapes, MEASURED_WINDOW)
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


def _recorded(episodes: Sequence[PushEpisode], shapes: Mapping[str, ObjectShape], length: int) -> Recording:
    recording = record(episodes, shapes, length)
    if not len(recording.starts):
        what = f"windows of {length} actions in which all objects stay on the table"
        raise InvalidInput(what, 0, "at least 1: collect more pushes")
    return recording


def _draw(recording: Recording, rng: np.random.Generator, count: int) -> np.ndarray:
    """Windows, most of them with something happening."""
    quiet = rng.integers(len(recording.starts), size=count - round(count * _BUSY_SHARE))
    return np.concatenate([rng.choice(recording.telling, count - len(quiet)), quiet])
