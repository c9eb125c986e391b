"""Checkpoints of trainings in PyTorch: written whole, and gone on from by the same run alone.

A checkpoint that is missing, cut short or of another run lets a training start over. One of this run that cannot be
taken over ends it: a run restored by half would learn something else, and starting over would lose the work unasked.
"""

from __future__ import annotations

import contextlib
import io
from collections.abc import Callable, Iterator, Mapping
from pathlib import Path
from typing import Any

import torch

from osfcore.errors import CorruptFile
from osfcore.io.files import write_atomically

_MOST_CHARACTERS = 100  # of what PyTorch says


def write_checkpoint(path: Path, fingerprint: object, content: Mapping[str, Any]) -> None:
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


def read_content(path: Path, fingerprint: object) -> dict[str, Any] | None:
    """What a run has written to go on, in main memory; None if it is missing, cut short or of another run.

    Raises:
        CorruptFile: if there is a file, but it cannot be read at all.
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
    """Tell in one sentence that a checkpoint of this run cannot be taken over.

    Raises:
        CorruptFile: for whatever is raised while that is tried, other than a lack of memory.
    """
    try:
        yield
    except (MemoryError, torch.OutOfMemoryError):
        raise
    except Exception as error:
        told = f"{type(error).__name__}: {error}".splitlines()[0][:_MOST_CHARACTERS]
        reason = f"the training cannot go on from it ({told}); delete it to start over, or write to another file"
        raise CorruptFile(path, reason) from error


def resume_from(path: Path, fingerprint: object, restore: Callable[[dict[str, Any]], None]) -> None:
    """Go on from a checkpoint of the same run; a run whose checkpoint is missing, cut short or old starts over.

    Args:
        path: of the file.
        fingerprint: must be that of the checkpoint.
        restore: takes over the content, which lies in main memory.

    Raises:
        CorruptFile: if the checkpoint cannot be read, or taken over; what `restore` was to change is then of no use.
    """
    content = read_content(path, fingerprint)
    if content is not None:
        with going_on_from(path):
            restore(content)
