"""One or two pushes that bring an object to a pose, by search over a table of pushes (Song et al., 2020, go deeper).

With e the goal in the object's planar frame and m_i the motion of push i, one push leaves e' = m_i^-1 e, and the second
push is the one in the table whose motion is nearest to e'. Sequences are drawn by

    s = sqrt(|e_xy|^2 + (arm * e_yaw)^2) + time price * (length of the pusher's path)

with probability proportional to exp(-s / temperature).
"""

from __future__ import annotations

import numpy as np
from jaxtyping import Float, Int
from scipy.spatial import KDTree

from osfcore.dynamics.contact_geometry import part_outlines
from osfcore.dynamics.shapes.object_shapes import ShapeTable
from osfcore.geometry.poses import Pose, planar_turn
from osfcore.geometry.workspace import PUSHER_REACH_M
from osfcore.planning.path_planning import FreeSpace
from osfcore.planning.pose_cost import ARM_M
from osfcore.planning.push_outcomes import PushOutcomes, push_outcomes

_PATH_PRICE = 0.1  # of a metre of the pusher's path, in metres of error
_TEMPERATURE_M = 0.003
_EVERY = 3  # rows of the table are tried as the first of two pushes
_NEARER = 0.9  # of the error may be left, or a sequence is not worth its time
_TURN_BACK_M = 0.008  # the pusher backs off before it walks around an object


class ObjectPushes:
    """Push sequences of one object while it rests on one side.

    Args:
        table: its shape alone.
        pose: of the object on that side, any yaw.
    """

    def __init__(self, table: ShapeTable, pose: Pose) -> None:
        self._centre = table.centre[0].numpy().astype(float)
        self._reference = pose.quaternion
        centre = pose.apply(self._centre)[:2]
        parts = [outline.astype(float) - centre for outline in part_outlines(table, 0, pose)]
        self.outcomes: PushOutcomes = push_outcomes(parts)
        self._motions = self.outcomes.motions.reshape(-1, 3)
        self._tree = KDTree(self._motions * [1, 1, ARM_M])
        self._ends = (
            self.outcomes.starts[:, None] + self.outcomes.lengths[:, None] * self.outcomes.directions[:, None]
        ).reshape(-1, 2)

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
        shift = turn.T @ (goal.apply(self._centre)[:2] - centre)
        target = np.array([*shift, planar_turn(pose.quaternion, goal.quaternion) or 0.0])
        is_within = np.abs(self._ends @ turn.T + centre).max(axis=1) <= PUSHER_REACH_M
        has_room = np.repeat(space.is_free(self.outcomes.starts @ turn.T + centre), len(self.outcomes.lengths))
        possible = np.flatnonzero(is_within & has_room)
        if not len(possible):
            return []
        chosen = self._choose(target, turn.T @ (pusher - centre), possible, count, rng)
        return [self._corners(first, second) @ turn.T + centre for first, second in chosen]

    def _choose(
        self,
        goal: Float[np.ndarray, "3"],
        pusher: Float[np.ndarray, "2"],
        possible: Int[np.ndarray, "M"],
        count: int,
        rng: np.random.Generator,
    ) -> Int[np.ndarray, "C 2"]:
        """Rows of the table for the first and for the second push, -1 for no second one."""
        starts, lengths = self.outcomes.starts, self.outcomes.lengths
        path = np.linalg.norm(starts[possible // len(lengths)] - pusher, axis=1) + lengths[possible % len(lengths)]
        error = _after(goal, self._motions[possible])
        residual, then = self._tree.query(error[::_EVERY] * [1, 1, ARM_M])
        between = self._carried(possible[::_EVERY], starts[then // len(lengths)]) - self._ends[possible[::_EVERY]]
        longer = path[::_EVERY] + np.linalg.norm(between, axis=1) + lengths[then % len(lengths)]
        left = np.concatenate([_size(error), residual])
        costs = left + _PATH_PRICE * np.concatenate([path, longer])
        rows = np.stack(
            [np.concatenate([possible, possible[::_EVERY]]), np.concatenate([np.full(len(possible), -1), then])], axis=1
        )
        better = np.flatnonzero(left < _NEARER * _size(goal[None]))
        drawn = costs[better] / _TEMPERATURE_M - rng.gumbel(size=len(better))
        return rows[better[np.argsort(drawn)[:count]]]

    def _carried(self, number: np.ndarray, points: Float[np.ndarray, "n 2"]) -> Float[np.ndarray, "n 2"]:
        """Points of the planar frame after pushes, in the frame before them."""
        motion = self._motions[number]
        cos, sin = np.cos(motion[:, 2]), np.sin(motion[:, 2])
        x = cos * points[:, 0] - sin * points[:, 1] + motion[:, 0]
        y = sin * points[:, 0] + cos * points[:, 1] + motion[:, 1]
        return np.stack([x, y], axis=1)

    def _corners(self, first: int, second: int) -> Float[np.ndarray, "C 2"]:
        start, end = self.outcomes.starts[first // len(self.outcomes.lengths)], self._ends[first]
        if second < 0:
            return np.stack([start, end])
        motion = self._motions[first]
        turn, shift = _rotation(motion[2]), motion[:2]
        back = end - _TURN_BACK_M * self.outcomes.directions[first // len(self.outcomes.lengths)]
        begin = self.outcomes.starts[second // len(self.outcomes.lengths)]
        around = around_loop(self.outcomes.loop, turn.T @ (back - shift), begin)
        then = np.vstack([around, begin, self._ends[second]])
        return np.vstack([start, end, back, then @ turn.T + shift])

    def leave(self, pose: Pose, at: Float[np.ndarray, "2"], toward: Float[np.ndarray, "2"]) -> Float[np.ndarray, "n 2"]:
        """Corners of a way around the object to the point of its loop that is nearest to another place."""
        turn, centre = _rotation(self.yaw(pose) or 0.0), pose.apply(self._centre)[:2]
        own, aim = turn.T @ (at - centre), turn.T @ (toward - centre)
        exit_ = self.outcomes.loop[np.linalg.norm(self.outcomes.loop - aim, axis=1).argmin()]
        return np.vstack([around_loop(self.outcomes.loop, own, exit_), exit_]) @ turn.T + centre


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


def _size(error: Float[np.ndarray, "M 3"]) -> Float[np.ndarray, "M"]:
    return np.sqrt(error[:, 0] ** 2 + error[:, 1] ** 2 + (ARM_M * error[:, 2]) ** 2)
