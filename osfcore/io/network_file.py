"""Parameters of networks in safetensors files, checked when read."""

from __future__ import annotations

from collections.abc import Mapping
from pathlib import Path

import torch
from safetensors import SafetensorError, safe_open
from torch import Tensor, nn

from osfcore.errors import CorruptFile, shown


def read_parameters(path: Path, expected: str, what: str) -> tuple[Mapping[str, str], dict[str, Tensor]]:
    """Metadata and finite parameters of a file of the expected format.

    Args:
        path: of the file.
        expected: format that the metadata must name.
        what: kind of network, for messages.

    Raises:
        CorruptFile: if the file is missing, cut short, of another format, or holds what is not finite.
    """
    try:
        with safe_open(path, framework="pt") as file:
            metadata = file.metadata() or {}
            values = {name: file.get_tensor(name) for name in file.keys()}  # noqa: SIM118 - not a mapping
    except (SafetensorError, OSError) as error:
        raise CorruptFile(path, f"it holds no {what} ({shown(error)})") from error
    if metadata.get("format") != expected:
        raise CorruptFile(path, f"it is not of the format {expected}")
    if not all(bool(torch.isfinite(value).all()) for value in values.values()):
        raise CorruptFile(path, "its parameters are not all finite")
    return metadata, values


def load_parameters(network: nn.Module, values: Mapping[str, Tensor], path: Path) -> None:
    """Give a network the parameters of a file.

    Raises:
        CorruptFile: if they are not those of such a network.
    """
    try:
        network.load_state_dict(values)
    except RuntimeError as error:
        raise CorruptFile(path, "its parameters do not fit its description") from error
