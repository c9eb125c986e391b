"""Up to three pushes that bring an object to a pose, by search over tables of pushes (Song et al., 2020, go deeper).

With e = (x, y, yaw) the goal in the object's planar frame and m_i the motion of push i, one push leaves e' = m_i^-1 e,
and the last push is the one in the table whose motion is nearest to e'. First pushes of two are a part of the table,
first and second pushes of three are drawn; three let a can on its side, which rolls under most pushes, be slid along
its axis, turned and slid back. A first push may roll the object onto the side that the goal shows; later pushes are
then those of that side. Sequences are drawn by

    s = sqrt(x^2 + y^2 + (arm * angle)^2) of what is left + price * (length of the pusher's path)

with probability proportional to exp(-s / temperature).
"""

from __future__ import annotations

from collections.abc import Callable, Iterable, Iterator
from dataclasses import dataclass
from functools import cache
from itertools import chain, islice

import numpy as np
from jaxtyping import Bool, Float, Int
from scipy.spatial import KDTree

from osfcore.geometry.poses import (
    UPRIGHT_RAD,
    Pose,
    planar_turn,
    planar_turns,
    quaternion_conjugate,
    quaternion_multiply,
    rotation_angle,
)
from osfcore.geometry.workspace import PUSHER_REACH_M
from osfcore.planning.path_planning import FreeSpace
from osfcore.planning.pose_cost import ARM_M
from osfcore.planning.push_outcomes import PushOutcomes

_PATH_PRICE = 0.1  # of a metre of the pusher's path, in metres of error
_TEMPERATURE_M = 0.003
_EVERY = 3  # rows of the table are tried as the first of two pushes
_PAIRS = 6000  # of pushes are tried as the first of three
_NEARER = 0.9  # of the error may be left, or a sequence is not worth its time
_MUCH_NEARER = 0.5  # where as little is left by pushes that do not roll the object, no others are drawn
_STEADY = 0.95  # of an object's pushes leave it on its side, or it rolls
_TURN_BACK_M = 0.008  # the pusher backs off before it walks around an object


