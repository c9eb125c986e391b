"""Files of the paper's networks: safetensors with half-precision parameters, checked when read."""

from __future__ import annotations

import json
from importlib.resources import files
from pathlib import Path

import torch
from safetensors import SafetensorError, safe_open
from safetensors.torch import save

from osfcore.errors import CorruptFile
from osfcore.io.files import write_atomically
from osfcore.paper.dynamics.graph import UNKNOWN
from osfcore.paper.dynamics.graph_network import GraphNetwork

FORMAT = "paper-pushes-1"
WEIGHTS_FILE = "paper_pushes.safetensors"
_MOST_HIDDEN, _MOST_STEPS, _MOST_NAMES = 1024, 16, 10_000


def weights_path(data_dir: Path | None) -> Path:
    """DATA_DIR/dynamics/paper_pushes.safetensors if it is there, else the package's."""
    own = None if data_dir is None else data_dir / "dynamics" / WEIGHTS_FILE
    return own if own is not None and own.is_file() else shipped()


def shipped() -> Path:
    """The file of the network that comes with the package."""
    return Path(str(files("osfcore.paper") / "shipped" / "pushes.safetensors"))


def network_bytes(network: GraphNetwork) -> bytes:
    """A network as the contents of a file."""
    tensors = {name: value.detach().cpu().half().contiguous() for name, value in network.state_dict().items()}
    words = {"hidden": str(network.hidden), "steps": str(network.steps), "names": json.dumps(network.names)}
    return save(tensors, {"format": FORMAT, **words})


def write_network(path: Path, network: GraphNetwork) -> None:
    """Write a network; the file appears only when it is whole.

    Raises:
        CannotWrite: if the disk refuses.
    """
    write_atomically(path, network_bytes(network))


def read_network(path: Path) -> GraphNetwork:
    """Read a network.

    Raises:
        CorruptFile: if the file is missing, cut short, of another version or no such network.
    """
    try:
        with safe_open(path, framework="pt") as file:
            metadata = file.metadata() or {}
            if metadata.get("format") != FORMAT:
                raise CorruptFile(path, f"it is not of the format {FORMAT}")
            hidden, steps, names = int(metadata["hidden"]), int(metadata["steps"]), json.loads(metadata["names"])
            if not (1 <= hidden <= _MOST_HIDDEN and 1 <= steps <= _MOST_STEPS):
                raise CorruptFile(path, f"{hidden} units and {steps} steps are out of range")
            if not _are_names(names):
                raise CorruptFile(path, "its names of objects are no list of different names")
            values = {name: file.get_tensor(name).float() for name in file.keys()}  # noqa: SIM118 - not a mapping
    except (SafetensorError, OSError, KeyError, ValueError, RecursionError) as error:
        if isinstance(error, CorruptFile):
            raise
        raise CorruptFile(path, f"it holds no network of pushes ({error})") from error
    network = GraphNetwork(names, hidden, steps)
    try:
        network.load_state_dict(values)
    except RuntimeError as error:
        raise CorruptFile(path, "its parameters do not fit its description") from error
    if not all(bool(torch.isfinite(value).all()) for value in values.values()):
        raise CorruptFile(path, "its parameters are not all finite")
    if network.embedding.weight[UNKNOWN].any():
        raise CorruptFile(path, "its embedding of unknown objects is not zero")
    return network.eval()


def _are_names(names: object) -> bool:
    """Whether they are what `network_bytes` writes."""
    if not isinstance(names, list) or len(names) > _MOST_NAMES or not all(isinstance(name, str) for name in names):
        return False
    return len(set(names)) == len(names)
