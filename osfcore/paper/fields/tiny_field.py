"""KiloOSF as published: a grid of tiny networks that give density and radiance transfer, and an occupancy grid.

As in KiloNeRF (Reiser et al. 2021), each cell of a regular grid over the object's box has a multilayer perceptron of
its own; as in OSFs (Yu et al. 2023) it reads the light as well. With p the point in its cell, in [-1, 1]^3:

    h     = relu(W2 relu(W1 enc(p)))
    sigma = DENSITY_GAIN * softplus(w_s h) / half of the box's longest side         [1 / unit of length]
    rho   = sigmoid(W5 relu(W4 [W3 h, enc(light), enc(view)]))                      paper eq. 1

Nothing but networks is stored: no voxel features, no albedo, no split of rho into an ambient and a direct part. Where
the occupancy grid has no voxel, nothing is asked. Readings of what the paper leaves open: positions are encoded in the
cell's own coordinates (with fewer octaves than a whole scene needs), and softplus stands in place of relu in sigma.
"""

from __future__ import annotations

from dataclasses import dataclass, field

import numpy as np
from jaxtyping import Bool, Float32, Int32, UInt8

from osfcore.fields.kiloosf import EMPTY_G, block_distances
from osfcore.fields.osf import DENSITY_GAIN

POSITION_OCTAVES = 6
DIRECTION_OCTAVES = 4
POSITION_INPUTS = 3 * (1 + 2 * POSITION_OCTAVES)
DIRECTION_INPUTS = 2 * 3 * (1 + 2 * DIRECTION_OCTAVES)  # light and view
MOST_WIDTH = 64
_SOLID_G = 1.0  # of an occupied corner; any number above the floor


def layer_shapes(width: int) -> tuple[tuple[int, int], ...]:
    """Inputs and outputs of each layer of a tiny network, in the order of its parameters."""
    return (
        (POSITION_INPUTS, width),
        (width, width),
        (width, width + 1),  # W3 and, in the last column, w_s
        (width + DIRECTION_INPUTS, width),
        (width, 3),
    )


def network_size(width: int) -> int:
    """Number of parameters of one tiny network: weights (inputs x outputs), then biases, layer by layer."""
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
    """Networks with first weights in every cell that holds something.

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
    parts = []
    for inputs, outputs in layer_shapes(width):
        bound = (6 / inputs) ** 0.5
        weights = rng.uniform(-bound, bound, (cells.max() + 1, inputs * outputs))
        parts += [weights, np.zeros((cells.max() + 1, outputs))]
    networks = np.concatenate(parts, axis=1).astype(np.float32)
    return TinyField(origin, voxel, occupied, cells, networks, width)


def _cells(occupied: Bool[np.ndarray, "nx ny nz"], across: int) -> Int32[np.ndarray, "cx cy cz"]:
    """Numbers for the cells of a grid that hold an occupied corner or touch one, -1 for the others."""
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
