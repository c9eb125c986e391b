"""Which trained network there is: one of this machine, or else the one that ships with the package."""

from __future__ import annotations

from collections.abc import Iterable
from pathlib import Path

import torch

from osfcore.dynamics.rollout import PushModel
from osfcore.dynamics.shapes import object_shape
from osfcore.dynamics.weights import read_network, shipped
from osfcore.fields.library import FieldLibrary

NETWORK_FILE = "pushes.safetensors"


def network_path(data_dir: Path | None) -> Path:
    """DATA_DIR/dynamics/pushes.safetensors if it is there, else the package's."""
    own = None if data_dir is None else data_dir / "dynamics" / NETWORK_FILE
    return own if own is not None and own.is_file() else shipped()


def load_push_model(
    data_dir: Path | None, fields: FieldLibrary, names: Iterable[str], device: torch.device | str = "cpu"
) -> PushModel:
    """The network with the shapes of some objects, each from its field.

    Raises:
        UnknownName: if an object has no field.
        CorruptFile: if a file is broken.
    """
    shapes = {name: object_shape(fields.load(name)) for name in names}
    return PushModel(read_network(network_path(data_dir)), shapes, device)
