"""Training an OSF from images by volume rendering: the first of the paper's three steps to a KiloOSF.

Holds what every training of a field shares: stages of gradient descent, measuring on unseen images, and checkpoints.
"""

from __future__ import annotations

import time
from collections.abc import Callable, Iterator, Mapping, Sequence
from dataclasses import dataclass, field
from functools import partial
from pathlib import Path
from typing import Any, Literal, Protocol

import cv2
import numpy as np
import torch
from jaxtyping import Bool, Float, Float32, UInt8
from scipy import ndimage
from torch import Tensor, nn
from torch.nn import functional

from osfcore.errors import InvalidInput
from osfcore.fields.kiloosf import DENSITY_FLOOR, EMPTY_G, FEATURES, FLOOR_G, STEP_VOXELS, KiloOSF
from osfcore.fields.kiloosf_query import KiloQuery, Scatter
from osfcore.fields.osf import OSF, OSFSize
from osfcore.fields.rays import RayBatch, RaySource, first_shell, march, shell_field
from osfcore.fields.visual_hull import silhouette_box
from osfcore.io import checkpoint as checkpoint_file
from osfcore.io.image_file import to_uint8
from osfcore.io.image_set import ImageSet, read_splits
from osfcore.progress import Progress

# Gradient descent on a field from the pixels of an image set: one stage of training, step by step.


# Step sizes of the features, relative to the learning rate: g spans tens, colours one.
_FEATURE_UNITS = (10.0, 1.0, 1.0, 1.0, 2.0, 2.0, 2.0, 2.0)
_NETWORK_RATE = 0.25
_CELL_JITTER = 0.25
_MOST_G = 10.0  # and least: a shorter range loses less when it is stored in 8 bits
_MOST_DIPOLE = 1.5
_DENSITY_REFRESH = 8  # iterations between looks at where samples matter
MOST_SAMPLES = 24  # along a ray, in training


@dataclass(frozen=True, slots=True)
class Rates:
    """Learning rate at the beginning and the end of a stage; exponential between."""

    first: float
    last: float

    def at(self, share: float) -> float:
        """The rate when `share` in [0, 1] of the stage is done."""
        return self.first * (self.last / self.first) ** share


def composite(
    query: Callable[[Tensor, Tensor, Tensor], Scatter], field: KiloOSF, rays: RayBatch, *,
    offsets: np.ndarray | None = None, min_weight: float = 1e-3, most: int = MOST_SAMPLES,
    device: torch.device | str = "cpu",
) -> tuple[Float[Tensor, "R 3"], Float[Tensor, "R"]]:  # fmt: skip
    """Radiance over black and opacity along rays (paper eq. 3 for one object).

    Args:
        query: what is looked at, a `KiloQuery` or an `OSF`: takes points, lights and views.
        field: its density chooses the samples.
        rays: R rays.
        offsets: of each ray's first sample, in steps.
        min_weight: samples that would contribute less are left out.
        most: samples a ray at most.
        device: where `query` computes.
    """
    step = STEP_VOXELS * field.voxel
    ts, used = march(field, rays.origins, rays.directions, step=step, offsets=offsets, min_weight=min_weight,
                     most=most)  # fmt: skip
    mask = torch.as_tensor(used, device=device)
    ray = torch.as_tensor(np.nonzero(used)[0], device=device)
    points = (rays.origins[:, None] + ts[..., None] * rays.directions[:, None])[used]
    light, view = (torch.as_tensor(a, device=device)[ray] for a in (rays.lights, rays.directions))
    scatter = query(torch.as_tensor(points, device=device), light, view)
    depth = torch.zeros(mask.shape, device=device).masked_scatter(mask, scatter.sigma * step)
    before = torch.cumsum(depth, dim=1) - depth
    weights = torch.exp(-before) * -torch.expm1(-depth)
    radiance = scatter.ambient + scatter.direct
    colour = torch.zeros(len(ts), 3, device=device).index_add(0, ray, weights[mask][:, None] * radiance)
    return colour, weights.sum(dim=1)


