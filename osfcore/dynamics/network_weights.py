"""Files of trained networks: safetensors with half-precision parameters, checked when read."""

from __future__ import annotations

import json
from collections.abc import Mapping
from importlib.resources import files
from pathlib import Path
from typing import Any

from safetensors.torch import save

from osfcore.dynamics.propagation_network import PropagationNetwork
from osfcore.errors import CorruptFile, shown
from osfcore.io.files import write_atomically
from osfcore.io.network_file import load_parameters, read_parameters

FORMAT = "pushes-2"
_MOST_HIDDEN, _MOST_STEPS = 1024, 16


def network_bytes(network: PropagationNetwork) -> bytes:
    """A network as the contents of a file."""
    tensors = {name: value.detach().cpu().half().contiguous() for name, value in network.state_dict().items()}
    return save(tensors, {"format": FORMAT, "hidden": str(network.hidden), "steps": str(network.steps)})


def write_network(path: Path, network: PropagationNetwork) -> None:
    """Write a network; the file appears only when it is whole.

    Raises:
        CannotWrite: if the disk refuses.
    """
    write_atomically(path, network_bytes(network))


def read_network(path: Path) -> PropagationNetwork:
    """Read a network.

    Raises:
        CorruptFile: if the file is missing, cut short, of another version or no such network.
    """
    metadata, values = read_parameters(path, FORMAT, "network of pushes")
    network = PropagationNetwork(*described_sizes(metadata, path))
    load_parameters(network, values, path)
    return network.eval()


def described_sizes(metadata: Mapping[str, str], path: Path) -> tuple[int, int]:
    """Width and propagation steps that a file describes.

    Raises:
        CorruptFile: if they are missing or out of range.
    """
    try:
        hidden, steps = int(metadata["hidden"]), int(metadata["steps"])
    except (KeyError, ValueError) as error:
        raise CorruptFile(path, f"it holds no network of pushes of known size ({shown(error)})") from error
    if not (1 <= hidden <= _MOST_HIDDEN and 1 <= steps <= _MOST_STEPS):
        raise CorruptFile(path, f"{hidden} units and {steps} steps are out of range")
    return hidden, steps


def shipped(name: str = "pushes") -> Path:
    """The file of a network that comes with the package."""
    return Path(str(files("osfcore.dynamics") / "shipped" / f"{name}.safetensors"))


def read_metrics(path: Path) -> Mapping[str, Any]:
    """What is known of how a network was trained, from the JSON beside its file; empty if that cannot be read."""
    try:
        content = json.loads(path.with_suffix(".json").read_text(encoding="utf-8"))
    except (OSError, ValueError, RecursionError):
        return {}
    return content if isinstance(content, dict) else {}
