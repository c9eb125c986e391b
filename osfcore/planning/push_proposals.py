"""Push proposals: samples for MPPI that push one object after another to its goal.

Random velocities touch an object in one of eight sequences, so sampling alone rarely finds a path around an object, let
alone pushes of three objects one after another. A proposal is a whole sequence of actions for an order of stages
(`push_order`): a collision-free path (`path_planning`) to an object, up to three pushes toward its pose
(`push_sequences`) or a straight one toward its place (`push_primitives`), then the same for the next stage, as if this
one had succeeded.
"""

from __future__ import annotations

from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass, replace

import numpy as np
from jaxtyping import Float

from osfcore.dynamics.contact_geometry import part_outlines
from osfcore.dynamics.shapes.object_shapes import ObjectShape, ShapeTable
from osfcore.geometry.poses import Pose, rotation_angle
from osfcore.geometry.rollouts import Rollouts
from osfcore.geometry.states import SceneState
from osfcore.geometry.workspace import PUSHER_REACH_M, STEP_S
from osfcore.planning.path_planning import FreeSpace, ShortestPaths, actions_along, duration_s
from osfcore.planning.pose_cost import PoseGoal, object_costs
from osfcore.planning.push_order import Outlines, OutlinesAt, Stage, push_orders
from osfcore.planning.push_outcomes import PushPredictor, push_outcomes
from osfcore.planning.push_primitives import outline_points, straight_pushes
from osfcore.planning.push_recombination import recombined
from osfcore.planning.push_sequences import DrawnPushes, ObjectPushes

_REACHED_M, _REACHED_RAD = 0.004, 0.045  # an object this close to its goal is not pushed on purpose
_SPEEDS = (0.5, 1.0)  # of the highest
_ORDERS = 6  # of stages; all of three objects in nobody's way
_SPARE = 3  # times as many pushes are drawn as needed: some begin where there is no room
_POOL = 120  # sequences of pushes of an object, drawn at once
_SIDES = 6  # of an object whose tables are kept
_STRAIGHT = 0.25  # share of pushes that are aimed at the goal's place alone


