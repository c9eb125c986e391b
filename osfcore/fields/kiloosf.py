"""KiloOSF: one object's relightable scattering function, as a voxel shell and a grid of tiny networks.

f(x, light direction, view direction) -> (rho, sigma), paper eq. 1. The features of a point are interpolated between the
eight corners of its voxel. The tiny network of its cell computes the scattered direct light from them, the light and
the view:

    sigma = max(softplus(g) - softplus(FLOOR), 0) / voxel                       [1 / unit of length]
    rho   = albedo * (ambient + max(n . l + network(n . l, latent, l, v, position in the cell), 0))

with g, albedo, n and latent the features. Deviations from the paper, each measured in docs/notes/fields.md:

- Density, reflectance and a dipole (n) are stored in voxels and not in the networks, so that occupied space,
  silhouettes and shadows need no network.
- The ambient part of rho is separate, so that a shadow removes only the direct part.
"""

from __future__ import annotations

import json
import struct
from collections.abc import Mapping
from dataclasses import dataclass, field, replace
from pathlib import Path

import numpy as np
from jaxtyping import Bool, Float32, Int32, UInt8
from safetensors import SafetensorError
from safetensors.numpy import load, save
from scipy import ndimage

from osfcore.errors import CorruptFile, shown
from osfcore.io.files import write_atomically

FEATURES = 8  # g, albedo (3), n (3), latent
NETWORK_INPUTS = 11  # n . l, latent, l (3), v (3), position in the cell (3)
EMPTY_G = -10.0  # of row 0, which every corner outside the shell shares
EMPTY_ROW = np.array([[EMPTY_G] + [0.0] * (FEATURES - 1)], np.float32)
FLOOR_G = -6.0  # at and below it the density is exactly 0
DENSITY_FLOOR = float(np.log1p(np.exp(FLOOR_G)))
STEP_VOXELS = 0.5  # distance between samples along a ray, in training and in exact rendering
MOST_HIDDEN = 64  # width of the tiny networks
MACRO_BITS = 2
MACRO = 1 << MACRO_BITS  # side of the blocks that divide occupied from empty space [voxels]


def network_size(hidden: int) -> int:
    """Return the number of parameters of one tiny network: two hidden layers, three outputs."""
    return (NETWORK_INPUTS + 1) * hidden + (hidden + 1) * hidden + (hidden + 1) * 3


@dataclass(frozen=True, eq=False, slots=True)
class KiloOSF:
    """A trained neural scattering function of one object, in the object's frame.

    It holds features on the corners of a voxel grid and one tiny network for each cell of a coarser grid. Lengths are
    in the units of its training set, which is metres unless the data came from elsewhere. `FieldLibrary.load` reads
    one; `SceneRenderer` draws it.

    Attributes:
        origin: corner (0, 0, 0) of the voxel grid [m].
        voxel: side of a voxel [m].
        index: row in `rows` of each corner; 0 for corners outside the shell around the surface.
        rows: features of the M - 1 corners in the shell; row 0 is empty space.
        cells: number of the tiny network of each cell. The cells divide the grid's box evenly.
        networks: parameters of C tiny networks, layer by layer: weights (inputs x outputs), then biases.
        hidden: width of the tiny networks.
        ambient: radiance of an unlit white point, per colour.
        density: density feature g of every corner; derived from `rows`.
        macro: for each block of 4 x 4 x 4 voxels, distance to the nearest block with density [blocks]; derived.

    Example:
        >>> lowest, highest = fields.load("006_mustard_bottle").extent
        >>> (highest - lowest).round(2)  # width, depth and height of the bottle [m]
        array([0.1 , 0.07, 0.2 ], dtype=float32)
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
        """Compute the derived arrays for ray marching."""
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


def numbered(shell: Bool[np.ndarray, "nx ny nz"]) -> Int32[np.ndarray, "nx ny nz"]:
    """Number the corners of a shell in the order of the grid, from 1. The others get 0, the row of empty space."""
    index = np.zeros(shell.shape, np.int32)
    index[shell] = 1 + np.arange(shell.sum(), dtype=np.int32)
    return index


def without_light(field: KiloOSF) -> KiloOSF:
    """Return a field with the same radiance under every light: n is 0, and the networks ignore n . l and l."""
    rows, networks = field.rows.copy(), field.networks.copy()
    rows[:, 4:7] = 0
    first = networks[:, : NETWORK_INPUTS * field.hidden].reshape(len(networks), NETWORK_INPUTS, field.hidden)
    first[:, [0, 2, 3, 4]] = 0
    return replace(field, rows=rows, networks=networks)


def block_distances(density: Float32[np.ndarray, "nx ny nz"]) -> UInt8[np.ndarray, "bx by bz"]:
    """Return the distance of each block of voxels to the nearest block with density, in blocks along the worst axis.

    It is 0 for blocks with density, and 255 if there is no density at all. A block includes the corners on all its
    faces. A ray in a block at distance d can skip all blocks less than d away.
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


