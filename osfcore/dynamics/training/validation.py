"""Errors of a network on held-out windows, and the distance that training minimises."""

from __future__ import annotations

import math
from dataclasses import dataclass

import numpy as np
import torch
from torch import Tensor

from osfcore.dynamics.motion import Motion
from osfcore.dynamics.propagation_network import PropagationNetwork
from osfcore.dynamics.shapes.object_shapes import ShapeTable
from osfcore.dynamics.substep import unroll
from osfcore.dynamics.training.windows import Batch, Recording, batch
from osfcore.geometry import torch_rotations as rotations

MEASURED_WINDOW = 4
MOVED_M = 0.01
MOVED_RAD = math.radians(5)  # what counts as truly moved within a window
_ARM_M = 0.05  # a rotation by an angle counts as the angle times this
_MEASURED = 2000  # windows


@dataclass(frozen=True, slots=True)
class Validation:
    """Errors on held-out windows of four actions, of objects that truly moved.

    Attributes:
        windows: how many objects in windows truly moved.
        mm_4: median error of position after four actions [mm].
        deg_4: median error of orientation [deg].
        mean_mm_4: mean error of position [mm].
        loss: mean distance over all substeps [mm]; training keeps the weights with the least.
        constant_mm_4: median distance these objects travel, the error of predicting no motion [mm].
    """

    windows: int
    mm_4: float
    deg_4: float
    mean_mm_4: float
    loss: float
    constant_mm_4: float


def distance(motion: Motion, pieces: Batch, step: int) -> Tensor:
    """How far every object is from the truth after a substep (B, N) [m], its orientation included.

    Args:
        motion: predicted.
        pieces: the windows, with the truth.
        step: which substep, from 0.
    """
    shift = motion.centre - pieces.targets.centre[step]
    turn = 2 * _sine(motion.quaternion, pieces.targets.quaternion[step])
    return (shift.square().sum(dim=-1) + (_ARM_M * turn).square() + 1e-8).sqrt()


def _sine(a: Tensor, b: Tensor) -> Tensor:
    """Sine of half the angle between orientations."""
    between = rotations.multiply(b * b.new_tensor([1.0, -1.0, -1.0, -1.0]), a)
    return (between[..., 1:].square().sum(dim=-1) + 1e-12).sqrt()


@torch.inference_mode()
def validate(
    network: PropagationNetwork, table: ShapeTable, recording: Recording, device: torch.device | str = "cpu"
) -> Validation:
    """Errors on windows in which something happens, or on all where nothing ever does.

    Args:
        network: to measure.
        table: shapes of the recorded objects, on `device`.
        recording: held out, with one or more windows of four actions; of the busy ones 2000 at most are measured.
        device: that computes.
    """
    chosen = np.random.default_rng(0).permutation(recording.telling)[:_MEASURED]
    pieces = batch(recording, table, chosen, device)
    loss, motion = 0.0, pieces.motion
    for step, motion in enumerate(unroll(network, table, pieces.number, pieces.motion, pieces.velocity)):
        loss += float(distance(motion, pieces, step).sum()) * 1e3 / len(chosen) / len(pieces.targets.centre)
    travel = (pieces.motion.centre - pieces.targets.centre[-1]).norm(dim=-1)
    turned = 2 * torch.asin(_sine(pieces.motion.quaternion, pieces.targets.quaternion[-1]).clamp(max=1))
    moved = (travel > MOVED_M) | (turned > MOVED_RAD)
    error = 1e3 * (motion.centre - pieces.targets.centre[-1]).norm(dim=-1)[moved]
    angle = torch.rad2deg(2 * torch.asin(_sine(motion.quaternion, pieces.targets.quaternion[-1]).clamp(max=1)))[moved]
    if not len(error):
        return Validation(0, 0.0, 0.0, 0.0, loss, 0.0)
    medians = [float(values.median()) for values in (error, angle, 1e3 * travel[moved])]
    return Validation(len(error), medians[0], medians[1], float(error.mean()), loss, medians[2])
