"""Checkpoints of a training run: everything that is needed to go on as if nothing had happened."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np
import torch

from osfcore.fields.kiloosf import KiloOSF
from osfcore.io import training_checkpoint

_ARRAYS = ("origin", "index", "rows", "cells", "networks", "ambient")


@dataclass(frozen=True, eq=False, slots=True)
class Checkpoint:
    """A run between two steps.

    Attributes:
        stage: name of the phase.
        field: the field as it is.
        optimiser: its moments and step count.
        clock: time and steps spent, last measurements.
        random: states of the random generators.
    """

    stage: str
    field: KiloOSF
    optimiser: dict[str, Any]
    clock: dict[str, Any]
    random: dict[str, Any]


def write_checkpoint(path: Path, checkpoint: Checkpoint, fingerprint: Mapping[str, Any]) -> None:
    """Write a checkpoint; the former one stays until the new one is whole.

    Args:
        path: of the file.
        checkpoint: the run as it is.
        fingerprint: settings and data of the run, which `read_checkpoint` compares.

    Raises:
        CannotWrite: if the disk refuses.
    """
    field = checkpoint.field
    arrays = {name: torch.from_numpy(np.ascontiguousarray(getattr(field, name))) for name in _ARRAYS}
    content = {
        "stage": checkpoint.stage,
        "field": {**arrays, "voxel": field.voxel, "hidden": field.hidden},
        "optimiser": checkpoint.optimiser,
        "clock": checkpoint.clock,
        "random": checkpoint.random,
    }
    training_checkpoint.write_checkpoint(path, dict(fingerprint), content)


def read_checkpoint(path: Path, fingerprint: Mapping[str, Any]) -> Checkpoint | None:
    """The checkpoint of the same run; None if there is none, it is cut short, or it belongs to other settings.

    Raises:
        CorruptFile: if it is of this run, but cannot be used.
    """
    content = training_checkpoint.read_content(path, dict(fingerprint))
    if content is None:
        return None
    with training_checkpoint.going_on_from(path):
        stored = content["field"]
        arrays = {name: stored[name].numpy() for name in _ARRAYS}
        field = KiloOSF(voxel=stored["voxel"], hidden=stored["hidden"], **arrays)
        return Checkpoint(content["stage"], field, content["optimiser"], content["clock"], content["random"])
