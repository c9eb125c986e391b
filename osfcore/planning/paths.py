"""Path planning of the pusher: shortest collision-free paths on a grid, shortened by lines of sight.

The configuration space is the distance transform of the objects' outlines; paths are minimum-cost paths over its cells
(scikit-image's MCP_Geometric, a Dijkstra search). Cells too close to an object cost 200 times as much. A path can then
start in contact. If no path is free, the result is the one with the fewest such cells.
"""

from __future__ import annotations

import math
from bisect import bisect_left, bisect_right
from collections.abc import Sequence

import cv2
import numpy as np
from jaxtyping import Bool, Float, Int
from scipy import ndimage
from skimage.draw import line

from osfcore.geometry.workspace import MAX_SPEED_M_S, PUSHER_RADIUS_M, PUSHER_REACH_M, STEP_S

CELL_M = 0.005
CLEARANCE_M = 0.006  # between the pusher's rim and what it goes around
# By how much an action may pass a corner: 3 mm touch less, but take longer (docs/notes/planning.md).
_CUT_M = 0.012
_SIDE = round(2 * PUSHER_REACH_M / CELL_M) + 1
_BLOCKED = 200.0  # cost of a cell too close to something, for a start in contact must be possible


class FreeSpace:
    """Free space of the centre of a disc, usually the pusher.

    Attributes:
        clearance: distance from the disc's rim to the nearest outline, with its centre on each cell of the grid [m].
    """

    clearance: Float[np.ndarray, "S S"]

    def __init__(self, outlines: Sequence[Float[np.ndarray, "_ 2"]], radius: float = PUSHER_RADIUS_M) -> None:
        """Compute the clearance from the outlines of the objects.

        Args:
            outlines: outlines of their convex parts, seen from above [m].
            radius: radius of the disc [m].
        """
        solid = np.zeros((_SIDE, _SIDE), np.uint8)
        for outline in outlines:
            cv2.fillConvexPoly(solid, _cells(outline)[:, ::-1].astype(np.int32), 1)
        distance = ndimage.distance_transform_edt(solid == 0) if solid.any() else np.full(solid.shape, float(_SIDE))
        self.clearance = CELL_M * np.asarray(distance) - radius
        self._free = self.clearance >= CLEARANCE_M

    def is_free(self, points: Float[np.ndarray, "n 2"]) -> Bool[np.ndarray, "n"]:
        """Return whether the disc is clear of all objects at places within the pusher's reach."""
        return self.clearance_at(points) >= CLEARANCE_M

    def clearance_at(self, points: Float[np.ndarray, "n 2"]) -> Float[np.ndarray, "n"]:
        """Return the clearance at places [m]; minus infinity beyond the pusher's reach."""
        cells = _cells(points)
        within = np.all((cells >= 0) & (cells < _SIDE), axis=1)
        rows = cells.clip(0, _SIDE - 1)
        return np.where(within, self.clearance[rows[:, 0], rows[:, 1]], -np.inf)

    def paths_from(self, start: Float[np.ndarray, "2"]) -> ShortestPaths:
        """Return all shortest paths from a place within reach [m]."""
        return ShortestPaths(self._free, start)


