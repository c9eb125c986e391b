"""What straight pushes do to one object, by the quasi-static limit surface: a table of pushes and planar motions.

The table is in a frame at the object's centre of mass that turns with its yaw, so that it serves wherever the object
lies and however it is turned about the vertical, as long as it rests on the same side. It is what off-centre pushes
are chosen by (Lynch and Mason, 1996; Akella and Mason, 1998); the learned dynamics model then judges the chosen ones.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

import cv2
import numpy as np
import torch
from jaxtyping import Float
from scipy.spatial import ConvexHull
from torch import Tensor

from osfcore.dynamics.limit_surface import friction_arm, push_motion
from osfcore.geometry.workspace import PUSHER_RADIUS_M
from osfcore.planning.path_planning import CLEARANCE_M

_SPARE_M = 0.003  # from where a push starts to what must stay clear
_PLACES = 48  # of contact, around the outline
_SLANTS_RAD = (-0.6, -0.3, 0.0, 0.3, 0.6)  # of the direction from the normal
_STEP_M = 0.005
_STEPS = 60  # of each push
_PIXEL_M = 0.001
_CORNER_M = 0.0007  # by how much the outline may be simplified
_ROUND = 24  # directions in which the loop around an object is rounded


@dataclass(frozen=True, eq=False, slots=True)
class PushOutcomes:
    """P straight pushes and what each has done after S lengths, in the object's planar frame.

    Attributes:
        starts: of the pusher's centre, clear of the object [m].
        directions: unit vectors.
        lengths: of the way from the start [m].
        motions: displacement (x, y) of the centre of mass [m] and turn about the vertical [rad].
        loop: a way around the object, clear of it, counterclockwise [m].
    """

    starts: Float[np.ndarray, "P 2"]
    directions: Float[np.ndarray, "P 2"]
    lengths: Float[np.ndarray, "S"]
    motions: Float[np.ndarray, "P S 3"]
    loop: Float[np.ndarray, "L 2"]


def push_outcomes(outlines: Sequence[Float[np.ndarray, "_ 2"]]) -> PushOutcomes:
    """The table of an object.

    Args:
        outlines: of its convex parts seen from above, around its centre of mass [m].
    """
    outline = silhouette(outlines)
    starts, directions, gaps = _candidates(outline)
    lengths = gaps.max() + _STEP_M * np.arange(1, _STEPS + 1)
    motions = _simulated(outline, starts, directions, lengths)
    return PushOutcomes(starts, directions, lengths, motions, _loop(outline))


def silhouette(outlines: Sequence[Float[np.ndarray, "_ 2"]]) -> Float[np.ndarray, "V 2"]:
    """The outer outline of the union of convex outlines, counterclockwise, within a millimetre [m]."""
    every = np.concatenate(list(outlines))
    low = every.min(axis=0) - 3 * _PIXEL_M
    side = np.ceil((every.max(axis=0) - low) / _PIXEL_M).astype(int) + 4
    solid = np.zeros((side[1], side[0]), np.uint8)
    for part in outlines:
        cv2.fillConvexPoly(solid, np.rint((part - low) / _PIXEL_M).astype(np.int32), 1)
    contours, _ = cv2.findContours(solid, cv2.RETR_EXTERNAL, cv2.CHAIN_APPROX_NONE)
    largest = max(contours, key=cv2.contourArea)
    corners = cv2.approxPolyDP(largest, _CORNER_M / _PIXEL_M, closed=True)[:, 0]
    points = corners * _PIXEL_M + low
    area = np.sum(points[:, 0] * np.roll(points[:, 1], -1) - points[:, 1] * np.roll(points[:, 0], -1))
    return points if area > 0 else points[::-1].copy()


def _candidates(outline: Float[np.ndarray, "V 2"]) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    """Starts and directions of pushes from all around, and their distances to the contact [m]."""
    closed = np.vstack([outline, outline[:1]])
    sides = np.diff(closed, axis=0)
    lengths = np.linalg.norm(sides, axis=1)
    at = (np.arange(_PLACES) + 0.5) / _PLACES * lengths.sum()
    along = np.concatenate([[0.0], np.cumsum(lengths)])
    number = (np.searchsorted(along, at) - 1).clip(0, len(sides) - 1)
    share = (at - along[number]) / lengths[number]
    points = outline[number] + share[:, None] * sides[number]
    smooth = _smooth_normals(points)
    angle = np.arctan2(-smooth[:, 1], -smooth[:, 0])[:, None] + np.array(_SLANTS_RAD)
    directions = np.stack([np.cos(angle), np.sin(angle)], axis=-1)
    centres = (points + PUSHER_RADIUS_M * smooth)[:, None]
    gap = CLEARANCE_M + _SPARE_M
    starts = centres - gap / np.cos(_SLANTS_RAD)[:, None] * directions
    starts, directions = starts.reshape(-1, 2), directions.reshape(-1, 2)
    distance, _ = _nearest(torch.as_tensor(outline), torch.as_tensor(starts))
    clear = distance.numpy() >= PUSHER_RADIUS_M + CLEARANCE_M
    return starts[clear], directions[clear], np.full(int(clear.sum()), gap)


def _smooth_normals(points: Float[np.ndarray, "M 2"]) -> Float[np.ndarray, "M 2"]:
    """Outward normals of a closed line, from the neighbours of each point."""
    tangent = np.roll(points, -1, axis=0) - np.roll(points, 1, axis=0)
    normal = np.stack([tangent[:, 1], -tangent[:, 0]], axis=1)
    return normal / np.maximum(np.linalg.norm(normal, axis=1, keepdims=True), 1e-9)


def _loop(outline: Float[np.ndarray, "V 2"]) -> Float[np.ndarray, "L 2"]:
    """The convex hull, widened by the pusher and its clearance."""
    angles = 2 * np.pi * np.arange(_ROUND) / _ROUND
    wide = (PUSHER_RADIUS_M + CLEARANCE_M + 2 * _SPARE_M) / np.cos(np.pi / _ROUND)
    rim = wide * np.stack([np.cos(angles), np.sin(angles)], axis=1)
    points = (outline[:, None] + rim).reshape(-1, 2)
    return points[ConvexHull(points).vertices]


def _nearest(outline: Tensor, points: Tensor) -> tuple[Float[Tensor, "P"], Float[Tensor, "P 2"]]:
    """Distance of points to the nearest of an outline's sides, and where that is."""
    side = outline.roll(-1, dims=0) - outline
    away = points[:, None] - outline
    along = ((away * side).sum(dim=2) / (side * side).sum(dim=1)).clamp(0, 1)
    rest = away - along[..., None] * side
    square = (rest * rest).sum(dim=2)
    nearest = square.argmin(dim=1)
    rows = torch.arange(len(points))
    return square[rows, nearest].sqrt(), points - rest[rows, nearest]


