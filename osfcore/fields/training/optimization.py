"""Gradient descent on a field from the pixels of an image set: one stage of training, step by step."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass
from functools import partial
from typing import Any

import numpy as np
import torch
from jaxtyping import Float
from torch import Tensor
from torch.nn import functional

from osfcore.fields.kiloosf import EMPTY_G, STEP_VOXELS, KiloOSF
from osfcore.fields.kiloosf_query import KiloQuery, Scatter
from osfcore.fields.ray_marching import march
from osfcore.fields.ray_sampling import RayBatch

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
