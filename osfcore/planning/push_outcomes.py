"""What straight pushes do to one object: a table of pushes, from all around it, and of the motions that they lead to.

The table is in a frame at the object's centre of mass that turns with its yaw, so that it serves wherever the object
lies and however it is turned about the vertical, as long as it rests on the same side. The learned dynamics model fills
it, for over 24 cm it errs by 3 to 5 deg in the median where the quasi-static limit surface errs by 10 to 20 deg.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from typing import Protocol

import cv2
import numpy as np
from jaxtyping import Float
from scipy.spatial import ConvexHull

from osfcore.geometry.poses import Pose
from osfcore.geometry.rollouts import Rollouts
from osfcore.geometry.states import SceneState
from osfcore.geometry.workspace import PUSHER_RADIUS_M, STEP_S
from osfcore.planning.path_planning import CLEARANCE_M

_SPARE_M = 0.003  # from where a push starts to what must stay clear
_PLACES = 36  # of contact, around the outline
_SLANTS_RAD = (-0.6, -0.3, 0.0, 0.3, 0.6)  # of the direction from the normal
_SPEED_M_S = 0.2
_ACTIONS = 6  # of each push
_BETWEEN = 4  # lengths for each action, by interpolation
_PIXEL_M = 0.001
_CORNER_M = 0.001  # by how much the outline may be simplified
_ROUND = 24  # directions in which the loop around an object is rounded


class PushPredictor(Protocol):
    """Predicts pushes that begin elsewhere: `PushModel.rollout`."""

    def __call__(
        self,
        state: SceneState,
        actions: Float[np.ndarray, "K T 3"],
        before: SceneState | None = None,
        pushers: Float[np.ndarray, "K 2"] | None = None,
    ) -> Rollouts:
        """Predicted poses under K sequences of T actions, each from its own place of the pusher [m]."""
        ...


@dataclass(frozen=True, eq=False, slots=True)
class PushOutcomes:
    """P straight pushes and where each has brought the object after S lengths, in the object's planar frame.

    Attributes:
        starts: of the pusher's centre, clear of the object [m].
        directions: unit vectors.
        lengths: of the way from the start [m].
        centres: of mass [m].
        quaternions: orientations.
        loop: a way around the object, clear of it, counterclockwise [m].
    """

    starts: Float[np.ndarray, "P 2"]
    directions: Float[np.ndarray, "P 2"]
    lengths: Float[np.ndarray, "S"]
    centres: Float[np.ndarray, "P S 2"]
    quaternions: Float[np.ndarray, "P S 4"]
    loop: Float[np.ndarray, "L 2"]


def push_outcomes(
    predict: PushPredictor | None,
    state: SceneState,
    centre: Float[np.ndarray, "3"],
    outlines: Sequence[Float[np.ndarray, "_ 2"]],
) -> PushOutcomes:
    """The table of an object.

    Args:
        predict: tells what pushes do; without it, the table is empty.
        state: of a scene with this object alone.
        centre: of mass, in the object's frame [m].
        outlines: of its convex parts seen from above [m].
    """
    pose = state.poses[0]
    origin = pose.apply(centre)[:2]
    outline = silhouette(outlines) - origin
    starts, directions = _candidates(outline) if predict is not None else (np.zeros((0, 2)), np.zeros((0, 2)))
    lengths = _SPEED_M_S * STEP_S / _BETWEEN * np.arange(1, _ACTIONS * _BETWEEN + 1)
    if predict is None or not len(starts):
        none = np.zeros((len(starts), len(lengths), 4))
        return PushOutcomes(starts, directions, lengths, none[..., :2], none, _loop(outline))
    actions = np.broadcast_to(np.pad(_SPEED_M_S * directions, ((0, 0), (0, 1)))[:, None], (len(starts), _ACTIONS, 3))
    futures = predict(state, actions, None, starts + origin)
    poses = Pose(futures.positions[:, :, 0], futures.quaternions[:, :, 0])
    centres = _between(poses.apply(centre)[..., :2] - origin)
    quaternions = _between(poses.quaternion)
    quaternions /= np.linalg.norm(quaternions, axis=-1, keepdims=True)
    return PushOutcomes(starts, directions, lengths, centres, quaternions, _loop(outline))


def _between(values: Float[np.ndarray, "P T1 D"]) -> Float[np.ndarray, "P S D"]:
    """Linear interpolation in time, without the first moment."""
    share = np.arange(1, _BETWEEN + 1)[:, None] / _BETWEEN
    parts = values[:, :-1, None] * (1 - share) + values[:, 1:, None] * share
    return parts.reshape(len(values), -1, values.shape[2])


def silhouette(outlines: Sequence[Float[np.ndarray, "_ 2"]]) -> Float[np.ndarray, "V 2"]:
    """The outer outline of a union of convex outlines, counterclockwise, within a millimetre [m].

    Gaps that the pusher does not fit into are closed, and what is still apart is joined by the convex hull.
    """
    every = np.concatenate(list(outlines))
    border = PUSHER_RADIUS_M + 3 * _PIXEL_M
    low = every.min(axis=0) - border
    columns, rows = np.ceil((every.max(axis=0) + border - low) / _PIXEL_M).astype(int) + 1
    solid = np.zeros((rows, columns), np.uint8)
    for part in outlines:
        cv2.fillConvexPoly(solid, np.rint((part - low) / _PIXEL_M).astype(np.int32), 1)
    width = 2 * round(PUSHER_RADIUS_M / _PIXEL_M) + 1
    disc = cv2.getStructuringElement(cv2.MORPH_ELLIPSE, (width, width))
    contours, _ = cv2.findContours(
        cv2.morphologyEx(solid, cv2.MORPH_CLOSE, disc), cv2.RETR_EXTERNAL, cv2.CHAIN_APPROX_NONE
    )
    outer = contours[0] if len(contours) == 1 else cv2.convexHull(np.concatenate(contours))
    points = cv2.approxPolyDP(outer, _CORNER_M / _PIXEL_M, closed=True)[:, 0] * _PIXEL_M + low
    area = np.sum(points[:, 0] * np.roll(points[:, 1], -1) - points[:, 1] * np.roll(points[:, 0], -1))
    return points if area > 0 else points[::-1].copy()


def _candidates(outline: Float[np.ndarray, "V 2"]) -> tuple[Float[np.ndarray, "P 2"], Float[np.ndarray, "P 2"]]:
    """Starts and directions of pushes from all around."""
    points = _spaced(outline, _PLACES)
    tangent = np.roll(points, -1, axis=0) - np.roll(points, 1, axis=0)
    normal = np.stack([tangent[:, 1], -tangent[:, 0]], axis=1)
    normal /= np.maximum(np.linalg.norm(normal, axis=1, keepdims=True), 1e-9)
    angle = np.arctan2(-normal[:, 1], -normal[:, 0])[:, None] + np.array(_SLANTS_RAD)
    directions = np.stack([np.cos(angle), np.sin(angle)], axis=-1)
    back = (CLEARANCE_M + _SPARE_M) / np.cos(_SLANTS_RAD)[:, None]
    starts = ((points + PUSHER_RADIUS_M * normal)[:, None] - back * directions).reshape(-1, 2)
    border = _spaced(outline, 8 * _PLACES)
    distance = np.linalg.norm(starts[:, None] - border, axis=2).min(axis=1)
    clear = distance >= PUSHER_RADIUS_M + CLEARANCE_M
    return starts[clear], directions.reshape(-1, 2)[clear]


def _spaced(outline: Float[np.ndarray, "V 2"], count: int) -> Float[np.ndarray, "count 2"]:
    """Equally spaced points along a closed line."""
    closed = np.vstack([outline, outline[:1]])
    along = np.concatenate([[0.0], np.cumsum(np.linalg.norm(np.diff(closed, axis=0), axis=1))])
    at = (np.arange(count) + 0.5) / count * along[-1]
    return np.stack([np.interp(at, along, closed[:, axis]) for axis in range(2)], axis=1)


def _loop(outline: Float[np.ndarray, "V 2"]) -> Float[np.ndarray, "L 2"]:
    """The convex hull, widened by the pusher and its clearance."""
    angles = 2 * np.pi * np.arange(_ROUND) / _ROUND
    wide = (PUSHER_RADIUS_M + CLEARANCE_M + 2 * _SPARE_M) / np.cos(np.pi / _ROUND)
    rim = wide * np.stack([np.cos(angles), np.sin(angles)], axis=1)
    points = (outline[:, None] + rim).reshape(-1, 2)
    return points[ConvexHull(points).vertices]
