"""Training the propagation network on recorded pushes.

Deviations from the paper (section 4.3), measured in docs/dynamics.md: an action is predicted in four substeps; the loss
is a distance rather than its square, of the centre of mass and the orientation together, so that a few objects that
topple do not outweigh all that slide; half of the windows are seen in a mirror. As in the paper, the loss runs over up
to three actions, with gradients through all of them; training begins with single ones, which is faster.
"""

from __future__ import annotations

import copy
import io
import math
import shlex
from collections.abc import Iterator, Mapping
from dataclasses import asdict, dataclass
from pathlib import Path
from typing import Any, Literal

import numpy as np
import torch
from torch import Tensor

from osfcore.dynamics import turns
from osfcore.dynamics.holdout import has_held_out_pair, is_for_validation
from osfcore.dynamics.motion import Motion
from osfcore.dynamics.network import PropagationNetwork
from osfcore.dynamics.shapes import ObjectShape, ShapeTable
from osfcore.dynamics.unroll import unroll
from osfcore.dynamics.weights import network_bytes
from osfcore.dynamics.windows import Batch, Recording, batch, record
from osfcore.errors import InvalidInput
from osfcore.fields.devices import pick_device
from osfcore.fields.outputs import check_weights_place
from osfcore.files import write_atomically, write_json
from osfcore.progress import Progress
from osfcore.pushfile import PushEpisode, read_pushes
from osfcore.scene import check_seed

LONG_WINDOW = 3  # actions (paper: up to three future steps)
MEASURED_WINDOW = 4
MOVED_M, MOVED_RAD = 0.01, math.radians(5)  # what counts as truly moved within a window
_ARM_M = 0.05  # a rotation by an angle counts as the angle times this
_BUSY_SHARE = 0.85  # of the windows of a batch: in the others nothing happens
_WARM_UP = 100
_LAST_RATE = 0.01  # of the first one
_AVERAGING = 0.998  # of the weights that are kept, from iteration to iteration
_CLIP = 5.0
_REPORT_EVERY, _MEASURE_EVERY = 20, 500
_MEASURED = 2000  # windows
_OWN_METRICS = ("validation_mm_4", "validation_windows")


