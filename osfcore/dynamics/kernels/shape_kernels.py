"""Support functions of bodies, their outlines seen from above, gaps between outlines, and pushes at a contact.

The same as `ShapeTable`, `osfcore.geometry.polygons` and `limit_surface`, for one body or pair at a time. A gap is the
distance, the normal out of the first outline (x, y) and the point of it that is nearest (x, y).
"""
# ruff: noqa: ANN001, ANN201, ANN202 - compiled helpers; types are given by their callers

from __future__ import annotations

import math
from typing import NamedTuple

import numba
import numpy as np

from osfcore.dynamics.contact_geometry import OUTLINE, PAIR_STRIDE
from osfcore.dynamics.kernels.options import HELPER, NEVER, ONE, ZERO
from osfcore.dynamics.limit_surface import FRICTION
from osfcore.dynamics.shapes.object_shapes import MAP_SIDE, ShapeTable

CIRCLE_X, CIRCLE_Y = (
    f(2 * np.pi / OUTLINE * np.arange(OUTLINE)).astype(np.float32) for f in (np.cos, np.sin)
)  # as `polygons.circle`
_SIDES, _HALF_SIDE, _LAST = np.int64(MAP_SIDE), np.float32(MAP_SIDE / 2), np.int64(MAP_SIDE - 1)
_FRICTION = np.float32(FRICTION)
_TINIER, _REPEATED = np.float32(1e-14), np.float32(1e-4)
_LEAST_GAIN = np.float32(1e-3)


class Shapes(NamedTuple):
    """A `ShapeTable` as compiled code takes it; attributes as there."""

    support: np.ndarray
    first_part: np.ndarray
    part_count: np.ndarray
    radius: np.ndarray
    half_extent: np.ndarray


def packed_shapes(table: ShapeTable) -> Shapes:
    """The arrays of a table."""
    arrays = (table.support, table.first_part, table.part_count, table.radius, table.half_extent)
    return Shapes(*(array.cpu().numpy() for array in arrays))


@numba.njit(**HELPER)
def support_row(body, x, y, z):
    """Row of `Shapes.support` for a direction in the body's frame, of any length but 0."""
    length = abs(x) + abs(y) + abs(z)
    x, y = x / length, y / length
    if z < ZERO:
        x, y = math.copysign(ONE - abs(y), x), math.copysign(ONE - abs(x), y)
    i = min(max(np.int64((x + ONE) * _HALF_SIDE), 0), _LAST)
    j = min(max(np.int64((y + ONE) * _HALF_SIDE), 0), _LAST)
    return (body * _SIDES + i) * _SIDES + j


@numba.njit(**HELPER)
def farthest_point(support, body, r, n, x, y, z):
    """Farthest point in a direction, relative to the centre of mass; r[n] rotates from the body's frame."""
    row = support_row(
        body,
        r[n, 0, 0] * x + r[n, 1, 0] * y + r[n, 2, 0] * z,
        r[n, 0, 1] * x + r[n, 1, 1] * y + r[n, 2, 1] * z,
        r[n, 0, 2] * x + r[n, 1, 2] * y + r[n, 2, 2] * z,
    )
    a, b, c = support[row, 0], support[row, 1], support[row, 2]
    return (
        r[n, 0, 0] * a + r[n, 0, 1] * b + r[n, 0, 2] * c,
        r[n, 1, 0] * a + r[n, 1, 1] * b + r[n, 1, 2] * c,
        r[n, 2, 0] * a + r[n, 2, 1] * b + r[n, 2, 2] * c,
    )


@numba.njit(**HELPER)
def extent_along(support, body, r, n, x, y, z):
    """How far a body reaches in a direction, a unit vector."""
    a, b, c = farthest_point(support, body, r, n, x, y, z)
    return a * x + b * y + c * z


@numba.njit(**HELPER)
def draw_outline(support, body, r, n, centre_x, centre_y, xs, ys, row) -> None:
    """The outline seen from above, into xs[row] and ys[row]."""
    for k in range(OUTLINE):
        x, y, _ = farthest_point(support, body, r, n, CIRCLE_X[k], CIRCLE_Y[k], ZERO)
        xs[row, k], ys[row, k] = x + centre_x, y + centre_y


@numba.njit(**HELPER)
def direction_number(x, y, count):
    """Number of the nearest of `count` equally spaced directions."""
    return np.int64(np.rint(math.atan2(y, x) * np.float32(count / (2 * np.pi)))) % count


