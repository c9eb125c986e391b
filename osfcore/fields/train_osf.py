"""Training an OSF from images by volume rendering: the first of the paper's three steps to a KiloOSF.

This file holds the common parts of all trainings of fields: stages of gradient descent, measurements on unseen images,
checkpoints, and trainings of several stages.
"""

from __future__ import annotations

import time
from abc import ABC, abstractmethod
from collections.abc import Callable, Iterator, Mapping, Sequence
from dataclasses import asdict, dataclass, field, replace
from functools import partial
from pathlib import Path
from typing import Any, Literal, Protocol

import numpy as np
import torch
from jaxtyping import Bool, Float, Float32, UInt8
from scipy import ndimage
from torch import Tensor, nn
from torch.nn import functional

from osfcore.errors import CorruptFile, InvalidInput, check_seed
from osfcore.fields.kiloosf import DENSITY_FLOOR, EMPTY_G, FEATURES, FLOOR_G, KiloOSF
from osfcore.fields.kiloosf_query import KiloQuery, Scatter
from osfcore.fields.osf import OSF, OSFSize
from osfcore.fields.rays import RayBatch, RaySource, first_shell, reshelled
from osfcore.fields.volume_rendering import composite
from osfcore.io.checkpoint import going_on_from, read_content, write_checkpoint
from osfcore.io.files import write_atomically, write_json
from osfcore.io.image_file import to_uint8
from osfcore.io.image_set import ImageSet, read_splits
from osfcore.io.output_paths import check_weights_place
from osfcore.metrics.image_errors import dilated
from osfcore.progress import Progress

# Gradient descent on a field from the pixels of an image set: one stage of training, step by step.


# Step sizes of the features, relative to the learning rate: g spans tens, colours one.
_FEATURE_UNITS = (10.0, 1.0, 1.0, 1.0, 2.0, 2.0, 2.0, 2.0)
_NETWORK_RATE = 0.25
_CELL_JITTER = 0.25
_ALPHA_WEIGHT = 0.5
_MOST_DIPOLE = 1.5
_DENSITY_REFRESH = 8  # iterations between looks at where samples matter
_MOST_SAMPLES = 24  # along a ray
_MIN_WEIGHT = 1e-3  # of a sample
MOST_G = 10.0  # and least: a shorter range loses less when it is stored in 8 bits


@dataclass(frozen=True, slots=True)
class Rates:
    """Learning rates at the beginning and the end of a stage; exponential in between."""

    first: float
    last: float

    def at(self, share: float) -> float:
        """Return the rate when `share` in [0, 1] of the stage is done."""
        return self.first * (self.last / self.first) ** share


def descend(optimiser: torch.optim.Optimizer, loss: Float[Tensor, ""], *rates: float) -> float:
    """Take one step down the gradient of a loss, each group of parameters at its rate, and return the loss."""
    for group, rate in zip(optimiser.param_groups, rates, strict=True):
        group["lr"] = rate
    optimiser.zero_grad(set_to_none=True)
    loss.backward()
    optimiser.step()
    return float(loss.detach())


def _image_loss(
    query: Callable[[Tensor, Tensor, Tensor], Scatter], field: KiloOSF, rays: RayBatch, rng: np.random.Generator,
    most: int, device: torch.device,
) -> Float[Tensor, ""]:  # fmt: skip
    """Return the squared error of colours and opacities along rays; `rng` draws the offsets of the samples."""
    offsets = rng.random(len(rays.alpha), dtype=np.float32)
    rgb, alpha = composite(query, field, rays, offsets=offsets, min_weight=_MIN_WEIGHT, most=most, device=device)
    loss = functional.mse_loss(rgb, torch.as_tensor(rays.rgb, device=device)) * 3
    return loss + _ALPHA_WEIGHT * functional.mse_loss(alpha, torch.as_tensor(rays.alpha, device=device))


