"""Training an OSF from images by volume rendering: the first of the paper's three steps to a KiloOSF.

A voxel grid proposes the samples. It begins as fog in the visual hull of the silhouettes and is baked anew from the
network every so often, so that samples gather where the network has found surfaces; a rim of fog stays around them, so
that they can still move.
"""

from __future__ import annotations

import time
from collections.abc import Iterator
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any, Literal

import numpy as np
import torch
from jaxtyping import Bool, Float, Float32
from scipy import ndimage
from torch.nn import functional

from osfcore.errors import InvalidInput
from osfcore.fields.kiloosf import DENSITY_FLOOR, EMPTY_G, FEATURES, FLOOR_G, KiloOSF
from osfcore.fields.kiloosf_query import KiloQuery
from osfcore.fields.osf import OSF, OSFSize
from osfcore.fields.ray_sampling import RayBatch, RaySource
from osfcore.fields.training.optimization import Rates, composite
from osfcore.fields.training.validation import Holdout
from osfcore.fields.training.visual_hull import silhouette_box
from osfcore.fields.voxel_shell import first_shell, shell_field
from osfcore.io.image_set import ImageSet, read_splits
from osfcore.progress import Progress

MOST_G = 10.0
_ALPHA_WEIGHT = 0.5
_MOST_SAMPLES = 40  # along a ray, in training
_EVERY_SAMPLE = 256
_FOG_G = -2.0  # about 0.06 of the light is lost between two samples
_FAINT_DEPTH = 0.01  # of a voxel: below, the network means empty
_RIM_VOXELS = 2
_POINTS_AT_ONCE = 32_768
_WARM_UP = 100  # steps until the learning rate is whole
_REPORT_S = 1.0


@dataclass(frozen=True, slots=True)
class TeacherRecipe:
    """How a teacher is trained.

    Attributes:
        size: of its network.
        across: voxels of the proposals along the longest side of the box.
        rays: pixels per step of descent.
        rebake: steps between two bakes of the proposals.
        rates: learning rates.
    """

    size: OSFSize = field(default_factory=OSFSize)
    across: int = 64
    rays: int = 1024
    rebake: int = 100
    rates: Rates = field(default_factory=lambda: Rates(3e-3, 5e-4))


@dataclass(frozen=True, slots=True)
class TrainTeacher:
    """A training run of a teacher alone.

    Attributes:
        data: image set in the OSF format; `train` is learned from, `test` measured on.
        minutes: time budget of the descent [min].
        iterations: instead of the time budget, that many steps.
        device: what computes.
        seed: of everything random.
    """

    data: Path
    minutes: float = 15.0
    iterations: int | None = None
    device: Literal["cpu", "cuda"] = "cpu"
    seed: int = 0


@dataclass(frozen=True, eq=False, slots=True)
class TeacherStep:
    """How far a teacher's training is.

    Attributes:
        progress: in seconds of the budget, or steps.
        loss: of the last step of descent; None before the first.
        osf: the network that learns; the same object in every step.
        proposal: where its density is.
        psnr_full: of the network itself on all held-out images, over black [dB]; only in the last step.
        psnr_mask: the same inside the silhouettes, dilated by 2 px [dB].
    """

    progress: Progress
    loss: float | None
    osf: OSF
    proposal: KiloOSF
    psnr_full: float | None = None
    psnr_mask: float | None = None


