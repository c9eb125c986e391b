"""Fields laid end to end in flat arrays, as compiled code likes them."""

from __future__ import annotations

from collections.abc import Sequence
from typing import NamedTuple

import numpy as np

from osfcore.errors import InvalidInput
from osfcore.fields.kiloosf import MOST_HIDDEN, KiloOSF


class Packed(NamedTuple):
    """N fields. `starts` says where each one begins in the flat arrays.

    Attributes:
        density: g on all corners.
        index: rows of all corners.
        rows: features, one after another.
        macro: distances between blocks and density.
        cells: numbers of networks.
        networks: parameters, one network after another.
        starts: N x 5: offsets into density and index, rows, macro, cells, networks.
        shapes: N x 9: grid, blocks, cells.
        scales: N x 4: origin [m], voxel [m].
        extents: N x 6: lowest and highest corner of the occupied part [m].
        ambient: N x 3.
        hidden: width of the networks, the same for all.
        parameters: of one network.
    """

    density: np.ndarray
    index: np.ndarray  # pyright: ignore[reportIncompatibleMethodOverride]
    rows: np.ndarray
    macro: np.ndarray
    cells: np.ndarray
    networks: np.ndarray
    starts: np.ndarray
    shapes: np.ndarray
    scales: np.ndarray
    extents: np.ndarray
    ambient: np.ndarray
    hidden: int
    parameters: int


def pack(fields: Sequence[KiloOSF]) -> Packed:
    """Lay fields end to end.

    Raises:
        InvalidInput: if their networks differ in width, or are too wide.
    """
    widths = {field.hidden for field in fields}
    if len(widths) > 1:
        raise InvalidInput("widths of the fields' networks", sorted(widths), "the same for all fields of a scene")
    if max(widths) > MOST_HIDDEN:
        raise InvalidInput("width of the fields' networks", max(widths), f"at most {MOST_HIDDEN}")
    flat = {name: [getattr(f, name).reshape(-1) for f in fields] for name in ("density", "index", "macro", "cells")}
    rows = [f.rows for f in fields]
    networks = [f.networks for f in fields]
    counts = [[len(parts[i]) for parts in (flat["density"], rows, flat["macro"], flat["cells"], networks)]
              for i in range(len(fields))]  # fmt: skip
    starts = np.zeros((len(fields), 5), np.int64)
    starts[1:] = np.cumsum(counts, axis=0)[:-1]
    return Packed(
        **{name: np.concatenate(parts) for name, parts in flat.items()},
        rows=np.concatenate(rows).reshape(-1),
        networks=np.concatenate(networks).reshape(-1),
        starts=starts,
        shapes=np.array([[*f.index.shape, *f.macro.shape, *f.cells.shape] for f in fields], np.int64),
        scales=np.array([[*f.origin, f.voxel] for f in fields], np.float32),
        extents=np.array([_reach(f).reshape(-1) for f in fields], np.float32),
        ambient=np.array([f.ambient for f in fields], np.float32),
        hidden=fields[0].hidden,
        parameters=fields[0].networks.shape[1],
    )


def _reach(field: KiloOSF) -> np.ndarray:
    """The occupied part and one voxel more: between an occupied corner and an empty one there is density too."""
    low, high = field.extent
    return np.stack([low - field.voxel, high + field.voxel])