class Stage:
    """A field on a fixed grid during training."""

    def __init__(self, field: KiloOSF, rates: Rates, device: torch.device) -> None:
        """Begin with a field's numbers."""
        self.field = field
        self._rates = rates
        self.query = KiloQuery(field, device=device, row_units=_FEATURE_UNITS)
        groups = [{"params": [self.query.rows]}, {"params": [self.query.networks, self.query.ambient]}]
        self._optimiser = torch.optim.Adam(groups, betas=(0.9, 0.99), eps=1e-12, fused=True)
        self._count = 0

    def step(self, rays: RayBatch, share: float, rng: np.random.Generator, generator: torch.Generator) -> float:
        """Take one step of descent on the pixels of some rays.

        Args:
            rays: with the pixels' colours and opacities.
            share: share of the stage that is done, in [0, 1].
            rng: draws the offsets of the samples along the rays.
            generator: draws the jitter of the cells.

        Returns:
            The loss.
        """
        if self._count % _DENSITY_REFRESH == 0:
            self.field = self.snapshot()
        self._count += 1
        rate = self._rates.at(share)
        query = partial(self.query, cell_jitter=_CELL_JITTER, generator=generator)
        loss = _image_loss(query, self.field, rays, rng, _MOST_SAMPLES, self.query.device)
        found = descend(self._optimiser, loss, rate, rate * _NETWORK_RATE)
        rows = self.query.rows
        with torch.no_grad():
            rows[:, 0].clamp_(-MOST_G / _FEATURE_UNITS[0], MOST_G / _FEATURE_UNITS[0])
            rows[:, 1:4].clamp_(0, 1)
            rows[:, 4:].clamp_(-_MOST_DIPOLE / _FEATURE_UNITS[4], _MOST_DIPOLE / _FEATURE_UNITS[4])
            rows[0] = 0  # empty space is shared by all corners outside the shell and stays empty
            rows[0, 0] = EMPTY_G / _FEATURE_UNITS[0]
            self.query.ambient.clamp_(min=0)
        return found

    def snapshot(self) -> KiloOSF:
        """Return the field as it is now."""
        return self.query.to_field(self.field)

    def glance(self, images: ImageSet) -> Look:
        """Measure on a few of some images."""
        return Holdout(images).glance(self.snapshot())

    def state(self) -> dict[str, Any]:
        """Return what a checkpoint needs besides the field."""
        return {"optimiser": self._optimiser.state_dict(), "count": self._count}

    def restore(self, state: dict[str, Any]) -> None:
        """Go on from a checkpoint."""
        self._optimiser.load_state_dict(state["optimiser"])
        self._count = state["count"]


# Checkpoints of a training run, from which it continues exactly.


_ARRAYS = ("origin", "index", "rows", "cells", "networks", "ambient")


@dataclass(frozen=True, eq=False, slots=True)
class Checkpoint:
    """A run between two steps.

    Attributes:
        stage: name of the phase.
        field: the present field.
        optimiser: moments and step count of the optimiser.
        clock: time and steps so far, and the last measurements.
        random: states of the random generators.
    """

    stage: str
    field: KiloOSF
    optimiser: dict[str, Any]
    clock: dict[str, Any]
    random: dict[str, Any]

    def write(self, path: Path, fingerprint: Mapping[str, Any]) -> None:
        """Write the checkpoint. The former one stays until the new one is complete.

        Args:
            path: path of the file.
            fingerprint: settings and data of the run, which `read` compares.

        Raises:
            CannotWrite: if the disk refuses.
        """
        field = self.field
        arrays = {name: torch.from_numpy(np.ascontiguousarray(getattr(field, name))) for name in _ARRAYS}
        stored = {**arrays, "voxel": field.voxel, "hidden": field.hidden}
        rest = {name: getattr(self, name) for name in ("optimiser", "clock", "random")}
        write_checkpoint(path, dict(fingerprint), {"stage": self.stage, "field": stored, **rest})

    @staticmethod
    def read(path: Path, fingerprint: Mapping[str, Any]) -> Checkpoint | None:
        """Return the checkpoint of the same run; None if it is missing, truncated, or of other settings.

        Raises:
            CorruptFile: if it is of this run but cannot be used.
        """
        content = read_content(path, dict(fingerprint))
        if content is None:
            return None
        with going_on_from(path):
            stored = content["field"]
            arrays = {name: stored[name].numpy() for name in _ARRAYS}
            field = KiloOSF(voxel=stored["voxel"], hidden=stored["hidden"], **arrays)
            return Checkpoint(content["stage"], field, content["optimiser"], content["clock"], content["random"])