class ShortestPaths:
    """Shortest paths from one place.

    Args:
        free: cells that the paths should use.
        start: their start [m].
    """

    def __init__(self, free: Bool[np.ndarray, "S S"], start: Float[np.ndarray, "2"]) -> None:
        from skimage.graph import MCP_Geometric

        self._free, self._start = free, start
        self._search = MCP_Geometric(np.where(free, 1.0, _BLOCKED))
        self._search.find_costs(_cells(start[None]).clip(0, _SIDE - 1).tolist())

    def to(self, end: Float[np.ndarray, "2"]) -> Float[np.ndarray, "n 2"]:
        """Return the corners of the path to a place within reach [m]."""
        cells = np.array(self._search.traceback(_cells(end[None]).clip(0, _SIDE - 1)[0].tolist()))
        corners = cells[self._corners(cells)] * CELL_M - PUSHER_REACH_M
        return np.concatenate([self._start[None], corners[1:-1], end[None]])

    def _corners(self, cells: Int[np.ndarray, "n 2"]) -> list[int]:
        """Shorten a path: connect each corner to the farthest corner with a free line between them."""
        kept, at = [0], 0
        while at < len(cells) - 1:
            later = len(cells) - 1
            while later > at + 1:
                rows, columns = line(*cells[at], *cells[later])
                if self._free[rows[1:-1], columns[1:-1]].all():
                    break
                later = at + max((later - at) * 3 // 4, 1)
            at = later
            kept.append(at)
        return kept


def _cells(points: Float[np.ndarray, "n 2"]) -> np.ndarray:
    return np.rint((points + PUSHER_REACH_M) / CELL_M).astype(int)


def actions_along(
    path: Float[np.ndarray, "n 2"], horizon: int, speeds: Float[np.ndarray, "n-1"] | None = None
) -> Float[np.ndarray, "T 3"]:
    """Return velocities that follow a path [m/s], each leg at its share of the highest speed; zeros after its end.

    The pusher moves straight during an action. If it would miss a corner by more than 12 mm, the action ends at the
    corner. Paths around objects then hardly touch them, and pushes begin close to their planned starts.

    Args:
        path: corners of the path; the first is the position of the pusher [m].
        horizon: number of actions.
        speeds: share of the highest speed on each leg, above 0; all 1 by default.
    """
    corners = path.tolist()  # numbers one by one: arrays of so few would take ten times as long
    times = [0.0, *(float(end) / STEP_S for end in np.cumsum(_legs_s(path, speeds)))]
    now, places = 0.0, [corners[0]]
    for _ in range(horizon):
        now = _next_moment(corners, times, now, places[-1])
        places.append(_place_at(corners, times, now))
    return np.pad(np.diff(np.asarray(places, np.float64), axis=0) / STEP_S, ((0, 0), (0, 1)))


def _next_moment(corners: list[list[float]], times: list[float], now: float, here: list[float]) -> float:
    """Return the end of the action that begins now, in actions along the path: after a whole action or at a corner."""
    end = now + 1
    first, last = bisect_right(times, now), bisect_left(times, end)
    while last > first:
        there = _place_at(corners, times, end)
        if all(_distance_to_line(corner, here, there) <= _CUT_M for corner in corners[first:last]):
            break
        last -= 1
        end = times[last]
    return end


def _place_at(corners: list[list[float]], times: list[float], moment: float) -> list[float]:
    """Return the position on the path at a moment; its last corner after its end."""
    after = bisect_right(times, moment)
    if after == len(times):
        return corners[-1]
    share = (moment - times[after - 1]) / (times[after] - times[after - 1])
    return [a + share * (b - a) for a, b in zip(corners[after - 1], corners[after], strict=True)]


def _distance_to_line(point: list[float], begin: list[float], end: list[float]) -> float:
    """Return the distance of a point from a line segment [m]."""
    x, y, u, v = end[0] - begin[0], end[1] - begin[1], point[0] - begin[0], point[1] - begin[1]
    share = min(max((u * x + v * y) / max(x * x + y * y, 1e-12), 0.0), 1.0)
    return math.hypot(u - share * x, v - share * y)


def duration_s(path: Float[np.ndarray, "n 2"], speeds: Float[np.ndarray, "n-1"] | None = None) -> float:
    """Return the duration of a path [s], each leg at its share of the highest speed. Corners may take longer."""
    return float(_legs_s(path, speeds).sum())


def _legs_s(path: Float[np.ndarray, "n 2"], speeds: Float[np.ndarray, "n-1"] | None) -> Float[np.ndarray, "n-1"]:
    legs = np.abs(np.diff(path, axis=0)).max(axis=1)  # speeds are limited along each axis
    return legs / (MAX_SPEED_M_S * (np.ones(len(legs)) if speeds is None else speeds))
