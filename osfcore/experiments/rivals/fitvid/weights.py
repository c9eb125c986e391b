"""Files of trained FitVid networks: safetensors with half-precision parameters, checked when read."""

from __future__ import annotations

from dataclasses import asdict
from pathlib import Path

import torch
from safetensors import SafetensorError, safe_open
from safetensors.torch import save
from torch import Tensor

from osfcore.errors import CorruptFile, shown
from osfcore.experiments.rivals.fitvid.model import FitVidModel, FitVidSettings
from osfcore.io.files import write_atomically

FORMAT = "fitvid-1"
_SIZES = ("side", "width", "features", "hidden", "latent")


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
    try:
        with safe_open(path, framework="pt") as file:
            metadata = file.metadata() or {}
            if metadata.get("format") != FORMAT:
                raise CorruptFile(path, f"it is not of the format {FORMAT}")
            settings = FitVidSettings(**{name: int(metadata[name]) for name in _SIZES})
            values: dict[str, Tensor] = {name: file.get_tensor(name) for name in file.keys()}  # noqa: SIM118 - no mapping
    except (SafetensorError, OSError, KeyError, ValueError) as error:
        if isinstance(error, CorruptFile):
            raise
        raise CorruptFile(path, f"it holds no video prediction network ({shown(error)})") from error
    with torch.device("meta"):  # what the file describes may be larger than what it holds
        model = FitVidModel(settings, precision)
    expected = model.state_dict()
    if {n: v.shape for n, v in values.items()} != {n: v.shape for n, v in expected.items()}:
        raise CorruptFile(path, "its parameters do not fit its description")
    if not all(bool(torch.isfinite(value).all()) for value in values.values()):
        raise CorruptFile(path, "its parameters are not all finite")
    model.load_state_dict({name: value.to(expected[name].dtype) for name, value in values.items()}, assign=True)
    return model.eval()
