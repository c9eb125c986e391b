"""KiloOSF as published: a grid of tiny networks that give density and radiance transfer, with an occupancy grid."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass, field
from pathlib import Path

import numpy as np
import torch
from jaxtyping import Bool, Float, Float32, Int, Int32, UInt8
from safetensors.numpy import save
from torch import Tensor, nn
from torch.nn import functional

from osfcore.errors import CorruptFile, shown
from osfcore.fields.kiloosf import EMPTY_G, block_distances, read_tensors, tensors_from_bytes
from osfcore.fields.kiloosf_query import Scatter
from osfcore.fields.osf import DENSITY_GAIN, encoding

# KiloOSF as published: a grid of tiny networks that give density and radiance transfer, and an occupancy grid.
#
# As in KiloNeRF (Reiser et al. 2021), each cell of a regular grid over the object's box has a multilayer perceptron
# of its own; as in OSFs (Yu et al. 2023) it reads the light as well. With p the point in its cell, in [-1, 1]^3:
#
#     h     = relu(W2 relu(W1 enc(p)))
#     sigma = DENSITY_GAIN * softplus(w_s h) / half of the box's longest side         [1 / unit of length]
#     rho   = sigmoid(W5 relu(W4 [W3 h, enc(light), enc(view)]))                      paper eq. 1
#
# Nothing but networks is stored: no voxel features, no albedo, no split of rho into an ambient and a direct part.
# Where the occupancy grid has no voxel, nothing is asked. Readings of what the paper leaves open: positions are
# encoded in the cell's own coordinates (with fewer octaves than a whole scene needs), and softplus stands in place
# of relu in sigma.


POSITION_OCTAVES = 6
DIRECTION_OCTAVES = 4
POSITION_INPUTS = 3 * (1 + 2 * POSITION_OCTAVES)
DIRECTION_INPUTS = 2 * 3 * (1 + 2 * DIRECTION_OCTAVES)  # light and view
MOST_WIDTH = 64
_SOLID_G = 1.0  # of an occupied corner; any number above the floor


def layer_shapes(width: int) -> tuple[tuple[int, int], ...]:
    """Return inputs and outputs of each layer of a tiny network, in the order of its parameters."""
    return (
        (POSITION_INPUTS, width),
        (width, width),
        (width, width + 1),  # W3 and, in the last column, w_s
        (width + DIRECTION_INPUTS, width),
        (width, 3),
    )


def network_size(width: int) -> int:
    """Return the number of parameters of one tiny network: weights (inputs x outputs), then biases, layer by layer."""
    return sum((inputs + 1) * outputs for inputs, outputs in layer_shapes(width))


@dataclass(frozen=True, eq=False, slots=True)
class TinyField:
    """A trained field in its object's frame [m].

    Attributes:
        origin: corner (0, 0, 0) of the occupancy grid [m].
        voxel: side of its voxels [m].
        occupied: corners of the grid with density.
        cells: number of the network of each cell, -1 where there is none; cells divide the grid's box evenly.
        networks: parameters of C networks.
        width: units of their layers.
        macro: how far blocks of voxels are from occupied ones (`kiloosf.block_distances`); derived.
    """

    origin: Float32[np.ndarray, "3"]
    voxel: float
    occupied: Bool[np.ndarray, "nx ny nz"]
    cells: Int32[np.ndarray, "cx cy cz"]
    networks: Float32[np.ndarray, "C P"]
    width: int
    macro: UInt8[np.ndarray, "bx by bz"] = field(init=False)

    def __post_init__(self) -> None:
        """Derive what marching looks at."""
        object.__setattr__(self, "macro", block_distances(self.density))

    @property
    def density(self) -> Float32[np.ndarray, "nx ny nz"]:
        """The occupancy as density features, for code that looks for empty space in those."""
        return np.where(self.occupied, np.float32(_SOLID_G), np.float32(EMPTY_G))

    @property
    def box(self) -> Float32[np.ndarray, "2 3"]:
        """Lowest and highest corner of the grid [m]."""
        size = self.voxel * (np.array(self.occupied.shape, np.float32) - 1)
        return np.stack([self.origin, self.origin + size]).astype(np.float32)

    @property
    def extent(self) -> Float32[np.ndarray, "2 3"]:
        """Lowest and highest corner of the occupied part of the grid [m]."""
        solid = np.argwhere(self.occupied)
        if not len(solid):
            return self.box
        return (self.origin + self.voxel * np.stack([solid.min(axis=0), solid.max(axis=0)])).astype(np.float32)

    @property
    def density_scale(self) -> float:
        """DENSITY_GAIN / half of the box's longest side [1/m]."""
        return DENSITY_GAIN / float(np.ptp(self.box, axis=0).max() / 2)


