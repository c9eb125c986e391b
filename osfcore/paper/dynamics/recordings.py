"""Recorded pushes as tensors, action by action: what the paper's model learns from and is measured on."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from typing import NamedTuple

import numpy as np
import torch
from jaxtyping import Float, Int
from torch import Tensor

from osfcore.dynamics.recorded_states import is_on_table
from osfcore.errors import InvalidInput
from osfcore.io.push_file import PushEpisode
from osfcore.paper.dynamics.graph import Scenes
from osfcore.paper.dynamics.graph_network import GraphNetwork


@dataclass(frozen=True, eq=False, slots=True)
class Recording:
    """E episodes of T actions and N objects.

    Attributes:
        number: of each object, as the network numbers them.
        kappa: of each object [m].
        position: of the objects, before the first and after each action [m].
        quaternion: likewise.
        pusher: its centre, likewise [m].
        action: velocity of the pusher [m/s].
        starts: episode and action at which windows of `length` actions may start.
        length: of the windows [actions].
    """

    number: Int[Tensor, "E N"]
    kappa: Float[Tensor, "E N"]
    position: Float[Tensor, "E T1 N 3"]
    quaternion: Float[Tensor, "E T1 N 4"]
    pusher: Float[Tensor, "E T1 3"]
    action: Float[Tensor, "E T 3"]
    starts: Int[np.ndarray, "W 2"]
    length: int


class Windows(NamedTuple):
    """B pieces of a recording.

    Attributes:
        number: of each object, as the network numbers them.
        kappa: of each object [m].
        start: the scenes before the first action.
        action: velocities of the pusher [m/s].
        pusher: its centre before the first and after each action [m].
        position: of the objects after each action [m].
        quaternion: likewise.
    """

    number: Int[Tensor, "B N"]
    kappa: Float[Tensor, "B N"]
    start: Scenes
    action: Float[Tensor, "B T 3"]
    pusher: Float[Tensor, "B T1 3"]
    position: Float[Tensor, "B T N 3"]
    quaternion: Float[Tensor, "B T N 4"]


def record(
    episodes: Sequence[PushEpisode], network: GraphNetwork, kappas: Mapping[str, float], length: int
) -> Recording:
    """Episodes as tensors, with the windows in which nothing falls off the table.

    Args:
        episodes: recorded pushes.
        network: that numbers their objects.
        kappas: longest axes of all of them, by name [m].
        length: of the windows [actions].

    Raises:
        InvalidInput: if the episodes differ in length or number of objects, or hold no such window.
    """
    sizes = {(len(e.actions), len(e.names)) for e in episodes}
    if len(sizes) != 1 or min(sizes)[0] < length:
        raise InvalidInput("steps and objects of the episodes", sorted(sizes), f"equal, with at least {length} steps")
    starts = np.array([place for n, e in enumerate(episodes) for place in _starts(n, e, length)], int).reshape(-1, 2)
    if not len(starts):
        what = f"windows of {length} actions in which all objects stay on the table"
        raise InvalidInput(what, 0, "at least 1: collect more pushes")

    def stacked(name: str) -> Tensor:
        return torch.as_tensor(np.stack([getattr(e, name) for e in episodes]), dtype=torch.float32)

    return Recording(
        number=torch.tensor([[network.number(name) for name in e.names] for e in episodes]),
        kappa=torch.tensor([[kappas[name] for name in e.names] for e in episodes]),
        position=stacked("positions"),
        quaternion=stacked("quaternions"),
        pusher=stacked("pusher"),
        action=stacked("actions"),
        starts=starts,
        length=length,
    )


def _starts(number: int, episode: PushEpisode, length: int) -> list[tuple[int, int]]:
    safe = is_on_table(episode)
    return [(number, at) for at in range(len(safe) - length) if safe[at : at + length + 1].all()]


def windows(recording: Recording, chosen: Int[np.ndarray, "B"], device: torch.device | str = "cpu") -> Windows:
    """Some windows of a recording.

    Args:
        recording: that holds them.
        chosen: numbers in `recording.starts`.
        device: of the tensors.
    """
    episode, first = (torch.as_tensor(column) for column in recording.starts[chosen].T)
    rows, times = episode[:, None], first[:, None] + torch.arange(recording.length + 1)
    position, quaternion = recording.position[rows, times].to(device), recording.quaternion[rows, times].to(device)
    pusher = recording.pusher[rows, times].to(device)
    start = Scenes(position[:, 0], quaternion[:, 0], pusher[:, 0])
    number, kappa = recording.number[episode].to(device), recording.kappa[episode].to(device)
    action = recording.action[rows, times[:, :-1]].to(device)
    return Windows(number, kappa, start, action, pusher, position[:, 1:], quaternion[:, 1:])
