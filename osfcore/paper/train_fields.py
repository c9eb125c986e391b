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
from jaxtyping import Bool, Float
from torch import Tensor

from osfcore.errors import CorruptFile, check_seed
from osfcore.fields.devices import pick_device
from osfcore.fields.kiloosf import FLOOR_G, KiloOSF
from osfcore.fields.osf import OSF, OSFSize
from osfcore.fields.rays import RayBatch, RaySource
from osfcore.fields.train_kiloosf import FieldStep
from osfcore.fields.train_osf import (
    Checkpoint,
    Holdout,
    NetworkStage,
    Rates,
    TeacherRecipe,
    baked_g,
    check_budget,
    corners,
    descend,
    first_teacher,
    restored_teacher,
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


@dataclass(frozen=True, eq=False, slots=True)
class TinyStart:
    """Where tiny networks begin.

    Attributes:
        field: with first weights.
        proposal: the teacher's density, which decides where samples lie along a ray.
        hull: corners of the proposals' grid outside which the object cannot be.
    """

    field: TinyField
    proposal: KiloOSF
    hull: Bool[np.ndarray, "nx ny nz"]

    def state(self) -> dict[str, Tensor]:
        """Return what a checkpoint needs besides the proposals."""
        arrays = {name: getattr(self.field, name) for name in ("cells", "occupied", "networks")}
        return {name: torch.from_numpy(array) for name, array in {"hull": self.hull, **arrays}.items()}

    @staticmethod
    def restored(proposal: KiloOSF, state: dict[str, Any], width: int) -> TinyStart:
        """Take it over from a checkpoint."""
        occupied, cells, networks, hull = (state[name].numpy() for name in ("occupied", "cells", "networks", "hull"))
        return TinyStart(TinyField(proposal.origin, proposal.voxel, occupied, cells, networks, width), proposal, hull)


class TinyDistillation:
    """Tiny networks while they learn from a teacher.

    Args:
        start: where the networks begin.
        teacher: a trained OSF of the same object.
        device: that computes.
    """

    def __init__(self, start: TinyStart, teacher: OSF, device: torch.device) -> None:
        self.start, self.teacher = start, teacher
        self.query = TinyQuery(start.field, device=device)
        self._optimiser = torch.optim.Adam(self.query.parameters(), eps=1e-12)
        self._corners = np.argwhere(start.field.occupied).astype(np.float32)

    def step(self, rays: RayBatch, share: float, rng: np.random.Generator, _generator: torch.Generator) -> float:
        """Take one step of descent on random points and return the loss.

        Args:
            rays: views and lights are drawn from theirs.
            share: of the stage that is done, in [0, 1].
            rng: draws the points.
            _generator: not needed here.
        """
        for group in self._optimiser.param_groups:
            group["lr"] = RATES.at(share)
        corner = self._corners[rng.integers(len(self._corners), size=_POINTS)]
        jitter = rng.uniform(-0.5, 0.5, corner.shape).astype(np.float32)
        points = self.start.field.origin + np.float32(self.start.field.voxel) * (corner + jitter)
        ray = rng.integers(len(rays.lights), size=_POINTS)
        drawn = (points, rays.lights[ray], rays.directions[ray])
        return descend(self._optimiser, self.loss(*(torch.as_tensor(a, device=self.query.device) for a in drawn)))

    def loss(
        self, x: Float[Tensor, "S 3"], light: Float[Tensor, "S 3"], view: Float[Tensor, "S 3"]
    ) -> Float[Tensor, ""]:
        """Return the squared error of a voxel's opacity, and of rho where the teacher is opaque.

        Args:
            x: points in the object's frame [m].
            light: unit vectors toward the light, in the object's frame.
            view: unit vectors from the camera into the scene, in the object's frame.
        """
        voxel = self.start.field.voxel
        with torch.no_grad():
            right = self.teacher(x, light, view)
            alpha = -torch.expm1(-right.sigma * voxel)
        mine = self.query(x, light, view)
        error = ((mine.direct - right.ambient - right.direct) ** 2).sum(dim=-1)
        return (alpha * error + (-torch.expm1(-mine.sigma * voxel) - alpha) ** 2).mean()

    def snapshot(self) -> KiloOSF:
        """Return the teacher's density."""
        return self.start.proposal

    def state(self) -> dict[str, Any]:
        """Return what a checkpoint needs besides the proposals."""
        networks = {"student": self.query.state_dict(), "teacher": self.teacher.state_dict()}
        return {"adam": self._optimiser.state_dict(), **networks, **self.start.state()}

    def restore(self, state: dict[str, Any]) -> None:
        """Go on from a checkpoint; the start and the teacher are given to the constructor."""
        self._optimiser.load_state_dict(state["adam"])
        self.query.load_state_dict(state["student"])


class TinyFineTuning(NetworkStage):
    """Tiny networks while they learn from images."""

    def __init__(self, query: TinyQuery, start: TinyStart, recipe: PaperFieldRecipe) -> None:
        super().__init__(query, start.proposal, start.hull, rates=recipe.rates, rebake=recipe.teacher.rebake)
        self.query, self.start = query, start

    def state(self) -> dict[str, Any]:
        """Return what a checkpoint needs besides the proposals."""
        return {**super().state(), **self.start.state()}


_LOOK_SHARE = 0.05  # of the budget between two looks at held-out images
_MOST_BYTES = 1_950_000  # of a file's networks
_METRICS = ("psnr_full", "psnr_mask")
_PHASES = {"teacher": "Teacher", "distil": "Distillation", "fine": "Fine-tuning"}


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
        report_s: between two steps that are reported [s].
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
    check_budget(config.minutes, config.iterations)
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
        self._checkpoint_path = config.out.with_suffix(".partial")
        settings = {**asdict(config), "data": str(config.data.resolve()), "out": str(config.out)}
        digests = [train.digest(), test.digest()]
        self._fingerprint = {"settings": settings, "recipe": asdict(recipe), "images": digests}

    def steps(self) -> Iterator[FieldStep]:
        yield self._report("Reading the images")
        saved = Checkpoint.read(self._checkpoint_path, self._fingerprint)
        if saved is None:
            box = silhouette_box(self._train, where=self._config.data)
            name, learner = "teacher", first_teacher(self._train, box, self._recipe.teacher, self._rng, self._device)
        else:
            with going_on_from(self._checkpoint_path):
                name, learner = saved.stage, self._resumed(saved)
        names, recipe = list(_PHASES), self._recipe
        ends = [0.0, recipe.teacher_share, recipe.teacher_share + recipe.distil_share, 1.0]
        for number in range(names.index(name), len(names)):
            if names[number] != name:
                learner = self._next(learner)
                self._save(names[number], learner)
            yield from self._descend(names[number], learner, ends[number], ends[number + 1])
        yield self._report("Measuring on all held-out images")
        assert isinstance(learner, TinyFineTuning)
        yield self._finish(learner)

    def _next(self, before: _Learner) -> _Learner:
        """Return the learner of a phase, from that of the phase before."""
        r = self._recipe
        if isinstance(before, TinyDistillation):
            return TinyFineTuning(before.query, before.start, r)
        assert isinstance(before.network, OSF)
        grid, most = before.snapshot(), _MOST_BYTES // (2 * network_size(r.width))
        tiny = first_field(grid.origin, grid.voxel, grid.density > FLOOR_G, across=r.across, width=r.width,
                           most_networks=most, rng=self._rng)  # fmt: skip
        return TinyDistillation(TinyStart(tiny, grid, before.state()["hull"].numpy()), before.network, self._device)

    def _share(self) -> float:
        """Return the share of the whole budget that is used up."""
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
            look = Holdout(self._test, learner.network).glance(learner.snapshot())
            self._clock |= {"looked_at": self._share(), "psnr": (look.psnr_full, look.psnr_mask)}
            preview = look.preview
        psnr = self._clock["psnr"]
        quality = f", {psnr[0]:.1f} dB held out ({psnr[1]:.1f} in the mask)" if psnr else ""
        return replace(self._report(f"{_PHASES[name]}, step {self._clock['steps']}{quality}"), preview=preview)

    def _report(self, words: str) -> FieldStep:
        total = self._config.iterations or max(1, round(60 * self._config.minutes))
        full, mask = self._clock["psnr"] or (None, None)
        return FieldStep(Progress(round(self._share() * total), total, words), full, mask, None)

    def _finish(self, learner: TinyFineTuning) -> FieldStep:
        """Measure what users will read from the file, and write it."""
        config, grid = self._config, learner.snapshot()
        occupied = np.zeros(grid.index.shape, bool)
        near = grid.density > FLOOR_G
        occupied[near] = baked_g(learner.query, corners(grid)[near], grid.voxel) > FLOOR_G
        data = field_bytes(learner.query.to_field(learner.start.field, occupied))
        written = TinyQuery(field_from_bytes(data, "The trained field"), device=self._device)
        look = Holdout(self._test, written).everything(grid)
        metrics = {
            "psnr_full": round(look.psnr_full, 3),
            "psnr_mask": round(look.psnr_mask, 3),
            "test_images": look.images,
            "bytes": len(data),
            "networks": len(learner.start.field.networks),
            "minutes": round(self._clock["seconds"] / 60, 3),
            "iterations": self._clock["steps"],
            "seed": config.seed,
            "device": str(self._device),
            "threads": torch.get_num_threads(),
            "data": config.data.name,
            "train_images": len(self._train.cameras),
            "image_size": list(self._source.image_shape),
            "recipe": {"name": "paper", **asdict(self._recipe)},
        }
        write_atomically(config.out, data)
        write_json(config.out.with_suffix(".json"), metrics)
        self._checkpoint_path.unlink(missing_ok=True)
        self._clock["psnr"] = look.psnr_full, look.psnr_mask
        words = f"{look.psnr_full:.2f} dB held out, {look.psnr_mask:.2f} dB in the mask, {len(data) / 1e6:.2f} MB"
        return replace(self._report(words), preview=look.preview)

    def _save(self, name: str, learner: _Learner) -> None:
        random = {"numpy": self._rng.bit_generator.state, "torch": self._generator.get_state()}
        checkpoint = Checkpoint(name, learner.snapshot(), learner.state(), dict(self._clock), random)
        checkpoint.write(self._checkpoint_path, self._fingerprint)

    def _resumed(self, saved: Checkpoint) -> _Learner:
        state, self._clock, recipe = saved.optimiser, dict(saved.clock), self._recipe
        self._rng.bit_generator.state = saved.random["numpy"]
        self._generator.set_state(saved.random["torch"])
        if saved.stage == "teacher":
            return restored_teacher(saved.field, state, recipe.teacher, self._device)
        start = TinyStart.restored(saved.field, state, recipe.width)
        if saved.stage == "distil":
            teacher = OSF(saved.field.box, recipe.teacher.size, device=self._device)
            teacher.load_state_dict(state["teacher"])
            learner = TinyDistillation(start, teacher, self._device)
        else:
            query = TinyQuery(start.field, device=self._device)
            query.load_state_dict(state["network"])
            learner = TinyFineTuning(query, start, recipe)
        learner.restore(state)
        return learner