class Stage:
    """A field on a fixed grid while it learns."""

    def __init__(self, field: KiloOSF, rates: Rates, device: torch.device) -> None:
        """Begin with a field's numbers."""
        self.field = field
        self._rates = rates
        self.query = KiloQuery(field, device=device, row_units=_FEATURE_UNITS)
        groups = [{"params": [self.query.rows]}, {"params": [self.query.networks, self.query.ambient]}]
        self._optimiser = torch.optim.Adam(groups, betas=(0.9, 0.99), eps=1e-12, fused=True)
        self._count = 0

    def step(self, rays: RayBatch, share: float, rng: np.random.Generator, generator: torch.Generator) -> float:
        """One step of descent on the pixels of some rays.

        Args:
            rays: with the pixels' colours and opacities.
            share: of the stage that is done, in [0, 1].
            rng: draws the offsets of the samples along the rays.
            generator: draws the jitter of the cells.

        Returns:
            The loss.
        """
        if self._count % _DENSITY_REFRESH == 0:
            self.field = self.snapshot()
        self._count += 1
        rate = self._rates.at(share)
        for group, factor in zip(self._optimiser.param_groups, (1.0, _NETWORK_RATE), strict=True):
            group["lr"] = rate * factor
        offsets = rng.random(len(rays.alpha), dtype=np.float32)
        query = partial(self.query, cell_jitter=_CELL_JITTER, generator=generator)
        device = self.query.rows.device
        rgb, alpha = composite(query, self.field, rays, offsets=offsets, device=device)
        loss = functional.mse_loss(rgb, torch.as_tensor(rays.rgb, device=device)) * 3
        loss = loss + _ALPHA_WEIGHT * functional.mse_loss(alpha, torch.as_tensor(rays.alpha, device=device))
        self._optimiser.zero_grad(set_to_none=True)
        loss.backward()
        self._optimiser.step()
        with torch.no_grad():
            rows = self.query.rows
            rows[:, 0].clamp_(-_MOST_G / _FEATURE_UNITS[0], _MOST_G / _FEATURE_UNITS[0])
            rows[:, 1:4].clamp_(0, 1)
            rows[:, 4:].clamp_(-_MOST_DIPOLE / _FEATURE_UNITS[4], _MOST_DIPOLE / _FEATURE_UNITS[4])
            rows[0] = 0  # empty space is shared by all corners outside the shell and stays empty
            rows[0, 0] = EMPTY_G / _FEATURE_UNITS[0]
            self.query.ambient.clamp_(min=0)
        return float(loss.detach())

    def snapshot(self) -> KiloOSF:
        """The field as it is now."""
        return self.query.to_field(self.field)

    def state(self) -> dict[str, Any]:
        """What a checkpoint needs besides the field."""
        return {"optimiser": self._optimiser.state_dict(), "count": self._count}

    def restore(self, state: dict[str, Any]) -> None:
        """Go on from a checkpoint."""
        self._optimiser.load_state_dict(state["optimiser"])
        self._count = state["count"]


# Checkpoints of a training run: everything that is needed to go on as if nothing had happened.


_ARRAYS = ("origin", "index", "rows", "cells", "networks", "ambient")


@dataclass(frozen=True, eq=False, slots=True)
class Checkpoint:
    """A run between two steps.

    Attributes:
        stage: name of the phase.
        field: the field as it is.
        optimiser: its moments and step count.
        clock: time and steps spent, last measurements.
        random: states of the random generators.
    """

    stage: str
    field: KiloOSF
    optimiser: dict[str, Any]
    clock: dict[str, Any]
    random: dict[str, Any]


def write_checkpoint(path: Path, checkpoint: Checkpoint, fingerprint: Mapping[str, Any]) -> None:
    """Write a checkpoint; the former one stays until the new one is whole.

    Args:
        path: of the file.
        checkpoint: the run as it is.
        fingerprint: settings and data of the run, which `read_checkpoint` compares.

    Raises:
        CannotWrite: if the disk refuses.
    """
    field = checkpoint.field
    arrays = {name: torch.from_numpy(np.ascontiguousarray(getattr(field, name))) for name in _ARRAYS}
    content = {
        "stage": checkpoint.stage,
        "field": {**arrays, "voxel": field.voxel, "hidden": field.hidden},
        "optimiser": checkpoint.optimiser,
        "clock": checkpoint.clock,
        "random": checkpoint.random,
    }
    checkpoint_file.write_checkpoint(path, dict(fingerprint), content)


def read_checkpoint(path: Path, fingerprint: Mapping[str, Any]) -> Checkpoint | None:
    """The checkpoint of the same run; None if there is none, it is cut short, or it belongs to other settings.

    Raises:
        CorruptFile: if it is of this run, but cannot be used.
    """
    content = checkpoint_file.read_content(path, dict(fingerprint))
    if content is None:
        return None
    with checkpoint_file.going_on_from(path):
        stored = content["field"]
        arrays = {name: stored[name].numpy() for name in _ARRAYS}
        field = KiloOSF(voxel=stored["voxel"], hidden=stored["hidden"], **arrays)
        return Checkpoint(content["stage"], field, content["optimiser"], content["clock"], content["random"])


