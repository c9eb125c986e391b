"""Predicting pushes, scored: what is rolled out, by whom, and how far it ends from the truth."""

from __future__ import annotations

from collections.abc import Callable, Iterator, Mapping, Sequence
from dataclasses import dataclass
from typing import NamedTuple

import numpy as np
import torch
from jaxtyping import Bool, Float, Int
from torch import Tensor

from osfcore.dynamics.graph import PropagationNetwork, unroll
from osfcore.dynamics.motion import SUBSTEPS, Motion, going_on, is_on_table, lowest_point
from osfcore.dynamics.shapes import ObjectShape, ShapeTable
from osfcore.experiments.rivals.quasistatic import push
from osfcore.geometry.poses import rotate, rotation_angle
from osfcore.io.push_file import PushEpisode
from osfcore.metrics.pose_errors import rotation_error
from osfcore.objects.asset import Symmetry

HORIZONS = (1, 2, 3, 4, 6, 8, 10, 15, 20, 25, 30)
LONGEST = HORIZONS[-1]
MOVED_MM, MOVED_DEG = 10.0, 5.0  # what counts as truly moved within a window
_START_EVERY = 4  # steps
_CHUNK = 512  # windows


@dataclass(frozen=True, eq=False, slots=True)
class Windows:
    """Pieces of episodes with equally many objects: W windows of `LONGEST` actions.

    Attributes:
        names: of the objects of each window.
        positions: true ones, one action before the start (or at it, where there was none), at the start, and after each
            action [m].
        quaternions: likewise.
        pusher: likewise [m].
        actions: velocities [m/s].
        on_table: how many actions pass before something comes near the table's edge.
    """

    names: tuple[tuple[str, ...], ...]
    positions: Float[np.ndarray, "W T2 N 3"]
    quaternions: Float[np.ndarray, "W T2 N 4"]
    pusher: Float[np.ndarray, "W T2 3"]
    actions: Float[np.ndarray, "W T 3"]
    on_table: Int[np.ndarray, "W"]


@dataclass(frozen=True, eq=False, slots=True)
class Predicted:
    """Poses after each action.

    Attributes:
        positions: of the objects [m].
        quaternions: likewise.
    """

    positions: Float[np.ndarray, "W T N 3"]
    quaternions: Float[np.ndarray, "W T N 4"]


@dataclass(frozen=True, eq=False, slots=True)
class Errors:
    """How far one predictor ends from the truth, for every horizon, window and object.

    Attributes:
        mm: of position [mm].
        deg: of orientation, by the object's symmetry [deg].
        way_mm: how far the object truly went [mm].
        moved: whether it truly moved.
        valid: whether everything was on the table up to then.
    """

    mm: Float[np.ndarray, "H W N"]
    deg: Float[np.ndarray, "H W N"]
    way_mm: Float[np.ndarray, "H W N"]
    moved: Bool[np.ndarray, "H W N"]
    valid: Bool[np.ndarray, "H W N"]

    def median(self, horizon: int, *, deg: bool = False) -> float | None:
        """Of objects that truly moved; None if there are none."""
        values = self.of_moved(horizon, deg=deg)
        return float(np.median(values)) if len(values) else None

    def of_moved(self, horizon: int, *, deg: bool = False) -> Float[np.ndarray, "M"]:
        """Errors of objects that truly moved within so many actions."""
        at = HORIZONS.index(horizon)
        return (self.deg if deg else self.mm)[at][self.moved[at] & self.valid[at]]

    def of_still(self, horizon: int) -> Float[np.ndarray, "M"]:
        """Position errors of objects that did not [mm]."""
        at = HORIZONS.index(horizon)
        return self.mm[at][~self.moved[at] & self.valid[at]]


def windows_of(episodes: Sequence[PushEpisode]) -> Windows:
    """All windows of episodes of one length and number of objects."""
    parts: list[tuple[object, ...]] = []
    for e in episodes:
        inside = is_on_table(e)
        for start in range(0, len(e.actions) - LONGEST + 1, _START_EVERY):
            steps = np.clip(np.arange(start - 1, start + LONGEST + 1), 0, None)
            leaves = np.flatnonzero(~inside[start : start + LONGEST + 1])
            last = int(leaves[0]) - 1 if len(leaves) else LONGEST
            taken = e.actions[start : start + LONGEST]
            parts.append((e.names, e.positions[steps], e.quaternions[steps], e.pusher[steps], taken, last))
    names, *arrays = zip(*parts, strict=True)
    return Windows(names, *(np.array(array) for array in arrays))  # pyright: ignore[reportArgumentType]


def constant(windows: Windows) -> Predicted:
    """Nothing ever moves."""
    shape = (len(windows.names), LONGEST, windows.positions.shape[2])
    return Predicted(
        np.broadcast_to(windows.positions[:, 1:2], (*shape, 3)),
        np.broadcast_to(windows.quaternions[:, 1:2], (*shape, 4)),
    )


