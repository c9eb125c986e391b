"""Training FitVid on recorded frames and actions.

As in the published program: windows of two context frames and ten more, beta 1e-4, Adam at a rate of 1e-3, gradients
clipped at a norm of 100. Deviations: batches are of 8 instead of 128 windows, and the rate falls over the last fifth of
the budget, for there are minutes where the original has ten million steps. The package's network learned at a rate of
5e-3 in batches of 4 without augmentation, from pushes that seek contact, of which videos show four times as much motion
as of the paper's random ones; as for our dynamics, episodes with a held-out pair of objects are left out.
"""

from __future__ import annotations

import shlex
import time
from collections.abc import Iterator
from dataclasses import asdict, dataclass, fields
from pathlib import Path
from typing import Any, Literal

import torch

from osfcore.errors import InvalidInput, check_ranges, check_seed
from osfcore.experiments.rivals.fitvid.augmentation import augmented
from osfcore.experiments.rivals.fitvid.frame_windows import VideoFiles
from osfcore.experiments.rivals.fitvid.measurement import as_frames, measure
from osfcore.experiments.rivals.fitvid.model import CONTEXT, FitVidModel, FitVidSettings
from osfcore.experiments.rivals.fitvid.weights import fitvid_bytes
from osfcore.fields.devices import pick_device
from osfcore.io.files import write_atomically, write_json
from osfcore.io.output_paths import check_weights_place
from osfcore.io.training_checkpoint import resume_from, write_checkpoint
from osfcore.progress import Progress
from osfcore.random_streams import Stream, stream_rng, stream_seed

_CLIP = 100.0
_FALLING = 0.2  # of the budget
_RECENT = 0.9  # of what is told as recent, kept from step to step
_OWN_METRICS = ("parameters", "horizons")
Precision = Literal["bfloat16", "float32"]


@dataclass(frozen=True, slots=True)
class TrainFitVid:
    """A training run.

    Attributes:
        data: push files with frames; one in twelve episodes is held out.
        out: file to write, FILE.safetensors; metrics go beside it to FILE.json.
        minutes: how long to train [min], without reading at the beginning and measuring at the end.
        iterations: instead of a time budget: that many steps of descent, repeatable on one machine.
        width: channels at full size.
        batch: windows in each step.
        frames: of a window, context included.
        rate: of learning.
        beta: weight of the KL divergence.
        augment: whether videos are varied.
        precision: what convolutions compute in while training.
        save_every: steps between checkpoints.
        measured: held-out videos to measure on in the end, at most.
        device: "auto", "cpu" or "cuda".
        seed: of everything random.
    """

    data: tuple[Path, ...]
    out: Path
    minutes: float = 60.0
    iterations: int | None = None
    width: int = 4
    batch: int = 8
    frames: int = 12
    rate: float = 1e-3
    beta: float = 1e-4
    augment: bool = True
    precision: Precision = "bfloat16"
    save_every: int = 20
    measured: int = 32
    device: Literal["auto", "cpu", "cuda"] = "auto"
    seed: int = 0

    @property
    def command(self) -> str:
        """How to do it again."""
        parts = ["osf", "train", "fitvid", "--data", *(path.name for path in self.data), "--out", self.out.name]
        for field in fields(self):
            value = getattr(self, field.name)
            if field.name in ("data", "out", "device") or value == field.default:
                continue
            name = field.name.replace("_", "-")
            parts += [f"--no-{name}"] if value is False else [f"--{name}", str(value)]
        return shlex.join(parts)


def train_fitvid(config: TrainFitVid) -> Iterator[Progress]:
    """Train a network and write it; a killed run goes on from its last checkpoint.

    Yields:
        Seconds of the budget (or steps).

    Raises:
        InvalidInput: if a number is out of range, the device is not there, or nothing is left to learn from.
        CorruptFile: if a push file cannot be read or has no frames, or the checkpoint of a killed run cannot be gone on
            from.
        CannotWrite: if the output cannot be written, which is tried first.
    """
    _check(config)
    device = pick_device(config.device)
    check_weights_place(config.out, _OWN_METRICS)
    with VideoFiles(config.data) as videos:
        run = _Run(config, videos, device)
        run.resume()
        yield run.progress("Reading the frames")
        while run.share < 1:
            note = run.iterate()
            if run.steps % config.save_every == 0:
                run.save()
            yield run.progress(note)
        run.save()  # a kill while it measures repeats no step
        yield from run.finish()


def _check(config: TrainFitVid) -> None:
    check_seed(config.seed)
    if config.precision not in ("bfloat16", "float32"):
        raise InvalidInput("precision", repr(config.precision), '"bfloat16" or "float32"')
    check_ranges(
        ("minutes", config.minutes, 0.01, 7 * 24 * 60),
        ("iterations", 1 if config.iterations is None else config.iterations, 1, 10_000_000),
        ("width of the network", config.width, 1, 256),
        ("batch", config.batch, 1, 10_000),
        ("frames of a window", config.frames, CONTEXT + 1, 1000),
        ("rate of learning", config.rate, 1e-9, 1),
        ("beta", config.beta, 0, 1e6),
        ("steps between checkpoints", config.save_every, 1, 1_000_000),
        ("held-out videos", config.measured, 1, 1_000_000),
    )