class ObjectPushes:
    """Push sequences of one object while it rests on one side.

    Args:
        outcomes: table of its pushes on that side.
        reference: orientation that the table was made in.
        centre: of mass, in the object's frame [m].
    """

    def __init__(
        self, outcomes: PushOutcomes, reference: Float[np.ndarray, "4"], centre: Float[np.ndarray, "3"]
    ) -> None:
        self._outcomes, self._reference, self._centre = outcomes, reference, centre
        self._turns = quaternion_multiply(outcomes.quaternions.reshape(-1, 4), quaternion_conjugate(reference))
        yaw, tilt = planar_turns(np.array([1.0, 0.0, 0.0, 0.0]), self._turns)
        self._motions = np.concatenate([outcomes.centres.reshape(-1, 2), yaw[:, None]], axis=1)
        self._planar = np.flatnonzero(tilt <= UPRIGHT_RAD)
        self._tree = KDTree(self._motions[self._planar] * [1, 1, ARM_M]) if len(self._planar) else None
        ends = outcomes.starts[:, None] + outcomes.lengths[:, None] * outcomes.directions[:, None]
        self._ends = ends.reshape(-1, 2)
        self._left_at = _into(self._motions, self._ends)
        self.rolls = len(self._planar) < _STEADY * len(self._turns)

    def yaw(self, pose: Pose) -> float | None:
        """Turn about the vertical from the pose that the table was made in; None if the object lies on another side."""
        return planar_turn(self._reference, pose.quaternion)

    def draw(
        self,
        pose: Pose,
        goal: Pose,
        later: ObjectPushes,
        space: FreeSpace,
        pusher: Float[np.ndarray, "2"],
        count: int,
        rng: np.random.Generator,
    ) -> DrawnPushes:
        """Sequences of up to three pushes that bring the object nearer.

        Args:
            pose: of the object, on the side that the table was made for.
            goal: where it should be.
            later: pushes on the side that the goal shows: these ones, or others if that is another side.
            space: where first pushes may begin.
            pusher: where it comes from [m].
            count: of sequences at most; fewer or none where no push that has room brings the object nearer.
            rng: draws them.
        """
        yaw, centre = self.yaw(pose) or 0.0, pose.apply(self._centre)[:2]
        turn = _rotation(yaw)
        is_within = np.abs(self._ends @ turn.T + centre).max(axis=1) <= PUSHER_REACH_M
        has_room = space.is_free(self._outcomes.starts @ turn.T + centre)
        possible = np.flatnonzero(is_within & np.repeat(has_room, len(self._outcomes.lengths)))
        if not len(possible):
            return DrawnPushes(0, 0, lambda _: np.zeros((0, 2)))
        first = self._first_pushes(possible, yaw, goal, later)
        shift = turn.T @ (goal.apply(self._centre)[:2] - centre)
        rows, left = _sequences(first, np.array([*shift, (later.yaw(goal) or 0.0) - yaw]), later, rng)
        path = self._path_lengths(rows, first, later, turn.T @ (pusher - centre))
        before = np.hypot(np.linalg.norm(shift), ARM_M * float(rotation_angle(pose.quaternion, goal.quaternion)))
        better = np.flatnonzero(left < _NEARER * before)
        stays = (rows[:, 1] >= 0) | first.lands[rows[:, 0]]
        if np.any(stays & (left < _MUCH_NEARER * before)):
            better = better[stays[better]]
        drawn = (left + _PATH_PRICE * path)[better] / _TEMPERATURE_M - rng.gumbel(size=len(better))
        kept = rows[better[np.argsort(drawn)]]
        return DrawnPushes(len(kept), count, lambda k: self._corners(kept[k], first, later) @ turn.T + centre)

    def _first_pushes(self, rows: Int[np.ndarray, "M"], yaw: float, goal: Pose, later: ObjectPushes) -> _FirstPushes:
        """What some pushes of the table do to an object that is turned by `yaw`, in the terms of later ones."""
        around = np.array([np.cos(yaw / 2), 0.0, 0.0, np.sin(yaw / 2)])
        ends = quaternion_multiply(quaternion_multiply(around, self._turns[rows]), self._reference)
        then, _ = planar_turns(later._reference, ends)
        _, tilts = planar_turns(goal.quaternion, ends)
        motions = np.concatenate([self._motions[rows, :2], (then - yaw)[:, None]], axis=1)
        angles = rotation_angle(ends, np.broadcast_to(goal.quaternion, ends.shape))
        return _FirstPushes(rows, motions, tilts, np.asarray(angles))

    def _path_lengths(
        self, rows: Int[np.ndarray, "C 3"], first: _FirstPushes, later: ObjectPushes, pusher: Float[np.ndarray, "2"]
    ) -> Float[np.ndarray, "C"]:
        """About how far the pusher goes, straight from push to push [m]."""
        own = first.rows[rows[:, 0]]
        path = self._walked(own, np.broadcast_to(pusher, (len(own), 2)))
        at = _into(first.motions[rows[:, 0]], self._ends[own])
        for push in rows[:, 1:].T:
            path += np.where(push < 0, 0.0, later._walked(push, at))
            at = later._left_at[push]
        return path

    def _walked(self, rows: Int[np.ndarray, "C"], begin: Float[np.ndarray, "C 2"]) -> Float[np.ndarray, "C"]:
        count = len(self._outcomes.lengths)
        return (
            np.linalg.norm(self._outcomes.starts[rows // count] - begin, axis=1) + self._outcomes.lengths[rows % count]
        )

    def _corners(self, row: Int[np.ndarray, "3"], first: _FirstPushes, later: ObjectPushes) -> Float[np.ndarray, "C 2"]:
        """The pusher's path through pushes, in the planar frame before the first."""
        own, motion = first.rows[row[0]], first.motions[row[0]]
        then = later._path_through([int(push) for push in row[1:] if push >= 0])
        return self._followed_by(int(own), motion, then, later._outcomes.loop)

    def _path_through(self, rows: list[int]) -> Float[np.ndarray, "C 2"]:
        if not rows:
            return np.zeros((0, 2))
        return self._followed_by(rows[0], self._motions[rows[0]], self._path_through(rows[1:]), self._outcomes.loop)

    def _followed_by(
        self, row: int, motion: Float[np.ndarray, "3"], then: Float[np.ndarray, "C 2"], loop: Float[np.ndarray, "L 2"]
    ) -> Float[np.ndarray, "D 2"]:
        """The path of one push, then around the object, then along a path in the frame after it."""
        number = row // len(self._outcomes.lengths)
        path = np.stack([self._outcomes.starts[number], self._ends[row]])
        if not len(then):
            return path
        back = path[1] - _TURN_BACK_M * self._outcomes.directions[number]
        around = around_loop(loop, _into(motion[None], back[None])[0], then[0])
        return np.vstack([path, back, np.vstack([around, then]) @ _rotation(motion[2]).T + motion[:2]])

    def leave(self, pose: Pose, at: Float[np.ndarray, "2"], toward: Float[np.ndarray, "2"]) -> Float[np.ndarray, "n 2"]:
        """Corners of a way around the object to the point of its loop that is nearest to another place."""
        turn, centre, loop = _rotation(self.yaw(pose) or 0.0), pose.apply(self._centre)[:2], self._outcomes.loop
        own, aim = turn.T @ (at - centre), turn.T @ (toward - centre)
        exit_ = loop[np.linalg.norm(loop - aim, axis=1).argmin()]
        return np.vstack([around_loop(loop, own, exit_), exit_]) @ turn.T + centre


class DrawnPushes:
    """Push sequences that were drawn, the best first. Paths are computed when they are asked for: few of them are.

    Args:
        known: how many sequences there are.
        wanted: how many of them may be used; those that lead out of the pusher's reach do not count.
        path: corners of the pusher's path of one of them, from the start of the first push to the end of the last [m].
    """

    def __init__(self, known: int, wanted: int, path: Callable[[int], Float[np.ndarray, "C 2"]]) -> None:
        self._known, self._wanted, self._path = known, wanted, cache(path)

    def __iter__(self) -> Iterator[Float[np.ndarray, "C 2"]]:
        """Paths within the pusher's reach."""
        return islice(self._within(range(self._known)), self._wanted)

    def sample(self, count: int, rng: np.random.Generator) -> list[Float[np.ndarray, "C 2"]]:
        """So many of them at most, in random order."""
        best = min(self._wanted, self._known)
        order = chain(rng.permutation(best).tolist(), range(best, self._known))
        return list(islice(self._within(order), count))

    def _within(self, order: Iterable[int]) -> Iterator[Float[np.ndarray, "C 2"]]:
        return (path for path in map(self._path, order) if np.abs(path).max() <= PUSHER_REACH_M)


@dataclass(frozen=True, eq=False, slots=True)
class _FirstPushes:
    """Some rows of a table, and what they lead to.

    Attributes:
        rows: of the table.
        motions: shift in the planar frame before, and turn from it to the planar frame of later pushes [m, rad].
        tilts: from the side that the goal shows [rad].
        angles: of the whole rotation to the goal [rad].
    """

    rows: Int[np.ndarray, "M"]
    motions: Float[np.ndarray, "M 3"]
    tilts: Float[np.ndarray, "M"]
    angles: Float[np.ndarray, "M"]

    @property
    def lands(self) -> Bool[np.ndarray, "M"]:
        """Whether the object lies on that side then."""
        return self.tilts <= UPRIGHT_RAD


def _sequences(
    first: _FirstPushes, target: Float[np.ndarray, "3"], later: ObjectPushes, rng: np.random.Generator
) -> tuple[Int[np.ndarray, "C 3"], Float[np.ndarray, "C"]]:
    """Sequences as numbers of first pushes, then rows of the table of later ones, -1 for none; what they leave [m].

    Args:
        first: pushes that are possible.
        target: the goal in the planar frame before the first, with its turn in that of later pushes.
        later: pushes on the goal's side.
        rng: draws first and second pushes of three.
    """
    motions, planar, tree = later._motions, later._planar, later._tree
    left = np.hypot(np.linalg.norm(target[:2] - first.motions[:, :2], axis=1), ARM_M * first.angles)
    every = np.arange(len(first.rows))
    rows = np.stack([every, *np.full((2, len(every)), -1)], axis=1)
    landing = np.flatnonzero(first.lands)
    if tree is None or not len(landing):
        return rows, left
    one = landing[::_EVERY]
    pairs = np.stack([rng.choice(landing, _PAIRS), rng.choice(planar, _PAIRS)], axis=1)
    two = _after(_after(target, first.motions[pairs[:, 0]]), motions[pairs[:, 1]])
    more, nearest = tree.query(np.concatenate([_after(target, first.motions[one]), two]) * [1, 1, ARM_M])
    more = np.hypot(more, ARM_M * first.tilts[np.concatenate([one, pairs[:, 0]])])
    last = planar[nearest]
    second = np.stack([one, last[: len(one)], np.full(len(one), -1)], axis=1)
    third = np.concatenate([pairs, last[len(one) :, None]], axis=1)
    return np.concatenate([rows, second, third]), np.concatenate([left, more])


def around_loop(
    loop: Float[np.ndarray, "L 2"], begin: Float[np.ndarray, "2"], end: Float[np.ndarray, "2"]
) -> Float[np.ndarray, "n 2"]:
    """Corners of the shorter way along a closed convex line, from near one place to near another [m]."""
    i, j = (int(np.linalg.norm(loop - place, axis=1).argmin()) for place in (begin, end))
    forth = np.arange(i, i + (j - i) % len(loop) + 1) % len(loop)
    back = np.arange(i, i - (i - j) % len(loop) - 1, -1) % len(loop)
    ways = [loop[forth], loop[back]]
    return min(ways, key=lambda way: float(np.linalg.norm(np.diff(way, axis=0), axis=1).sum()))


def _rotation(angle: float) -> Float[np.ndarray, "2 2"]:
    return np.array([[np.cos(angle), -np.sin(angle)], [np.sin(angle), np.cos(angle)]])


def _into(motions: Float[np.ndarray, "M 3"], points: Float[np.ndarray, "M 2"]) -> Float[np.ndarray, "M 2"]:
    """Points in the frame of an object that has made motions."""
    cos, sin = np.cos(motions[:, 2]), np.sin(motions[:, 2])
    x, y = (points - motions[:, :2]).T
    return np.stack([cos * x + sin * y, cos * y - sin * x], axis=1)


def _after(
    goal: Float[np.ndarray, "3"] | Float[np.ndarray, "M 3"], motions: Float[np.ndarray, "M 3"]
) -> Float[np.ndarray, "M 3"]:
    """Goals (x, y, yaw) in the frame of an object that has made motions: m^-1 e."""
    goals = np.broadcast_to(goal, motions.shape)
    yaw = (goals[:, 2] - motions[:, 2] + np.pi) % (2 * np.pi) - np.pi
    return np.concatenate([_into(motions, goals[:, :2]), yaw[:, None]], axis=1)