# Files of trained fields: safetensors with 8-bit voxel features and half-precision networks, checked when read.


FORMAT = "kiloosf-1"
MAX_FILE_BYTES = 64_000_000
_MAX_CORNERS = 20_000_000
_LEVELS = 255
_LARGEST = 1e9  # number in a file, in whatever unit of length
_VECTORS = {"origin": 3, "ambient": 3, "low": FEATURES, "span": FEATURES}
_KINDS = {"origin": "f", "voxel": "f", "shape": "iu", "shell": "u", "levels": "u", "low": "f", "span": "f",
          "cells": "iu", "networks": "f", "ambient": "f"}  # fmt: skip

Tensors = tuple[Mapping[str, str], Mapping[str, np.ndarray]]  # metadata, and what is in a file


def write_field(path: Path, field: KiloOSF) -> None:
    """Write a field. The file appears only once it is complete.

    Raises:
        CannotWrite: if the disk refuses.
    """
    write_atomically(path, field_bytes(field))


def field_bytes(field: KiloOSF) -> bytes:
    """Return a field as the contents of a file. Each feature is quantised to 8 bits of its range."""
    features = field.rows[1:]
    low = features.min(axis=0, initial=0).astype(np.float32)
    span = np.maximum(features.max(axis=0, initial=0) - low, 1e-6).astype(np.float32)
    order = field.index[field.index > 0] - 1  # features are stored in the order of the grid
    levels = np.round((features[order] - low) / span * _LEVELS).astype(np.uint8)
    used = np.unique(field.cells)
    tensors = {
        "origin": field.origin,
        "voxel": np.array([field.voxel], np.float32),
        "shape": np.array(field.index.shape, np.int32),
        "shell": np.packbits(field.index > 0),
        "levels": levels,
        "low": low,
        "span": span,
        "cells": np.searchsorted(used, field.cells).astype(np.int16),
        "networks": field.networks[used].astype(np.float16),
        "ambient": field.ambient,
    }
    return save(tensors, metadata={"format": FORMAT, "hidden": str(field.hidden)})


def read_field(path: Path) -> KiloOSF:
    """Read a field.

    Raises:
        CorruptFile: if the file is missing, cut short, of another version or not a field.
    """
    return field_from_bytes(_read(path), path)


def field_from_bytes(data: bytes, where: Path | str) -> KiloOSF:
    """Return the field in the contents of a file.

    Args:
        data: contents, as `field_bytes` returns them.
        where: name of the file in messages.

    Raises:
        CorruptFile: if the data are truncated, of another version or not a field.
    """
    meta, tensors = tensors_from_bytes(data, FORMAT, where)
    try:
        return _field(int(meta["hidden"]), tensors)
    except (KeyError, ValueError, IndexError, TypeError, OverflowError) as error:
        raise CorruptFile(where, f"it is not a sound field ({shown(error)})") from error


