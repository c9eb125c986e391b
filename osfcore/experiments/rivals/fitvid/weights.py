"""Files of trained FitVid networks: safetensors with half-precision parameters, checked when read."""

from __future__ import annotations

from dataclasses import asdict
from importlib.resources import files
from pathlib import Path

import torch
from safetensors.torch import save

from osfcore.errors import CorruptFile, shown
from osfcore.experiments.rivals.fitvid.model import FitVidModel, FitVidSettings
from osfcore.io.files import write_atomically
from osfcore.io.network_file import read_parameters

FORMAT = "fitvid-2"
_FILE = "fitvid.safetensors"
_SIZES = ("side", "width", "features", "hidden", "latent")


def fitvid_path(data_dir: Path | None) -> Path:
    """Where the network lies: DATA_DIR/fitvid.safetensors, else the package's."""
    own = None if data_dir is None else data_dir / _FILE
    shipped = Path(str(files("osfcore.experiments.rivals") / "shipped" / _FILE))
    return own if own is not None and own.is_file() else shipped


def fitvid_bytes(model: FitVidModel) -> bytes:
    """A network as the contents of a file; the statistics of batch norm keep their precision."""
    halved = {name for name, _ in model.named_parameters()}
    tensors = {
        name: (value.detach().half() if name in halved else value.detach()).cpu().contiguous()
        for name, value in model.state_dict().items()
    }
    return save(tensors, {"format": FORMAT, **{name: str(value) for name, value in asdict(model.settings).items()}})


def write_fitvid(path: Path, model: FitVidModel) -> None:
    """Write a network; the file appears only when it is whole.

    Raises:
        CannotWrite: if the disk refuses.
    """
    write_atomically(path, fitvid_bytes(model))


def read_fitvid(path: Path, precision: torch.dtype = torch.float32) -> FitVidModel:
    """Read a network, ready to predict.

    Args:
        path: of the file.
        precision: what it shall compute in.

    Raises:
        CorruptFile: if the file is missing, cut short, of another version or no such network.
    """
    metadata, values = read_parameters(path, FORMAT, "video prediction network")
    try:
        settings = FitVidSettings(**{name: int(metadata[name]) for name in _SIZES})
    except (KeyError, ValueError) as error:
        raise CorruptFile(path, f"it holds no video prediction network of known size ({shown(error)})") from error
    with torch.device("meta"):  # what the file describes may be larger than what it holds
        model = FitVidModel(settings, precision)
    expected = model.state_dict()
    if {n: v.shape for n, v in values.items()} != {n: v.shape for n, v in expected.items()}:
        raise CorruptFile(path, "its parameters do not fit its description")
    model.load_state_dict({name: value.to(expected[name].dtype) for name, value in values.items()}, assign=True)
    return model.eval()
