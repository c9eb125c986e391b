"""One or two pushes that bring an object to a pose, by search over a table of pushes (Song et al., 2020, go deeper).

With e = (x, y, yaw) the goal in the object's planar frame and m_i the motion of push i, one push leaves e' = m_i^-1 e,
and the second push is the one in the table whose motion is nearest to e'. Sequences are drawn by

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
_NEARER = 0.9  # of the error may be left, or a sequence is not worth its time
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
        rows, left = self._sequences(possible, pose, goal, shift)
        path = self._path_lengths(rows, turn.T @ (pusher - centre))
        better = np.flatnonzero(left < _NEARER * before)
        drawn = (left + _PATH_PRICE * path)[better] / _TEMPERATURE_M - rng.gumbel(size=len(better))
        chosen = rows[better[np.argsort(drawn)[:count]]]
        return [self._corners(first, second) @ turn.T + centre for first, second in chosen]

    def _sequences(
        self, possible: Int[np.ndarray, "M"], pose: Pose, goal: Pose, shift: Float[np.ndarray, "2"]
    ) -> tuple[Int[np.ndarray, "C 2"], Float[np.ndarray, "C"]]:
        """Rows of the table for the first and for the second push, -1 for no second one; and what they leave [m]."""
        yaw = self.yaw(pose) or 0.0
        around = np.array([np.cos(yaw / 2), 0.0, 0.0, np.sin(yaw / 2)])
        ends = quaternion_multiply(quaternion_multiply(around, self._turns[possible]), self._reference)
        angle = rotation_angle(ends, np.broadcast_to(goal.quaternion, ends.shape))
        one = np.hypot(np.linalg.norm(shift - self._motions[possible, :2], axis=1), turn_cost(angle))
        rows = np.stack([possible, np.full(len(possible), -1)], axis=1)
        first = possible[self._is_planar[possible]][::_EVERY]
        if self._tree is None or not len(first):
            return rows, one
        to_turn = planar_turn(pose.quaternion, goal.quaternion)
        error = _after(np.array([*shift, to_turn or 0.0]), self._motions[first])
        left, nearest = self._tree.query(error * [1, 1, ARM_M])
        if to_turn is None:  # which pushes on this side cannot change
            left = np.hypot(left, turn_cost(rotation_angle(pose.quaternion, goal.quaternion)))
        two = np.stack([first, self._planar[nearest]], axis=1)
        return np.concatenate([rows, two]), np.concatenate([one, left])

    def _path_lengths(self, rows: Int[np.ndarray, "C 2"], pusher: Float[np.ndarray, "2"]) -> Float[np.ndarray, "C"]:
        """About how far the pusher goes, straight from push to push [m]."""
        starts, lengths = self._outcomes.starts, self._outcomes.lengths
        first, second = rows.T
        path = np.linalg.norm(starts[first // len(lengths)] - pusher, axis=1) + lengths[first % len(lengths)]
        between = self._carried(first, starts[second // len(lengths)]) - self._ends[first]
        more = np.linalg.norm(between, axis=1) + lengths[second % len(lengths)]
        return path + np.where(second < 0, 0.0, more)

    def _carried(self, number: Int[np.ndarray, "n"], points: Float[np.ndarray, "n 2"]) -> Float[np.ndarray, "n 2"]:
        """Points of the planar frame after pushes, in the frame before them."""
        motion = self._motions[number]
        cos, sin = np.cos(motion[:, 2]), np.sin(motion[:, 2])
        x = cos * points[:, 0] - sin * points[:, 1] + motion[:, 0]
        y = sin * points[:, 0] + cos * points[:, 1] + motion[:, 1]
        return np.stack([x, y], axis=1)

    def _corners(self, first: int, second: int) -> Float[np.ndarray, "C 2"]:
        outcomes, count = self._outcomes, len(self._outcomes.lengths)
        start, end = outcomes.starts[first // count], self._ends[first]
        if second < 0:
            return np.stack([start, end])
        motion = self._motions[first]
        turn, shift = _rotation(motion[2]), motion[:2]
        back = end - _TURN_BACK_M * outcomes.directions[first // count]
        begin = outcomes.starts[second // count]
        around = around_loop(outcomes.loop, turn.T @ (back - shift), begin)
        then = np.vstack([around, begin, self._ends[second]])
        return np.vstack([start, end, back, then @ turn.T + shift])

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


def _after(goal: Float[np.ndarray, "3"], motions: Float[np.ndarray, "M 3"]) -> Float[np.ndarray, "M 3"]:
    """The goal (x, y, yaw) in the frame of an object that has made motions: m^-1 e."""
    cos, sin = np.cos(motions[:, 2]), np.sin(motions[:, 2])
    x, y = (goal[:2] - motions[:, :2]).T
    yaw = (goal[2] - motions[:, 2] + np.pi) % (2 * np.pi) - np.pi
    return np.stack([cos * x + sin * y, cos * y - sin * x, yaw], axis=1)
