"""Whose predictions are evaluated: those of our model, or of the paper's as it is published."""

from __future__ import annotations

from collections.abc import Callable, Mapping
from dataclasses import dataclass
from pathlib import Path
from typing import Literal, get_args

import numpy as np
import torch
from torch import Tensor

from osfcore.dynamics.dynamics_model import DynamicsModel
from osfcore.dynamics.network_weights import read_network
from osfcore.dynamics.push_models import network_path
from osfcore.dynamics.pusher_path import SUBSTEPS, pusher_path
from osfcore.dynamics.rollout import PushModel
from osfcore.dynamics.shapes.object_shapes import ObjectShape
from osfcore.errors import InvalidInput
from osfcore.experiments.dynamics.scores import Predicted, Windows, learned
from osfcore.fields.field_library import FieldLibrary
from osfcore.paper.dynamics.graph import Scenes, longest_axes
from osfcore.paper.dynamics.graph_network import GraphNetwork
from osfcore.paper.dynamics.prediction import unroll
from osfcore.paper.dynamics.rollout import PaperPushModel
from osfcore.paper.dynamics.weights import read_network as read_paper_network
from osfcore.paper.dynamics.weights import weights_path

DynamicsMethod = Literal["ours", "paper"]
METHODS: tuple[DynamicsMethod, ...] = get_args(DynamicsMethod)
_CHUNK = 512  # windows


@dataclass(frozen=True, eq=False, slots=True)
class Predictor:
    """One way to predict.

    Attributes:
        predict: poses in windows of episodes, told the poses of one action before the start.
        model: the same as planning asks for it.
    """

    predict: Callable[[Windows], Predicted]
    model: DynamicsModel


def check_method(method: str) -> None:
    """Refuse what is no method.

    Raises:
        InvalidInput: if it is none.
    """
    if method not in METHODS:
        raise InvalidInput("method", repr(method), f"one of {', '.join(METHODS)}")


def load_predictor(
    method: DynamicsMethod, data_dir: Path | None, fields: FieldLibrary, shapes: Mapping[str, ObjectShape]
) -> Predictor:
    """A trained network, on the CPU.

    Args:
        method: whose.
        data_dir: a network in it comes before the package's.
        fields: of the objects.
        shapes: of all objects that occur, by name.

    Raises:
        CorruptFile: if a file is broken.
    """
    if method == "ours":
        network = read_network(network_path(data_dir))
        return Predictor(lambda windows: learned(network, shapes, windows), PushModel(network, shapes))
    published, kappas = read_paper_network(weights_path(data_dir)), longest_axes(fields, shapes)
    return Predictor(lambda windows: as_published(published, kappas, windows), PaperPushModel(published, kappas))


def as_published(network: GraphNetwork, kappas: Mapping[str, float], windows: Windows) -> Predicted:
    """Predictions of the paper's network, which looks at the poses at the start alone.

    Args:
        network: on the CPU.
        kappas: longest axes of all objects in the windows, by name [m].
        windows: what to predict.
    """
    number = torch.tensor([[network.number(name) for name in row] for row in windows.names])
    kappa = torch.tensor([[kappas[name] for name in row] for row in windows.names])
    path = pusher_path(windows.pusher[:, 1, :2], windows.actions[..., :2])[:, ::SUBSTEPS]
    height = np.broadcast_to(windows.pusher[:, 1:2, 2:], (*path.shape[:2], 1))
    pusher = _tensor(np.concatenate([path, height], axis=-1))
    start = Scenes(_tensor(windows.positions[:, 1]), _tensor(windows.quaternions[:, 1]), pusher[:, 0])
    placed: list[np.ndarray] = []
    turned: list[np.ndarray] = []
    with torch.inference_mode():
        for first in range(0, len(number), _CHUNK):
            rows = slice(first, first + _CHUNK)
            begin = Scenes(start.position[rows], start.quaternion[rows], start.pusher[rows])
            actions = _tensor(windows.actions[rows])
            scenes = list(unroll(network, number[rows], kappa[rows], begin, actions, pusher[rows]))
            placed.append(torch.stack([s.position for s in scenes], dim=1).numpy())
            turned.append(torch.stack([s.quaternion for s in scenes], dim=1).numpy())
    return Predicted(np.concatenate(placed).astype(float), np.concatenate(turned).astype(float))


def _tensor(array: np.ndarray) -> Tensor:
    return torch.as_tensor(np.ascontiguousarray(array), dtype=torch.float32)
