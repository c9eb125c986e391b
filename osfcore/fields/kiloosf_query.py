"""Evaluating a KiloOSF at points, with gradients, on any device and in any dtype."""

from __future__ import annotations

from collections.abc import Sequence
from typing import NamedTuple

import numpy as np
import torch
from jaxtyping import Float, Int
from torch import Tensor, nn
from torch.nn import functional

from osfcore.fields.kiloosf import DENSITY_FLOOR, FEATURES, NETWORK_INPUTS, KiloOSF


class Scatter(NamedTuple):
    """A field at S points: rho = ambient + direct (paper eq. 1), kept apart for shadows.

    Attributes:
        ambient: part of rho that no shadow removes.
        direct: part of rho that the light causes.
        sigma: density [1/m].
    """

    ambient: Float[Tensor, "S 3"]
    direct: Float[Tensor, "S 3"]
    sigma: Float[Tensor, "S"]


class KiloQuery(nn.Module):
    """A KiloOSF as a PyTorch module, whose numbers are parameters."""

    row_units: Float[Tensor, "8"]
    low: Float[Tensor, "3"]
    cell_size: Float[Tensor, "3"]
    index: Int[Tensor, "corners"]
    cells: Int[Tensor, "cells"]
    corners: Int[Tensor, "8"]

    def __init__(
        self,
        field: KiloOSF,
        *,
        dtype: torch.dtype = torch.float32,
        device: torch.device | str = "cpu",
        row_units: Sequence[float] = (1.0,) * FEATURES,
    ) -> None:
        """Copy a field's numbers. The parameter `rows` is in units of `row_units`, which scales its training steps."""
        super().__init__()
        units = torch.tensor(row_units, dtype=dtype, device=device)
        self.register_buffer("row_units", units)

        def parameter(array: np.ndarray) -> nn.Parameter:
            return nn.Parameter(torch.as_tensor(array, dtype=dtype, device=device).clone())

        self.rows = parameter(field.rows / units.cpu().numpy())
        self.networks = parameter(field.networks)
        self.ambient = parameter(field.ambient)
        self.hidden, self.voxel = field.hidden, field.voxel
        self.shape, self.counts = field.index.shape, field.cells.shape
        low, high = (torch.as_tensor(corner, dtype=dtype, device=device) for corner in field.box)
        self.register_buffer("low", low)
        self.register_buffer("cell_size", (high - low) / torch.tensor(self.counts, dtype=dtype, device=device))
        self.register_buffer("index", torch.as_tensor(field.index.ravel(), device=device))
        self.register_buffer("cells", torch.as_tensor(field.cells.ravel(), device=device).long())
        _, ny, nz = self.shape
        corners = [(i * ny + j) * nz + k for i in (0, 1) for j in (0, 1) for k in (0, 1)]
        self.register_buffer("corners", torch.tensor(corners, device=device))

    @property
    def device(self) -> torch.device:
        """The device of its parameters."""
        return self.rows.device

    def to_field(self, grid: KiloOSF) -> KiloOSF:
        """Return the present numbers as a field on the grid and cells of `grid`."""

        def array(tensor: Tensor) -> np.ndarray:
            return tensor.detach().to("cpu", torch.float32).numpy().copy()

        rows, networks, ambient = array(self.rows * self.row_units), array(self.networks), array(self.ambient)
        return KiloOSF(grid.origin, grid.voxel, grid.index, rows, grid.cells, networks, grid.hidden, ambient)

    def features(self, x: Float[Tensor, "S 3"]) -> Float[Tensor, "S 8"]:
        """Interpolate features at points [m]. Points outside the grid's box are moved to its faces."""
        most = torch.tensor(self.shape, dtype=x.dtype, device=x.device) - 1.001
        p = torch.minimum(((x - self.low) / self.voxel).clamp(min=0), most)
        whole = p.floor()
        i, j, k = whole.long().unbind(-1)
        base = (i * self.shape[1] + j) * self.shape[2] + k
        rows = self.index[base[:, None] + self.corners]
        f = p - whole
        wx, wy, wz = torch.stack([1 - f, f], dim=-1).unbind(-2)
        weights = (wx[:, :, None, None] * wy[:, None, :, None] * wz[:, None, None, :]).reshape(-1, 8)
        return functional.embedding_bag(rows, self.rows, per_sample_weights=weights, mode="sum") * self.row_units

    def sigma(self, g: Float[Tensor, "*shape"]) -> Float[Tensor, "*shape"]:
        """Return the density [1/m] of the density feature."""
        return torch.relu(functional.softplus(g) - DENSITY_FLOOR) / self.voxel

    def density(self, x: Float[Tensor, "S 3"]) -> Float[Tensor, "S"]:
        """Return the density at points of the field's frame [1/m]; 0 outside the grid's box."""
        p = (x - self.low) / self.voxel
        most = torch.tensor(self.shape, dtype=x.dtype, device=x.device) - 1
        inside = ((p >= 0) & (p <= most)).all(dim=-1)
        return self.sigma(self.features(x)[:, 0]) * inside

    def forward(
        self,
        x: Float[Tensor, "S 3"],
        light: Float[Tensor, "S 3"],
        view: Float[Tensor, "S 3"],
        *,
        cell_jitter: float = 0.0,
        generator: torch.Generator | None = None,
    ) -> Scatter:
        """Evaluate the field (paper eq. 1).

        Args:
            x: points in the field's frame [m].
            light: unit vectors toward the light, in the field's frame.
            view: unit vectors from the camera into the scene, in the field's frame.
            cell_jitter: in training, how far beyond its own cell a network is evaluated [cells]. Neighbouring networks
                then agree at their border, so that relighting is smooth across it.
            generator: random generator of the jitter.
        """
        features = self.features(x)
        albedo, normal, latent = features[:, 1:4], features[:, 4:7], features[:, 7:]
        dipole = (normal * light).sum(dim=-1, keepdim=True)
        place = (x - self.low) / self.cell_size
        asked = place
        if cell_jitter:
            noise = torch.rand(place.shape, generator=generator, dtype=place.dtype, device=place.device)
            asked = place + (2 * noise - 1) * cell_jitter
        last = torch.tensor(self.counts, device=x.device) - 1
        cell = torch.minimum(asked.floor().clamp(min=0).long(), last)
        local = 2 * (place - cell) - 1
        number = self.cells[(cell[:, 0] * self.counts[1] + cell[:, 1]) * self.counts[2] + cell[:, 2]]
        inputs = torch.cat([dipole, latent, light, view, local], dim=-1)
        gain = torch.relu(dipole + self._run_networks(inputs, number))
        return Scatter(albedo * self.ambient, albedo * gain, self.sigma(features[:, 0]))

    def _run_networks(self, inputs: Float[Tensor, "S 11"], number: Int[Tensor, "S"]) -> Float[Tensor, "S 3"]:
        """Pass each input through its own tiny network: sorted, padded to equal counts, multiplied as a batch."""
        order = torch.argsort(number)
        asked, counts = torch.unique_consecutive(number[order], return_counts=True)
        if not len(asked):
            return inputs.new_zeros(0, 3)
        most = int(counts.max())
        slot = torch.repeat_interleave(torch.arange(len(asked), device=inputs.device) * most, counts)
        starts = torch.repeat_interleave(torch.cumsum(counts, 0) - counts, counts)
        slot = slot + torch.arange(len(order), device=inputs.device) - starts
        batch = inputs.new_zeros(len(asked) * most, NETWORK_INPUTS).index_copy(0, slot, inputs[order])
        a, networks, start = batch.view(len(asked), most, NETWORK_INPUTS), self.networks[asked], 0
        for rows, columns in ((NETWORK_INPUTS, self.hidden), (self.hidden, self.hidden), (self.hidden, 3)):
            end = start + rows * columns
            weights = networks[:, start:end].view(-1, rows, columns)
            a = torch.baddbmm(networks[:, end : end + columns].unsqueeze(1), a, weights)
            start = end + columns
            if start < networks.shape[1]:
                a = torch.relu(a)
        out = a.reshape(-1, 3)[slot]
        return torch.empty_like(out).index_copy(0, order, out)