def train_teacher(config: TrainTeacher, recipe: TeacherRecipe | None = None) -> Iterator[TeacherStep]:
    """Train an OSF from an image set and measure it.

    Raises:
        InvalidInput: if the settings are out of range.
        CorruptFile: if the image set is not sound.
    """
    if config.iterations is None and not 0.05 <= config.minutes <= 24 * 60:
        raise InvalidInput("minutes", config.minutes, "between 0.05 and 1440")
    train, test = read_splits(config.data)
    rng = np.random.default_rng(config.seed)
    generator = torch.Generator(config.device).manual_seed(config.seed)
    box = silhouette_box(train, where=config.data)
    teacher = Teacher.first(train, box, recipe or TeacherRecipe(), rng, torch.device(config.device))
    source = RaySource(train)
    pixels = source.silhouette_pixels()
    budget = config.iterations or 60 * config.minutes
    began = reported = time.monotonic()
    loss, count, share = None, 0, 0.0
    yield TeacherStep(Progress(0, round(budget), "Learning"), loss, teacher.osf, teacher.snapshot())
    while share < 1:
        rays = source.batch(rng.choice(pixels, teacher.recipe.rays))
        loss = teacher.step(rays, share, rng, generator)
        count, now = count + 1, time.monotonic()
        share = min(1.0, (count if config.iterations else now - began) / budget)
        if now - reported > _REPORT_S:
            reported = now
            progress = Progress(round(share * budget), round(budget), f"Learning, step {count}")
            yield TeacherStep(progress, loss, teacher.osf, teacher.snapshot())
    look = TeacherHoldout(test, teacher).everything(teacher.snapshot())
    words = f"{look.psnr_full:.2f} dB held out, {look.psnr_mask:.2f} dB in the mask, {count} steps"
    progress = Progress(round(budget), round(budget), words)
    yield TeacherStep(progress, loss, teacher.osf, teacher.snapshot(), look.psnr_full, look.psnr_mask)


class Teacher:
    """An OSF while it learns, with the grid that proposes its samples."""

    def __init__(self, osf: OSF, proposal: KiloOSF, recipe: TeacherRecipe, hull: Bool[np.ndarray, "nx ny nz"]) -> None:
        """Begin with a network and proposals.

        Args:
            osf: learns in place.
            proposal: density that tells where samples lie along a ray.
            recipe: how it learns.
            hull: corners of the proposals' grid outside which the object cannot be.
        """
        self.osf, self.recipe = osf, recipe
        self._proposal, self._hull = proposal, hull
        self._optimiser = torch.optim.Adam(osf.parameters(), betas=(0.9, 0.99), eps=1e-12)
        self._count = 0

    @staticmethod
    def first(
        images: ImageSet, box: Float[np.ndarray, "2 3"], recipe: TeacherRecipe, rng: np.random.Generator,
        device: torch.device,
    ) -> Teacher:  # fmt: skip
        """A new network, and fog in the visual hull.

        Args:
            images: whose silhouettes carve the hull.
            box: of the object [m].
            recipe: how it learns.
            rng: draws the first weights.
            device: that computes.
        """
        fog = first_shell(images, box, across=recipe.across, cells=1, hidden=8, inside_g=_FOG_G, rng=rng)
        weights = torch.Generator().manual_seed(int(rng.integers(2**62)))
        return Teacher(OSF(fog.box, recipe.size, generator=weights, device=device), fog, recipe, fog.index > 0)

    def step(self, rays: RayBatch, share: float, rng: np.random.Generator, _generator: torch.Generator) -> float:
        """One step of descent on the pixels of some rays.

        Args:
            rays: with the pixels' colours and opacities.
            share: of the training that is done, in [0, 1].
            rng: draws the offsets of the samples along the rays.
            _generator: not needed here; the stages of a KiloOSF draw from it.

        Returns:
            The loss.
        """
        self._count += 1
        for group in self._optimiser.param_groups:
            group["lr"] = self.recipe.rates.at(share) * min(1.0, self._count / _WARM_UP)
        offsets = rng.random(len(rays.alpha), dtype=np.float32)
        rgb, alpha = composite(
            self.osf, self._proposal, rays, offsets=offsets, most=_MOST_SAMPLES, device=self.osf.ambient.device
        )
        loss = functional.mse_loss(rgb, torch.as_tensor(rays.rgb, device=rgb.device)) * 3
        loss = loss + _ALPHA_WEIGHT * functional.mse_loss(alpha, torch.as_tensor(rays.alpha, device=rgb.device))
        self._optimiser.zero_grad(set_to_none=True)
        loss.backward()
        self._optimiser.step()
        if self._count % self.recipe.rebake == 0:
            self.update_proposal()
        return float(loss.detach())

    def update_proposal(self) -> None:
        """Propose samples where the network now has density, and thinly around."""
        grid = self._proposal
        g = np.full(grid.index.shape, EMPTY_G, np.float32)
        g[self._hull] = baked_g(self.osf, corners(grid)[self._hull], grid.voxel)
        solid = g > FLOOR_G
        if not solid.any():  # nothing found yet: keep looking everywhere
            return
        rim = ndimage.binary_dilation(solid, iterations=_RIM_VOXELS)
        features = np.zeros((*g.shape, FEATURES), np.float32)
        features[..., 0] = np.where(rim, np.maximum(g, _FOG_G), EMPTY_G)
        self._proposal = shell_field(grid.origin, grid.voxel, features, rim, grid.cells, grid.networks, grid.ambient)

    def snapshot(self) -> KiloOSF:
        """The proposals: density alone means something in them."""
        return self._proposal

    def state(self) -> dict[str, Any]:
        """What a checkpoint needs besides the proposals."""
        network, hull = self.osf.state_dict(), torch.from_numpy(self._hull)
        return {"network": network, "adam": self._optimiser.state_dict(), "count": self._count, "hull": hull}

    @staticmethod
    def restored(
        proposal: KiloOSF, state: dict[str, Any], recipe: TeacherRecipe, device: torch.device
    ) -> Teacher:  # fmt: skip
        """Go on from a checkpoint.

        Args:
            proposal: as it was.
            state: what `state` told.
            recipe: how it learns.
            device: that computes.
        """
        osf = OSF(proposal.box, recipe.size, device=device)
        osf.load_state_dict(state["network"])
        teacher = Teacher(osf, proposal, recipe, state["hull"].numpy())
        teacher._optimiser.load_state_dict(state["adam"])
        teacher._count = state["count"]
        return teacher