class PushProposals:
    """Proposes pushes among some objects.

    Args:
        shapes: of the objects, by name.
        predict: fills tables of pushes; without it, all pushes are straight ones toward the goal's place.
    """

    def __init__(self, shapes: Mapping[str, ObjectShape], predict: PushPredictor | None = None) -> None:
        self._tables = {name: ShapeTable((shape,)) for name, shape in shapes.items()}
        self._predict = predict
        self._pushes: dict[str, list[ObjectPushes]] = {}  # on each side that an object has lain on

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
        now, goals = ([of.pose(name) for name in state.names] for of in (state, goal))
        off = [n for n, (here, there) in enumerate(zip(now, goals, strict=True)) if _is_off(here, there)]
        if not off:
            return np.zeros((0, horizon, 3))
        assert state.pusher is not None
        outlines = self._outlines(state.names)
        orders = push_orders(now, goals, off, outlines, _ORDERS, rng)

        def pushes(n: int, pose: Pose) -> ObjectPushes:
            return self._pushes_at(state, n, pose, outlines(n, pose))

        chains = _PushSequences(state.pusher[:2], now, pushes, outlines, horizon, rng)
        each = -(-count // len(orders))
        proposals = [actions for order in orders for actions in chains.draw(order, each)]
        return np.array(proposals[:count]).reshape(-1, horizon, 3)

    def recombine(self, goal: PoseGoal, rollouts: Rollouts, count: int) -> Float[np.ndarray, "P T 3"]:
        """At most `count` sequences of pushes that succeeded in different futures (`push_recombination`).

        Args:
            goal: where everything should be.
            rollouts: the futures, from one state.
            count: of sequences.
        """
        return recombined(rollouts, object_costs(rollouts, goal), self._outlines(rollouts.names), count)

    def _outlines(self, names: Sequence[str]) -> OutlinesAt:
        """Tells the outlines of objects, each pose's once."""
        known: dict[tuple[int, bytes], Outlines] = {}

        def at(n: int, pose: Pose) -> Outlines:
            key = n, pose.position.tobytes() + pose.quaternion.tobytes()
            if key not in known:
                known[key] = list(part_outlines(self._tables[names[n]], 0, pose).astype(float))
            return known[key]

        return at

    def _pushes_at(self, state: SceneState, n: int, pose: Pose, outlines: Outlines) -> ObjectPushes:
        name = state.names[n]
        known = self._pushes.setdefault(name, [])
        for one in known:
            if one.yaw(pose) is not None:
                return one
        centre = self._tables[name].centre[0].numpy().astype(float)
        alone = replace(state, names=(name,), poses=Pose.stacked([pose]))
        outcomes = push_outcomes(self._predict, alone, centre, outlines)
        known.append(ObjectPushes(outcomes, pose.quaternion, centre))
        del known[:-_SIDES]
        return known[-1]


def _is_off(pose: Pose, goal: Pose) -> bool:
    if np.linalg.norm((goal.position - pose.position)[:2]) > _REACHED_M:
        return True
    return float(rotation_angle(pose.quaternion, goal.quaternion)) > _REACHED_RAD


class _PushSequences:
    """Samples sequences of pushes; what several orders that begin alike need is computed once."""

    def __init__(
        self, pusher: Float[np.ndarray, "2"], now: Sequence[Pose], pushes: Callable[[int, Pose], ObjectPushes],
        outlines: OutlinesAt, horizon: int, rng: np.random.Generator,
    ) -> None:  # fmt: skip
        self._pusher, self._now, self._pushes, self._outlines = pusher, now, pushes, outlines
        self._horizon, self._rng = horizon, rng
        self._known: dict[tuple[bytes, ...], _Leg] = {}

    def draw(self, order: tuple[Stage, ...], count: int) -> list[Float[np.ndarray, "T 3"]]:
        """Sequences that go through stages in this order, as far as time and room allow."""
        corners = [[self._pusher] for _ in range(count)]
        speeds: list[list[float]] = [[] for _ in range(count)]
        limit_s = self._horizon * STEP_S
        for number in range(len(order)):
            leg = self._leg(order[: number + 1])
            ways = self._ways(leg, order[number], count)
            if not ways:
                break
            for k in range(count):
                if speeds[k] and duration_s(np.array(corners[k]), np.array(speeds[k])) >= limit_s:
                    continue
                way = ways[k % len(ways)]
                path = [*leg.walk(corners[k][-1], way[0]), *way[1:]]
                corners[k] += path
                speeds[k] += [1.0] * (len(path) - len(way) + 1)
                speeds[k] += [float(self._rng.uniform(*_SPEEDS))] * (len(way) - 1)
        if not speeds[0]:
            return []
        return [actions_along(np.array(c), self._horizon, np.array(s)) for c, s in zip(corners, speeds, strict=True)]

    def _leg(self, stages: tuple[Stage, ...]) -> _Leg:
        """What the last of some stages needs, when those before it have succeeded."""
        key = tuple(part for one in stages for part in (bytes([one.number]), one.target.position.tobytes()))
        if key not in self._known:
            places = list(self._now)
            for one in stages[:-1]:
                places[one.number] = one.target
            *_, last, n = -1, *(one.number for one in stages)
            space = FreeSpace([part for k, pose in enumerate(places) for part in self._outlines(k, pose)])
            around = None if last < 0 else (self._pushes(last, places[last]), places[last])
            begin = self._pusher
            if around is not None:
                toward = places[n].position[:2]
                begin = around[0].leave(around[1], toward, toward)[-1].clip(-PUSHER_REACH_M, PUSHER_REACH_M)
            here, target = places[n], stages[-1].target
            own = self._pushes(n, here)
            pool = own.draw(here, target, self._pushes(n, target), space, begin, _POOL, self._rng)
            self._known[key] = _Leg(here, space, begin, space.paths_from(begin), around, pool, own.rolls)
        return self._known[key]

    def _ways(self, leg: _Leg, stage: Stage, count: int) -> list[Float[np.ndarray, "C 2"]]:
        """Pushes of a stage that begin where the pusher has room."""
        offset = (stage.target.position - leg.here.position)[:2]
        ways = leg.pool.sample(count - round(_STRAIGHT * count), self._rng)
        straight = 0 if ways and leg.rolls else count - len(ways)
        if straight and np.linalg.norm(offset) > _REACHED_M:
            sides = outline_points(self._outlines(stage.number, leg.here))
            drawn = straight_pushes(sides, offset, _SPARE * straight, self._rng)
            clear = np.flatnonzero(leg.space.is_free(drawn.starts))[:straight]
            ways += list(np.stack([drawn.starts[clear], drawn.ends[clear]], axis=1))
        return [way.clip(-PUSHER_REACH_M, PUSHER_REACH_M) for way in ways]


@dataclass(frozen=True, eq=False, slots=True)
class _Leg:
    """A stage, when those before it have succeeded.

    Attributes:
        here: where its object is.
        space: where the pusher can be.
        begin: where it sets out: now, or beside the object of the stage before.
        paths: from there.
        around: pushes and pose of the object of the stage before, which it walks around first.
        pool: pushes to choose from.
        rolls: the object rolls under some pushes, of which straight ones take no heed.
    """

    here: Pose
    space: FreeSpace
    begin: Float[np.ndarray, "2"]
    paths: ShortestPaths
    around: tuple[ObjectPushes, Pose] | None
    pool: DrawnPushes
    rolls: bool

    def walk(self, at: Float[np.ndarray, "2"], start: Float[np.ndarray, "2"]) -> list[Float[np.ndarray, "2"]]:
        """Corners of a path to the start of a push."""
        path = list(self.paths.to(start)[1:])
        if self.around is None:
            return path
        pushes, pose = self.around
        return [*pushes.leave(pose, at, self.begin), *path]
