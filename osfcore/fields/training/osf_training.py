"""Training an OSF from images by volume rendering: the first of the paper's three steps to a KiloOSF.

Samples are proposed as `network_stage` tells.
"""

from __future__ import annotations

import time
from collections.abc import Iterator
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any, Literal

import numpy as np
import torch
from jaxtyping import Float

from osfcore.errors import InvalidInput
from osfcore.fields.kiloosf import KiloOSF
from osfcore.fields.osf import OSF, OSFSize
from osfcore.fields.ray_sampling import RaySource
from osfcore.fields.training.network_stage import FOG_G, NetworkHoldout, NetworkStage
from osfcore.fields.training.optimization import Rates
from osfcore.fields.training.visual_hull import silhouette_box
from osfcore.fields.voxel_shell import first_shell
from osfcore.io.image_set import ImageSet, read_splits
from osfcore.progress import Progress

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
