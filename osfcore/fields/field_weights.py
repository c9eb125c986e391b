"""Files of trained fields: safetensors with 8-bit voxel features and half-precision networks, checked when read."""

from __future__ import annotations

import json
import struct
from collections.abc import Mapping
from pathlib import Path

import numpy as np
from jaxtyping import Float32
from safetensors import SafetensorError
from safetensors.numpy import load, save

from osfcore.errors import CorruptFile, shown
from osfcore.fields.kiloosf import EMPTY_G, FEATURES, MOST_HIDDEN, KiloOSF, network_size
from osfcore.io.files import write_atomically

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
    """Write a field; the file appears only when it is whole.

    Raises:
        CannotWrite: if the disk refuses.
    """
    write_atomically(path, field_bytes(field))


def field_bytes(field: KiloOSF) -> bytes:
    """A field as the contents of a file. Features lose precision: 8 bits of each one's range."""
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
    """A field from the contents of a file.

    Args:
        data: as `field_bytes` makes them.
        where: what messages name.

    Raises:
        CorruptFile: if they are cut short, of another version or not a field.
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
    shape = tuple(int(n) for n in tensors["shape"])
    if len(shape) != 3 or min(shape) < 2 or np.prod(shape) > _MAX_CORNERS:
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
    index = np.zeros(shape, np.int32)
    index[shell] = 1 + np.arange(len(levels), dtype=np.int32)
    empty = np.zeros((1, FEATURES), np.float32)
    empty[0, 0] = EMPTY_G
    vectors = {name: _vector(tensors, name, size) for name, size in _VECTORS.items()}
    rows = np.concatenate([empty, levels.astype(np.float32) / _LEVELS * vectors["span"] + vectors["low"]])
    cells, networks = tensors["cells"].astype(np.int32), tensors["networks"].astype(np.float32)
    if not 1 <= hidden <= MOST_HIDDEN or networks.shape != (len(networks), network_size(hidden)):
        raise ValueError(f"networks {networks.shape} of width {hidden}, at most {MOST_HIDDEN}")
    if cells.ndim != 3 or cells.min() < 0 or cells.max() >= len(networks):
        raise ValueError(f"networks {networks.shape} of width {hidden} for cells {cells.shape}")
    voxel = float(tensors["voxel"][0])
    if not 1 / _LARGEST < voxel < _LARGEST:
        raise ValueError(f"a voxel of {voxel:g}")
    origin, ambient = vectors["origin"], vectors["ambient"]
    if ambient.min() < 0 or vectors["span"].min() < 0:
        raise ValueError("ambient or span is negative")
    return KiloOSF(origin, voxel, index, rows.astype(np.float32), cells, networks, hidden, ambient)


def _vector(tensors: Mapping[str, np.ndarray], name: str, size: int) -> Float32[np.ndarray, "size"]:
    vector = tensors[name].astype(np.float32)
    if vector.shape != (size,) or np.abs(vector).max() > _LARGEST:
        raise ValueError(f"{name} of shape {vector.shape} and numbers up to {np.abs(vector).max(initial=0):g}")
    return vector


def read_tensors(path: Path, expected: str) -> Tensors:
    """Metadata and tensors of a safetensors file of the expected format.

    Raises:
        CorruptFile: if the file is missing, cut short or of another format or version.
    """
    return tensors_from_bytes(_read(path), expected, path)


def tensors_from_bytes(data: bytes, expected: str, where: Path | str) -> Tensors:
    """Metadata and tensors from the contents of a safetensors file.

    Args:
        data: the contents.
        expected: format that the metadata must name.
        where: what messages name.

    Raises:
        CorruptFile: if they are cut short or of another format or version.
    """
    meta, tensors = _parsed(data, where)
    found = meta.get("format", "no format at all")
    if found != expected:
        raise CorruptFile(where, f"its format is {shown(found)}; this version reads {expected}: train it again")
    return meta, tensors


def tensor_format(path: Path) -> str | None:
    """What kind of weights a safetensors file says it holds.

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
