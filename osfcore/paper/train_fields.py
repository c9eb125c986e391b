"""Training a KiloOSF as published: a teacher OSF from images, distillation into tiny networks, fine-tuning on images.

All three share the time budget. A checkpoint beside the output lets the same command go on after it was killed.
"""

from __future__ import annotations

import time
from collections.abc import Iterator
from dataclasses import asdict, dataclass, field, replace
from pathlib import Path
from typing import Any, Literal

import numpy as np
import torch
from jaxtyping import Float
from torch import Tensor

from osfcore.errors import CorruptFile, InvalidInput, check_seed
from osfcore.fields.devices import pick_device
from osfcore.fields.kiloosf import FLOOR_G, KiloOSF
from osfcore.fields.osf import OSF, OSFSize
from osfcore.fields.rays import RayBatch, RaySource
from osfcore.fields.train_kiloosf import FieldStep
from osfcore.fields.train_osf import (
    Checkpoint,
    NetworkHoldout,
    NetworkStage,
    Rates,
    TeacherRecipe,
    baked_g,
    corners,
    first_teacher,
    read_checkpoint,
    restored_teacher,
    write_checkpoint,
)
from osfcore.fields.visual_hull import silhouette_box
from osfcore.io.checkpoint import going_on_from
from osfcore.io.files import write_atomically, write_json
from osfcore.io.image_set import ImageSet, read_splits
from osfcore.io.output_paths import check_weights_place
from osfcore.paper.fields import TinyField, TinyQuery, field_bytes, field_from_bytes, first_field, network_size
from osfcore.progress import Progress

# From a teacher OSF to tiny networks, the second of the three steps of KiloNeRF (Reiser et al. 2021, section 3.2).
#
# Points are drawn uniformly from the occupied space, with the views and lights that the images have; the tiny
# networks learn to answer as the teacher does, by the mean squared error of the opacity of a voxel and of rho.
#
# Deviation: rho counts where the teacher is opaque, for the tiny networks never render it elsewhere.


RATES = Rates(3e-3, 1e-3)
_POINTS = 8192


class TinyDistillation:
    """Tiny networks while they learn from a teacher.

    Args:
        field: where the networks begin.
        teacher: a trained OSF of the same object.
        device: that computes.
    """

    def __init__(self, field: TinyField, teacher: OSF, device: torch.device) -> None:
        self.teacher, self.grid = teacher, field
        self.query = TinyQuery(field, device=device)
        self._optimiser = torch.optim.Adam(self.query.parameters(), eps=1e-12)
        self._corners = np.argwhere(field.occupied).astype(np.float32)

    def step(self, rays: RayBatch, share: float, rng: np.random.Generator, _generator: torch.Generator) -> float:
        """One step of descent on random points.

        Args:
            rays: views and lights are drawn from theirs.
            share: of the stage that is done, in [0, 1].
            rng: draws the points.

        Returns:
            The loss.
        """
        for group in self._optimiser.param_groups:
            group["lr"] = RATES.at(share)
        corner = self._corners[rng.integers(len(self._corners), size=_POINTS)]
        jitter = rng.uniform(-0.5, 0.5, corner.shape).astype(np.float32)
        points = self.grid.origin + np.float32(self.grid.voxel) * (corner + jitter)
        ray = rng.integers(len(rays.lights), size=_POINTS)
        loss = self.loss(*(torch.as_tensor(a, device=self.query.device)
                           for a in (points, rays.lights[ray], rays.directions[ray])))  # fmt: skip
        self._optimiser.zero_grad(set_to_none=True)
        loss.backward()
        self._optimiser.step()
        return float(loss.detach())

    def loss(
        self, x: Float[Tensor, "S 3"], light: Float[Tensor, "S 3"], view: Float[Tensor, "S 3"]
    ) -> Float[Tensor, ""]:
        """Squared error of a voxel's opacity, and of rho where the teacher is opaque.

        Args:
            x: points in the object's frame [m].
            light: unit vectors toward the light, in the object's frame.
            view: unit vectors from the camera into the scene, in the object's frame.
        """
        with torch.no_grad():
            right = self.teacher(x, light, view)
            alpha = -torch.expm1(-right.sigma * self.grid.voxel)
        mine = self.query(x, light, view)
        error = ((mine.direct - right.ambient - right.direct) ** 2).sum(dim=-1)
        return (alpha * error + (-torch.expm1(-mine.sigma * self.grid.voxel) - alpha) ** 2).mean()

    def state(self) -> dict[str, Any]:
        """What a checkpoint needs."""
        return {"adam": self._optimiser.state_dict(), "student": self.query.state_dict()}

    def restore(self, state: dict[str, Any]) -> None:
        """Go on from a checkpoint."""
        self._optimiser.load_state_dict(state["adam"])
        self.query.load_state_dict(state["student"])


