"""Up to three pushes that bring an object to a pose, by search over a table of pushes (Song et al., 2020, go deeper).

With e = (x, y, yaw) the goal in the object's planar frame and m_i the motion of push i, one push leaves e' = m_i^-1 e,
and the last push is the one in the table whose motion is nearest to e'. First pushes of two are a part of the table,
first and second pushes of three are drawn; three let a can on its side, which rolls under most pushes, be slid along
its axis, turned and slid back. Sequences are drawn by

    s = sqrt(x^2 + y^2 + turn_cost(angle)^2) of what is left + price * (length of the pusher's path)

with probability proportional to exp(-s / temperature). Pushes that roll the object onto another side end a sequence;
what is left after them is told by the whole rotation.
"""

from __future__ import annotations

import numpy as np
from jaxtyping import Float, Int
from scipy.spatial import KDTree

from osfcore.geometry.poses import (
    Pose,
    planar_turn,
    planar_turns,
    quaternion_conjugate,
    quaternion_multiply,
    rotation_angle,
)
from osfcore.geometry.workspace import PUSHER_REACH_M
from osfcore.planning.path_planning import FreeSpace
from osfcore.planning.pose_cost import ARM_M, turn_cost
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
        yaw, is_planar = planar_turns(np.array([1.0, 0.0, 0.0, 0.0]), self._turns)
        self._motions = np.concatenate([outcomes.centres.reshape(-1, 2), yaw[:, None]], axis=1)
        self._planar = np.flatnonzero(is_planar)
        self._is_planar = is_planar
        self._tree = KDTree(self._motions[self._planar] * [1, 1, ARM_M]) if len(self._planar) else None
        ends = outcomes.starts[:, None] + outcomes.lengths[:, None] * outcomes.directions[:, None]
        self._ends = ends.reshape(-1, 2)
        self._left_at = _into(self._motions, self._ends)
        self.rolls = bool(np.mean(is_planar) < _STEADY) if len(is_planar) else False

    def yaw(self, pose: Pose) -> float | None:
        """Turn about the vertical from the pose that the table was made in; None if the object lies on another side."""
        return planar_turn(self._reference, pose.quaternion)

    def draw(
        self,
        pose: Pose,
        goal: Pose,
        space: FreeSpace,
        pusher: Float[np.ndarray, "2"],
        count: int,
        rng: np.random.Generator,
    ) -> list[Float[np.ndarray, "C 2"]]:
        """Corners of the pusher's path, from the start of the first push to the end of the last [m].

        Args:
            pose: of the object, on the side that the table was made for.
            goal: where it should be.
            space: where first pushes may begin.
            pusher: where it comes from [m].
            count: of sequences at most; none where no push that has room brings the object nearer.
            rng: draws them.
        """
        turn, centre = _rotation(self.yaw(pose) or 0.0), pose.apply(self._centre)[:2]
        is_within = np.abs(self._ends @ turn.T + centre).max(axis=1) <= PUSHER_REACH_M
        has_room = space.is_free(self._outcomes.starts @ turn.T + centre)
        possible = np.flatnonzero(is_within & np.repeat(has_room, len(self._outcomes.lengths)))
        if not len(possible):
            return []
        shift = turn.T @ (goal.apply(self._centre)[:2] - centre)
        before = np.hypot(np.linalg.norm(shift), turn_cost(rotation_angle(pose.quaternion, goal.quaternion)))
        rows, left = self._sequences(possible, pose, goal, shift, rng)
        path = self._path_lengths(rows, turn.T @ (pusher - centre))
        stays = (rows[:, 1] >= 0) | self._is_planar[rows[:, 0]]
        better = np.flatnonzero(left < _NEARER * before)
        if np.any(stays & (left < _MUCH_NEARER * before)):
            better = better[stays[better]]
        drawn = (left + _PATH_PRICE * path)[better] / _TEMPERATURE_M - rng.gumbel(size=len(better))
        chosen = rows[better[np.argsort(drawn)[:count]]]
        return [self._corners(row) @ turn.T + centre for row in chosen]

    def _sequences(
        self, possible: Int[np.ndarray, "M"], pose: Pose, goal: Pose, shift: Float[np.ndarray, "2"],
        rng: np.random.Generator,
    ) -> tuple[Int[np.ndarray, "C 3"], Float[np.ndarray, "C"]]:  # fmt: skip
        """Rows of the table for each push, -1 for none; and what they leave [m]."""
        yaw = self.yaw(pose) or 0.0
        around = np.array([np.cos(yaw / 2), 0.0, 0.0, np.sin(yaw / 2)])
        ends = quaternion_multiply(quaternion_multiply(around, self._turns[possible]), self._reference)
        angle = rotation_angle(ends, np.broadcast_to(goal.quaternion, ends.shape))
        left = np.hypot(np.linalg.norm(shift - self._motions[possible, :2], axis=1), turn_cost(angle))
        rows = np.stack([possible, *np.full((2, len(possible)), -1)], axis=1)
        first = possible[self._is_planar[possible]]
        if self._tree is None or not len(first):
            return rows, left
        to_turn = planar_turn(pose.quaternion, goal.quaternion)
        target = np.array([*shift, to_turn or 0.0])
        pairs = np.stack([rng.choice(first, _PAIRS), rng.choice(self._planar, _PAIRS)], axis=1)
        one, two = first[::_EVERY], _after(_after(target, self._motions[pairs[:, 0]]), self._motions[pairs[:, 1]])
        error = np.concatenate([_after(target, self._motions[one]), two])
        more, nearest = self._tree.query(error * [1, 1, ARM_M])
        if to_turn is None:  # which pushes on this side cannot change
            more = np.hypot(more, turn_cost(rotation_angle(pose.quaternion, goal.quaternion)))
        last = self._planar[nearest]
        second = np.stack([one, last[: len(one)], np.full(len(one), -1)], axis=1)
        third = np.concatenate([pairs, last[len(one) :, None]], axis=1)
        return np.concatenate([rows, second, third]), np.concatenate([left, more])

    def _path_lengths(self, rows: Int[np.ndarray, "C 3"], pusher: Float[np.ndarray, "2"]) -> Float[np.ndarray, "C"]:
        """About how far the pusher goes, straight from push to push [m]."""
        starts, lengths = self._outcomes.starts, self._outcomes.lengths
        path, at = np.zeros(len(rows)), np.broadcast_to(pusher, (len(rows), 2))
        for push in rows.T:
            more = np.linalg.norm(starts[push // len(lengths)] - at, axis=1) + lengths[push % len(lengths)]
            path += np.where(push < 0, 0.0, more)
            at = self._left_at[push]
        return path

    def _corners(self, rows: Int[np.ndarray, "_"]) -> Float[np.ndarray, "C 2"]:
        """The pusher's path through pushes, in the planar frame before the first."""
        outcomes = self._outcomes
        push, later = rows[0], rows[1:]
        number = push // len(outcomes.lengths)
        path = np.stack([outcomes.starts[number], self._ends[push]])
        if not len(later) or later[0] < 0:
            return path
        then = self._corners(later)
        back = path[1] - _TURN_BACK_M * outcomes.directions[number]
        motion = self._motions[push]
        around = around_loop(outcomes.loop, _into(motion[None], back[None])[0], then[0])
        return np.vstack([path, back, np.vstack([around, then]) @ _rotation(motion[2]).T + motion[:2]])

    def leave(self, pose: Pose, at: Float[np.ndarray, "2"], toward: Float[np.ndarray, "2"]) -> Float[np.ndarray, "n 2"]:
        """Corners of a way around the object to the point of its loop that is nearest to another place."""
        turn, centre, loop = _rotation(self.yaw(pose) or 0.0), pose.apply(self._centre)[:2], self._outcomes.loop
        own, aim = turn.T @ (at - centre), turn.T @ (toward - centre)
        exit_ = loop[np.linalg.norm(loop - aim, axis=1).argmin()]
        return np.vstack([around_loop(loop, own, exit_), exit_]) @ turn.T + centre


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
