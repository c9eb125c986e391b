"""Errors of the paper's network on held-out windows, as ours are measured, beside those of predicting no motion."""

from __future__ import annotations

import math
from dataclasses import dataclass

import numpy as np
import torch
from jaxtyping import Float
from torch import Tensor

from osfcore.paper.dynamics.graph import Scenes
from osfcore.paper.dynamics.graph_network import GraphNetwork
from osfcore.paper.dynamics.prediction import unroll
from osfcore.paper.dynamics.recordings import Recording, Windows, windows

MEASURED_WINDOW = 4  # actions
_MOVED_M, _MOVED_RAD = 0.01, math.radians(5)  # what counts as truly moved within a window
_TOGETHER = 512  # windows


@dataclass(frozen=True, slots=True)
class Validation:
    """Errors after four actions of objects that truly moved; of all objects where none did.

    Attributes:
        windows: how many objects in windows truly moved.
        mm_4: median error of position [mm].
        deg_4: median error of orientation [deg].
        mean_mm_4: mean error of position [mm]; training keeps the weights with the least.
        constant_mm_4: median error of position when nothing is predicted to move [mm].
        constant_deg_4: median error of orientation, likewise [deg].
    """

    windows: int
    mm_4: float
    deg_4: float
    mean_mm_4: float
    constant_mm_4: float
    constant_deg_4: float


@torch.inference_mode()
def validate(network: GraphNetwork, recording: Recording, device: torch.device | str = "cpu") -> Validation:
    """Roll out all held-out windows.

    Args:
        network: to measure, on `device`.
        recording: of episodes that nothing was learned from, with windows of four actions.
        device: that computes.
    """
    count = len(recording.starts)
    parts = [_errors(network, windows(recording, rows, device)) for rows in _chunks(count)]
    shift, turn, way, turned = torch.cat(parts, dim=1)
    moved = (way > _MOVED_M) | (turned > _MOVED_RAD)
    chosen = moved if bool(moved.any()) else torch.ones_like(moved)
    shift, turn, way, turned = (part[chosen] for part in (1e3 * shift, turn.rad2deg(), 1e3 * way, turned.rad2deg()))
    medians = [float(part.median()) for part in (shift, turn, way, turned)]
    return Validation(int(moved.sum()), medians[0], medians[1], float(shift.mean()), medians[2], medians[3])


def _chunks(count: int) -> list[np.ndarray]:
    return np.array_split(np.arange(count), range(_TOGETHER, count, _TOGETHER))


def _errors(network: GraphNetwork, pieces: Windows) -> Float[Tensor, "four B N"]:
    """How far and by what angle predictions end from the truth, and beginnings [m, rad]."""
    *_, end = unroll(network, pieces.number, pieces.kappa, pieces.start, pieces.action, pieces.pusher)
    differences = [_difference(scenes, pieces) for scenes in (end, pieces.start)]
    return torch.cat(differences)


def _difference(scenes: Scenes, pieces: Windows) -> Float[Tensor, "two B N"]:
    cosine = (scenes.quaternion * pieces.quaternion[:, -1]).sum(dim=-1).abs().double().clamp(max=1)
    return torch.stack([(scenes.position - pieces.position[:, -1]).norm(dim=-1), 2 * torch.acos(cosine).float()])
