"""Which trained network and shapes there are: those of this machine, or else those that ship with the package."""

from __future__ import annotations

import contextlib
import hashlib
from collections.abc import Iterable
from importlib.resources import files
from pathlib import Path

import torch

from osfcore.dynamics.network_weights import read_network, shipped
from osfcore.dynamics.rollout import PushModel
from osfcore.dynamics.shapes.field_parts import field_parts, read_parts, write_parts
from osfcore.dynamics.shapes.object_shapes import ObjectShape, object_shape
from osfcore.errors import CannotWrite
from osfcore.fields.field_library import FieldLibrary

NETWORK_FILE = "pushes.safetensors"


def network_path(data_dir: Path | None) -> Path:
    """DATA_DIR/dynamics/pushes.safetensors if it is there, else the package's."""
    own = None if data_dir is None else data_dir / "dynamics" / NETWORK_FILE
    return own if own is not None and own.is_file() else shipped()


def load_shapes(data_dir: Path | None, fields: FieldLibrary, names: Iterable[str]) -> dict[str, ObjectShape]:
    """The shapes of some objects by name, each from its field.

    A field that is seen for the first time is cut into convex parts, which takes up to half a minute; they are kept in
    DATA_DIR/dynamics/parts.

    Args:
        data_dir: DATA_DIR; where it is None, nothing is kept.
        fields: of the objects.
        names: which objects.

    Raises:
        UnknownName: if an object has no field.
        CorruptFile: if a field's file is broken.
        OsfError: if nothing in a field is solid.
    """
    return {name: _load_shape(data_dir, fields, name) for name in names}


def _load_shape(data_dir: Path | None, fields: FieldLibrary, name: str) -> ObjectShape:
    field = fields.load(name)
    digest = hashlib.sha256(fields.info(name).path.read_bytes()).hexdigest()
    own = None if data_dir is None else data_dir / "dynamics" / "parts" / f"{name}.safetensors"
    kept = Path(str(files("osfcore.dynamics") / "shipped" / "parts" / f"{name}.safetensors"))
    for path in (own, kept):
        parts = None if path is None else read_parts(path, digest)
        if parts is not None:
            return object_shape(field, parts)
    parts = field_parts(field)
    if own is not None:
        with contextlib.suppress(CannotWrite):  # a full disk costs time, not the prediction
            write_parts(own, parts, digest)
    return object_shape(field, parts)


def load_push_model(
    data_dir: Path | None, fields: FieldLibrary, names: Iterable[str], device: torch.device | str = "cpu"
) -> PushModel:
    """The network with the shapes of some objects, each from its field.

    Args:
        data_dir: as in `load_shapes`; a network in it comes before the package's.
        fields: of the objects.
        names: which objects.
        device: that computes.

    Raises:
        UnknownName: if an object has no field.
        CorruptFile: if a file is broken.
        OsfError: if nothing in a field is solid.
    """
    return PushModel(read_network(network_path(data_dir)), load_shapes(data_dir, fields, names), device)