_LOOK_SHARE = 0.05  # of the budget between two looks at held-out images
_MOST_BYTES = 1_950_000  # of a file's networks
_METRICS = ("psnr_full", "psnr_mask")
_WORDS = {"teacher": "Teacher", "distil": "Distillation", "fine": "Fine-tuning"}


@dataclass(frozen=True, slots=True)
class PaperFieldRecipe:
    """How a KiloOSF is trained.

    Attributes:
        teacher: of the first step; NeRF's networks have 8 layers of 256 units.
        across: cells along the longest side; fewer where the file would pass 2 MB.
        width: units of the tiny networks (KiloNeRF's 32).
        rays: pixels per step of fine-tuning.
        rates: of fine-tuning.
        teacher_share: of the budget.
        distil_share: likewise.
        report_s: between two steps that are told [s].
        checkpoint_s: between two checkpoints [s].
    """

    teacher: TeacherRecipe = field(default_factory=TeacherRecipe)
    across: int = 8
    width: int = 32
    rays: int = 1024
    rates: Rates = field(default_factory=lambda: Rates(2e-3, 3e-4))
    teacher_share: float = 0.3
    distil_share: float = 0.1
    report_s: float = 1.0
    checkpoint_s: float = 20.0


@dataclass(frozen=True, slots=True)
class TrainPaperField:
    """A training run.

    Attributes:
        data: image set in the OSF format; `train` is learned from, `test` measured on.
        out: file to write, FILE.safetensors; metrics go beside it to FILE.json.
        minutes: time budget of the descent [min].
        device: "auto", "cpu" or "cuda".
        seed: of everything random.
        iterations: instead of the time budget, that many steps: repeatable on one machine.
        teacher_width: units of each layer of the teacher.
        teacher_depth: its layers.
    """

    data: Path
    out: Path
    minutes: float = 30.0
    device: Literal["auto", "cpu", "cuda"] = "auto"
    seed: int = 0
    iterations: int | None = None
    teacher_width: int = 64
    teacher_depth: int = 4


_Learner = NetworkStage | TinyDistillation


def train_paper_field(config: TrainPaperField, recipe: PaperFieldRecipe | None = None) -> Iterator[FieldStep]:
    """Train a field from an image set and write it.

    Raises:
        InvalidInput: if the settings are out of range, cuda is asked for and not there, or a file of somebody else lies
            where the metrics belong.
        CorruptFile: if the image set is not sound, or the checkpoint of a killed run cannot be gone on from.
        CannotWrite: if the output cannot be written, which is tried first.
    """
    device = pick_device(config.device)
    if not 0.05 <= config.minutes <= 24 * 60:
        raise InvalidInput("minutes", config.minutes, "between 0.05 and 1440")
    if config.iterations is not None and not 10 <= config.iterations <= 10_000_000:
        raise InvalidInput("iterations", config.iterations, "between 10 and 10,000,000")
    check_seed(config.seed)
    check_weights_place(config.out, _METRICS)
    recipe = recipe or PaperFieldRecipe()
    size = OSFSize(config.teacher_depth, config.teacher_width)
    recipe = replace(recipe, teacher=replace(recipe.teacher, size=size))
    train, test = read_splits(config.data)
    if train.is_opaque:
        raise CorruptFile(config.data, "its images are opaque all over; an object before transparency is expected")
    yield from _Run(config, recipe, device, train, test).steps()


