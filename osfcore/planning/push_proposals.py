"""Push proposals: samples for MPPI that push one object after another toward its goal.

Random velocities touch an object in one of eight sequences, so sampling alone rarely finds a path around an object, let
alone pushes of three objects one after another. A proposal is a whole sequence of actions: a collision-free path
(`path_planning`) to an object, one or two pushes toward its pose (`push_sequences`) or a straight one toward its place
(`push_primitives`), then the same for the next object, as if the first had arrived. All orders of up to three objects
are sampled, six random ones of more.
"""

from __future__ import annotations

from collections.abc import Mapping
from itertools import islice, permutations

import numpy as np
from jaxtyping import Float

from osfcore.dynamics.contact_geometry import part_outlines
from osfcore.dynamics.shapes.object_shapes import ObjectShape, ShapeTable
from osfcore.geometry.poses import Pose, planar_turn
from osfcore.geometry.states import SceneState
from osfcore.geometry.workspace import PUSHER_REACH_M, STEP_S
from osfcore.planning.path_planning import FreeSpace, ShortestPaths, actions_along, duration_s
from osfcore.planning.pose_cost import PoseGoal
from osfcore.planning.push_primitives import Pushes, outline_points, straight_pushes
from osfcore.planning.push_sequences import ObjectPushes

_REACHED_M, _REACHED_RAD = 0.004, 0.045  # an object this close to its goal is not pushed on purpose
_SPEEDS = (0.6, 1.0)  # of the highest
_ORDERS = 6  # all of three objects
_SPARE = 3  # times as many pushes are drawn as needed: some begin where there is no room
_POOL = 120  # sequences of pushes of an object, drawn at once
_STRAIGHT = 0.25  # share of pushes that are aimed at the goal's place alone

Outlines = list[Float[np.ndarray, "_ 2"]]  # of an object's convex parts


