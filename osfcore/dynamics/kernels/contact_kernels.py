"""What may move in a substep of one scene, and where it touches: `contact_graph` and `contact_geometry`, compiled."""
# ruff: noqa: ANN001, ANN201, ANN202 - compiled helpers; types are given by their callers

from __future__ import annotations

from typing import NamedTuple

import numba
import numpy as np

from osfcore.dynamics.contact_geometry import CLEAR_M, FAR_M, OUTLINE, PAIR_REACH_M, PUSHER_TOP_M, SLACK_M, TOUCH_M
from osfcore.dynamics.contact_graph import LOOKUP_M, TRAVEL_M
from osfcore.dynamics.kernels.options import HALF, HELPER, NEVER, ONE, TWO, ZERO
from osfcore.dynamics.kernels.shape_kernels import (
    CIRCLE_X,
    CIRCLE_Y,
    direction_number,
    draw_outline,
    extent_along,
    outline_to_outline,
    outline_to_point,
)
from osfcore.geometry.workspace import PUSHER_RADIUS_M

_TRAVEL, _TOUCH, _RIM = (np.float32(x) for x in (TRAVEL_M, TOUCH_M, PUSHER_RADIUS_M))
_REACH, _TOP, _FAR = (np.float32(x) for x in (PAIR_REACH_M, PUSHER_TOP_M, FAR_M))
_CLEAR, _SLACK = np.float32(CLEAR_M), np.float32(SLACK_M)
_NEAR = np.float32(PUSHER_RADIUS_M + TOUCH_M + LOOKUP_M)
_PAIR = np.float32(PAIR_REACH_M + 2 * LOOKUP_M)
_TINY, _SHORT = np.float32(1e-12), np.float32(1e-6)


class Scenes(NamedTuple):
    """Scenes that are rolled out; attributes as those of `Motion`, `number` the shape of each object."""

    number: np.ndarray
    centre: np.ndarray
    quaternion: np.ndarray
    linear: np.ndarray
    angular: np.ndarray
    pusher: np.ndarray
    floor: np.ndarray


class Contacts(NamedTuple):
    """One scene's N objects, along the pusher's heading with its centre as the origin.

    Attributes:
        centre, linear, angular: of each object.
        rotation: from its frame.
        outline_x, outline_y: seen from above.
        first, many: its first convex part and how many it has; -1 before they are drawn.
        part_x, part_y, low, high: of the parts: outlines, lowest and highest point.
        reach: of each part in all directions of the circle.
        before, halfway, after: gaps to the pusher's rim at its start, halfway and at its end; `face` at its start.
        moving, near, possible, touched, awake: whether it moves, may be touched by the pusher, may take part at all, is
            touched, takes part.
        couples, touching: pairs that may touch, and that do.
        pair, gap, faces: the pairs that touch; out of the first one; both ends of both sides.
    """

    centre: np.ndarray
    linear: np.ndarray
    angular: np.ndarray
    rotation: np.ndarray
    outline_x: np.ndarray
    outline_y: np.ndarray
    first: np.ndarray
    many: np.ndarray
    part_x: np.ndarray
    part_y: np.ndarray
    low: np.ndarray
    high: np.ndarray
    reach: np.ndarray
    before: np.ndarray
    halfway: np.ndarray
    after: np.ndarray
    face: np.ndarray
    moving: np.ndarray
    near: np.ndarray
    possible: np.ndarray
    touched: np.ndarray
    awake: np.ndarray
    couples: np.ndarray
    touching: np.ndarray
    pair: np.ndarray
    gap: np.ndarray
    faces: np.ndarray


@numba.njit(error_model="numpy")
def new_contacts(n, parts):
    """Room for n objects that together have so many parts."""
    f, i, b, pairs = np.float32, np.int64, np.bool_, n * n
    return Contacts(
        np.empty((n, 3), f), np.empty((n, 3), f), np.empty((n, 3), f), np.empty((n, 3, 3), f),
        np.empty((n, OUTLINE), f), np.empty((n, OUTLINE), f), np.empty(n, i), np.empty(n, i),
        np.empty((parts, OUTLINE), f), np.empty((parts, OUTLINE), f), np.empty(parts, f), np.empty(parts, f),
        np.empty((parts, OUTLINE), f),
        np.empty((n, 5), f), np.empty((n, 5), f), np.empty((n, 5), f), np.empty((n, 4), f), np.empty(n, b),
        np.empty(n, b), np.empty(n, b), np.empty(n, b), np.empty(n, b), np.empty((n, n), b), np.empty((n, n), b),
        np.empty((pairs, 2), i), np.empty((pairs, 5), f), np.empty((pairs, 8), f),
    )  # fmt: skip