class _Run:
    """One training run."""

    def __init__(
        self, config: TrainPaperField, recipe: PaperFieldRecipe, device: torch.device, train: ImageSet, test: ImageSet
    ) -> None:
        self._config, self._recipe, self._device = config, recipe, device
        self._train, self._test, self._source = train, test, RaySource(train)
        self._pixels = self._source.silhouette_pixels()
        self._rng = np.random.default_rng(config.seed)
        self._generator = torch.Generator(device).manual_seed(config.seed)
        self._clock: dict[str, Any] = {"seconds": 0.0, "steps": 0, "looked_at": 0.0, "psnr": None}
        self._tiny: TinyField | None = None
        self._proposal: KiloOSF | None = None
        self._hull: np.ndarray | None = None
        end = recipe.teacher_share + recipe.distil_share
        self._ends = {"teacher": recipe.teacher_share, "distil": end, "fine": 1.0}

    def steps(self) -> Iterator[FieldStep]:
        yield self._report("Reading the images")
        saved = read_checkpoint(self._checkpoint_path, self._fingerprint())
        if saved is None:
            name, learner = self._first()
        else:
            with going_on_from(self._checkpoint_path):
                name, learner = self._resumed(saved)
        names = list(self._ends)
        for number in range(names.index(name), len(names)):
            if number > names.index(name):
                learner = self._next(names[number], learner)
                self._save(names[number], learner)
            start = self._ends[names[number - 1]] if number else 0.0
            yield from self._descend(names[number], learner, start, self._ends[names[number]])
        yield self._report("Measuring on all held-out images")
        yield self._finish(learner)

    def _first(self) -> tuple[str, _Learner]:
        box = silhouette_box(self._train, where=self._config.data)
        return "teacher", first_teacher(self._train, box, self._recipe.teacher, self._rng, self._device)

    def _next(self, name: str, before: _Learner) -> _Learner:
        """The learner of a phase, from that of the phase before."""
        r = self._recipe
        if isinstance(before, NetworkStage):
            assert isinstance(before.network, OSF)
            self._proposal, self._hull = before.snapshot(), before.state()["hull"].numpy()
            grid, most = self._proposal, _MOST_BYTES // (2 * network_size(r.width))
            occupied = grid.density > FLOOR_G
            self._tiny = first_field(grid.origin, grid.voxel, occupied, across=r.across, width=r.width,
                                     most_networks=most, rng=self._rng)  # fmt: skip
            return TinyDistillation(self._tiny, before.network, self._device)
        return self._fine(before.query)

    def _fine(self, query: TinyQuery) -> NetworkStage:
        assert self._proposal is not None
        assert self._hull is not None
        recipe = self._recipe
        return NetworkStage(query, self._proposal, self._hull, rates=recipe.rates, rebake=recipe.teacher.rebake)

    def _share(self) -> float:
        """Of the whole budget that is used up."""
        if self._config.iterations is not None:
            return min(1.0, self._clock["steps"] / self._config.iterations)
        return min(1.0, self._clock["seconds"] / (60 * self._config.minutes))

    def _descend(self, name: str, learner: _Learner, start: float, end: float) -> Iterator[FieldStep]:
        rays = self._recipe.teacher.rays if name == "teacher" else self._recipe.rays
        began = reported = saved = time.monotonic()
        already = self._clock["seconds"]
        while (share := self._share()) < end:
            batch = self._source.batch(self._rng.choice(self._pixels, rays))
            learner.step(batch, (share - start) / (end - start), self._rng, self._generator)
            now = time.monotonic()
            self._clock |= {"steps": self._clock["steps"] + 1, "seconds": already + now - began}
            if now - reported > self._recipe.report_s:
                reported = now
                yield self._look(name, learner)
            if now - saved > self._recipe.checkpoint_s:
                saved = now
                self._save(name, learner)
            began += time.monotonic() - now  # looking and saving cost nobody's budget

    def _look(self, name: str, learner: _Learner) -> FieldStep:
        preview = None
        if isinstance(learner, NetworkStage) and self._share() - self._clock["looked_at"] > _LOOK_SHARE:
            look = NetworkHoldout(self._test, learner.network).glance(learner.snapshot())
            self._clock |= {"looked_at": self._share(), "psnr": (look.psnr_full, look.psnr_mask)}
            preview = look.preview
        psnr = self._clock["psnr"]
        quality = f", {psnr[0]:.1f} dB held out ({psnr[1]:.1f} in the mask)" if psnr else ""
        return replace(self._report(f"{_WORDS[name]}, step {self._clock['steps']}{quality}"), preview=preview)

    def _report(self, words: str) -> FieldStep:
        total = self._config.iterations or max(1, round(60 * self._config.minutes))
        full, mask = self._clock["psnr"] or (None, None)
        return FieldStep(Progress(round(self._share() * total), total, words), full, mask, None)

    def _finish(self, learner: _Learner) -> FieldStep:
        """Measure what users will read from the file, and write it."""
        assert isinstance(learner, NetworkStage)
        assert isinstance(learner.network, TinyQuery)
        assert self._tiny is not None
        grid = learner.snapshot()
        occupied = np.zeros(grid.index.shape, bool)
        near = grid.density > FLOOR_G
        occupied[near] = baked_g(learner.network, corners(grid)[near], grid.voxel) > FLOOR_G
        data = field_bytes(learner.network.to_field(self._tiny, occupied))
        written = TinyQuery(field_from_bytes(data, "The trained field"), device=self._device)
        look = NetworkHoldout(self._test, written).everything(grid)
        metrics = self._metrics(len(data), look.psnr_full, look.psnr_mask, look.images)
        write_atomically(self._config.out, data)
        write_json(self._config.out.with_suffix(".json"), metrics)
        self._checkpoint_path.unlink(missing_ok=True)
        self._clock["psnr"] = look.psnr_full, look.psnr_mask
        words = f"{look.psnr_full:.2f} dB held out, {look.psnr_mask:.2f} dB in the mask, {len(data) / 1e6:.2f} MB"
        return replace(self._report(words), preview=look.preview)

    def _metrics(self, size: int, full: float, mask: float, images: int) -> dict[str, Any]:
        assert self._tiny is not None
        return {
            "psnr_full": round(full, 3),
            "psnr_mask": round(mask, 3),
            "test_images": images,
            "bytes": size,
            "networks": len(self._tiny.networks),
            "minutes": round(self._clock["seconds"] / 60, 3),
            "iterations": self._clock["steps"],
            "seed": self._config.seed,
            "device": str(self._device),
            "threads": torch.get_num_threads(),
            "data": self._config.data.name,
            "train_images": len(self._train.cameras),
            "image_size": list(self._source.image_shape),
            "recipe": {"name": "paper", **asdict(self._recipe)},
        }

    @property
    def _checkpoint_path(self) -> Path:
        return self._config.out.with_suffix(".partial")

    def _fingerprint(self) -> dict[str, Any]:
        """What a checkpoint must agree with to be gone on from."""
        settings = {**asdict(self._config), "data": str(self._config.data.resolve()), "out": str(self._config.out)}
        digests = [self._train.digest(), self._test.digest()]
        return {"settings": settings, "recipe": asdict(self._recipe), "images": digests}

    def _save(self, name: str, learner: _Learner) -> None:
        random = {"numpy": self._rng.bit_generator.state, "torch": self._generator.get_state()}
        state = learner.state()
        proposal = learner.snapshot() if isinstance(learner, NetworkStage) else self._proposal
        assert proposal is not None
        if self._tiny is not None:
            kept = {"cells": self._tiny.cells, "occupied": self._tiny.occupied, "networks": self._tiny.networks}
            state |= {"hull": torch.from_numpy(self._hull), **{k: torch.from_numpy(v) for k, v in kept.items()}}
        if isinstance(learner, TinyDistillation):
            state["teacher"] = learner.teacher.state_dict()
        write_checkpoint(
            self._checkpoint_path, Checkpoint(name, proposal, state, dict(self._clock), random), self._fingerprint()
        )

    def _resumed(self, saved: Checkpoint) -> tuple[str, _Learner]:
        state, self._clock = saved.optimiser, dict(saved.clock)
        self._rng.bit_generator.state = saved.random["numpy"]
        self._generator.set_state(saved.random["torch"])
        if saved.stage == "teacher":
            return saved.stage, restored_teacher(saved.field, state, self._recipe.teacher, self._device)
        grid, self._proposal, self._hull = saved.field, saved.field, state["hull"].numpy()
        cells, occupied, networks = (state[name].numpy() for name in ("cells", "occupied", "networks"))
        self._tiny = TinyField(grid.origin, grid.voxel, occupied, cells, networks, self._recipe.width)
        if saved.stage == "distil":
            teacher = OSF(grid.box, self._recipe.teacher.size, device=self._device)
            teacher.load_state_dict(state["teacher"])
            learner = TinyDistillation(self._tiny, teacher, self._device)
        else:
            query = TinyQuery(self._tiny, device=self._device)
            query.load_state_dict(state["network"])
            learner = self._fine(query)
        learner.restore(state)
        return saved.stage, learner
