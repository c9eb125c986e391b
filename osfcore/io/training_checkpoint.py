"""Checkpoints of trainings in PyTorch: written whole, and gone on from by the same run alone."""

from __future__ import annotations

import io
from collections.abc import Callable, Mapping
from pathlib import Path
from typing import Any

import torch

from osfcore.io.files import write_atomically


def write_checkpoint(path: Path, fingerprint: str, content: Mapping[str, Any]) -> None:
    """Write what a run needs to go on; the former checkpoint stays until this one is whole.

    Args:
        path: of the file.
        fingerprint: settings and data of the run.
        content: tensors, numbers, words, and lists and dicts of them.

    Raises:
        CannotWrite: if the disk refuses.
    """
    buffer = io.BytesIO()
    torch.save({**content, "fingerprint": fingerprint}, buffer)
    write_atomically(path, buffer.getvalue())


def resume_from(
    path: Path, fingerprint: str, restore: Callable[[dict[str, Any]], None], device: torch.device | str = "cpu"
) -> None:
    """Go on from a checkpoint of the same run; a run whose checkpoint is missing, cut short or old starts over.

    Args:
        path: of the file.
        fingerprint: must be that of the checkpoint.
        restore: takes over the content.
        device: where tensors go.
    """
    try:
        content = torch.load(path, weights_only=True, map_location=device)
        if content["fingerprint"] == fingerprint:
            restore(content)
    except Exception:  # whatever is wrong with it, the training can be done again
        return
