"""Descent of a whole network on an image set, its samples proposed by a density grid that is baked from it.

The grid begins as fog in the visual hull of the silhouettes and is baked anew from the network every so often, so that
samples gather where the network has found surfaces; a rim of fog stays around them, so that they can still move. It is
what an occupancy grid is in KiloNeRF, and stands in place of NeRF's coarse network.
"""

from __future__ import annotations

from collections.abc import Iterator
from typing import Any, Protocol

import numpy as np
import torch
from jaxtyping import Bool, Float, Float32
from scipy import ndimage
from torch import Tensor, nn
from torch.nn import functional

from osfcore.fields.kiloosf import DENSITY_FLOOR, EMPTY_G, FEATURES, FLOOR_G, KiloOSF
from osfcore.fields.kiloosf_query import KiloQuery, Scatter
from osfcore.fields.ray_sampling import RayBatch
from osfcore.fields.training.optimization import Rates, composite
from osfcore.fields.training.validation import Holdout
from osfcore.fields.voxel_shell import shell_field
from osfcore.io.image_set import ImageSet

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