# Measuring a field on images that it did not learn from.


MASK_MARGIN_PX = 2
_GLANCE_IMAGES = 6
_DIFFERENCE_GAIN = 4
_MIN_WEIGHT = 1e-5
_VALIDATION_SAMPLES = 192
_MIN_ERROR = 1e-10  # 100 dB


@dataclass(frozen=True, eq=False, slots=True)
class Look:
    """A measurement.

    Attributes:
        psnr_full: mean over images of the PSNR of the whole image over black [dB].
        psnr_mask: mean over images of the PSNR inside the silhouette, dilated by 2 px [dB].
        images: how many were looked at.
        preview: one of them: truth, ours, difference x 4.
    """

    psnr_full: float
    psnr_mask: float
    images: int
    preview: UInt8[np.ndarray, "h w3 3"]


class Holdout:
    """The test images of a set."""

    def __init__(self, images: ImageSet) -> None:
        """Take over a split; pixels are not copied."""
        self._images, self._source = images, RaySource(images)

    def glance(self, field: KiloOSF) -> Look:
        """Measure on a few images."""
        count = len(self._images.cameras)
        return self._look(field, np.unique(np.linspace(0, count - 1, _GLANCE_IMAGES).astype(int)).tolist())

    def everything(self, field: KiloOSF) -> Look:
        """Measure on all images."""
        return self._look(field, range(len(self._images.cameras)))

    def beside(self, fields: Sequence[KiloOSF], count: int = 3) -> UInt8[np.ndarray, "h w 3"]:
        """A few images under each other: the truth, and beside it what each of the fields makes of it."""
        rows = []
        for number in np.unique(np.linspace(0, len(self._images.cameras) - 1, count).astype(int)).tolist():
            pairs = [self._pair(KiloQuery(field), field, number) for field in fields]
            rows.append(np.hstack([pairs[0][0], *(ours for _, ours in pairs)]))
        return to_uint8(np.vstack(rows))

    def _look(self, field: KiloOSF, numbers: Sequence[int]) -> Look:
        query = KiloQuery(field)
        full, inside, preview = [], [], None
        for number in numbers:
            truth, ours = self._pair(query, field, number)
            error = np.mean((truth - ours) ** 2, axis=-1)
            full.append(_decibels(error))
            inside.append(_decibels(error[dilated_mask(self._images.rgba[number, ..., 3])]))
            if preview is None:
                strip = np.hstack([truth, ours, _DIFFERENCE_GAIN * np.abs(truth - ours)])
                preview = to_uint8(strip)
        assert preview is not None, "a set has at least one test image"
        return Look(float(np.mean(full)), float(np.mean(inside)), len(full), preview)

    @torch.no_grad()
    def _pair(self, query: KiloQuery, field: KiloOSF, number: int) -> tuple[np.ndarray, np.ndarray]:
        rays = self._source.batch(self._source.image_pixels(number))
        colour, _ = composite(query, field, rays, min_weight=_MIN_WEIGHT, most=_VALIDATION_SAMPLES)
        shape = (*self._source.image_shape, 3)
        ours: Float32[np.ndarray, "h w 3"] = np.clip(colour.numpy(), 0, 1).reshape(shape)
        return rays.rgb.reshape(shape), ours


def dilated_mask(alpha: UInt8[np.ndarray, "h w"]) -> Bool[np.ndarray, "h w"]:
    """The silhouette, grown by 2 px."""
    kernel = np.ones((2 * MASK_MARGIN_PX + 1,) * 2, np.uint8)
    return cv2.dilate((alpha > 0).astype(np.uint8), kernel) > 0


def _decibels(squared_error: Float[np.ndarray, "*shape"]) -> float:
    """PSNR of values in [0, 1]; at most 100 dB."""
    return float(-10 * np.log10(max(float(np.mean(squared_error)), _MIN_ERROR)))


# Descent of a whole network on an image set, its samples proposed by a density grid that is baked from it.
#
# The grid begins as fog in the visual hull of the silhouettes and is baked anew from the network every so often, so
# that samples gather where the network has found surfaces; a rim of fog stays around them, so that they can still
# move. It is what an occupancy grid is in KiloNeRF, and stands in place of NeRF's coarse network.


MOST_G = 10.0
FOG_G = -2.0  # about 0.06 of the light is lost between two samples
_ALPHA_WEIGHT = 0.5
_MOST_SAMPLES = 40  # along a ray, in training
_EVERY_SAMPLE = 256
_FAINT_DEPTH = 0.01  # of a voxel: below, the network means empty
_RIM_VOXELS = 2
_POINTS_AT_ONCE = 32_768
_WARM_UP = 100  # steps until the learning rate is whole