class _Run:
    """The state of a training run."""

    def __init__(self, config: TrainFitVid, videos: VideoFiles, device: torch.device) -> None:
        self._config, self._videos, self._device = config, videos, device
        generator = torch.random.get_rng_state()
        torch.manual_seed(stream_seed(config.seed, Stream.VIDEO_WEIGHTS))
        self._model = FitVidModel(FitVidSettings(videos.side, config.width), getattr(torch, config.precision))
        torch.random.set_rng_state(generator)
        self._model.to(device)
        self._adam = torch.optim.Adam(self._model.parameters(), config.rate)
        self.steps, self._spent_s = 0, 0.0
        self._recent: dict[str, float] = {}

    @property
    def share(self) -> float:
        """Of the budget that is spent."""
        if self._config.iterations is not None:
            return self.steps / self._config.iterations
        return self._spent_s / (60 * self._config.minutes)

    def progress(self, note: str) -> Progress:
        """In seconds, or in steps."""
        config = self._config
        total = config.iterations or max(1, round(60 * config.minutes))
        return Progress(min(round(self.share * total), total), total, note)

    def iterate(self) -> str:
        """One step of descent. What is random in it depends on its number alone, not on the steps before it."""
        began, config = time.monotonic(), self._config
        rng = stream_rng(config.seed, Stream.VIDEO_WINDOWS, self.steps)
        window = self._videos.drawn(rng, config.batch, config.frames - 1)
        frames = as_frames(window.frames, self._device)
        if config.augment:
            frames = augmented(frames, rng)
        latents = torch.Generator(self._device).manual_seed(int(rng.integers(2**62)))
        actions = torch.as_tensor(window.actions, device=self._device)
        losses = self._model.losses(frames, actions, latents)
        self._descend(losses.squared_error + config.beta * losses.kl)
        still = (frames[:, CONTEXT:] - frames[:, CONTEXT - 1 : CONTEXT]).square().mean()
        told = {
            "error": float(losses.squared_error.detach()) / (config.frames - 1),
            "kl": float(losses.kl.detach()) / (config.frames - 1),
            "still": float(still),
        }
        for name, value in told.items():
            self._recent[name] = value + _RECENT * (self._recent.get(name, value) - value)
        self.steps += 1
        self._spent_s += time.monotonic() - began
        error, still, kl = (self._recent[name] for name in ("error", "still", "kl"))
        return f"step {self.steps}: MSE {error:.5f}, of a copied frame {still:.5f}; KL {kl:.2f}"

    def _descend(self, loss: torch.Tensor) -> None:
        self._adam.zero_grad(set_to_none=True)
        loss.backward()
        norm = torch.nn.utils.clip_grad_norm_(self._model.parameters(), _CLIP)
        for group in self._adam.param_groups:
            group["lr"] = self._config.rate * min(1.0, max((1 - self.share) / _FALLING, 1e-3))
        if torch.isfinite(norm):  # else this step would spoil all that follow
            self._adam.step()

    @property
    def _checkpoint(self) -> Path:
        return self._config.out.with_suffix(".checkpoint")

    def _fingerprint(self) -> str:
        free = {"out": "", "device": "", "save_every": 0, "measured": 0, "minutes": 0.0, "iterations": 0}
        settings = {**asdict(self._config), **free, "data": [path.name for path in self._config.data]}
        return repr((settings, self._videos.side, len(self._videos.learned)))

    def save(self) -> None:
        """Everything that is needed to go on, also with a larger budget."""
        content: dict[str, Any] = {
            "model": self._model.state_dict(),
            "adam": self._adam.state_dict(),
            "steps": self.steps,
            "spent_s": self._spent_s,
            "recent": self._recent,
        }
        write_checkpoint(self._checkpoint, self._fingerprint(), content)

    def resume(self) -> None:
        """Go on from the checkpoint of the same run, if there is one."""
        resume_from(self._checkpoint, self._fingerprint(), self._restore)

    def _restore(self, content: dict[str, Any]) -> None:
        self._model.load_state_dict(content["model"])
        self._adam.load_state_dict(content["adam"])
        self.steps, self._spent_s, self._recent = content["steps"], content["spent_s"], content["recent"]

    def finish(self) -> Iterator[Progress]:
        """Measure on held-out videos, and write weights and metrics."""
        model, videos = self._model.eval(), self._videos.held_out[: self._config.measured]
        errors = None
        for errors in measure(model, videos):
            yield self.progress(f"Measuring on held-out videos ({len(errors.predicted)} of {len(videos)})")
        assert errors is not None
        report, data = errors.report(), fitvid_bytes(model)
        write_atomically(self._config.out, data)
        own = {
            "command": self._config.command,
            "seed": self._config.seed,
            "data": [path.name for path in self._config.data],
            "parameters": model.parameter_count,
            "bytes": len(data),
            "minutes": round(self._spent_s / 60, 2),
            "iterations": self.steps,
            "episodes": len(self._videos.learned),
            "device": str(self._device),
            "threads": torch.get_num_threads(),
            "training_mse": round(self._recent.get("error", 0.0), 7),
            "training_mse_copied": round(self._recent.get("still", 0.0), 7),
            "training_kl": round(self._recent.get("kl", 0.0), 4),
        }
        write_json(self._config.out.with_suffix(".json"), {**own, **report})
        self._checkpoint.unlink(missing_ok=True)
        horizon, means = list(report["horizons"].items())[-1]
        told = f"{means['psnr']:.1f} dB over {horizon} steps (copied: {means['psnr_copied']:.1f} dB)"
        yield self.progress(f"held out: {told}")