def learned(network: PropagationNetwork, shapes: Mapping[str, ObjectShape], windows: Windows) -> Predicted:
    """Predictions of the network, told the poses of one action before the start.

    Args:
        network: on the CPU.
        shapes: of all objects in the windows, by name.
        windows: what to predict.
    """

    def roll(scenes: _Scenes) -> Iterator[Motion]:
        given = (network, scenes.table, scenes.number)
        start = going_on(scenes.former, scenes.start)
        for step, motion in enumerate(unroll(*given, start, scenes.velocity), start=1):
            if step % SUBSTEPS == 0:
                yield motion

    return _rolled(shapes, windows, roll)


def analytic(shapes: Mapping[str, ObjectShape], windows: Windows) -> Predicted:
    """The quasi-static model."""

    def roll(scenes: _Scenes) -> Iterator[Motion]:
        return push(scenes.table, scenes.number, scenes.start, scenes.shifts)

    return _rolled(shapes, windows, roll)


class _Scenes(NamedTuple):
    """Some windows as tensors: the scenes one action before their start and at it, and what the pusher does."""

    table: ShapeTable
    number: Tensor
    former: Motion
    start: Motion
    velocity: Float[Tensor, "T B 2"]
    shifts: Float[Tensor, "T B 2"]


def _rolled(
    shapes: Mapping[str, ObjectShape], windows: Windows, roll: Callable[[_Scenes], Iterator[Motion]]
) -> Predicted:
    """Poses after each action, some windows at a time."""
    names = tuple(sorted(shapes))
    table = ShapeTable(tuple(shapes[name] for name in names))
    number = torch.tensor([[names.index(name) for name in row] for row in windows.names])
    centres: list[np.ndarray] = []
    turned: list[np.ndarray] = []
    with torch.inference_mode():
        for first in range(0, len(number), _CHUNK):
            rows = slice(first, first + _CHUNK)
            former, start = (_motion(table, number[rows], windows, rows, at) for at in (0, 1))
            velocity = torch.as_tensor(windows.actions[rows, :, :2], dtype=torch.float32).transpose(0, 1)
            shifts = torch.as_tensor(np.diff(windows.pusher[rows, 1:, :2], axis=1), dtype=torch.float32)
            motions = list(roll(_Scenes(table, number[rows], former, start, velocity, shifts.transpose(0, 1))))
            centres.append(torch.stack([motion.centre for motion in motions], dim=1).numpy())
            turned.append(torch.stack([motion.quaternion for motion in motions], dim=1).numpy())
    quaternions = np.concatenate(turned).astype(float)
    offsets = np.array([shapes[name].centre for name in names])[number.numpy()][:, None]
    return Predicted(np.concatenate(centres) - rotate(quaternions, offsets), quaternions)


def _motion(table: ShapeTable, number: Tensor, windows: Windows, rows: slice, at: int) -> Motion:
    """The scenes at one instant, at rest."""
    quaternion = torch.as_tensor(windows.quaternions[rows, at], dtype=torch.float32)
    offsets = table.centre[number].numpy()
    centre = windows.positions[rows, at] + rotate(windows.quaternions[rows, at], offsets)
    centre = torch.as_tensor(centre, dtype=torch.float32)
    lowest = lowest_point(table, number.flatten(), centre.flatten(0, 1), quaternion.flatten(0, 1)).view(number.shape)
    still = torch.zeros_like(centre)
    pusher = torch.as_tensor(windows.pusher[rows, at, :2], dtype=torch.float32)
    return Motion(centre, quaternion, still, still, pusher, lowest.clamp(max=0))


def errors(windows: Windows, predicted: Predicted, symmetries: Mapping[str, Symmetry]) -> Errors:
    """Score a predictor at every horizon.

    Args:
        windows: with the truth.
        predicted: for these windows.
        symmetries: of all objects in them, by name.
    """
    at = np.array(HORIZONS)
    true_p, true_q = (np.moveaxis(a[:, 1 + at], 1, 0) for a in (windows.positions, windows.quaternions))
    p, q = (np.moveaxis(a[:, at - 1], 1, 0) for a in (predicted.positions, predicted.quaternions))
    way = 1e3 * np.linalg.norm(true_p - windows.positions[:, 1], axis=-1)
    start = np.broadcast_to(windows.quaternions[:, 1], true_q.shape)
    turned = _angles(windows, symmetries, start, true_q)
    valid = at[:, None] <= windows.on_table
    return Errors(
        mm=1e3 * np.linalg.norm(p - true_p, axis=-1),
        deg=_angles(windows, symmetries, q, true_q),
        way_mm=way,
        moved=(way > MOVED_MM) | (turned > MOVED_DEG),
        valid=np.broadcast_to(valid[..., None], way.shape),
    )


def _angles(
    windows: Windows, symmetries: Mapping[str, Symmetry], a: Float[np.ndarray, "H W N 4"], b: np.ndarray
) -> Float[np.ndarray, "H W N"]:
    """Symmetry-aware angles between orientations [deg]."""
    angles = np.asarray(rotation_angle(a, b))
    for window, names in enumerate(windows.names):
        for slot, name in enumerate(names):
            if symmetries[name].kind != "none":
                for h in range(len(HORIZONS)):
                    place = (h, window, slot)
                    angles[place] = rotation_error(symmetries[name], a[place], b[place])
    return np.rad2deg(angles)