# Descent of a whole network on an image set. A density grid, which is baked from the network, proposes samples.
#
# The grid begins as fog in the visual hull of the silhouettes. It is regularly baked again from the network, so that
# samples gather at the surfaces that the network has found. A rim of fog stays around surfaces, so that they can still
# move. The grid corresponds to the occupancy grid of KiloNeRF, and replaces NeRF's coarse network.


FOG_G = -2.0  # about 0.06 of the light is lost between two samples
_NETWORK_SAMPLES = 40  # along a ray, in training
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
        """Return the density at points of the object's frame [1/m]."""
        ...

    def __call__(self, x: Float[Tensor, "S 3"], light: Float[Tensor, "S 3"], view: Float[Tensor, "S 3"]) -> Scatter:
        """Evaluate the field (paper eq. 1)."""
        ...

    def parameters(self) -> Iterator[nn.Parameter]:
        """Return what is learned."""
        ...

    def state_dict(self) -> dict[str, Any]:
        """Return all numbers."""
        ...


class NetworkStage:
    """A network during training, with the grid that proposes its samples.

    Args:
        network: network that is trained in place.
        proposal: density that decides where samples lie along a ray.
        hull: corners of the proposals' grid that may belong to the object.
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
        """Take one step of descent on the pixels of some rays.

        Args:
            rays: with the pixels' colours and opacities.
            share: share of the training that is done, in [0, 1].
            rng: draws the offsets of the samples along the rays.
            _generator: not needed here; the stages of a KiloOSF draw from it.

        Returns:
            The loss.
        """
        self._count += 1
        network = self.network
        loss = _image_loss(network, self._proposal, rays, rng, _NETWORK_SAMPLES, network.device)
        found = descend(self._optimiser, loss, self._rates.at(share) * min(1.0, self._count / _WARM_UP))
        if self._count % self._rebake == 0:
            self.update_proposal()
        return found

    def update_proposal(self) -> None:
        """Update the grid: samples where the network now has density, and a few around it."""
        grid = self._proposal
        g = np.full(grid.index.shape, EMPTY_G, np.float32)
        g[self._hull] = baked_g(self.network, corners(grid)[self._hull], grid.voxel)
        solid = g > FLOOR_G
        if not solid.any():  # nothing found yet: keep looking everywhere
            return
        rim = ndimage.binary_dilation(solid, iterations=_RIM_VOXELS)
        features = np.zeros((*g.shape, FEATURES), np.float32)
        features[..., 0] = np.where(rim, np.maximum(g, FOG_G), EMPTY_G)
        self._proposal = reshelled(grid, rim, features)

    def snapshot(self) -> KiloOSF:
        """Return the proposals, in which only the density is meaningful."""
        return self._proposal

    def glance(self, images: ImageSet) -> Look:
        """Measure on a few of some images."""
        return Holdout(images, self.network).glance(self._proposal)

    def state(self) -> dict[str, Any]:
        """Return what a checkpoint needs besides the proposals."""
        network, hull = self.network.state_dict(), torch.from_numpy(self._hull)
        return {"network": network, "adam": self._optimiser.state_dict(), "count": self._count, "hull": hull}

    def restore(self, state: dict[str, Any]) -> None:
        """Continue from a checkpoint. The constructor receives the network and the proposals."""
        self._optimiser.load_state_dict(state["adam"])
        self._count = state["count"]


def corners(grid: KiloOSF) -> Float32[np.ndarray, "nx ny nz 3"]:
    """Return the positions of the corners of a field's grid [m]."""
    steps = np.moveaxis(np.indices(grid.index.shape, dtype=np.float32), 0, -1)
    return (grid.origin + np.float32(grid.voxel) * steps).astype(np.float32)