@dataclass(frozen=True, slots=True)
class TrainDynamics:
    """A training run.

    Attributes:
        data: push files; one in twelve episodes is held out.
        out: file to write, FILE.safetensors; metrics go beside it to FILE.json.
        iterations: at most.
        short_share: share of the iterations with windows of a single action, before those of three.
        batch: windows of a single action in an iteration; a third as many where there are three.
        hidden: width of the network.
        rate: of learning, at its highest.
        patience: measurements on held-out episodes without a better one after which training stops.
        without: objects whose episodes are left out.
        device: "auto", "cpu" or "cuda".
        seed: of everything random.
    """

    data: tuple[Path, ...]
    out: Path
    iterations: int = 14_000
    short_share: float = 0.6
    batch: int = 192
    hidden: int = 128
    rate: float = 2e-3
    patience: int = 6
    without: tuple[str, ...] = ()
    device: Literal["auto", "cpu", "cuda"] = "auto"
    seed: int = 0

    @property
    def command(self) -> str:
        """How to do it again."""
        parts = ["osf", "train", "dynamics", "--data", *(path.name for path in self.data), "--out", self.out.name]
        default = TrainDynamics(self.data, self.out)
        for name in ("iterations", "short_share", "batch", "hidden", "rate", "patience", "seed"):
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
        CorruptFile: if a push file cannot be read.
        CannotWrite: if the output cannot be written, which is tried first.
    """
    _check(config)
    device = pick_device(config.device)
    check_weights_place(config.out, _OWN_METRICS)
    yield Progress(0, config.iterations, "Reading the pushes")
    run = _Run(config, shapes, device)
    run.resume()
    while run.done < config.iterations and run.fruitless < config.patience:
        note = run.iterate()
        if run.done % _MEASURE_EVERY == 0 or run.done == config.iterations:
            run.measure()
            run.save()
        if run.done % _REPORT_EVERY == 0:
            yield Progress(run.done, config.iterations, note)
    run.finish()
    yield Progress(config.iterations, config.iterations, run.note)


def _check(config: TrainDynamics) -> None:
    check_seed(config.seed)
    for what, value, low, high in (
        ("number of iterations", config.iterations, 1, 10_000_000),
        ("batch", config.batch, 3, 100_000),
        ("width of the network", config.hidden, 1, 1024),
        ("patience", config.patience, 1, 1_000_000),
        ("rate of learning", config.rate, 1e-9, 1),
        ("share of single actions", config.short_share, 0, 1),
    ):
        if not low <= value <= high:
            raise InvalidInput(what, value, f"between {low} and {high}")


@dataclass(frozen=True, slots=True)
class Validation:
    """Errors on held-out windows of four actions, of objects that truly moved.

    Attributes:
        windows: how many objects in windows truly moved.
        mm_4: median error of position after four actions [mm].
        deg_4: median error of orientation [deg].
        mean_mm_4: mean error of position [mm].
        loss: mean distance over all substeps [mm]; training keeps the weights with the least.
        constant_mm_4: median way of these objects [mm].
    """

    windows: int
    mm_4: float
    deg_4: float
    mean_mm_4: float
    loss: float
    constant_mm_4: float


class _Run:
    """The state of a training run."""

    def __init__(self, config: TrainDynamics, shapes: Mapping[str, ObjectShape], device: torch.device) -> None:
        self._config, self._device = config, device
        names = tuple(sorted(shapes))
        self._table = ShapeTable(tuple(shapes[name] for name in names), device)
        learned, kept = _episodes(config, frozenset(names))
        self._short, self._long = record(learned, shapes, 1), record(learned, shapes, LONG_WINDOW)
        self._validation = record(kept, shapes, MEASURED_WINDOW)
        self._used = len(learned)
        torch.manual_seed(config.seed)
        self._rng = np.random.default_rng(config.seed)
        self._network = PropagationNetwork(config.hidden).to(device)
        self._average = copy.deepcopy(self._network)
        self._optimiser = torch.optim.AdamW(self._network.parameters(), lr=config.rate, weight_decay=1e-4)
        self._best: dict[str, Tensor] = {}
        self.best: Validation | None = None
        self.done = self.fruitless = 0

    @property
    def note(self) -> str:
        """How good it is, for a person."""
        if self.best is None:
            return "not measured yet"
        return f"held out: {self.best.mm_4:.1f} mm, {self.best.deg_4:.1f} deg after 4 steps"

    def iterate(self) -> str:
        """One step of descent."""
        config = self._config
        is_short = self.done < config.short_share * config.iterations
        recording = self._short if is_short else self._long
        windows = _draw(recording, self._rng, config.batch if is_short else config.batch // LONG_WINDOW)
        pieces = batch(recording, self._table, windows, self._device)
        mirror = torch.as_tensor(self._rng.random(len(windows)) < 0.5, device=self._device)
        loss = torch.zeros((), device=self._device)
        for step, motion in enumerate(self._unroll(pieces, mirror)):
            loss = loss + distance(motion, pieces, step).sum()
        loss = loss * (1e3 / len(windows) / len(pieces.targets.centre))
        self._set_rate()
        self._optimiser.zero_grad(set_to_none=True)
        loss.backward()
        torch.nn.utils.clip_grad_norm_(self._network.parameters(), _CLIP)
        self._optimiser.step()
        share = min(_AVERAGING, self.done / (self.done + 10))
        with torch.no_grad():
            for kept, new in zip(self._average.parameters(), self._network.parameters(), strict=True):
                kept.lerp_(new, 1 - share)
        self.done += 1
        return f"loss {float(loss.detach()):.2f} mm a window; {self.note}"

    def _unroll(self, pieces: Batch, mirror: Tensor) -> Iterator[Motion]:
        return unroll(self._network, self._table, pieces.number, pieces.motion, pieces.velocity, mirror)

    def _set_rate(self) -> None:
        share = self.done / self._config.iterations
        falling = _LAST_RATE + (1 - _LAST_RATE) * (1 + math.cos(math.pi * share)) / 2
        rate = self._config.rate * min(1, (self.done + 1) / _WARM_UP) * falling
        for group in self._optimiser.param_groups:
            group["lr"] = rate

    def measure(self) -> None:
        """Keep the averaged weights if they are the best so far."""
        found = validate(self._average, self._table, self._validation, self._device)
        if self.best is None or found.loss < self.best.loss:
            self.best, self.fruitless = found, 0
            self._best = {name: value.detach().cpu().clone() for name, value in self._average.state_dict().items()}
        else:
            self.fruitless += 1

    @property
    def _checkpoint(self) -> Path:
        return self._config.out.with_suffix(".checkpoint")

    def _fingerprint(self) -> str:
        settings = {**asdict(self._config), "data": [path.name for path in self._config.data], "out": "", "device": ""}
        return repr((settings, self._used, len(self._short.starts)))

    def save(self) -> None:
        """Everything that is needed to go on."""
        content: dict[str, Any] = {
            "fingerprint": self._fingerprint(),
            "network": self._network.state_dict(),
            "average": self._average.state_dict(),
            "optimiser": self._optimiser.state_dict(),
            "best": self._best,
            "validation": asdict(self.best) if self.best else None,
            "numbers": [self.done, self.fruitless],
            "rng": self._rng.bit_generator.state,
        }
        buffer = io.BytesIO()
        torch.save(content, buffer)
        write_atomically(self._checkpoint, buffer.getvalue())

    def resume(self) -> None:
        """Go on from the checkpoint of the same run, if there is one."""
        try:
            content = torch.load(self._checkpoint, weights_only=True, map_location=self._device)
            if content["fingerprint"] != self._fingerprint():
                return
            self._network.load_state_dict(content["network"])
            self._average.load_state_dict(content["average"])
            self._optimiser.load_state_dict(content["optimiser"])
            self._best = content["best"]
            self.best = Validation(**content["validation"]) if content["validation"] else None
            self.done, self.fruitless = content["numbers"]
            self._rng.bit_generator.state = content["rng"]
        except Exception:  # missing, cut short or of another version: start over
            return

    def finish(self) -> None:
        """Write the best weights and what is known of them."""
        assert self.best is not None
        self._network.load_state_dict(self._best)
        data = network_bytes(self._network)
        write_atomically(self._config.out, data)
        metrics = {f"validation_{name}": round(value, 3) for name, value in asdict(self.best).items()}
        own = {"iterations": self.done, "seed": self._config.seed, "device": str(self._device), "bytes": len(data),
               "episodes": self._used, "without": list(self._config.without), "threads": torch.get_num_threads(),
               "data": [path.name for path in self._config.data], "command": self._config.command}  # fmt: skip
        write_json(self._config.out.with_suffix(".json"), {**metrics, **own})
        self._checkpoint.unlink(missing_ok=True)


def _episodes(config: TrainDynamics, known: frozenset[str]) -> tuple[list[PushEpisode], list[PushEpisode]]:
    """What is learned from, and what is kept to stop by; nothing that is held out is in either."""
    parts: tuple[list[PushEpisode], list[PushEpisode]] = [], []
    unknown = set[str]()
    for path in config.data:
        for number, episode in enumerate(read_pushes(path)):
            unknown |= set(episode.names) - known
            left_out = set(episode.names) & set(config.without)
            if set(episode.names) <= known and not left_out and not has_held_out_pair(episode.names):
                parts[is_for_validation(number)].append(episode)
    if not all(parts):
        what = "episodes to learn from" if not parts[0] else "episodes to validate on"
        lacking = f" (objects without a field: {', '.join(sorted(unknown))})" if unknown else ""
        raise InvalidInput(what, f"0{lacking}", "at least 1: collect more, or leave out fewer objects")
    return parts


def _draw(recording: Recording, rng: np.random.Generator, count: int) -> np.ndarray:
    """Windows, most of them with something happening."""
    busy = np.flatnonzero(recording.is_busy)
    quiet = rng.integers(len(recording.starts), size=count - round(count * _BUSY_SHARE))
    chosen = busy if len(busy) else np.arange(len(recording.starts))
    return np.concatenate([rng.choice(chosen, count - len(quiet)), quiet])


def distance(motion: Motion, pieces: Batch, step: int) -> Tensor:
    """How far every object is from the truth after a substep (B, N) [m], its orientation included."""
    shift = motion.centre - pieces.targets.centre[step]
    turn = 2 * _sine(motion.quaternion, pieces.targets.quaternion[step])
    return (shift.square().sum(dim=-1) + (_ARM_M * turn).square() + 1e-8).sqrt()


def _sine(a: Tensor, b: Tensor) -> Tensor:
    """Sine of half the angle between orientations."""
    between = turns.multiply(b * b.new_tensor([1.0, -1.0, -1.0, -1.0]), a)
    return (between[..., 1:].square().sum(dim=-1) + 1e-12).sqrt()


@torch.inference_mode()
def validate(
    network: PropagationNetwork, table: ShapeTable, recording: Recording, device: torch.device | str = "cpu"
) -> Validation:
    """Errors on windows of four actions in which something happens."""
    busy = np.flatnonzero(recording.is_busy)
    chosen = np.random.default_rng(0).permutation(busy)[:_MEASURED]
    pieces = batch(recording, table, chosen, device)
    loss, motion = 0.0, pieces.motion
    for step, motion in enumerate(unroll(network, table, pieces.number, pieces.motion, pieces.velocity)):
        loss += float(distance(motion, pieces, step).sum()) * 1e3 / len(chosen) / len(pieces.targets.centre)
    way = (pieces.motion.centre - pieces.targets.centre[-1]).norm(dim=-1)
    turned = 2 * torch.asin(_sine(pieces.motion.quaternion, pieces.targets.quaternion[-1]).clamp(max=1))
    moved = (way > MOVED_M) | (turned > MOVED_RAD)
    error = 1e3 * (motion.centre - pieces.targets.centre[-1]).norm(dim=-1)[moved]
    angle = torch.rad2deg(2 * torch.asin(_sine(motion.quaternion, pieces.targets.quaternion[-1]).clamp(max=1)))[moved]
    if not len(error):
        return Validation(0, 0.0, 0.0, 0.0, loss, 0.0)
    medians = [float(values.median()) for values in (error, angle, 1e3 * way[moved])]
    return Validation(len(error), medians[0], medians[1], float(error.mean()), loss, medians[2])
