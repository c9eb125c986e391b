"""Rays and triangles by a hierarchy of bounding boxes, where there is no Embree: slower, with the same pictures."""

from __future__ import annotations

import numba
import numpy as np
from jaxtyping import Bool, Float, Float32, Int, Int32

_LEAF = 8  # triangles in the smallest boxes
_EDGE = 1e-7  # by which triangles are larger, in barycentric coordinates: no ray passes between two of them
_WIDER_M = 1e-9  # on each side of a box, so that flat ones are hit, and rays along a side


class Triangles:
    """Triangles that rays meet, with the methods and numbers of `embree.Triangles`.

    Boxes are stored in the order of a walk that enters each: the first half of a box comes right after it, and `past`
    is where the walk goes on if a ray misses the box, or has seen all in it.

    Args:
        vertices: corners.
        faces: indices of each triangle's corners.
    """

    def __init__(self, vertices: Float32[np.ndarray, "W 3"], faces: Int32[np.ndarray, "F 3"]) -> None:
        corners = vertices[faces].astype(np.float64)
        lows, highs, centres = corners.min(1), corners.max(1), corners.mean(1)
        boxes, past, first, order = [], [], [], []

        def add(chosen: np.ndarray) -> None:
            box = len(boxes)
            boxes.append(np.stack([lows[chosen].min(0) - _WIDER_M, highs[chosen].max(0) + _WIDER_M]))
            past.append(0)
            first.append(len(order))
            if len(chosen) <= _LEAF:
                order.extend(chosen)
            else:
                axis = np.ptp(centres[chosen], axis=0).argmax()
                middle = len(chosen) // 2
                sides = chosen[np.argpartition(centres[chosen, axis], middle)]
                add(sides[:middle])
                add(sides[middle:])
            past[box] = len(boxes)

        add(np.arange(len(faces)))
        self._order = np.array(order)
        self._tree = np.array(boxes), np.array(past), np.array([*first, len(order)]), corners[self._order]

    def intersect(
        self, origins: Float[np.ndarray, "S 3"], directions: Float[np.ndarray, "S 3"]
    ) -> tuple[Float[np.ndarray, "S"], Int[np.ndarray, "S"], Float[np.ndarray, "S 2"]]:
        """Find each ray's first hit: distance [ray lengths; infinite for none], face, barycentric coordinates."""
        distance, triangle, weights = _trace(*self._tree, origins, directions, np.inf, False)
        return distance.astype(np.float32), np.where(triangle < 0, -1, self._order[triangle]), weights

    def occludes(
        self, origins: Float[np.ndarray, "S 3"], directions: Float[np.ndarray, "S 3"], end: float | None = None
    ) -> Bool[np.ndarray, "S"]:
        """Return whether a triangle stands in each ray's way, up to `end` [ray lengths] if it is given."""
        return _trace(*self._tree, origins, directions, np.inf if end is None else float(end), True)[1] >= 0


@numba.njit(error_model="numpy", inline="always")
def _minus(a, b):  # noqa: ANN001, ANN202
    return a[0] - b[0], a[1] - b[1], a[2] - b[2]


@numba.njit(error_model="numpy", inline="always")
def _cross(a, b):  # noqa: ANN001, ANN202
    return a[1] * b[2] - a[2] * b[1], a[2] * b[0] - a[0] * b[2], a[0] * b[1] - a[1] * b[0]


@numba.njit(error_model="numpy", inline="always")
def _dot(a, b):  # noqa: ANN001, ANN202
    return a[0] * b[0] + a[1] * b[1] + a[2] * b[2]


@numba.njit(error_model="numpy", cache=True, nogil=True)
def _trace(boxes, past, first, corners, origins, directions, end, any_is_enough):  # noqa: ANN001, ANN202
    """Return distance, place among `corners` (-1 for none) and barycentric coordinates of each ray's first hit."""
    rays = len(directions)
    distance, triangle, weights = np.full(rays, end), np.full(rays, -1), np.zeros((rays, 2), np.float32)
    for ray in range(rays):
        origin = np.float64(origins[ray, 0]), np.float64(origins[ray, 1]), np.float64(origins[ray, 2])
        direction = np.float64(directions[ray, 0]), np.float64(directions[ray, 1]), np.float64(directions[ray, 2])
        per_m = 1 / direction[0], 1 / direction[1], 1 / direction[2]
        box = 0
        while box < len(past):
            near, far = 0.0, distance[ray]
            for axis in range(3):
                low = (boxes[box, 0, axis] - origin[axis]) * per_m[axis]
                high = (boxes[box, 1, axis] - origin[axis]) * per_m[axis]
                near, far = max(near, min(low, high)), min(far, max(low, high))
            if near > far:
                box = past[box]
                continue
            if past[box] == box + 1:
                for i in range(first[box], first[box + 1]):
                    # Möller and Trumbore, "Fast, minimum storage ray-triangle intersection", 1997.
                    side_u, side_v = _minus(corners[i, 1], corners[i, 0]), _minus(corners[i, 2], corners[i, 0])
                    p, offset = _cross(direction, side_v), _minus(origin, corners[i, 0])
                    q, determinant = _cross(offset, side_u), _dot(side_u, p)
                    u, v = _dot(offset, p) / determinant, _dot(direction, q) / determinant
                    t = _dot(side_v, q) / determinant
                    if u >= -_EDGE and v >= -_EDGE and u + v <= 1 + _EDGE and 0 <= t < distance[ray]:
                        distance[ray], triangle[ray], weights[ray, 0], weights[ray, 1] = t, i, u, v
                if any_is_enough and triangle[ray] >= 0:
                    break
            box += 1
    return distance, triangle, weights
