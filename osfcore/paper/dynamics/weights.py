"""Files of the paper's networks: safetensors with half-precision parameters, checked when read."""

from __future__ import annotations

import json
from collections.abc import Mapping
from importlib.resources import files
from pathlib import Path

from safetensors.torch import save

from osfcore.dynamics.network_weights import described_sizes
from osfcore.errors import CorruptFile, shown
from osfcore.io.files import write_atomically
from osfcore.io.network_file import load_parameters, read_parameters
from osfcore.paper.dynamics.graph import UNKNOWN
from osfcore.paper.dynamics.graph_network import GraphNetwork

FORMAT = "paper-pushes-1"
WEIGHTS_FILE = "paper_pushes.safetensors"
_MOST_NAMES = 10_000


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
    metadata, values = read_parameters(path, FORMAT, "network of pushes")
    network = GraphNetwork(_names(metadata, path), *described_sizes(metadata, path))
    load_parameters(network, values, path)
    if network.embedding.weight[UNKNOWN].any():
        raise CorruptFile(path, "its embedding of unknown objects is not zero")
    return network.eval()


def _names(metadata: Mapping[str, str], path: Path) -> list[str]:
    """The objects that a file says its network knows."""
    try:
        names: list[str] = json.loads(metadata["names"])
    except (KeyError, ValueError, RecursionError) as error:
        raise CorruptFile(path, f"it holds no network of pushes of known objects ({shown(error)})") from error
    is_list = isinstance(names, list) and all(isinstance(name, str) for name in names)
    if not is_list or not len(set(names)) == len(names) <= _MOST_NAMES:
        raise CorruptFile(path, "its names of objects are no list of different names")
    return names