class FieldNetwork(Protocol):
    """A scattering function as a network: an `osfcore.fields.osf.OSF`, or a grid of tiny networks."""

    @property
    def device(self) -> torch.device:
        """Where it computes."""
        ...

    def density(self, x: Float[Tensor, "S 3"]) -> Float[Tensor, "S"]:
        """Density at points of the object's frame [1/m]."""
        ...

    def __call__(self, x: Float[Tensor, "S 3"], light: Float[Tensor, "S 3"], view: Float[Tensor, "S 3"]) -> Scatter:
        """Paper eq. 1."""
        ...

    def parameters(self) -> Iterator[nn.Parameter]:
        """What is learned."""
        ...

    def state_dict(self) -> dict[str, Any]:
        """All numbers."""
        ...


class NetworkStage:
    """A network while it learns, with the grid that proposes its samples.

    Args:
        network: learns in place.
        proposal: density that tells where samples lie along a ray.
        hull: corners of the proposals' grid outside which the object cannot be.
        rates: learning rates.
        rebake: steps between two bakes of the proposals.
    """

    def __init__(
        self, network: FieldNetwork, proposal: KiloOSF, hull: Bool[np.ndarray, "nx ny nz"], *, rates: Rates, rebake: int
    ) -> None:
        self.network = network
        self._rates, self._rebake = rates, rebake
        self._proposal, self._hull = proposal, hull
        self._optimiser = torch.optim.Adam(network.parameters(), betas=(0.9, 0.99), eps=1e-12)
        self._count = 0

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
            group["lr"] = self._rates.at(share) * min(1.0, self._count / _WARM_UP)
        offsets = rng.random(len(rays.alpha), dtype=np.float32)
        rgb, alpha = composite(
            self.network, self._proposal, rays, offsets=offsets, most=_MOST_SAMPLES, device=self.network.device
        )
        loss = functional.mse_loss(rgb, torch.as_tensor(rays.rgb, device=rgb.device)) * 3
        loss = loss + _ALPHA_WEIGHT * functional.mse_loss(alpha, torch.as_tensor(rays.alpha, device=rgb.device))
        self._optimiser.zero_grad(set_to_none=True)
        loss.backward()
        self._optimiser.step()
        if self._count % self._rebake == 0:
            self.update_proposal()
        return float(loss.detach())

    def update_proposal(self) -> None:
        """Propose samples where the network now has density, and thinly around."""
        grid = self._proposal
        g = np.full(grid.index.shape, EMPTY_G, np.float32)
        g[self._hull] = baked_g(self.network, corners(grid)[self._hull], grid.voxel)
        solid = g > FLOOR_G
        if not solid.any():  # nothing found yet: keep looking everywhere
            return
        rim = ndimage.binary_dilation(solid, iterations=_RIM_VOXELS)
        features = np.zeros((*g.shape, FEATURES), np.float32)
        features[..., 0] = np.where(rim, np.maximum(g, FOG_G), EMPTY_G)
        self._proposal = shell_field(grid.origin, grid.voxel, features, rim, grid.cells, grid.networks, grid.ambient)

    def snapshot(self) -> KiloOSF:
        """The proposals: density alone means something in them."""
        return self._proposal

    def state(self) -> dict[str, Any]:
        """What a checkpoint needs besides the proposals."""
        network, hull = self.network.state_dict(), torch.from_numpy(self._hull)
        return {"network": network, "adam": self._optimiser.state_dict(), "count": self._count, "hull": hull}

    def restore(self, state: dict[str, Any]) -> None:
        """Go on from a checkpoint; the network and the proposals are given to the constructor."""
        self._optimiser.load_state_dict(state["adam"])
        self._count = state["count"]


class NetworkHoldout(Holdout):
    """The test images of a set, against what a network itself renders."""

    def __init__(self, images: ImageSet, network: FieldNetwork) -> None:
        """Take over a split and a network."""
        super().__init__(images)
        self._network = network

    @torch.no_grad()
    def _pair(self, query: KiloQuery, field: KiloOSF, number: int) -> tuple[np.ndarray, np.ndarray]:
        rays = self._source.batch(self._source.image_pixels(number))
        network = self._network
        colour, _ = composite(network, field, rays, min_weight=1e-4, most=_EVERY_SAMPLE, device=network.device)
        shape = (*self._source.image_shape, 3)
        return rays.rgb.reshape(shape), np.clip(colour.cpu().numpy(), 0, 1).reshape(shape)