@numba.njit(**HELPER)
def outline_to_point(xs, ys, row, px, py):
    """The gap from an outline to a point."""
    best, best_x, best_y, middle_x, middle_y = NEVER, ZERO, ZERO, ZERO, ZERO
    for k in range(OUTLINE):
        x, y = xs[row, k], ys[row, k]
        after = k + 1 if k + 1 < OUTLINE else 0
        side_x, side_y, away_x, away_y = xs[row, after] - x, ys[row, after] - y, px - x, py - y
        along = (away_x * side_x + away_y * side_y) / (side_x * side_x + side_y * side_y + _TINY)
        along = min(max(along, ZERO), ONE)
        rest_x, rest_y = away_x - along * side_x, away_y - along * side_y
        square = rest_x * rest_x + rest_y * rest_y
        middle_x += x
        middle_y += y
        if square < best:
            best, best_x, best_y = square, rest_x, rest_y
    length = np.sqrt(best + _TINIER)
    share = ONE / np.float32(OUTLINE)
    x, y = px - best_x, py - best_y
    outward = best_x * (x - middle_x * share) + best_y * (y - middle_y * share)
    sign = -ONE if outward < ZERO else ONE  # a convex outline's nearest point lies away from its middle
    return sign * length, sign / length * best_x, sign / length * best_y, x, y


@numba.njit(**HELPER)
def _separation(xs, ys, a, us, vs, b):
    """Largest separation of two outlines along the normals of the first one's sides, and that normal."""
    best, best_x, best_y = -NEVER, ONE, ZERO
    for k in range(0, OUTLINE, PAIR_STRIDE):
        after = (k + PAIR_STRIDE) % OUTLINE
        side_x, side_y = xs[a, after] - xs[a, k], ys[a, after] - ys[a, k]
        length = np.sqrt(side_x * side_x + side_y * side_y)
        if length <= _REPEATED:  # repeated points have no side between them
            if best < -ONE:
                best = -ONE
            continue
        x, y = side_y / length, -side_x / length
        least, most = NEVER, -NEVER
        for m in range(OUTLINE // PAIR_STRIDE):
            # Not from the side's own corner: points found with an error may run back a little before they go on.
            least = min(least, x * us[b, PAIR_STRIDE * m] + y * vs[b, PAIR_STRIDE * m])
            most = max(most, x * xs[a, PAIR_STRIDE * m] + y * ys[a, PAIR_STRIDE * m])
        if least - most > best:
            best, best_x, best_y = least - most, x, y
    return best, best_x, best_y


@numba.njit(**HELPER)
def outline_to_outline(xs, ys, a, us, vs, b):
    """The gap out of the outline xs[a], ys[a] to us[b], vs[b]: the best separating axis."""
    distance, x, y = _separation(xs, ys, a, us, vs, b)
    other, other_x, other_y = _separation(us, vs, b, xs, ys, a)
    if other > distance:
        distance, x, y = other, -other_x, -other_y
    corner = PAIR_STRIDE * direction_number(x, y, OUTLINE // PAIR_STRIDE)
    return distance, x, y, xs[a, corner], ys[a, corner]


@numba.njit(**HELPER)
def push_motion(x, y, inward_x, inward_y, depth, shift_x, shift_y, arm):
    """Displacement (x, y) and turn of an object pushed at a contact; as `limit_surface.push_motion`."""
    if depth <= ZERO:
        return ZERO, ZERO, ZERO
    drag = shift_y * inward_x - shift_x * inward_y
    u, v = depth * inward_x - drag * inward_y, depth * inward_y + drag * inward_x
    square = arm * arm
    scale = ONE / (square + x * x + y * y)
    vx = ((square + x * x) * u + x * y * v) * scale
    vy = (x * y * u + (square + y * y) * v) * scale
    normal, side = vx * inward_x + vy * inward_y, vy * inward_x - vx * inward_y
    if abs(side) <= _FRICTION * normal:
        return vx, vy, (x * vy - y * vx) / square
    sign = ONE if side > ZERO else (-ONE if side < ZERO else ZERO)
    edge_x, edge_y = inward_x - _FRICTION * sign * inward_y, inward_y + _FRICTION * sign * inward_x
    turn = (x * edge_y - y * edge_x) / square
    along = (edge_x - turn * y) * inward_x + (edge_y + turn * x) * inward_y
    gain = depth / max(along, _LEAST_GAIN)
    return gain * edge_x, gain * edge_y, gain * turn
