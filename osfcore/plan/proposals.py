"""Pushes worth trying: go around to the far side of an object, then push it toward its goal.

Random velocities touch an object in one step of eight, so sampling alone rarely finds that the pusher has to walk
around an object first. Each proposal is a whole sequence of actions: a way that touches nothing to a place behind an
object, then a straight push at some angle, off its middle by some amount, about as far as it has to go. MPPI takes it
from there.
"""

from __future__ import annotations

from collections.abc import Mapping

import numpy as np
from jaxtyping import Float

from osfcore.dynamics.contact import part_outlines
from osfcore.dynamics.shapes import ObjectShape, ShapeTable
from osfcore.plan.goals import PoseGoal
from osfcore.plan.travel import CLEARANCE_M, FreeSpace, actions_along
from osfcore.scene import PUSHER_RADIUS_M, PUSHER_REACH_M, SceneState

_DONE_M = 0.004  # an object this close to its goal is not pushed on purpose
_ANGLE_RAD = 0.2  # sigma of the push's direction around that of the goal
_ASIDE = 0.2  # sigma of the push's offset from the middle, of half the object's breadth
_LENGTHS = (0.6, 1.15)  # of the distance to go
_SPEEDS = (0.4, 1.0)  # of the highest
_SPARE_M = 0.003  # from the place behind an object to what must stay clear


class Proposals:
    """Proposes pushes among some objects.

    Args:
        shapes: of the objects, by name.
    """

    def __init__(self, shapes: Mapping[str, ObjectShape]) -> None:
        self._tables = {name: ShapeTable((shape,)) for name, shape in shapes.items()}

    def draw(
        self, state: SceneState, goal: PoseGoal, each: int, horizon: int, rng: np.random.Generator
    ) -> Float[np.ndarray, "P T 3"]:
        """Up to `each` pushes for every object that is off its goal; none where there is no room for the pusher.

        Args:
            state: of the scene, with its pusher.
            goal: where everything should be.
            each: number of pushes an object.
            horizon: length of the sequences.
            rng: draws angles, offsets, lengths and speeds.
        """
        assert state.pusher is not None
        parts = [part_outlines(self._tables[name], 0, state.pose(name)).astype(float) for name in state.names]
        space = FreeSpace([outline for outlines_of in parts for outline in outlines_of])
        starts, ends = [], []
        for offset, outlines_of in zip(goal.offsets_m(state), parts, strict=True):
            if np.linalg.norm(offset) > _DONE_M:
                start, end = _pushes(np.concatenate(outlines_of), offset, each, rng)
                clear = np.abs(start).max(axis=1) <= PUSHER_REACH_M
                clear &= space.is_free(start)
                starts.append(start[clear])
                ends.append(end[clear])
        if not sum(map(len, starts)):
            return np.zeros((0, horizon, 3))
        behind, beyond = np.concatenate(starts), np.concatenate(ends).clip(-PUSHER_REACH_M, PUSHER_REACH_M)
        sequences = []
        for way, end in zip(space.ways(state.pusher[:2], behind), beyond, strict=True):
            speeds = np.append(np.ones(len(way) - 1), rng.uniform(*_SPEEDS))
            sequences.append(actions_along(np.vstack([way, end]), horizon, speeds))
        return np.array(sequences)


def _pushes(
    outline: Float[np.ndarray, "K 2"], offset: Float[np.ndarray, "2"], count: int, rng: np.random.Generator
) -> tuple[Float[np.ndarray, "P 2"], Float[np.ndarray, "P 2"]]:
    """Where pushes of one object start, free of it, and where they end [m]."""
    distance = np.linalg.norm(offset)
    angle = np.arctan2(offset[1], offset[0]) + rng.normal(0, _ANGLE_RAD, count)
    direction = np.stack([np.cos(angle), np.sin(angle)], axis=1)
    side = np.stack([-direction[:, 1], direction[:, 0]], axis=1)
    along, across = outline @ direction.T, outline @ side.T  # K x P
    low, high = across.min(axis=0), across.max(axis=0)
    aside = (low + high) / 2 + rng.normal(0, _ASIDE, count).clip(-1, 1) * (high - low) / 2
    reach = np.abs(across - aside) <= PUSHER_RADIUS_M + 0.01  # what of the outline the pusher meets on its line
    back = np.where(reach, along, np.inf).min(axis=0)
    back = np.where(np.isfinite(back), back, along.min(axis=0))
    touching = back - PUSHER_RADIUS_M
    away = touching - CLEARANCE_M - _SPARE_M
    length = distance * rng.uniform(*_LENGTHS, count)
    starts = away[:, None] * direction + aside[:, None] * side
    ends = (touching + length)[:, None] * direction + aside[:, None] * side
    return starts, ends
