"""KiloOSF: one object's relightable scattering function, as a voxel shell and a grid of tiny networks.

f(x, light direction, view direction) -> (rho, sigma), paper eq. 1. A point's features are interpolated between the
eight corners of its voxel; the tiny network of its cell turns them, the light and the view into the direct light it
scatters:

    sigma = max(softplus(g) - softplus(FLOOR), 0) / voxel                       [1 / unit of length]
    rho   = albedo * (ambient + max(n . l + network(n . l, latent, l, v, position in the cell), 0))

with g, albedo, n and latent the features. Deviations from the paper, each measured in docs/fields.md: density,
reflectance and a dipole (n) live in voxels and not in the networks, so that occupied space, silhouettes and shadows
need no network; the ambient part of rho is kept apart, so that a shadow can remove the direct part alone.
"""

from __future__ import annotations

from dataclasses import dataclass, field, replace

import numpy as np
from jaxtyping import Float32, Int32, UInt8
from scipy import ndimage

FEATURES = 8  # g, albedo (3), n (3), latent
NETWORK_INPUTS = 11  # n . l, latent, l (3), v (3), position in the cell (3)
EMPTY_G = -10.0  # of row 0, which every corner outside the shell shares
FLOOR_G = -6.0  # at and below it the density is exactly 0
DENSITY_FLOOR = float(np.log1p(np.exp(FLOOR_G)))
STEP_VOXELS = 0.5  # distance between samples along a ray, in training and in exact rendering
MOST_HIDDEN = 64  # width of the tiny networks
MACRO_BITS = 2
MACRO = 1 << MACRO_BITS  # side of the blocks that tell occupied from empty space [voxels]


def network_size(hidden: int) -> int:
    """Number of parameters of one tiny network: two hidden layers, three outputs."""
    return (NETWORK_INPUTS + 1) * hidden + (hidden + 1) * hidden + (hidden + 1) * 3


@dataclass(frozen=True, eq=False, slots=True)
class KiloOSF:
    """A trained field in its object's frame. Lengths are in the units of its training set: metres for our own.

    Attributes:
        origin: corner (0, 0, 0) of the voxel grid [m].
        voxel: side of a voxel [m].
        index: row of each corner's features; 0 outside the shell.
        rows: features of the corners in the shell; row 0 is empty space.
        cells: number of the tiny network of each cell; cells divide the grid's box evenly.
        networks: parameters of C tiny networks, layer by layer: weights (inputs x outputs), then biases.
        hidden: width of the tiny networks.
        ambient: what an unlit white point sends out, per colour.
        macro: of each block of 4 x 4 x 4 voxels, how many blocks away the nearest density is; derived.
        density: g on every corner; derived.
    """

    origin: Float32[np.ndarray, "3"]
    voxel: float
    index: Int32[np.ndarray, "nx ny nz"]
    rows: Float32[np.ndarray, "M 8"]
    cells: Int32[np.ndarray, "cx cy cz"]
    networks: Float32[np.ndarray, "C P"]
    hidden: int
    ambient: Float32[np.ndarray, "3"]
    density: Float32[np.ndarray, "nx ny nz"] = field(init=False)
    macro: UInt8[np.ndarray, "bx by bz"] = field(init=False)

    def __post_init__(self) -> None:
        """Derive what marching looks at."""
        density = np.ascontiguousarray(self.rows[:, 0][self.index])
        object.__setattr__(self, "density", density)
        object.__setattr__(self, "macro", block_distances(density))

    @property
    def box(self) -> Float32[np.ndarray, "2 3"]:
        """Lowest and highest corner of the grid [m]."""
        size = self.voxel * (np.array(self.index.shape, np.float32) - 1)
        return np.stack([self.origin, self.origin + size]).astype(np.float32)

    @property
    def extent(self) -> Float32[np.ndarray, "2 3"]:
        """Lowest and highest corner of the occupied part of the grid [m]."""
        solid = np.argwhere(self.density > FLOOR_G)
        if not len(solid):
            return self.box
        return (self.origin + self.voxel * np.stack([solid.min(axis=0), solid.max(axis=0)])).astype(np.float32)


def without_light(field: KiloOSF) -> KiloOSF:
    """The same field with n = 0 and networks blind to n . l and l: its radiance is then the same under every light."""
    rows, networks = field.rows.copy(), field.networks.copy()
    rows[:, 4:7] = 0
    first = networks[:, : NETWORK_INPUTS * field.hidden].reshape(len(networks), NETWORK_INPUTS, field.hidden)
    first[:, [0, 2, 3, 4]] = 0
    return replace(field, rows=rows, networks=networks)


def block_distances(density: Float32[np.ndarray, "nx ny nz"]) -> UInt8[np.ndarray, "bx by bz"]:
    """How far blocks of voxels are from the nearest one that holds density: in blocks, along the worst axis.

    0 for those with density, 255 where there is none at all. A block counts the corners on all its faces. A ray in a
    block at distance d may leave all blocks less than d away at once.
    """
    shape = tuple(-(-(n - 1) // MACRO) for n in density.shape)
    solid = density > FLOOR_G
    blocks = np.zeros(shape, bool)
    for start in np.ndindex(*((MACRO + 1,) * 3)):
        part = solid[tuple(slice(s, None, MACRO) for s in start)]
        cut = tuple(slice(0, min(a, b)) for a, b in zip(part.shape, shape, strict=True))
        blocks[cut] |= part[cut]
    if not blocks.any():
        return np.full(shape, 255, np.uint8)
    distances = np.asarray(ndimage.distance_transform_cdt(~blocks, metric="chessboard"))
    return np.minimum(distances, 255).astype(np.uint8)
