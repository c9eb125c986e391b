"""Checkpoints of trainings in PyTorch, and parameters of networks in safetensors files; both are checked when read."""

from __future__ import annotations

import contextlib
import io
from collections.abc import Callable, Iterator, Mapping
from pathlib import Path
from typing import Any

import torch
from safetensors import SafetensorError, safe_open
from torch import Tensor, nn

from osfcore.errors import CorruptFile, shown
from osfcore.io.files import write_atomically

# A training starts over if its checkpoint is missing, truncated, or of another run. If a checkpoint of the same run
# cannot be restored, the training ends: a partly restored run would learn something else, and starting over would lose
# work.

_MOST_CHARACTERS = 100  # of what PyTorch says


def write_checkpoint(path: Path, fingerprint: object, content: Mapping[str, Any]) -> None:
    """Write a checkpoint. The former checkpoint stays until this one is complete.

    Args:
        path: path of the file.
        fingerprint: settings and data of the run.
        content: tensors, numbers, words, and lists and dicts of them.

    Raises:
        CannotWrite: if the disk refuses.
    """
    buffer = io.BytesIO()
    torch.save({**content, "fingerprint": fingerprint}, buffer)
    write_atomically(path, buffer.getvalue())


def read_content(path: Path, fingerprint: object) -> dict[str, Any] | None:
    """Return the contents of a checkpoint, in main memory; None if it is missing, truncated or of another run.

    Raises:
        CorruptFile: if the file exists but cannot be read.
    """
    try:
        data = path.read_bytes()
    except FileNotFoundError:
        return None
    except OSError as error:
        raise CorruptFile(path, f"it cannot be read ({error.strerror or error})") from error
    try:
        content = torch.load(io.BytesIO(data), weights_only=True, map_location="cpu")
        return content if content["fingerprint"] == fingerprint else None
    except MemoryError:
        raise
    except Exception:  # PyTorch has no error of its own for what is no checkpoint
        return None


@contextlib.contextmanager
def going_on_from(path: Path) -> Iterator[None]:
    """Turn errors while a checkpoint of this run is restored into `CorruptFile`.

    Raises:
        CorruptFile: for any error other than a lack of memory.
    """
    try:
        yield
    except (MemoryError, torch.OutOfMemoryError):
        raise
    except Exception as error:
        cause = f"{type(error).__name__}: {error}".splitlines()[0][:_MOST_CHARACTERS]
        reason = f"the training cannot go on from it ({cause}); delete it to start over, or write to another file"
        raise CorruptFile(path, reason) from error


def resume_from(path: Path, fingerprint: object, restore: Callable[[dict[str, Any]], None]) -> None:
    """Continue from a checkpoint of the same run. Without a usable checkpoint, the run starts over.

    Args:
        path: path of the file.
        fingerprint: settings and data of the run, which the checkpoint must agree with.
        restore: function that receives the contents, in main memory.

    Raises:
        CorruptFile: if the checkpoint cannot be read or restored. The objects that `restore` changes are then unusable.
    """
    content = read_content(path, fingerprint)
    if content is not None:
        with going_on_from(path):
            restore(content)


def read_parameters(path: Path, expected: str, what: str) -> tuple[Mapping[str, str], dict[str, Tensor]]:
    """Return metadata and finite parameters of a safetensors file of the expected format.

    Args:
        path: path of the file.
        expected: format that the metadata must name.
        what: kind of network, for messages.

    Raises:
        CorruptFile: if the file is missing, truncated, of another format, or has values that are not finite.
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
    """Load the parameters of a file into a network.

    Raises:
        CorruptFile: if they do not fit the network.
    """
    try:
        network.load_state_dict(values)
    except RuntimeError as error:
        raise CorruptFile(path, "its parameters do not fit its description") from error