def _field(hidden: int, tensors: Mapping[str, np.ndarray]) -> KiloOSF:
    for name, kinds in _KINDS.items():
        tensor = tensors[name]
        if tensor.dtype.kind not in kinds or (kinds == "u" and tensor.dtype != np.uint8):
            raise ValueError(f"{name} holds {tensor.dtype}")
        if kinds == "f" and not np.all(np.isfinite(tensor)):
            raise ValueError(f"{name} has values that are not finite")
    if tensors["shape"].shape != (3,):
        raise ValueError(f"{tensors['shape'].shape} numbers of corners")
    shape = tuple(int(n) for n in tensors["shape"])
    if min(shape) < 2 or np.prod(shape) > _MAX_CORNERS:
        raise ValueError(f"shape {shape}")
    shell = np.unpackbits(tensors["shell"], count=int(np.prod(shape))).astype(bool).reshape(shape)
    levels = tensors["levels"]
    if not shell.any():
        raise ValueError("it has no corners, so it shows nothing")
    if levels.shape != (shell.sum(), FEATURES):
        raise ValueError(f"levels {levels.shape} for {shell.sum()} corners")
    for axis in range(3):
        if np.moveaxis(shell, axis, 0)[[0, -1]].any():
            raise ValueError("the shell touches the grid's faces")
    vectors = {name: tensors[name].astype(np.float32) for name in _VECTORS}
    for name, vector in vectors.items():
        if vector.shape != (_VECTORS[name],) or np.abs(vector).max() > _LARGEST:
            raise ValueError(f"{name} of shape {vector.shape} and numbers up to {np.abs(vector).max(initial=0):g}")
    rows = np.concatenate([EMPTY_ROW, levels.astype(np.float32) / _LEVELS * vectors["span"] + vectors["low"]])
    cells, networks = tensors["cells"].astype(np.int32), tensors["networks"].astype(np.float32)
    if not 1 <= hidden <= MOST_HIDDEN or networks.shape != (len(networks), network_size(hidden)):
        raise ValueError(f"networks {networks.shape} of width {hidden}, at most {MOST_HIDDEN}")
    if cells.ndim != 3 or cells.min() < 0 or cells.max() >= len(networks):
        raise ValueError(f"networks {networks.shape} of width {hidden} for cells {cells.shape}")
    voxel = float(tensors["voxel"][0])
    if not 1 / _LARGEST < voxel < _LARGEST:
        raise ValueError(f"a voxel of {voxel:g}")
    ambient = vectors["ambient"]
    if ambient.min() < 0 or vectors["span"].min() < 0:
        raise ValueError("ambient or span is negative")
    rows = rows.astype(np.float32)
    return KiloOSF(vectors["origin"], voxel, numbered(shell), rows, cells, networks, hidden, ambient)


def read_tensors(path: Path, expected: str) -> Tensors:
    """Read metadata and tensors of a safetensors file of the expected format.

    Raises:
        CorruptFile: if the file is missing, cut short or of another format or version.
    """
    return tensors_from_bytes(_read(path), expected, path)


def tensors_from_bytes(data: bytes, expected: str, where: Path | str) -> Tensors:
    """Return metadata and tensors from the contents of a safetensors file.

    Args:
        data: the contents.
        expected: format that the metadata must name.
        where: name of the file in messages.

    Raises:
        CorruptFile: if the data are truncated, or of another format or version.
    """
    meta, tensors = _parsed(data, where)
    found = meta.get("format", "no format at all")
    if found != expected:
        raise CorruptFile(where, f"its format is {shown(found)}; this version reads {expected}: train it again")
    return meta, tensors


def tensor_format(path: Path) -> str | None:
    """Return the format in a safetensors file's metadata: the kind of its weights.

    Raises:
        CorruptFile: if the file is missing or cut short.
    """
    return _parsed(_read(path), path)[0].get("format")


def _read(path: Path) -> bytes:
    try:
        if path.stat().st_size > MAX_FILE_BYTES:
            raise CorruptFile(path, f"it is larger than {MAX_FILE_BYTES // 1_000_000} MB")
        return path.read_bytes()
    except OSError as error:
        raise CorruptFile(path, "it cannot be read") from error


def _parsed(data: bytes, where: Path | str) -> Tensors:
    try:
        tensors = load(data)
        (length,) = struct.unpack("<Q", data[:8])
        meta = json.loads(data[8 : 8 + length]).get("__metadata__") or {}  # null is allowed
    except (SafetensorError, ValueError, TypeError, AttributeError, struct.error, KeyError, RecursionError) as error:
        raise CorruptFile(where, "it is not a whole safetensors file") from error
    return meta, tensors
