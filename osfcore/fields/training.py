"""Training a KiloOSF straight from images, cameras, lights and silhouettes: coarse fog first, then a fine shell.

Three phases share the time budget: the visual hull of the silhouettes becomes a coarse field, which learns until it knows
where surfaces are (also those that no silhouette shows); the corners that some pixel sees are kept on a fine grid, which
learns the rest. A checkpoint beside the output lets the same command go on after it was killed.
"""

from __future__ import annotations

import time
from collections.abc import Iterator
from dataclasses import asdict, dataclass, replace
from pathlib import Path
from typing import Any, Literal

import numpy as np
import torch
from jaxtyping import UInt8

from osfcore.errors import InvalidInput
from osfcore.fields.checkpoint import Checkpoint, read_checkpoint, write_checkpoint
from osfcore.fields.holdout import Holdout
from osfcore.fields.hull import silhouette_box
from osfcore.fields.image_set import ImageSet, read_splits
from osfcore.fields.kiloosf import KiloOSF
from osfcore.fields.optimise import Rates, Stage
from osfcore.fields.rays import RaySource
from osfcore.fields.shell import first_shell, refine
from osfcore.fields.weights import field_bytes, read_field, write_atomically, write_json
from osfcore.progress import Progress

_REPORT_S = 1.0
_CHECKPOINT_S = 20.0
_LOOK_SHARE = 0.05  # of the budget between two looks at held-out images
_MIN_LOOK_S = 5.0


@dataclass(frozen=True, slots=True)
class Recipe:
    """How a field is trained; docs/fields.md has the measurements behind the numbers.

    Attributes:
        coarse_across: voxels along the longest side in the first phase.
        fine_across: the same in the second.
        coarse_share: of the time budget.
        cells: tiny networks along the longest side.
        hidden: their width.
        rays: pixels per step of descent.
        inside_g: density feature inside the visual hull at first.
        coarse_rates: learning rates of the first phase.
        fine_rates: of the second.
    """

    coarse_across: int = 48
    fine_across: int = 96
    coarse_share: float = 0.3
    cells: int = 8
    hidden: int = 16
    rays: int = 4096
    inside_g: float = -3.0
    coarse_rates: Rates = Rates(2e-2, 1e-2)
    fine_rates: Rates = Rates(2e-2, 1e-3)


@dataclass(frozen=True, slots=True)
class TrainField:
    """A training run.

    Attributes:
        data: image set in the OSF format; `train` is learned from, `test` measured on.
        out: file to write, FILE.safetensors; metrics go beside it to FILE.json.
        minutes: time budget of the descent [min].
        device: "auto", "cpu" or "cuda".
        seed: of everything random.
        iterations: instead of the time budget, that many steps: repeatable on one machine.
    """

    data: Path
    out: Path
    minutes: float = 30.0
    device: Literal["auto", "cpu", "cuda"] = "auto"
    seed: int = 0
    iterations: int | None = None


@dataclass(frozen=True, eq=False, slots=True)
class FieldStep:
    """How far training is.

    Attributes:
        progress: in seconds of the budget (or steps), with PSNR and time left in words.
        psnr_full: on held-out images, over black [dB]; None until measured.
        psnr_mask: the same inside the silhouettes, dilated by 2 px [dB].
        preview: one held-out image: truth, ours, difference x 4; None between looks.
    """

    progress: Progress
    psnr_full: float | None
    psnr_mask: float | None
    preview: UInt8[np.ndarray, "h w3 3"] | None


def train_field(config: TrainField, recipe: Recipe | None = None) -> Iterator[FieldStep]:
    """Train a field from an image set and write it.

    Raises:
        InvalidInput: if the settings are out of range, or cuda is asked for and not there.
        CorruptFile: if the image set is not sound.
        CannotWrite: if the disk refuses.
    """
    device = pick_device(config.device)
    _check(config)
    recipe = recipe or Recipe()
    yield FieldStep(Progress(0, _total(config), "Reading the images"), None, None, None)
    train, test = read_splits(config.data)
    yield from _Run(config, recipe, device, train, test).steps()


