"""Evaluating a KiloOSF of tiny networks at points, with gradients; called like `osfcore.fields.osf.OSF`."""

from __future__ import annotations

from collections.abc import Iterator

import numpy as np
import torch
from jaxtyping import Bool, Float, Int
from torch import Tensor, nn
from torch.nn import functional

from osfcore.fields.kiloosf_query import Scatter
from osfcore.fields.osf import encoding
from osfcore.paper.fields.tiny_field import DIRECTION_OCTAVES, POSITION_OCTAVES, TinyField, layer_shapes


class TinyQuery(nn.Module):
    """A `TinyField` whose numbers are parameters."""

    low: Float[Tensor, "3"]
    cell_size: Float[Tensor, "3"]
    cells: Int[Tensor, "cells"]

    def __init__(self, field: TinyField, *, device: torch.device | str = "cpu") -> None:
        """Copy a field's numbers."""
        super().__init__()
        self.networks = nn.Parameter(torch.as_tensor(field.networks, device=device).clone())
        self.width, self.scale, self.counts = field.width, field.density_scale, field.cells.shape
        low, high = (torch.as_tensor(corner, device=device) for corner in field.box)
        self.register_buffer("low", low)
        self.register_buffer("cell_size", (high - low) / torch.tensor(self.counts, device=device))
        self.register_buffer("cells", torch.as_tensor(field.cells.ravel(), device=device).long())

    @property
    def device(self) -> torch.device:
        """Where it computes."""
        return self.networks.device

    def to_field(self, grid: TinyField, occupied: Bool[np.ndarray, "nx ny nz"] | None = None) -> TinyField:
        """The present numbers as a field on the grid of `grid`, with another occupancy if one is given."""
        networks = self.networks.detach().cpu().numpy().copy()
        kept = grid.occupied if occupied is None else occupied
        return TinyField(grid.origin, grid.voxel, kept, grid.cells, networks, grid.width)

    def density(self, x: Float[Tensor, "S 3"]) -> Float[Tensor, "S"]:
        """Density at points of the object's frame [1/m]; 0 in cells without a network."""
        return self._evaluate(x, None)[0]

    def forward(self, x: Float[Tensor, "S 3"], light: Float[Tensor, "S 3"], view: Float[Tensor, "S 3"]) -> Scatter:
        """Evaluate the field (paper eq. 1); all of rho counts as direct light.

        Args:
            x: points in the object's frame [m].
            light: unit vectors toward the light, in the object's frame.
            view: unit vectors from the camera into the scene, in the object's frame.
        """
        directions = torch.cat([encoding(d, DIRECTION_OCTAVES) for d in (light, view)], dim=-1)
        sigma, rho = self._evaluate(x, directions)
        return Scatter(torch.zeros_like(rho), rho, sigma)

    def _evaluate(
        self, x: Float[Tensor, "S 3"], directions: Float[Tensor, "S d"] | None
    ) -> tuple[Float[Tensor, "S"], Float[Tensor, "S 3"]]:
        """Density, and rho if directions are given."""
        place = (x - self.low) / self.cell_size
        last = torch.tensor(self.counts, device=x.device) - 1
        cell = torch.minimum(place.floor().clamp(min=0).long(), last)
        number = self.cells[(cell[:, 0] * self.counts[1] + cell[:, 1]) * self.counts[2] + cell[:, 2]]
        inside = ((place >= 0) & (place <= last + 1)).all(dim=-1) & (number >= 0)
        chosen = inside.nonzero()[:, 0]
        sigma, rho = x.new_zeros(len(x)), x.new_zeros(len(x), 3)
        if not len(chosen):
            return sigma, rho
        chosen = chosen[torch.argsort(number[chosen])]
        local = encoding(2 * (place[chosen] - cell[chosen]) - 1, POSITION_OCTAVES)
        out = self._run_sorted(number[chosen], local, None if directions is None else directions[chosen])
        sigma = sigma.index_copy(0, chosen, functional.softplus(out[:, 0]) * self.scale)
        if directions is not None:
            rho = rho.index_copy(0, chosen, torch.sigmoid(out[:, 1:]))
        return sigma, rho

    def _run_sorted(
        self, number: Int[Tensor, "S"], local: Float[Tensor, "S p"], directions: Float[Tensor, "S d"] | None
    ) -> Float[Tensor, "S o"]:
        """Each input through its own network: padded to equal counts and multiplied as a batch."""
        asked, counts = torch.unique_consecutive(number, return_counts=True)
        most = int(counts.max())
        starts = torch.repeat_interleave(torch.cumsum(counts, 0) - counts, counts)
        slot = torch.repeat_interleave(torch.arange(len(asked), device=number.device) * most, counts)
        slot = slot + torch.arange(len(number), device=number.device) - starts

        def batched(rows: Tensor) -> Tensor:
            flat = rows.new_zeros(len(asked) * most, rows.shape[1]).index_copy(0, slot, rows)
            return flat.view(len(asked), most, -1)

        layers = self._layers(self.networks[asked])
        h = torch.relu(_linear(batched(local), next(layers)))
        h = torch.relu(_linear(h, next(layers)))
        h = _linear(h, next(layers))
        out = h[..., self.width :]
        if directions is not None:
            h = torch.cat([h[..., : self.width], batched(directions)], dim=-1)
            h = torch.relu(_linear(h, next(layers)))
            out = torch.cat([out, _linear(h, next(layers))], dim=-1)
        return out.reshape(len(asked) * most, -1)[slot]

    def _layers(self, networks: Float[Tensor, "C P"]) -> Iterator[tuple[Tensor, Tensor]]:
        """Weights (C, inputs, outputs) and biases (C, 1, outputs) of each layer."""
        start = 0
        for inputs, outputs in layer_shapes(self.width):
            end = start + inputs * outputs
            yield networks[:, start:end].view(-1, inputs, outputs), networks[:, end : end + outputs].unsqueeze(1)
            start = end + outputs


def _linear(a: Float[Tensor, "C n i"], layer: tuple[Tensor, Tensor]) -> Float[Tensor, "C n o"]:
    weights, biases = layer
    return torch.baddbmm(biases, a, weights)