@numba.njit(**HELPER)
def find_contacts(shapes, scenes, b, heading_x, heading_y, shift_x, shift_y, c):
    """Fill `c` for scene b.

    Returns:
        Number of pairs that touch; -1 if nothing in the scene moves.
    """
    count = len(scenes.number)
    if not _any_seed(shapes, scenes, b, shift_x, shift_y, c):
        return -1
    shift_x, shift_y = heading_x * shift_x + heading_y * shift_y, heading_x * shift_y - heading_y * shift_x
    _couple(shapes, scenes, b, c)
    for n in range(count):
        c.possible[n] = c.near[n] or c.moving[n]
    _spread(c.couples, c.possible)
    used = 0
    for n in range(count):
        c.touched[n] = False
        if c.possible[n]:
            _place(shapes, scenes, b, n, heading_x, heading_y, c)
            used = _find_parts(shapes, scenes.number[n], n, used, c)
            _meet_pusher(n, shift_x, shift_y, c)
    pairs = _find_pairs(count, c)
    for n in range(count):
        c.awake[n] = c.possible[n] and (c.touched[n] or c.moving[n])
    _spread(c.touching, c.awake)
    return pairs


@numba.njit(**HELPER)
def _any_seed(shapes, scenes, b, shift_x, shift_y, c):
    """Which objects move, and which the pusher may touch: a cheap upper bound."""
    found = False
    px, py = scenes.pusher[b, 0], scenes.pusher[b, 1]
    square = shift_x * shift_x + shift_y * shift_y + _TINY
    for n in range(len(scenes.number)):
        c.moving[n] = False
        for k in range(3):
            if scenes.linear[b, n, k] != ZERO or scenes.angular[b, n, k] != ZERO:
                c.moving[n] = True
        x, y = px - scenes.centre[b, n, 0], py - scenes.centre[b, n, 1]
        along = min(max(-(x * shift_x + y * shift_y) / square, ZERO), ONE)
        x, y = x + along * shift_x, y + along * shift_y
        length = np.sqrt(x * x + y * y)
        c.near[n] = length - _NEAR < shapes.radius[scenes.number[n]]
        if c.near[n] or c.moving[n]:
            rotation_of(scenes.quaternion, b, n, c.rotation)
        if c.near[n]:
            c.near[n] = length - _NEAR < _reach_of(shapes, scenes.number[n], c, n, x, y, length)
        found = found or c.near[n] or c.moving[n]
    return found


@numba.njit(**HELPER)
def _reach_of(shapes, body, c, n, x, y, length):
    """How far an object reaches horizontally from its centre of mass."""
    if length <= _SHORT:
        x, y, length = ONE, ZERO, ONE
    return extent_along(shapes.support, body, c.rotation, n, x / length, y / length, ZERO)


@numba.njit(**HELPER)
def rotation_of(quaternion, b, n, rotation) -> None:
    """The rotation matrix of object n in scene b, into rotation[n]."""
    w, x, y, z = quaternion[b, n, 0], quaternion[b, n, 1], quaternion[b, n, 2], quaternion[b, n, 3]
    r = rotation
    r[n, 0, 0], r[n, 1, 1], r[n, 2, 2] = (
        ONE - TWO * (y * y + z * z),
        ONE - TWO * (x * x + z * z),
        ONE - TWO * (x * x + y * y),
    )
    r[n, 0, 1], r[n, 1, 0] = TWO * (x * y - w * z), TWO * (x * y + w * z)
    r[n, 0, 2], r[n, 2, 0] = TWO * (x * z + w * y), TWO * (x * z - w * y)
    r[n, 1, 2], r[n, 2, 1] = TWO * (y * z - w * x), TWO * (y * z + w * x)