def pick_device(name: str) -> torch.device:
    """The device to compute on; "auto" takes a GPU where there is one.

    Raises:
        InvalidInput: if the name is unknown or there is no such device.
    """
    if name not in ("auto", "cpu", "cuda"):
        raise InvalidInput("device", name, "auto, cpu or cuda")
    if name == "cuda" and not torch.cuda.is_available():
        raise InvalidInput("device", name, "auto or cpu on this machine: PyTorch finds no GPU")
    return torch.device("cuda" if name != "cpu" and torch.cuda.is_available() else "cpu")


def _check(config: TrainField) -> None:
    if not 0.05 <= config.minutes <= 24 * 60:
        raise InvalidInput("minutes", config.minutes, "between 0.05 and 1440")
    if config.seed < 0:
        raise InvalidInput("seed", config.seed, "0 or more")
    if config.iterations is not None and not 10 <= config.iterations <= 10_000_000:
        raise InvalidInput("iterations", config.iterations, "between 10 and 10,000,000")
    if config.out.suffix != ".safetensors":
        raise InvalidInput("output file", config.out, "a path that ends in .safetensors")


def _total(config: TrainField) -> int:
    return config.iterations or max(1, round(config.minutes * 60))


class _Run:
    """The state of one training run between its steps."""

    def __init__(
        self, config: TrainField, recipe: Recipe, device: torch.device, train: ImageSet, test: ImageSet
    ) -> None:
        self._config, self._recipe, self._device = config, recipe, device
        self._images, self._source = train, RaySource(train)
        self._pixels = self._source.silhouette_pixels()
        self._holdout = Holdout(test)
        self._rng = np.random.default_rng(config.seed)
        self._generator = torch.Generator(device).manual_seed(config.seed)
        self._done_s, self._done_steps = 0.0, 0
        self._psnr: tuple[float, float] | None = None
        self._looked_at = 0.0

    def steps(self) -> Iterator[FieldStep]:
        saved = read_checkpoint(self._checkpoint_path, self._fingerprint())
        if saved is not None:
            stage_name, stage = saved.stage, self._resumed(saved)
            yield self._report("Going on from a checkpoint")
        else:
            yield self._report("Carving the silhouettes")
            stage_name, stage = "coarse", self._first_stage()
        if stage_name == "coarse":
            yield from self._descend("coarse", stage, 0.0, self._recipe.coarse_share)
            yield self._report("Refining the shell")
            across = self._recipe.fine_across
            stage = self._stage(refine(stage.snapshot(), self._images, across=across, rng=self._rng), "fine")
        yield from self._descend("fine", stage, self._recipe.coarse_share, 1.0)
        yield self._report("Measuring on all held-out images")
        yield self._finish(stage.snapshot())

    def _first_stage(self) -> Stage:
        box = silhouette_box(self._images, where=self._config.data)
        r = self._recipe
        field = first_shell(self._images, box, across=r.coarse_across, cells=r.cells, hidden=r.hidden,
                            inside_g=r.inside_g, rng=self._rng)  # fmt: skip
        return self._stage(field, "coarse")

    def _stage(self, field: KiloOSF, name: str) -> Stage:
        rates = self._recipe.coarse_rates if name == "coarse" else self._recipe.fine_rates
        return Stage(field, rates, self._device)

    def _share(self) -> float:
        """Of the whole budget that is used up."""
        if self._config.iterations is not None:
            return min(1.0, self._done_steps / self._config.iterations)
        return min(1.0, self._done_s / (60 * self._config.minutes))

    def _descend(self, name: str, stage: Stage, start: float, end: float) -> Iterator[FieldStep]:
        began = reported = saved = time.monotonic()
        already = self._done_s
        while (share := self._share()) < end:
            rays = self._source.batch(self._rng.choice(self._pixels, self._recipe.rays))
            stage.step(rays, (share - start) / (end - start), self._rng, self._generator)
            self._done_steps += 1
            now = time.monotonic()
            self._done_s = already + now - began
            if now - reported > _REPORT_S:
                reported = now
                yield self._look(stage)
                began += time.monotonic() - now  # looking costs nobody's budget
            if now - saved > _CHECKPOINT_S:
                saved = now
                self._save(name, stage)
                began += time.monotonic() - now

    def _look(self, stage: Stage) -> FieldStep:
        budget_s = 60 * self._config.minutes
        preview = None
        if self._done_s - self._looked_at > max(_MIN_LOOK_S, _LOOK_SHARE * budget_s):
            self._looked_at = self._done_s
            look = self._holdout.glance(stage.snapshot())
            self._psnr, preview = (look.psnr_full, look.psnr_mask), look.preview
        return replace(self._report(""), preview=preview)

    def _report(self, words: str) -> FieldStep:
        total = _total(self._config)
        share = self._share()
        full, mask = self._psnr or (None, None)
        if not words:
            left_s = self._done_s * (1 / share - 1) if share else 0.0
            quality = f"{full:.1f} dB held out ({mask:.1f} in the mask), " if full is not None else ""
            words = f"{quality}{_duration(left_s)} left"
        return FieldStep(Progress(round(share * total), total, words), full, mask, None)

    def _finish(self, field: KiloOSF) -> FieldStep:
        """Write the file, read it back, and measure what was read: that is what users get."""
        out = self._config.out
        data = field_bytes(field)
        write_atomically(out, data)
        look = self._holdout.everything(read_field(out))
        metrics = {
            "psnr_full": round(look.psnr_full, 3),
            "psnr_mask": round(look.psnr_mask, 3),
            "test_images": look.images,
            "bytes": len(data),
            "minutes": round(self._done_s / 60, 3),
            "iterations": self._done_steps,
            "seed": self._config.seed,
            "device": str(self._device),
            "threads": torch.get_num_threads(),
            "data": self._config.data.name,
            "train_images": len(self._images.cameras),
            "image_size": list(self._source.image_shape),
            "recipe": asdict(self._recipe),
        }
        write_json(out.with_suffix(".json"), metrics)
        self._checkpoint_path.unlink(missing_ok=True)
        self._psnr = look.psnr_full, look.psnr_mask
        words = f"{look.psnr_full:.2f} dB held out, {look.psnr_mask:.2f} dB in the mask, {len(data) / 1e6:.2f} MB"
        total = _total(self._config)
        return FieldStep(Progress(total, total, words), look.psnr_full, look.psnr_mask, look.preview)

    @property
    def _checkpoint_path(self) -> Path:
        return self._config.out.with_suffix(".partial")

    def _fingerprint(self) -> dict[str, Any]:
        """What a checkpoint must agree with to be gone on from."""
        settings = {**asdict(self._config), "data": str(self._config.data.resolve()), "out": str(self._config.out)}
        return {"settings": settings, "recipe": asdict(self._recipe), "images": len(self._images.cameras)}

    def _save(self, name: str, stage: Stage) -> None:
        clock = {"seconds": self._done_s, "steps": self._done_steps, "looked_at": self._looked_at, "psnr": self._psnr}
        random = {"numpy": self._rng.bit_generator.state, "torch": self._generator.get_state()}
        checkpoint = Checkpoint(name, stage.snapshot(), stage.state(), clock, random)
        write_checkpoint(self._checkpoint_path, checkpoint, self._fingerprint())

    def _resumed(self, saved: Checkpoint) -> Stage:
        stage = self._stage(saved.field, saved.stage)
        stage.restore(saved.optimiser)
        self._done_s, self._done_steps = saved.clock["seconds"], saved.clock["steps"]
        self._looked_at, self._psnr = saved.clock["looked_at"], saved.clock["psnr"]
        self._rng.bit_generator.state = saved.random["numpy"]
        self._generator.set_state(saved.random["torch"])
        return stage


def _duration(seconds: float) -> str:
    minutes, rest = divmod(round(seconds), 60)
    return f"{minutes} min {rest} s" if minutes else f"{rest} s"