@torch.no_grad()
def baked_g(network: FieldNetwork, points: Float32[np.ndarray, "n 3"], voxel: float) -> Float32[np.ndarray, "n"]:
    """Return density features with the density of a network at points; EMPTY_G if it is almost 0.

    Args:
        network: network to bake.
        points: points in the object's frame [m].
        voxel: side of the voxels with the features [m].
    """
    pieces = np.array_split(points, max(1, len(points) // _POINTS_AT_ONCE))
    parts = [network.density(torch.as_tensor(piece, device=network.device)).cpu() for piece in pieces]
    return inverse_density(torch.cat(parts).numpy() * np.float32(voxel))


def inverse_density(depth: Float32[np.ndarray, "n"]) -> Float32[np.ndarray, "n"]:
    """Solve for g: sigma * voxel = max(softplus(g) - softplus(FLOOR_G), 0), within the range of trained fields."""
    whole = np.clip(depth.astype(np.float64) + DENSITY_FLOOR, 1e-9, None)
    g = np.where(whole > 30, whole, np.log(np.expm1(np.minimum(whole, 30))))
    return np.where(depth < _FAINT_DEPTH, EMPTY_G, np.minimum(g, MOST_G)).astype(np.float32)


# Measurements of a field or a network on images that it was not trained on.


_GLANCE_IMAGES = 6
_DIFFERENCE_GAIN = 4
_MIN_ERROR = 1e-10  # 100 dB


@dataclass(frozen=True, eq=False, slots=True)
class Look:
    """A measurement.

    Attributes:
        psnr_full: mean over images of the PSNR of the whole image over black [dB].
        psnr_mask: mean over images of the PSNR inside the silhouette, dilated by 2 px [dB].
        images: number of images.
        preview: one of them, always the same, in bright light: truth, rendering, difference x 4.
    """

    psnr_full: float
    psnr_mask: float
    images: int
    preview: UInt8[np.ndarray, "h w3 3"]


class Holdout:
    """The test images of an image set.

    Args:
        images: the images. Their pixels are not copied.
        network: network to measure, for which fields propose samples; None to measure the fields themselves.
    """

    def __init__(self, images: ImageSet, network: FieldNetwork | None = None) -> None:
        self._images, self._source, self._network = images, RaySource(images), network
        self._min_weight, self._most = (1e-5, 192) if network is None else (1e-4, 256)
        some = self._some(_GLANCE_IMAGES)
        brightness = (images.rgba[some, ..., :3] * (images.rgba[some, ..., 3:] > 0)).sum(axis=(1, 2, 3))
        self._shown = some[int(np.argmax(brightness))]

    def glance(self, field: KiloOSF) -> Look:
        """Measure on a few images."""
        return self._look(field, self._some(_GLANCE_IMAGES))

    def everything(self, field: KiloOSF) -> Look:
        """Measure on all images."""
        return self._look(field, range(len(self._images.cameras)))

    def beside(self, fields: Sequence[KiloOSF], count: int = 3) -> UInt8[np.ndarray, "h w 3"]:
        """Return a few images below each other: the truth, and beside it the rendering of each field."""
        rows = []
        for number in self._some(count):
            pairs = [self._pair(self._query(field), field, number) for field in fields]
            rows.append(np.hstack([pairs[0][0], *(ours for _, ours in pairs)]))
        return to_uint8(np.vstack(rows))

    def _some(self, count: int) -> list[int]:
        """Return images spread evenly over the split."""
        return np.unique(np.linspace(0, len(self._images.cameras) - 1, count).astype(int)).tolist()

    def _look(self, field: KiloOSF, numbers: Sequence[int]) -> Look:
        query = self._query(field)
        full, inside, preview = [], [], np.zeros((1, 3, 3))
        for number in numbers:
            truth, ours = self._pair(query, field, number)
            error = np.mean((truth - ours) ** 2, axis=-1)
            full.append(_decibels(error))
            inside.append(_decibels(error[dilated(self._images.rgba[number, ..., 3] > 0)]))
            if number == self._shown:
                preview = np.hstack([truth, ours, _DIFFERENCE_GAIN * np.abs(truth - ours)])
        return Look(float(np.mean(full)), float(np.mean(inside)), len(full), to_uint8(preview))

    def _query(self, field: KiloOSF) -> FieldNetwork:
        return KiloQuery(field) if self._network is None else self._network

    @torch.no_grad()
    def _pair(self, query: FieldNetwork, field: KiloOSF, number: int) -> tuple[np.ndarray, np.ndarray]:
        """Return the truth and the rendering of one image over black."""
        rays = self._source.batch(self._source.image_pixels(number))
        colour, _ = composite(query, field, rays, min_weight=self._min_weight, most=self._most, device=query.device)
        shape = (*self._source.image_shape, 3)
        return rays.rgb.reshape(shape), np.clip(colour.cpu().numpy(), 0, 1).reshape(shape)


def _decibels(squared_error: Float[np.ndarray, "*shape"]) -> float:
    """Return the PSNR of values in [0, 1] [dB]; at most 100 dB."""
    return float(-10 * np.log10(max(float(np.mean(squared_error)), _MIN_ERROR)))


# The teacher: an OSF that learns from images, with samples proposed by a grid as above.


@dataclass(frozen=True, slots=True)
class TeacherRecipe:
    """Settings of a teacher's training.

    Attributes:
        size: size of its network.
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


def first_teacher(
    images: ImageSet, box: Float[np.ndarray, "2 3"], recipe: TeacherRecipe, rng: np.random.Generator,
    device: torch.device,
) -> NetworkStage:  # fmt: skip
    """Draw a new network, and fill the visual hull with fog.

    Args:
        images: images whose silhouettes carve the hull.
        box: box of the object [m].
        recipe: settings of its training.
        rng: random generator of the initial weights.
        device: PyTorch device.
    """
    fog = first_shell(images, box, across=recipe.across, cells=1, hidden=8, inside_g=FOG_G, rng=rng)
    weights = torch.Generator().manual_seed(int(rng.integers(2**62)))
    osf = OSF(fog.box, recipe.size, generator=weights, device=device)
    return NetworkStage(osf, fog, fog.index > 0, rates=recipe.rates, rebake=recipe.rebake)


def restored_teacher(
    proposal: KiloOSF, state: dict[str, Any], recipe: TeacherRecipe, device: torch.device
) -> NetworkStage:
    """Continue from a checkpoint.

    Args:
        proposal: the proposals in the checkpoint.
        state: the result of `NetworkStage.state`.
        recipe: settings of its training.
        device: PyTorch device.
    """
    osf = OSF(proposal.box, recipe.size, device=device)
    osf.load_state_dict(state["network"])
    stage = NetworkStage(osf, proposal, state["hull"].numpy(), rates=recipe.rates, rebake=recipe.rebake)
    stage.restore(state)
    return stage


# A whole training: phases that share a budget, and a checkpoint beside the output from which a killed run continues.


_LOOK_SHARE = 0.05  # of the budget between two looks at held-out images
_MIN_LOOK_S = 5.0
_METRICS = ("psnr_full", "psnr_mask")  # by which a file of metrics is known


@dataclass(frozen=True, slots=True)
class FieldSettings:
    """Settings of every training of a field.

    Attributes:
        data: image set in the OSF format, with `train` to learn from and `test` to measure on.
        out: file to write, FILE.safetensors. Metrics go beside it to FILE.json.
        minutes: time budget of the descent [min].
        device: "auto", "cpu" or "cuda".
        seed: seed of everything random.
        iterations: number of steps instead of the time budget; the result is then repeatable on one machine.
        teacher_width: units of each layer of the teacher.
        teacher_depth: layers of the teacher.
    """

    data: Path
    out: Path
    minutes: float = 30.0
    device: Literal["auto", "cpu", "cuda"] = "auto"
    seed: int = 0
    iterations: int | None = None
    teacher_width: int = 64
    teacher_depth: int = 4

    @property
    def total(self) -> int:
        """Number of steps of descent, or the time budget [s]."""
        return self.iterations or max(1, round(self.minutes * 60))

    def check(self) -> None:
        """Check the ranges and the output.

        Raises:
            InvalidInput: if a value is out of range, or another program's file lies in place of the metrics.
            CannotWrite: if the output cannot be written.
        """
        if not 0.05 <= self.minutes <= 24 * 60:
            raise InvalidInput("minutes", self.minutes, "between 0.05 and 1440")
        if self.iterations is not None and not 10 <= self.iterations <= 10_000_000:
            raise InvalidInput("iterations", self.iterations, "between 10 and 10,000,000")
        OSFSize(self.teacher_depth, self.teacher_width)  # refuses what cannot be built
        check_seed(self.seed)
        check_weights_place(self.out, _METRICS)

    def images(self) -> tuple[ImageSet, ImageSet]:
        """Read the images to learn from, and those to measure on.

        Raises:
            CorruptFile: if the image set is damaged, or shows no object.
        """
        train, test = read_splits(self.data)
        if train.is_opaque:
            expected = "an object before a transparent background is expected (opaque sets show the bare table)"
            raise CorruptFile(self.data, f"its images are opaque all over; {expected}")
        return train, test


@dataclass(frozen=True, slots=True)
class Pace:
    """How often a training reports. It does not change the result.

    Attributes:
        report_s: time between two reports [s].
        checkpoint_s: time between two checkpoints [s].
        clock: function that returns the time for both and for the budget [s].
    """

    report_s: float = 1.0
    checkpoint_s: float = 20.0
    clock: Callable[[], float] = time.monotonic


@dataclass(frozen=True, eq=False, slots=True)
class FieldStep:
    """Progress of a training.

    Attributes:
        progress: seconds of the budget (or steps), with PSNR and time left in words.
        psnr_full: PSNR on held-out images, over black [dB]; None until measured.
        psnr_mask: PSNR inside the silhouettes, dilated by 2 px [dB]; None until measured.
        preview: one held-out image: truth, rendering, difference x 4; None between measurements.
    """

    progress: Progress
    psnr_full: float | None = None
    psnr_mask: float | None = None
    preview: UInt8[np.ndarray, "h w3 3"] | None = None


class Learner(Protocol):
    """One phase of a training between its steps."""

    def step(self, rays: RayBatch, share: float, rng: np.random.Generator, generator: torch.Generator, /) -> float:
        """Take one step of descent when `share` in [0, 1] of the phase is done, and return the loss."""
        ...

    def snapshot(self) -> KiloOSF:
        """Return the field as it is now."""
        ...

    def glance(self, images: ImageSet, /) -> Look | None:
        """Measure on a few of some images; None if there is nothing to show."""
        ...

    def state(self) -> dict[str, Any]:
        """Return what a checkpoint needs besides the field."""
        ...


class FieldTraining(ABC):
    """A training of a field from images; subclasses say in which phases.

    Args:
        settings: what is asked for.
        recipe: how the field learns; it belongs to what a checkpoint must agree with.
        pace: how often to report.
        device: that computes.
        train: images to learn from.
        test: images to measure on.
    """

    phases: Mapping[str, tuple[float, str]]  # when each ends [share of the budget], and what is reported before it

    def __init__(
        self, settings: FieldSettings, recipe: Mapping[str, Any], pace: Pace, device: torch.device,
        train: ImageSet, test: ImageSet,
    ) -> None:  # fmt: skip
        self._settings, self._pace, self.device = settings, pace, device
        self.train, self.test, self._source = train, test, RaySource(train)
        self._pixels = self._source.silhouette_pixels()
        self.rng = np.random.default_rng(settings.seed)
        self._generator = torch.Generator(device).manual_seed(settings.seed)
        self._clock: dict[str, Any] = {"seconds": 0.0, "steps": 0, "looked_at": 0.0, "psnr": None}
        self._checkpoint_path = settings.out.with_suffix(".partial")
        asked = {**asdict(settings), "data": str(settings.data.resolve()), "out": str(settings.out)}
        digests = [train.digest(), test.digest()]
        self._fingerprint = {"settings": asked, "recipe": dict(recipe), "images": digests}

    @abstractmethod
    def rays(self, phase: str) -> int:
        """Return the pixels per step of descent."""

    @abstractmethod
    def begun(self, phase: str, before: Learner | None) -> Learner:
        """Return the learner of a phase from that of the phase before, which is None before the first."""

    @abstractmethod
    def resumed(self, saved: Checkpoint) -> Learner:
        """Return the learner that a checkpoint holds."""

    @abstractmethod
    def finished(self, learner: Learner) -> tuple[bytes, Look, dict[str, Any]]:
        """Return the file of the field, what users will see of it on all held-out images, and further metrics."""

    def steps(self) -> Iterator[FieldStep]:
        """Descend phase by phase, from the checkpoint of a killed run if there is one, and write the field."""
        saved = Checkpoint.read(self._checkpoint_path, self._fingerprint)
        names, first, learner = list(self.phases), 0, None
        if saved is not None:
            with going_on_from(self._checkpoint_path):
                first, learner = names.index(saved.stage), self.resumed(saved)
                self._clock = {name: saved.clock[name] for name in self._clock}
                self.rng.bit_generator.state = saved.random["numpy"]
                self._generator.set_state(saved.random["torch"])
            yield self._report("Going on from a checkpoint")
        ends = [0.0, *(end for end, _ in self.phases.values())]
        for number, name in list(enumerate(names))[first:]:
            if learner is None or number > first:
                yield self._report(self.phases[name][1])
                learner = self.begun(name, learner)
                if number:
                    self._save(name, learner)
            yield from self._descend(name, learner, ends[number], ends[number + 1])
        assert learner is not None, "there is at least one phase"
        yield self._report("Measuring on all held-out images")
        yield self._finish(learner)

    def _descend(self, name: str, learner: Learner, start: float, end: float) -> Iterator[FieldStep]:
        clock, already = self._pace.clock, self._clock["seconds"]
        began = reported = saved = clock()
        while (share := self._share()) < end:
            rays = self._source.batch(self.rng.choice(self._pixels, self.rays(name)))
            learner.step(rays, (share - start) / (end - start), self.rng, self._generator)
            now = clock()
            self._clock |= {"steps": self._clock["steps"] + 1, "seconds": already + now - began}
            if now - reported > self._pace.report_s:
                reported = now
                yield self._look(learner)
            if now - saved > self._pace.checkpoint_s:
                saved = now
                self._save(name, learner)
            began += clock() - now  # looking and saving cost nobody's budget

    def _share(self) -> float:
        """Return the share of the whole budget that is used up."""
        if self._settings.iterations is not None:
            return min(1.0, self._clock["steps"] / self._settings.iterations)
        return min(1.0, self._clock["seconds"] / (60 * self._settings.minutes))

    def _look(self, learner: Learner) -> FieldStep:
        look, seconds = None, self._clock["seconds"]
        if seconds - self._clock["looked_at"] > max(_MIN_LOOK_S, _LOOK_SHARE * 60 * self._settings.minutes):
            look = learner.glance(self.test)
            if look is not None:
                self._clock |= {"looked_at": seconds, "psnr": (look.psnr_full, look.psnr_mask)}
        share, psnr = self._share(), self._clock["psnr"]
        minutes, rest = divmod(round(seconds * (1 / share - 1) if share else 0.0), 60)
        quality = f"{psnr[0]:.1f} dB held out ({psnr[1]:.1f} in the mask), " if psnr else ""
        left = f"{minutes} min {rest} s" if minutes else f"{rest} s"
        return replace(self._report(f"{quality}{left} left"), preview=None if look is None else look.preview)

    def _report(self, words: str) -> FieldStep:
        full, mask = self._clock["psnr"] or (None, None)
        return FieldStep(Progress(round(self._share() * self._settings.total), self._settings.total, words), full, mask)

    def _save(self, name: str, learner: Learner) -> None:
        random = {"numpy": self.rng.bit_generator.state, "torch": self._generator.get_state()}
        checkpoint = Checkpoint(name, learner.snapshot(), learner.state(), dict(self._clock), random)
        checkpoint.write(self._checkpoint_path, self._fingerprint)

    def _finish(self, learner: Learner) -> FieldStep:
        """Write the field once it is known to be sound, and its metrics beside it."""
        settings = self._settings
        data, look, further = self.finished(learner)
        metrics = {
            "psnr_full": round(look.psnr_full, 3),
            "psnr_mask": round(look.psnr_mask, 3),
            "test_images": look.images,
            "bytes": len(data),
            "minutes": round(self._clock["seconds"] / 60, 3),
            "iterations": self._clock["steps"],
            "seed": settings.seed,
            "device": str(self.device),
            "threads": torch.get_num_threads(),
            "data": settings.data.name,
            "train_images": len(self.train.cameras),
            "image_size": list(self._source.image_shape),
            **further,
        }
        write_atomically(settings.out, data)
        write_json(settings.out.with_suffix(".json"), metrics)
        self._checkpoint_path.unlink(missing_ok=True)
        words = f"{look.psnr_full:.2f} dB held out, {look.psnr_mask:.2f} dB in the mask, {len(data) / 1e6:.2f} MB"
        progress = Progress(settings.total, settings.total, words)
        return FieldStep(progress, look.psnr_full, look.psnr_mask, look.preview)
