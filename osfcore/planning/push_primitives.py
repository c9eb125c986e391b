"""Straight pushes of one object: where the pusher starts behind it, and where it ends."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np
from jaxtyping import Float

from osfcore.geometry.workspace import PUSHER_RADIUS_M
from osfcore.planning.path_planning import CLEARANCE_M

_ANGLE_RAD = 0.2  # sigma of the push's direction around that of the goal
_ASIDE = 0.2  # sigma of the push's offset from the middle, of half the object's breadth
_LENGTHS = (0.6, 1.15)  # of the distance to go
_APART_M = 0.005
_MEETS_M = PUSHER_RADIUS_M + 0.01  # beside the pusher's line, what of an outline it may meet


@dataclass(frozen=True, eq=False, slots=True)
class Pushes:
    """P straight pushes of one object.

    Attributes:
        starts: of the pusher's centre, free of the object [m].
        ends: likewise, where the object should have arrived [m].
    """

    starts: Float[np.ndarray, "P 2"]
    ends: Float[np.ndarray, "P 2"]


def outline_points(outlines: Sequence[Float[np.ndarray, "_ 2"]]) -> Float[np.ndarray, "n 2"]:
    """Points at most 5 mm apart all along the outlines of an object's convex parts [m]."""
    pushes = []
    for outline in outlines:
        closed = np.vstack([outline, outline[:1]])
        length = np.concatenate([[0.0], np.cumsum(np.linalg.norm(np.diff(closed, axis=0), axis=1))])
        at = np.linspace(0, length[-1], max(int(np.ceil(length[-1] / _APART_M)), 1), endpoint=False)
        between = np.stack([np.interp(at, length, closed[:, axis]) for axis in range(2)], axis=1)
        pushes += [outline, between]
    return np.concatenate(pushes)


def straight_pushes(
    outline: Float[np.ndarray, "K 2"], offset: Float[np.ndarray, "2"], count: int, rng: np.random.Generator | None
) -> Pushes:
    """Pushes that bring an object about as far as it has to go.

    Args:
        outline: of the object from above, points all along it, see `outline_points` [m].
        offset: how far it has to go [m], not zero.
        count: how many to draw.
        rng: draws directions, places beside the middle and lengths; None for pushes straight through the middle.
    """
    direction_to, distance = np.arctan2(offset[1], offset[0]), np.linalg.norm(offset)
    turn, aside_by, share = _sample_directions(count, rng)
    angle = direction_to + turn
    direction = np.stack([np.cos(angle), np.sin(angle)], axis=1)
    side = np.stack([-direction[:, 1], direction[:, 0]], axis=1)
    along, across = outline @ direction.T, outline @ side.T  # K x P
    low, high = across.min(axis=0), across.max(axis=0)
    aside = (low + high) / 2 + aside_by * (high - low) / 2
    back = np.where(np.abs(across - aside) <= _MEETS_M, along, np.inf).min(axis=0)
    back = np.where(np.isfinite(back), back, along.min(axis=0))
    touching = back - PUSHER_RADIUS_M
    lateral = aside[:, None] * side
    starts = (touching - CLEARANCE_M - _SPARE_M)[:, None] * direction + lateral
    return Pushes(starts, (touching + distance * share)[:, None] * direction + lateral)


def _sample_directions(count: int, rng: np.random.Generator | None) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    if rng is None:
        return np.zeros(count), np.zeros(count), np.ones(count)
    turn = rng.normal(0, _ANGLE_RAD, count)
    return turn, rng.normal(0, _ASIDE, count).clip(-1, 1), rng.uniform(*_LENGTHS, count)
