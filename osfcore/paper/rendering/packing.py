"""Fields of tiny networks laid end to end in flat arrays, as compiled code likes them."""

from __future__ import annotations

from collections.abc import Sequence
from typing import NamedTuple

import numpy as np
from jaxtyping import Bool, UInt8
from scipy import ndimage

from osfcore.errors import InvalidInput
from osfcore.paper.fields.tiny_field import TinyField


class PackedTiny(NamedTuple):
    """F fields. `starts` says where each one begins in the flat arrays.

    Attributes:
        solid: 1 for voxels with an occupied corner.
        macro: distances between blocks of voxels and occupied ones.
        cells: numbers of networks, -1 for none.
        networks: parameters, one network after another.
        starts: F x 4: offsets into solid, macro, cells, networks.
        shapes: F x 9: voxels, blocks, cells.
        scales: F x 5: origin [m], voxel [m], density scale [1/m].
        reach: F x 6: lowest and highest corner of the occupied part, a voxel wider [m].
        width: units of the networks' layers, the same for all.
        parameters: of one network.
    """

    solid: np.ndarray
    macro: np.ndarray
    cells: np.ndarray
    networks: np.ndarray
    starts: np.ndarray
    shapes: np.ndarray
    scales: np.ndarray
    reach: np.ndarray
    width: int
    parameters: int


def pack(fields: Sequence[TinyField]) -> PackedTiny:
    """Lay fields end to end.

    Raises:
        InvalidInput: if their networks differ in width.
    """
    widths = {field.width for field in fields}
    if len(widths) != 1:
        raise InvalidInput("widths of the fields' networks", sorted(widths), "the same for all fields of a scene")
    solids = [_solid_voxels(field.occupied) for field in fields]
    parts = [
        (solid.ravel(), field.macro.ravel(), field.cells.ravel(), field.networks.ravel())
        for solid, field in zip(solids, fields, strict=True)
    ]
    starts = np.zeros((len(fields), 4), np.int64)
    starts[1:] = np.cumsum([[len(array) for array in part] for part in parts], axis=0)[:-1]
    solid, macro, cells, networks = (np.concatenate([part[i] for part in parts]) for i in range(4))
    shapes = [
        [*voxels.shape, *field.macro.shape, *field.cells.shape] for voxels, field in zip(solids, fields, strict=True)
    ]
    reach = [np.stack([f.extent[0] - f.voxel, f.extent[1] + f.voxel]).clip(*f.box).reshape(-1) for f in fields]
    return PackedTiny(
        solid,
        macro,
        cells,
        networks,
        starts,
        np.array(shapes, np.int64),
        np.array([[*f.origin, f.voxel, f.density_scale] for f in fields], np.float32),
        np.array(reach, np.float32),
        fields[0].width,
        fields[0].networks.shape[1],
    )


def _solid_voxels(occupied: Bool[np.ndarray, "nx ny nz"]) -> UInt8[np.ndarray, "vx vy vz"]:
    """Voxels that have an occupied corner."""
    return ndimage.maximum_filter(occupied.astype(np.uint8), size=2, origin=-1)[:-1, :-1, :-1].copy()
