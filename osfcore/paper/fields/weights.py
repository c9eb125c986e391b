"""Files of KiloOSFs as published: safetensors with half-precision networks, checked when read."""

from __future__ import annotations

from collections.abc import Mapping
from pathlib import Path

import numpy as np
from safetensors.numpy import save

from osfcore.errors import CorruptFile, shown
from osfcore.fields.field_weights import read_tensors, tensors_from_bytes
from osfcore.paper.fields.tiny_field import MOST_WIDTH, TinyField, network_size

FORMAT = "paper-kiloosf-1"
_MOST_CORNERS = 20_000_000


def field_bytes(field: TinyField) -> bytes:
    """A field as the contents of a file."""
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
    """A field from the contents of a file.

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
        field = _parsed(int(meta["width"]), tensors)
    except (KeyError, ValueError, IndexError, TypeError, OverflowError) as error:
        raise CorruptFile(where, f"it is not a sound field ({shown(error)})") from error
    return field


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