def _simulated(
    outline: Float[np.ndarray, "V 2"],
    starts: Float[np.ndarray, "P 2"],
    directions: Float[np.ndarray, "P 2"],
    lengths: Float[np.ndarray, "S"],
) -> Float[np.ndarray, "P S 3"]:
    """Planar motions after each length."""
    border = torch.as_tensor(outline)
    arm = friction_arm(border).expand(len(starts))
    begin, heading = torch.as_tensor(starts), torch.as_tensor(directions)
    pose = torch.zeros(len(starts), 3, dtype=torch.float64)
    motions, before = [], 0.0
    for length in lengths:
        turn = _turns(pose[:, 2])
        pusher = begin + float(length) * heading
        own = (turn.transpose(1, 2) @ (pusher - pose[:, :2])[..., None])[..., 0]
        shift = (turn.transpose(1, 2) @ ((float(length) - before) * heading)[..., None])[..., 0]
        distance, point = _nearest(border, own)
        inward = (point - own) / distance.clamp(min=1e-9)[:, None]
        depth = (PUSHER_RADIUS_M - distance).clamp(min=0)
        motion = push_motion(point, inward, depth, shift, arm)
        pose = pose + torch.cat([(turn @ motion[:, :2, None])[..., 0], motion[:, 2:]], dim=1)
        motions.append(pose)
        before = float(length)
    return torch.stack(motions, dim=1).numpy()


def _turns(angle: Tensor) -> Float[Tensor, "P 2 2"]:
    cos, sin = angle.cos(), angle.sin()
    return torch.stack([torch.stack([cos, -sin], dim=1), torch.stack([sin, cos], dim=1)], dim=1)
