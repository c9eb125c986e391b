"""Push proposals: samples for MPPI that push one object after another toward its goal.

Random velocities touch an object in one of eight sequences, so sampling alone rarely finds a path around an object, let
alone pushes of three objects one after another. A proposal is a whole sequence of actions: a collision-free path
(`path_planning`) to the far side of an object, a straight push toward its goal (`push_primitives`) with random angle,
offset and length, then the same for the next object, as if the first had arrived. All orders of objects are sampled.
"""

from __future__ import annotations

from collections.abc import Mapping
from itertools import islice, permutations

import numpy as np
from jaxtyping import Float

from osfcore.dynamics.contact_geometry import part_outlines
from osfcore.dynamics.shapes.object_shapes import ObjectShape, ShapeTable
from osfcore.geometry.poses import Pose
from osfcore.geometry.states import SceneState
from osfcore.geometry.workspace import PUSHER_REACH_M, STEP_S
from osfcore.planning.path_planning import FreeSpace, ShortestPaths, actions_along, duration_s
from osfcore.planning.pose_cost import PoseGoal
from osfcore.planning.push_primitives import Pushes, outline_points, straight_pushes

_REACHED_M = 0.004  # an object this close to its goal is not pushed on purpose
_SPEEDS = (0.6, 1.0)  # of the highest
_ORDERS = 6  # all of three objects
_SPARE = 3  # times as many pushes are drawn as needed: some begin where there is no room

Outlines = list[Float[np.ndarray, "_ 2"]]  # of an object's convex parts


class PushProposals:
    """Proposes pushes among some objects.

    Args:
        shapes: of the objects, by name.
    """

    def __init__(self, shapes: Mapping[str, ObjectShape]) -> None:
        self._tables = {name: ShapeTable((shape,)) for name, shape in shapes.items()}

    def draw(
        self, state: SceneState, goal: PoseGoal, count: int, horizon: int, rng: np.random.Generator
    ) -> Float[np.ndarray, "P T 3"]:
        """About `count` sequences; none where everything is where it should be or there is no room for the pusher.

        Args:
            state: of the scene, with its pusher.
            goal: where everything should be.
            count: of sequences.
            horizon: length of the sequences.
            rng: draws orders, angles, offsets, lengths and speeds.
        """
        offsets = goal.offsets_m(state)
        off = [n for n, offset in enumerate(offsets) if np.linalg.norm(offset) > _REACHED_M]
        if not off:
            return np.zeros((0, horizon, 3))
        here = [self._outlines(name, state.pose(name)) for name in state.names]
        there = [self._outlines(name, goal.pose(name)) for name in state.names]
        orders = _orders(off, rng)
        chains = _PushSequences(state, here, there, offsets, horizon, rng)
        each = -(-count // len(orders))
        proposals = [actions for order in orders for actions in chains.draw(order, each)]
        return np.array(proposals[:count]).reshape(-1, horizon, 3)

    def _outlines(self, name: str, pose: Pose) -> Outlines:
        return list(part_outlines(self._tables[name], 0, pose).astype(float))


def _orders(off: list[int], rng: np.random.Generator) -> list[tuple[int, ...]]:
    if len(off) <= 3:
        return list(islice(permutations(off), _ORDERS))
    return [tuple(rng.permutation(off).tolist()) for _ in range(_ORDERS)]


class _PushSequences:
    """Samples sequences of pushes; free space and paths that several of them need are computed once."""

    def __init__(
        self, state: SceneState, here: list[Outlines], there: list[Outlines], offsets: Float[np.ndarray, "N 2"],
        horizon: int, rng: np.random.Generator,
    ) -> None:  # fmt: skip
        assert state.pusher is not None
        self._pusher, self._here, self._there, self._offsets = state.pusher[:2], here, there, offsets
        self._sides = [outline_points(outlines) for outlines in here]
        self._horizon, self._rng = horizon, rng
        self._spaces: dict[frozenset[int], FreeSpace] = {}
        self._paths: dict[tuple[frozenset[int], int], ShortestPaths] = {}

    def draw(self, order: tuple[int, ...], count: int) -> list[Float[np.ndarray, "T 3"]]:
        """Sequences that push objects in this order, as far as time and room allow."""
        corners = [[self._pusher] for _ in range(count)]
        speeds: list[list[float]] = [[] for _ in range(count)]
        limit_s = self._horizon * STEP_S
        for stage, number in enumerate(order):
            space, paths = self._after(order[:stage])
            pushes = self._clear_pushes(number, space, count)
            if pushes is None:
                break
            for k in range(count):
                if speeds[k] and duration_s(np.array(corners[k]), np.array(speeds[k])) >= limit_s:
                    continue
                path = paths.to(pushes.starts[k])
                speed = float(self._rng.uniform(*_SPEEDS))
                corners[k] += [*path[1:], pushes.ends[k]]
                speeds[k] += [1.0] * (len(path) - 1) + [speed]
        if not speeds[0]:
            return []
        return [actions_along(np.array(c), self._horizon, np.array(s)) for c, s in zip(corners, speeds, strict=True)]

    def _after(self, pushed: tuple[int, ...]) -> tuple[FreeSpace, ShortestPaths]:
        """Where the pusher can go once some objects have arrived, from behind the last of them."""
        key = frozenset(pushed)
        if key not in self._spaces:
            outlines = [self._there[n] if n in key else self._here[n] for n in range(len(self._here))]
            self._spaces[key] = FreeSpace([outline for parts in outlines for outline in parts])
        space = self._spaces[key]
        last = pushed[-1] if pushed else -1
        if (key, last) not in self._paths:
            self._paths[key, last] = space.paths_from(self._pusher if last < 0 else self._end(last))
        return space, self._paths[key, last]

    def _end(self, number: int) -> Float[np.ndarray, "2"]:
        """Where the pusher is after it has brought an object to its goal."""
        pushes = straight_pushes(self._sides[number], self._offsets[number], 1, None)
        return pushes.ends[0].clip(-PUSHER_REACH_M, PUSHER_REACH_M)

    def _clear_pushes(self, number: int, space: FreeSpace, count: int) -> Pushes | None:
        """Pushes of an object that begin where the pusher has room; None if there are none."""
        drawn = straight_pushes(self._sides[number], self._offsets[number], _SPARE * count, self._rng)
        clear = np.flatnonzero(space.is_free(drawn.starts))
        if not len(clear):
            return None
        chosen = np.resize(clear, count)
        return Pushes(drawn.starts[chosen], drawn.ends[chosen].clip(-PUSHER_REACH_M, PUSHER_REACH_M))