def first_field(
    origin: Float32[np.ndarray, "3"],
    voxel: float,
    occupied: Bool[np.ndarray, "nx ny nz"],
    *,
    across: int,
    width: int,
    most_networks: int,
    rng: np.random.Generator,
) -> TinyField:
    """Return networks with first weights in every cell that holds something.

    Args:
        origin: corner (0, 0, 0) of the occupancy grid [m].
        voxel: side of its voxels [m].
        occupied: corners of the grid with density.
        across: cells along the longest side; fewer if there would be more than `most_networks`.
        width: units of the networks' layers.
        most_networks: so that the file stays small.
        rng: draws the weights (He et al. 2015, uniform).
    """
    cells = _cells(occupied, across)
    while cells.max() >= most_networks and across > 1:
        across -= 1
        cells = _cells(occupied, across)
    parts, count = [], cells.max() + 1
    for inputs, outputs in layer_shapes(width):
        bound = (6 / inputs) ** 0.5
        parts += [rng.uniform(-bound, bound, (count, inputs * outputs)), np.zeros((count, outputs))]
    networks = np.concatenate(parts, axis=1).astype(np.float32)
    return TinyField(origin, voxel, occupied, cells, networks, width)


def _cells(occupied: Bool[np.ndarray, "nx ny nz"], across: int) -> Int32[np.ndarray, "cx cy cz"]:
    """Return numbers for the cells of a grid that hold an occupied corner or touch one, -1 for the others."""
    spans = np.array(occupied.shape) - 1
    counts = np.maximum(np.round(across * spans / spans.max()), 1).astype(int)
    holds = np.zeros(counts, bool)
    places = np.argwhere(occupied) / spans * counts  # in cells
    reach = counts / spans  # one voxel: between an occupied corner and an empty one there may be density
    for sign in np.stack(np.meshgrid(*[(-1, 0, 1)] * 3), axis=-1).reshape(-1, 3):
        where = np.clip(np.floor(places + sign * reach), 0, counts - 1).astype(int)
        holds[tuple(where.T)] = True
    cells = np.full(counts, -1, np.int32)
    cells[holds] = np.arange(holds.sum(), dtype=np.int32)
    return cells


# Evaluating a KiloOSF of tiny networks at points, with gradients; called like `osfcore.fields.osf.OSF`.


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

    def to_field(self, grid: TinyField, occupied: Bool[np.ndarray, "nx ny nz"]) -> TinyField:
        """Return the present numbers as a field with the grid and cells of another, and its own occupancy."""
        networks = self.networks.detach().cpu().numpy().copy()
        return TinyField(grid.origin, grid.voxel, occupied, grid.cells, networks, grid.width)

    def density(self, x: Float[Tensor, "S 3"]) -> Float[Tensor, "S"]:
        """Return the density at points of the object's frame [1/m]; 0 in cells without a network."""
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
        """Return the density, and rho if directions are given."""
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
        """Put each input through its own network: they are padded to equal counts and multiplied as a batch."""
        asked, counts = torch.unique_consecutive(number, return_counts=True)
        most = int(counts.max())
        starts = torch.repeat_interleave(torch.cumsum(counts, 0) - counts, counts)
        slot = torch.repeat_interleave(torch.arange(len(asked), device=number.device) * most, counts)
        slot = slot + torch.arange(len(number), device=number.device) - starts

        def batched(rows: Tensor) -> Tensor:
            flat = rows.new_zeros(len(asked) * most, rows.shape[1]).index_copy(0, slot, rows)
            return flat.view(len(asked), most, -1)

        networks, shapes = self.networks[asked], layer_shapes(self.width)
        starts = np.cumsum([0, *((inputs + 1) * outputs for inputs, outputs in shapes)]).tolist()

        def linear(layer: int, a: Float[Tensor, "C n i"]) -> Float[Tensor, "C n o"]:
            inputs, outputs = shapes[layer]
            bias = starts[layer] + inputs * outputs
            weights = networks[:, starts[layer] : bias].view(-1, inputs, outputs)
            return torch.baddbmm(networks[:, bias : starts[layer + 1]].unsqueeze(1), a, weights)

        h = torch.relu(linear(0, batched(local)))
        h = linear(2, torch.relu(linear(1, h)))
        out = h[..., self.width :]
        if directions is not None:
            h = torch.relu(linear(3, torch.cat([h[..., : self.width], batched(directions)], dim=-1)))
            out = torch.cat([out, linear(4, h)], dim=-1)
        return out.reshape(len(asked) * most, -1)[slot]


