"""Predicting pushes, scored: what is rolled out, by whom, and how far it ends from the truth."""

from __future__ import annotations

from collections.abc import Callable, Iterator, Mapping, Sequence
from dataclasses import dataclass, fields
from itertools import islice

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

    def chunks(self) -> Iterator[Windows]:
        """Yield a few hundred windows at a time, to bound the memory that predictions take."""
        for first in range(0, len(self.names), _CHUNK):
            yield Windows(*(getattr(self, field.name)[first : first + _CHUNK] for field in fields(self)))


@dataclass(frozen=True, eq=False, slots=True)
class Predicted:
    """Poses of the objects after each action [m]."""

    positions: Float[np.ndarray, "W T N 3"]
    quaternions: Float[np.ndarray, "W T N 4"]


@dataclass(frozen=True, eq=False, slots=True)
class Errors:
    """How far one predictor ends from the truth, for every horizon, window and object.

    Attributes:
        mm: error of the position [mm].
        deg: error of the orientation, by the object's symmetry [deg].
        moved: whether the object truly moved.
        valid: whether everything was on the table up to then.
    """

    mm: Float[np.ndarray, "H W N"]
    deg: Float[np.ndarray, "H W N"]
    moved: Bool[np.ndarray, "H W N"]
    valid: Bool[np.ndarray, "H W N"]

    def of_moved(
        self, horizon: int, *, deg: bool = False, among: Bool[np.ndarray, "W N"] | bool = True
    ) -> Float[np.ndarray, "M"]:
        """Return errors of objects that truly moved within so many actions [mm or deg].

        Args:
            horizon: one of `HORIZONS`.
            deg: errors of orientations instead of positions.
            among: objects that count.
        """
        at = HORIZONS.index(horizon)
        return (self.deg if deg else self.mm)[at][self.moved[at] & self.valid[at] & among]

    def of_still(self, horizon: int) -> Float[np.ndarray, "M"]:
        """Return position errors of objects that did not move [mm]."""
        at = HORIZONS.index(horizon)
        return self.mm[at][~self.moved[at] & self.valid[at]]


def windows_of(episodes: Sequence[PushEpisode]) -> Windows:
    """Cut episodes of one length and number of objects into windows."""
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
    """Predict that nothing ever moves."""
    shape = (len(windows.names), LONGEST, windows.positions.shape[2])
    return Predicted(
        np.broadcast_to(windows.positions[:, 1:2], (*shape, 3)),
        np.broadcast_to(windows.quaternions[:, 1:2], (*shape, 4)),
    )


def learned(network: PropagationNetwork, shapes: Mapping[str, ObjectShape], windows: Windows) -> Predicted:
    """Predict by the network, which knows the poses of one action before the start.

    Args:
        network: on the CPU.
        shapes: of all objects in the windows, by name.
        windows: what to predict.
    """

    def roll(table: ShapeTable, number: Tensor, part: Windows) -> Iterator[Motion]:
        start = going_on(_at_rest(table, number, part, 0), _at_rest(table, number, part, 1))
        velocity = torch.as_tensor(part.actions[..., :2], dtype=torch.float32).transpose(0, 1)
        return islice(unroll(network, table, number, start, velocity), SUBSTEPS - 1, None, SUBSTEPS)

    return _rolled(shapes, windows, roll)


def analytic(shapes: Mapping[str, ObjectShape], windows: Windows) -> Predicted:
    """Predict by the quasi-static model."""

    def roll(table: ShapeTable, number: Tensor, part: Windows) -> Iterator[Motion]:
        shifts = torch.as_tensor(np.diff(part.pusher[:, 1:, :2], axis=1), dtype=torch.float32)
        return push(table, number, _at_rest(table, number, part, 1), shifts.transpose(0, 1))

    return _rolled(shapes, windows, roll)


def _rolled(
    shapes: Mapping[str, ObjectShape], windows: Windows, roll: Callable[[ShapeTable, Tensor, Windows], Iterator[Motion]]
) -> Predicted:
    """Return poses after each action.

    Args:
        shapes: of all objects in the windows, by name.
        windows: what to predict.
        roll: yields motions after each action of some windows, given a table of shapes and the objects' numbers in it.
    """
    names = tuple(sorted(shapes))
    table = ShapeTable(tuple(shapes[name] for name in names))
    centres, turned = [], []
    with torch.inference_mode():
        for part in windows.chunks():
            number = torch.tensor([[names.index(name) for name in row] for row in part.names])
            motions = list(roll(table, number, part))
            centres.append(torch.stack([motion.centre for motion in motions], dim=1).numpy())
            turned.append(torch.stack([motion.quaternion for motion in motions], dim=1).numpy())
    quaternions = np.concatenate(turned).astype(float)
    offsets = np.array([[shapes[name].centre for name in row] for row in windows.names])[:, None]
    return Predicted(np.concatenate(centres) - rotate(quaternions, offsets), quaternions)


def _at_rest(table: ShapeTable, number: Tensor, windows: Windows, at: int) -> Motion:
    """Return the scenes one action before the start (at = 0) or at it (1), without velocities."""
    quaternion = torch.as_tensor(windows.quaternions[:, at], dtype=torch.float32)
    offsets = table.centre[number].numpy()
    centre = windows.positions[:, at] + rotate(windows.quaternions[:, at], offsets)
    centre = torch.as_tensor(centre, dtype=torch.float32)
    lowest = lowest_point(table, number.flatten(), centre.flatten(0, 1), quaternion.flatten(0, 1)).view(number.shape)
    still = torch.zeros_like(centre)
    pusher = torch.as_tensor(windows.pusher[:, at, :2], dtype=torch.float32)
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
    way_mm = 1e3 * np.linalg.norm(true_p - windows.positions[:, 1], axis=-1)
    start = np.broadcast_to(windows.quaternions[:, 1], true_q.shape)
    turned_deg = _angles(windows, symmetries, start, true_q)
    valid = at[:, None] <= windows.on_table
    return Errors(
        mm=1e3 * np.linalg.norm(p - true_p, axis=-1),
        deg=_angles(windows, symmetries, q, true_q),
        moved=(way_mm > MOVED_MM) | (turned_deg > MOVED_DEG),
        valid=np.broadcast_to(valid[..., None], way_mm.shape),
    )


def _angles(
    windows: Windows, symmetries: Mapping[str, Symmetry], a: Float[np.ndarray, "H W N 4"], b: np.ndarray
) -> Float[np.ndarray, "H W N"]:
    """Return symmetry-aware angles between orientations [deg]."""
    angles = np.asarray(rotation_angle(a, b))
    for window, names in enumerate(windows.names):
        for slot, name in enumerate(names):
            if symmetries[name].kind != "none":
                for h in range(len(HORIZONS)):
                    place = (h, window, slot)
                    angles[place] = rotation_error(symmetries[name], a[place], b[place])
    return np.rad2deg(angles)
