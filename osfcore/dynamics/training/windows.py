"""Pieces of recorded pushes as tensors: what training and evaluation roll out and compare with."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from typing import NamedTuple

import numpy as np
import torch
from jaxtyping import Bool, Float, Int
from torch import Tensor

from osfcore.dynamics.motion import Motion, lowest_point, sleeping
from osfcore.dynamics.pusher_path import SUBSTEPS, pusher_path
from osfcore.dynamics.recorded_states import is_on_table, substates
from osfcore.dynamics.shapes.object_shapes import ObjectShape, ShapeTable
from osfcore.errors import InvalidInput
from osfcore.geometry.poses import quaternion_conjugate, quaternion_log, quaternion_multiply, rotate
from osfcore.io.push_file import PushEpisode

_MOVED_M = 1e-3


class Targets(NamedTuple):
    """Where the objects of B windows truly are after each substep.

    Attributes:
        centre: centres of mass [m].
        quaternion: orientations.
    """

    centre: Float[Tensor, "S B N 3"]
    quaternion: Float[Tensor, "S B N 4"]


@dataclass(frozen=True, eq=False, slots=True)
class Recording:
    """Episodes of one length and number of objects, substep by substep.

    Attributes:
        number: shape of each object.
        centre: centres of mass before the first substep and after each one [m].
        quaternion: orientations, likewise.
        pusher: its centre, likewise [m].
        velocity: commanded in each action [m/s].
        starts: episode and action at which windows of `length` actions may start.
        is_busy: whether something moves or is touched in such a window.
        length: of the windows [actions].
    """

    number: Int[Tensor, "E N"]
    centre: Float[Tensor, "E S1 N 3"]
    quaternion: Float[Tensor, "E S1 N 4"]
    pusher: Float[Tensor, "E S1 2"]
    velocity: Float[Tensor, "E T 2"]
    starts: Int[np.ndarray, "W 2"]
    is_busy: Bool[np.ndarray, "W"]
    length: int

    @property
    def telling(self) -> Int[np.ndarray, "chosen"]:
        """Numbers of the windows in which something happens; of all where nothing ever does."""
        busy = np.flatnonzero(self.is_busy)
        return busy if len(busy) else np.arange(len(self.starts))


def record(episodes: Sequence[PushEpisode], shapes: Mapping[str, ObjectShape], length: int) -> Recording:
    """Episodes as tensors, with the windows that can be learned from.

    Args:
        episodes: recorded with poses within their actions.
        shapes: of all objects in them, by name; numbered by sorted names.
        length: of the windows [actions].

    Raises:
        InvalidInput: if the episodes were recorded without substeps, differ in length or number of objects, or are
            shorter than a window.
    """
    order = {name: number for number, name in enumerate(sorted(shapes))}
    sizes = {(len(e.actions), len(e.names)) for e in episodes}
    if len(sizes) != 1 or min(sizes)[0] < length:
        raise InvalidInput("steps and objects of the episodes", sorted(sizes), f"equal, with at least {length} steps")
    number = np.array([[order[name] for name in e.names] for e in episodes])
    poses = [substates(e) for e in episodes]
    position, quaternion = np.stack([p.position for p in poses]), np.stack([p.quaternion for p in poses])
    centres = np.array([shapes[name].centre for name in sorted(shapes)])
    centre = position + rotate(quaternion, centres[number][:, None])
    velocity = np.stack([e.actions[:, :2] for e in episodes])
    pusher = np.stack([pusher_path(e.pusher[0, :2], e.actions[:, :2]) for e in episodes])
    starts, is_busy = _windows(episodes, length)

    def tensor(array: np.ndarray) -> Tensor:
        return torch.as_tensor(np.ascontiguousarray(array), dtype=torch.float32)

    return Recording(torch.as_tensor(number), tensor(centre), tensor(quaternion), tensor(pusher), tensor(velocity),
                     starts, is_busy, length)  # fmt: skip


def _windows(episodes: Sequence[PushEpisode], length: int) -> tuple[np.ndarray, np.ndarray]:
    """Starts of windows in which nothing falls off the table, and whether anything happens in them."""
    starts, busy = [], []
    for number, e in enumerate(episodes):
        last = len(e.actions) - length
        safe = is_on_table(e)
        moved = np.linalg.norm(np.diff(e.positions, axis=0), axis=-1).max(axis=1) > _MOVED_M
        happens = moved | e.contact.any(axis=1)
        for start in range(last + 1):
            if safe[start : start + length + 1].all():
                starts.append((number, start))
                busy.append(happens[start : start + length].any())
    return np.array(starts, int).reshape(-1, 2), np.array(busy, bool)


class Batch(NamedTuple):
    """B windows ready to be rolled out.

    Attributes:
        number: shape of each object.
        motion: at their start.
        velocity: commanded in each action [m/s].
        targets: the truth.
    """

    number: Int[Tensor, "B N"]
    motion: Motion
    velocity: Float[Tensor, "T B 2"]
    targets: Targets


def batch(
    recording: Recording,
    table: ShapeTable,
    windows: Int[np.ndarray, "B"],
    device: torch.device | str = "cpu",
    coarse: Bool[np.ndarray, "B"] | None = None,
) -> Batch:
    """Windows of a recording, ready to be rolled out. Velocities at their starts are those of the substep before.

    Args:
        recording: that holds them.
        table: shapes, on `device`.
        windows: numbers in `recording.starts`.
        device: of the tensors.
        coarse: windows that start with means over the action before instead, all that a rollout from observed states
            knows; by default none.
    """
    episode, start = (torch.as_tensor(column) for column in recording.starts[windows].T)
    first = start * SUBSTEPS
    steps = first[:, None] + torch.arange(recording.length * SUBSTEPS + 1)
    centre, quaternion = recording.centre[episode[:, None], steps], recording.quaternion[episode[:, None], steps]
    back = torch.ones_like(first) if coarse is None else torch.where(torch.as_tensor(coarse), SUBSTEPS, 1)
    back = torch.minimum(back, first)
    share = 1 / back.clamp(min=1)[:, None, None]
    linear = share * (centre[:, 0] - recording.centre[episode, first - back])
    angular = share * turn_between(recording.quaternion[episode, first - back], quaternion[:, 0])
    actions = start[:, None] + torch.arange(recording.length)
    number = recording.number[episode].to(device)

    def put(tensor: Tensor) -> Tensor:
        return tensor.to(device)

    lowest = lowest_point(
        table, number.flatten(), put(centre[:, 0].flatten(0, 1)), put(quaternion[:, 0].flatten(0, 1))
    ).view(number.shape)
    start = (centre[:, 0], quaternion[:, 0], linear, angular, recording.pusher[episode, first])
    motion = sleeping(Motion(*[put(part) for part in start], floor=lowest.clamp(max=0)))
    targets = Targets(put(centre[:, 1:].transpose(0, 1)), put(quaternion[:, 1:].transpose(0, 1)))
    return Batch(number, motion, put(recording.velocity[episode[:, None], actions].transpose(0, 1)), targets)


def turn_between(first: Tensor, second: Tensor) -> Tensor:
    """Rotation vectors from one orientation to another [rad]."""
    a, b = first.double().numpy(), second.double().numpy()
    return torch.as_tensor(quaternion_log(quaternion_multiply(b, quaternion_conjugate(a))), dtype=torch.float32)