def corners(grid: KiloOSF) -> Float32[np.ndarray, "nx ny nz 3"]:
    """Where the corners of a field's grid lie [m]."""
    steps = np.moveaxis(np.indices(grid.index.shape, dtype=np.float32), 0, -1)
    return (grid.origin + np.float32(grid.voxel) * steps).astype(np.float32)


@torch.no_grad()
def baked_g(network: FieldNetwork, points: Float32[np.ndarray, "n 3"], voxel: float) -> Float32[np.ndarray, "n"]:
    """Density features as dense as a network, at points; EMPTY_G where that is next to nothing.

    Args:
        network: that is baked.
        points: in the object's frame [m].
        voxel: side of the voxels that get the features [m].
    """
    pieces = np.array_split(points, max(1, len(points) // _POINTS_AT_ONCE))
    parts = [network.density(torch.as_tensor(piece, device=network.device)).cpu() for piece in pieces]
    return inverse_density(torch.cat(parts).numpy() * np.float32(voxel))


def inverse_density(depth: Float32[np.ndarray, "n"]) -> Float32[np.ndarray, "n"]:
    """Solve for g: sigma * voxel = max(softplus(g) - softplus(FLOOR_G), 0), within the range of trained fields."""
    whole = np.clip(depth.astype(np.float64) + DENSITY_FLOOR, 1e-9, None)
    g = np.where(whole > 30, whole, np.log(np.expm1(np.minimum(whole, 30))))
    return np.where(depth < _FAINT_DEPTH, EMPTY_G, np.minimum(g, MOST_G)).astype(np.float32)


# Training an OSF from images by volume rendering: the first of the paper's three steps to a KiloOSF.
#
# Samples are proposed as `network_stage` tells.


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
    recipe = recipe or TeacherRecipe()
    teacher = first_teacher(train, box, recipe, rng, torch.device(config.device))
    osf = teacher.network
    assert isinstance(osf, OSF)
    source = RaySource(train)
    pixels = source.silhouette_pixels()
    budget = config.iterations or 60 * config.minutes
    began = reported = time.monotonic()
    loss, count, share = None, 0, 0.0
    yield TeacherStep(Progress(0, round(budget), "Learning"), loss, osf, teacher.snapshot())
    while share < 1:
        rays = source.batch(rng.choice(pixels, recipe.rays))
        loss = teacher.step(rays, share, rng, generator)
        count, now = count + 1, time.monotonic()
        share = min(1.0, (count if config.iterations else now - began) / budget)
        if now - reported > _REPORT_S:
            reported = now
            progress = Progress(round(share * budget), round(budget), f"Learning, step {count}")
            yield TeacherStep(progress, loss, osf, teacher.snapshot())
    look = NetworkHoldout(test, osf).everything(teacher.snapshot())
    words = f"{look.psnr_full:.2f} dB held out, {look.psnr_mask:.2f} dB in the mask, {count} steps"
    progress = Progress(round(budget), round(budget), words)
    yield TeacherStep(progress, loss, osf, teacher.snapshot(), look.psnr_full, look.psnr_mask)


def first_teacher(
    images: ImageSet, box: Float[np.ndarray, "2 3"], recipe: TeacherRecipe, rng: np.random.Generator,
    device: torch.device,
) -> NetworkStage:  # fmt: skip
    """A new network, and fog in the visual hull.

    Args:
        images: whose silhouettes carve the hull.
        box: of the object [m].
        recipe: how it learns.
        rng: draws the first weights.
        device: that computes.
    """
    fog = first_shell(images, box, across=recipe.across, cells=1, hidden=8, inside_g=FOG_G, rng=rng)
    weights = torch.Generator().manual_seed(int(rng.integers(2**62)))
    osf = OSF(fog.box, recipe.size, generator=weights, device=device)
    return NetworkStage(osf, fog, fog.index > 0, rates=recipe.rates, rebake=recipe.rebake)


def restored_teacher(
    proposal: KiloOSF, state: dict[str, Any], recipe: TeacherRecipe, device: torch.device
) -> NetworkStage:
    """Go on from a checkpoint.

    Args:
        proposal: as it was.
        state: what `NetworkStage.state` told.
        recipe: how it learns.
        device: that computes.
    """
    osf = OSF(proposal.box, recipe.size, device=device)
    osf.load_state_dict(state["network"])
    stage = NetworkStage(osf, proposal, state["hull"].numpy(), rates=recipe.rates, rebake=recipe.rebake)
    stage.restore(state)
    return stage