@numba.njit(**HELPER)
def _couple(shapes, scenes, b, c) -> None:
    """Pairs that could collide (eq. 8) and are not clear of each other along the line between their centres."""
    count, centre, number = len(scenes.number), scenes.centre, scenes.number
    for n in range(count):
        rotation_of(scenes.quaternion, b, n, c.rotation)
        c.couples[n, n] = False
    for i in range(count):
        for j in range(i + 1, count):
            x, y = centre[b, j, 0] - centre[b, i, 0], centre[b, j, 1] - centre[b, i, 1]
            z, p, q = centre[b, j, 2] - centre[b, i, 2], number[i], number[j]
            length = np.sqrt(x * x + y * y)
            close = np.sqrt(x * x + y * y + z * z) < shapes.half_extent[p] + shapes.half_extent[q] + _TRAVEL
            close = close and length - _PAIR < shapes.radius[p] + shapes.radius[q]
            if close:
                reach = _reach_of(shapes, p, c, i, x, y, length) + _reach_of(shapes, q, c, j, -x, -y, length)
                close = length - _PAIR < reach
            c.couples[i, j], c.couples[j, i] = close, close


@numba.njit(**HELPER)
def _spread(links, chosen) -> None:
    """Everything connected to what is chosen by any number of links."""
    changed = True
    while changed:
        changed = False
        for i in range(len(chosen)):
            for j in range(len(chosen)):
                if chosen[i] and links[i, j] and not chosen[j]:
                    chosen[j], changed = True, True


@numba.njit(**HELPER)
def _place(shapes, scenes, b, n, heading_x, heading_y, c) -> None:
    """An object along the heading, and its outline."""
    dx, dy = scenes.centre[b, n, 0] - scenes.pusher[b, 0], scenes.centre[b, n, 1] - scenes.pusher[b, 1]
    c.centre[n, 0], c.centre[n, 1] = heading_x * dx + heading_y * dy, heading_x * dy - heading_y * dx
    c.centre[n, 2] = scenes.centre[b, n, 2]
    for values, turned in ((scenes.linear, c.linear), (scenes.angular, c.angular)):
        x, y = values[b, n, 0], values[b, n, 1]
        turned[n, 0], turned[n, 1] = heading_x * x + heading_y * y, heading_x * y - heading_y * x
        turned[n, 2] = values[b, n, 2]
    for k in range(3):
        x, y = c.rotation[n, 0, k], c.rotation[n, 1, k]
        c.rotation[n, 0, k], c.rotation[n, 1, k] = heading_x * x + heading_y * y, heading_x * y - heading_y * x
    body = scenes.number[n]
    draw_outline(shapes.support, body, c.rotation, n, c.centre[n, 0], c.centre[n, 1], c.outline_x, c.outline_y, n)


@numba.njit(**HELPER)
def _find_parts(shapes, number, n, used, c):
    """The convex parts of an object, from number `used` on; where the next ones go."""
    first, many = shapes.first_part[number], shapes.part_count[number]
    c.first[n], c.many[n] = used, many
    for part in range(many):
        row = used + part
        if many > 1:
            draw_outline(shapes.support, first + part, c.rotation, n, c.centre[n, 0], c.centre[n, 1], c.part_x,
                         c.part_y, row)  # fmt: skip
        for k in range(OUTLINE):
            if many == 1:
                c.part_x[row, k], c.part_y[row, k] = c.outline_x[n, k], c.outline_y[n, k]
            c.reach[row, k] = c.part_x[row, k] * CIRCLE_X[k] + c.part_y[row, k] * CIRCLE_Y[k]
        c.low[row] = c.centre[n, 2] - extent_along(shapes.support, first + part, c.rotation, n, ZERO, ZERO, -ONE)
        c.high[row] = c.centre[n, 2] + extent_along(shapes.support, first + part, c.rotation, n, ZERO, ZERO, ONE)
    return used + many