# Files of KiloOSFs as published: safetensors with half-precision networks, checked when read.


FORMAT = "paper-kiloosf-1"
_MOST_CORNERS = 20_000_000


def field_bytes(field: TinyField) -> bytes:
    """Return a field as the contents of a file."""
    tensors = {
        "origin": field.origin,
        "voxel": np.array([field.voxel], np.float32),
        "shape": np.array(field.occupied.shape, np.int32),
        "occupied": np.packbits(field.occupied),
        "cells": field.cells.astype(np.int16),
        "networks": field.networks.astype(np.float16),
    }
    return save(tensors, metadata={"format": FORMAT, "width": str(field.width)})


def read_field(path: Path) -> TinyField:
    """Read a field.

    Raises:
        CorruptFile: if the file is missing, cut short, of another version or not such a field.
    """
    return _field(read_tensors(path, FORMAT), path)


def field_from_bytes(data: bytes, where: Path | str) -> TinyField:
    """Return a field from the contents of a file.

    Args:
        data: as `field_bytes` makes them.
        where: what messages name.

    Raises:
        CorruptFile: if they are cut short, of another version or not such a field.
    """
    return _field(tensors_from_bytes(data, FORMAT, where), where)


def _field(content: tuple[Mapping[str, str], Mapping[str, np.ndarray]], where: Path | str) -> TinyField:
    meta, tensors = content
    try:
        return _parsed(int(meta["width"]), tensors)
    except (KeyError, ValueError, IndexError, TypeError, OverflowError) as error:
        raise CorruptFile(where, f"it is not a sound field ({shown(error)})") from error


def _parsed(width: int, tensors: Mapping[str, np.ndarray]) -> TinyField:
    shape = tuple(int(n) for n in tensors["shape"])
    if len(shape) != 3 or min(shape) < 2 or np.prod(shape) > _MOST_CORNERS:
        raise ValueError(f"shape {shape}")
    occupied = np.unpackbits(tensors["occupied"], count=int(np.prod(shape))).astype(bool).reshape(shape)
    cells, networks = tensors["cells"].astype(np.int32), tensors["networks"].astype(np.float32)
    if not 1 <= width <= MOST_WIDTH or networks.shape != (len(networks), network_size(width)):
        raise ValueError(f"networks {networks.shape} of width {width}, at most {MOST_WIDTH}")
    if cells.ndim != 3 or cells.min(initial=-1) < -1 or cells.max(initial=-1) >= len(networks):
        raise ValueError(f"{len(networks)} networks for cells {cells.shape}")
    origin, voxel = tensors["origin"].astype(np.float32), float(tensors["voxel"][0])
    if origin.shape != (3,) or not np.all(np.isfinite(origin)) or not np.all(np.isfinite(networks)):
        raise ValueError("it has values that are not finite")
    if not 1e-9 < voxel < 1e9:
        raise ValueError(f"a voxel of {voxel:g}")
    return TinyField(origin, voxel, occupied, cells, networks, width)