class PushProposals:
    """Proposes pushes among some objects.

    Args:
        shapes: of the objects, by name.
    """

    def __init__(self, shapes: Mapping[str, ObjectShape]) -> None:
        self._tables = {name: ShapeTable((shape,)) for name, shape in shapes.items()}
        self._pushes: dict[str, ObjectPushes] = {}

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
        off = [n for n, name in enumerate(state.names) if _is_off(state.pose(name), goal.pose(name))]
        if not off:
            return np.zeros((0, horizon, 3))
        here = [self._outlines(name, state.pose(name)) for name in state.names]
        there = [self._outlines(name, goal.pose(name)) for name in state.names]
        orders = _orders(off, rng)
        pushes = {n: self._pushes_of(state.names[n], state.pose(state.names[n])) for n in off}
        chains = _PushSequences(state, goal, pushes, here, there, horizon, rng)
        each = -(-count // len(orders))
        proposals = [actions for order in orders for actions in chains.draw(order, each)]
        return np.array(proposals[:count]).reshape(-1, horizon, 3)

    def _outlines(self, name: str, pose: Pose) -> Outlines:
        return list(part_outlines(self._tables[name], 0, pose).astype(float))

    def _pushes_of(self, name: str, pose: Pose) -> ObjectPushes:
        if name not in self._pushes or self._pushes[name].yaw(pose) is None:
            self._pushes[name] = ObjectPushes(self._tables[name], pose)
        return self._pushes[name]


def _is_off(pose: Pose, goal: Pose) -> bool:
    if np.linalg.norm((goal.position - pose.position)[:2]) > _REACHED_M:
        return True
    return abs(planar_turn(pose.quaternion, goal.quaternion) or 0.0) > _REACHED_RAD


def _orders(off: list[int], rng: np.random.Generator) -> list[tuple[int, ...]]:
    if len(off) <= 3:
        return list(islice(permutations(off), _ORDERS))
    return [tuple(rng.permutation(off).tolist()) for _ in range(_ORDERS)]


class _PushSequences:
    """Samples sequences of pushes; free space and paths that several of them need are computed once."""

    def __init__(
        self, state: SceneState, goal: PoseGoal, pushes: Mapping[int, ObjectPushes], here: list[Outlines],
        there: list[Outlines], horizon: int, rng: np.random.Generator,
    ) -> None:  # fmt: skip
        assert state.pusher is not None
        self._pusher, self._here, self._there = state.pusher[:2], here, there
        self._now = [state.pose(name) for name in state.names]
        self._goals = [goal.pose(name) for name in state.names]
        self._pushes = pushes
        self._offsets = goal.offsets_m(state)
        self._sides = [outline_points(outlines) for outlines in here]
        self._horizon, self._rng = horizon, rng
        self._spaces: dict[frozenset[int], FreeSpace] = {}
        self._paths: dict[tuple[frozenset[int], int, int], ShortestPaths] = {}
        self._pools: dict[tuple[frozenset[int], int, int], list[Float[np.ndarray, "C 2"]]] = {}

    def draw(self, order: tuple[int, ...], count: int) -> list[Float[np.ndarray, "T 3"]]:
        """Sequences that push objects in this order, as far as time and room allow."""
        corners = [[self._pusher] for _ in range(count)]
        speeds: list[list[float]] = [[] for _ in range(count)]
        limit_s = self._horizon * STEP_S
        for stage, number in enumerate(order):
            ways = self._clear_ways(order[:stage], number, count)
            if not ways:
                break
            for k in range(count):
                if speeds[k] and duration_s(np.array(corners[k]), np.array(speeds[k])) >= limit_s:
                    continue
                way = ways[k % len(ways)]
                path = [*self._walk(order[:stage], number, corners[k][-1], way[0]), *way[1:]]
                corners[k] += path
                speeds[k] += [1.0] * (len(path) - len(way) + 1)
                speeds[k] += [float(self._rng.uniform(*_SPEEDS))] * (len(way) - 1)
        if not speeds[0]:
            return []
        return [actions_along(np.array(c), self._horizon, np.array(s)) for c, s in zip(corners, speeds, strict=True)]

    def _space(self, pushed: tuple[int, ...]) -> FreeSpace:
        key = frozenset(pushed)
        if key not in self._spaces:
            outlines = [self._there[n] if n in key else self._here[n] for n in range(len(self._here))]
            self._spaces[key] = FreeSpace([outline for parts in outlines for outline in parts])
        return self._spaces[key]

    def _from(self, last: int, number: int) -> Float[np.ndarray, "2"]:
        """Where the pusher leaves the object pushed last, on its way to another one."""
        if last < 0:
            return self._pusher
        toward = self._now[number].position[:2]
        leave = self._pushes[last].leave(self._goals[last], toward, toward)
        return leave[-1].clip(-PUSHER_REACH_M, PUSHER_REACH_M)

    def _walk(
        self, pushed: tuple[int, ...], number: int, at: Float[np.ndarray, "2"], start: Float[np.ndarray, "2"]
    ) -> list[Float[np.ndarray, "2"]]:
        """Corners of a path to the start of a push, after some objects have arrived."""
        last = pushed[-1] if pushed else -1
        key = (frozenset(pushed), last, number if pushed else -1)
        begin = self._from(last, number)
        if key not in self._paths:
            self._paths[key] = self._space(pushed).paths_from(begin)
        path = list(self._paths[key].to(start)[1:])
        if not pushed:
            return path
        return [*self._pushes[last].leave(self._goals[last], at, begin), *path]

    def _clear_ways(self, pushed: tuple[int, ...], number: int, count: int) -> list[Float[np.ndarray, "C 2"]]:
        """Pushes of an object, after others have arrived, that begin where the pusher has room."""
        straight, space = round(_STRAIGHT * count), self._space(pushed)
        pool = self._pool(pushed, number)
        ways = [pool[k] for k in self._rng.permutation(len(pool))[: count - straight]]
        if np.linalg.norm(self._offsets[number]) > _REACHED_M and (
            pushes := self._clear_pushes(number, space, straight)
        ):
            ways += [np.stack(pair) for pair in zip(pushes.starts, pushes.ends, strict=True)]
        return [way.clip(-PUSHER_REACH_M, PUSHER_REACH_M) for way in ways]

    def _pool(self, pushed: tuple[int, ...], number: int) -> list[Float[np.ndarray, "C 2"]]:
        """Push sequences of an object, after others have arrived."""
        key = frozenset(pushed), pushed[-1] if pushed else -1, number
        if key not in self._pools:
            begin, space = self._from(key[1], number), self._space(pushed)
            here, there = self._now[number], self._goals[number]
            self._pools[key] = self._pushes[number].draw(here, there, space, begin, _POOL, self._rng)
        return self._pools[key]

    def _clear_pushes(self, number: int, space: FreeSpace, count: int) -> Pushes | None:
        """Pushes of an object that begin where the pusher has room; None if there are none."""
        if not count:
            return None
        drawn = straight_pushes(self._sides[number], self._offsets[number], _SPARE * count, self._rng)
        clear = np.flatnonzero(space.is_free(drawn.starts))
        if not len(clear):
            return None
        chosen = np.resize(clear, count)
        return Pushes(drawn.starts[chosen], drawn.ends[chosen].clip(-PUSHER_REACH_M, PUSHER_REACH_M))