@numba.njit(**HELPER)
def _meet_pusher(n, shift_x, shift_y, c) -> None:
    """The gaps between the pusher's rim and the nearest part of an object."""
    c.before[n, 0], c.halfway[n, 0], c.after[n, 0] = NEVER, NEVER, NEVER
    if not c.near[n]:
        return
    half_x, half_y, half = HALF * shift_x, HALF * shift_y, HALF * np.sqrt(shift_x * shift_x + shift_y * shift_y)
    row_before = c.first[n]
    for row in range(c.first[n], c.first[n] + c.many[n]):
        d, x, y, u, v = outline_to_point(c.part_x, c.part_y, row, half_x, half_y)
        d = d - _RIM if c.low[row] < _TOP else _FAR
        if d < c.halfway[n, 0]:
            _put_gap(c.halfway, n, d, x, y, u, v)
        reached = d - half < _TOUCH
        e = d
        if reached:
            e, x, y, u, v = outline_to_point(c.part_x, c.part_y, row, ZERO, ZERO)
            e -= _RIM
        if e < c.before[n, 0]:
            row_before = row
            _put_gap(c.before, n, e, x, y, u, v)
        if reached:
            d, x, y, u, v = outline_to_point(c.part_x, c.part_y, row, shift_x, shift_y)
            d -= _RIM
        if d < c.after[n, 0]:
            _put_gap(c.after, n, d, x, y, u, v)
    _put_face(c.part_x, c.part_y, row_before, c.before[n, 1], c.before[n, 2], c.face, n, 0)
    c.touched[n] = min(c.before[n, 0], c.halfway[n, 0], c.after[n, 0]) < _TOUCH


@numba.njit(**HELPER)
def _put_gap(gaps, row, distance, x, y, u, v) -> None:
    gaps[row, 0], gaps[row, 1], gaps[row, 2], gaps[row, 3], gaps[row, 4] = distance, x, y, u, v


@numba.njit(**HELPER)
def _put_face(xs, ys, row, x, y, faces, at, column) -> None:
    """Both ends of the side of an outline that faces a direction."""
    middle = direction_number(x, y, OUTLINE)
    for end, step in ((0, -1), (2, 1)):
        corner = (middle + step) % OUTLINE
        faces[at, column + end], faces[at, column + end + 1] = xs[row, corner], ys[row, corner]


@numba.njit(**HELPER)
def _find_pairs(count, c):
    """Pairs of objects that can touch within a substep; how many."""
    pairs = 0
    for i in range(count):
        for j in range(count):
            c.touching[i, j] = False
    for i in range(count):
        for j in range(i + 1, count):
            if not (c.couples[i, j] and c.possible[i] and c.possible[j]):
                continue
            p, q = c.first[i], c.first[j]
            d, x, y, u, v = outline_to_outline(c.outline_x, c.outline_y, i, c.outline_x, c.outline_y, j)
            if d < _REACH and c.many[i] * c.many[j] > 1:
                p, q, d, x, y, u, v = _nearest_parts(i, j, c)
            if d < _REACH:
                c.touching[i, j], c.touching[j, i] = True, True
                c.pair[pairs, 0], c.pair[pairs, 1] = i, j
                _put_gap(c.gap, pairs, d, x, y, u, v)
                _put_face(c.part_x, c.part_y, p, x, y, c.faces, pairs, 0)
                _put_face(c.part_x, c.part_y, q, -x, -y, c.faces, pairs, 4)
                pairs += 1
    return pairs


@numba.njit(**HELPER)
def _nearest_parts(i, j, c):
    """Among all parts of two objects the two that are nearest, and their gap; far ones are ruled out by a bound."""
    least = NEVER
    for p in range(c.first[i], c.first[i] + c.many[i]):
        for q in range(c.first[j], c.first[j] + c.many[j]):
            least = min(least, _separation_bound(p, q, c))
    a, b, best, best_x, best_y, best_u, best_v = c.first[i], c.first[j], NEVER, ONE, ZERO, ZERO, ZERO
    for p in range(c.first[i], c.first[i] + c.many[i]):
        for q in range(c.first[j], c.first[j] + c.many[j]):
            bound = _separation_bound(p, q, c)
            if bound <= least + _SLACK:
                d, x, y, u, v = outline_to_outline(c.part_x, c.part_y, p, c.part_x, c.part_y, q)
                d = d if bound < _FAR else _FAR
                if d < best:
                    a, b, best, best_x, best_y, best_u, best_v = p, q, d, x, y, u, v
    return a, b, best, best_x, best_y, best_u, best_v


@numba.njit(**HELPER)
def _separation_bound(p, q, c):
    """A bound of the distance of two parts, a few millimetres less at most; far where one is well above the other."""
    if max(c.low[p] - c.high[q], c.low[q] - c.high[p]) > _CLEAR:
        return _FAR
    least = NEVER
    for k in range(OUTLINE // 2):
        least = min(least, c.reach[p, k] + c.reach[q, k + OUTLINE // 2], c.reach[p, k + OUTLINE // 2] + c.reach[q, k])
    return -least