class TeacherHoldout(Holdout):
    """The test images of a set, against what a teacher itself renders."""

    def __init__(self, images: ImageSet, teacher: Teacher) -> None:
        """Take over a split and a teacher."""
        super().__init__(images)
        self._teacher = teacher

    @torch.no_grad()
    def _pair(self, query: KiloQuery, field: KiloOSF, number: int) -> tuple[np.ndarray, np.ndarray]:
        rays = self._source.batch(self._source.image_pixels(number))
        osf = self._teacher.osf
        colour, _ = composite(osf, field, rays, min_weight=1e-4, most=_EVERY_SAMPLE, device=osf.ambient.device)
        shape = (*self._source.image_shape, 3)
        return rays.rgb.reshape(shape), np.clip(colour.cpu().numpy(), 0, 1).reshape(shape)


def corners(grid: KiloOSF) -> Float32[np.ndarray, "nx ny nz 3"]:
    """Where the corners of a field's grid lie [m]."""
    steps = np.moveaxis(np.indices(grid.index.shape, dtype=np.float32), 0, -1)
    return (grid.origin + np.float32(grid.voxel) * steps).astype(np.float32)


@torch.no_grad()
def baked_g(osf: OSF, points: Float32[np.ndarray, "n 3"], voxel: float) -> Float32[np.ndarray, "n"]:
    """Density features as dense as the teacher, at points; EMPTY_G where that is next to nothing.

    Args:
        osf: teacher.
        points: in the object's frame [m].
        voxel: side of the voxels that get the features [m].
    """
    pieces = np.array_split(points, max(1, len(points) // _POINTS_AT_ONCE))
    parts = [osf.density(torch.as_tensor(piece, device=osf.ambient.device)).cpu() for piece in pieces]
    return inverse_density(torch.cat(parts).numpy() * np.float32(voxel))


def inverse_density(depth: Float32[np.ndarray, "n"]) -> Float32[np.ndarray, "n"]:
    """Solve for g: sigma * voxel = max(softplus(g) - softplus(FLOOR_G), 0), within the range of trained fields."""
    whole = np.clip(depth.astype(np.float64) + DENSITY_FLOOR, 1e-9, None)
    g = np.where(whole > 30, whole, np.log(np.expm1(np.minimum(whole, 30))))
    return np.where(depth < _FAINT_DEPTH, EMPTY_G, np.minimum(g, MOST_G)).astype(np.float32)
