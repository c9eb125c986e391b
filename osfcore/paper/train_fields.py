"""Training a KiloOSF as published: a teacher OSF from images, distillation into tiny networks, fine-tuning on images.

All three share the time budget. A checkpoint beside the output lets the same command go on after it was killed.
"""

from __future__ import annotations

from collections.abc import Iterator
from dataclasses import asdict, dataclass, field, replace
from typing import Any

import numpy as np
import torch
from jaxtyping import Bool, Float
from torch import Tensor

from osfcore.fields.devices import pick_device
from osfcore.fields.kiloosf import FLOOR_G, KiloOSF
from osfcore.fields.osf import OSF, OSFSize
from osfcore.fields.rays import RayBatch
from osfcore.fields.train_osf import (
    Checkpoint,
    FieldSettings,
    FieldStep,
    FieldTraining,
    Holdout,
    Learner,
    Look,
    NetworkStage,
    Pace,
    Rates,
    TeacherRecipe,
    baked_g,
    corners,
    descend,
    first_teacher,
    restored_teacher,
)
from osfcore.fields.visual_hull import silhouette_box
from osfcore.io.image_set import ImageSet
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
        corner = self._corners[rng.integers(len(self._corners), size=_POINTS)]
        jitter = rng.uniform(-0.5, 0.5, corner.shape).astype(np.float32)
        points = self.start.field.origin + np.float32(self.start.field.voxel) * (corner + jitter)
        ray = rng.integers(len(rays.lights), size=_POINTS)
        drawn = (points, rays.lights[ray], rays.directions[ray])
        loss = self.loss(*(torch.as_tensor(a, device=self.query.device) for a in drawn))
        return descend(self._optimiser, loss, RATES.at(share))

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

    def glance(self, _images: ImageSet) -> None:
        """Show nothing: colours are right only where the teacher's points were drawn."""

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


_MOST_BYTES = 1_950_000  # of a file's networks


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
    """

    teacher: TeacherRecipe = field(default_factory=TeacherRecipe)
    across: int = 8
    width: int = 32
    rays: int = 1024
    rates: Rates = field(default_factory=lambda: Rates(2e-3, 3e-4))
    teacher_share: float = 0.3
    distil_share: float = 0.1


def train_paper_field(
    config: FieldSettings, recipe: PaperFieldRecipe | None = None, pace: Pace | None = None
) -> Iterator[FieldStep]:
    """Train a field from an image set and write it.

    Raises:
        InvalidInput: if the settings are out of range, cuda is asked for and not there, or a file of somebody else lies
            where the metrics belong.
        CorruptFile: if the image set is not sound, or the checkpoint of a killed run cannot be gone on from.
        CannotWrite: if the output cannot be written, which is tried first.
    """
    device = pick_device(config.device)
    config.check()
    recipe = recipe or PaperFieldRecipe()
    size = OSFSize(config.teacher_depth, config.teacher_width)
    recipe = replace(recipe, teacher=replace(recipe.teacher, size=size))
    yield FieldStep(Progress(0, config.total, "Reading the images"))
    yield from _Training(config, recipe, pace or Pace(), device, *config.images()).steps()


class _Training(FieldTraining):
    def __init__(
        self, config: FieldSettings, recipe: PaperFieldRecipe, pace: Pace, device: torch.device, train: ImageSet,
        test: ImageSet,
    ) -> None:  # fmt: skip
        super().__init__(config, asdict(recipe), pace, device, train, test)
        self._data, self._recipe = config.data, recipe
        self.phases = {
            "teacher": (recipe.teacher_share, "Carving the silhouettes"),
            "distil": (recipe.teacher_share + recipe.distil_share, "Drawing tiny networks"),
            "fine": (1.0, "Fine-tuning on the images"),
        }

    def rays(self, phase: str) -> int:
        return self._recipe.teacher.rays if phase == "teacher" else self._recipe.rays

    def begun(self, phase: str, before: Learner | None) -> Learner:
        r = self._recipe
        if before is None:
            box = silhouette_box(self.train, where=self._data)
            return first_teacher(self.train, box, r.teacher, self.rng, self.device)
        if isinstance(before, TinyDistillation):
            return TinyFineTuning(before.query, before.start, r)
        assert isinstance(before, NetworkStage)
        assert isinstance(before.network, OSF)
        grid, most = before.snapshot(), _MOST_BYTES // (2 * network_size(r.width))
        tiny = first_field(grid.origin, grid.voxel, grid.density > FLOOR_G, across=r.across, width=r.width,
                           most_networks=most, rng=self.rng)  # fmt: skip
        return TinyDistillation(TinyStart(tiny, grid, before.state()["hull"].numpy()), before.network, self.device)

    def resumed(self, saved: Checkpoint) -> Learner:
        state, recipe = saved.optimiser, self._recipe
        if saved.stage == "teacher":
            return restored_teacher(saved.field, state, recipe.teacher, self.device)
        start = TinyStart.restored(saved.field, state, recipe.width)
        if saved.stage == "distil":
            teacher = OSF(saved.field.box, recipe.teacher.size, device=self.device)
            teacher.load_state_dict(state["teacher"])
            learner = TinyDistillation(start, teacher, self.device)
        else:
            query = TinyQuery(start.field, device=self.device)
            query.load_state_dict(state["network"])
            learner = TinyFineTuning(query, start, recipe)
        learner.restore(state)
        return learner

    def finished(self, learner: Learner) -> tuple[bytes, Look, dict[str, Any]]:
        assert isinstance(learner, TinyFineTuning)
        grid = learner.snapshot()
        occupied = np.zeros(grid.index.shape, bool)
        near = grid.density > FLOOR_G
        occupied[near] = baked_g(learner.query, corners(grid)[near], grid.voxel) > FLOOR_G
        data = field_bytes(learner.query.to_field(learner.start.field, occupied))
        written = TinyQuery(field_from_bytes(data, "The trained field"), device=self.device)
        further = {"networks": len(learner.start.field.networks), "recipe": {"name": "paper", **asdict(self._recipe)}}
        return data, Holdout(self.test, written).everything(grid), further
