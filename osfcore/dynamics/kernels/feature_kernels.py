"""What the network sees of one scene's contacts: `osfcore.dynamics.features`, compiled."""
# ruff: noqa: ANN001, ANN201, ANN202, D417 - compiled helpers; types are given by their callers

from __future__ import annotations

import math

import numba
import numpy as np

from osfcore.dynamics.contact_geometry import OUTLINE
from osfcore.dynamics.features import (
    AROUND,
    CLOSE_M,
    FOOT,
    FOOT_ANGLE,
    GAP_M,
    LENGTH_M,
    MAGNIFIED,
    SHIFT_M,
    SLANTED,
    TURN_RAD,
)
from osfcore.dynamics.kernels.network_kernels import EDGE_WIDTH, NODE_WIDTH
from osfcore.dynamics.kernels.options import HALF, HELPER, ONE, ZERO
from osfcore.dynamics.kernels.shape_kernels import extent_along, farthest_point, push_motion
from osfcore.dynamics.limit_surface import ARM_RATIO


def _fan(count: int, radius: float, height: float) -> np.ndarray:
    angles = 2 * np.pi / count * np.arange(count)
    return np.stack([radius * np.cos(angles), radius * np.sin(angles), np.full(count, height)], axis=1)


_CLOSE, _MAGNIFIED = np.float32(CLOSE_M), np.float32(MAGNIFIED)
_PER_LENGTH, _PER_SHIFT, _PER_TURN, _PER_GAP = (np.float32(1 / x) for x in (LENGTH_M, SHIFT_M, TURN_RAD, GAP_M))
_ARM, _MOST_NEAR, _RESTS = np.float32(ARM_RATIO / OUTLINE), np.float32(4), np.float32(1e-6)
_SLANT = math.sqrt(0.5)
_EXTENTS = np.concatenate(
    [_fan(AROUND, 1, 0), _fan(SLANTED, _SLANT, -_SLANT), _fan(SLANTED, _SLANT, _SLANT), [[0, 0, -1], [0, 0, 1]]]
).astype(np.float32)
_FEET = _fan(FOOT, math.sin(FOOT_ANGLE), -math.cos(FOOT_ANGLE)).astype(np.float32)
_DOWN = len(_EXTENTS) - 2
_GAPS_AT = 1  # in the row of an edge


@numba.njit(**HELPER)
def add_features(shapes, scenes, contacts, pairs, shift_x, shift_y, scratch, memory, nodes, edges):
    """Rows for the objects of a scene that take part, and for what touches them.

    Args:
        pairs: how many of `contacts.pair` count.
        scratch: N x 6: for each object its frame (cosine, sine), c of its friction, and how it would slide.
        nodes, edges: how many rows there are already.

    Returns:
        How many there are then.
    """
    c, first = contacts, nodes
    for n in range(len(scenes.number)):
        if c.awake[n]:
            _choose_frame(n, pairs, c, scratch)
            slide = _sliding(n, c.after, c, shift_x, shift_y, scratch)
            scratch[n, 3], scratch[n, 4], scratch[n, 5] = slide
            _add_node(shapes, scenes.number[n], n, c, shift_x, shift_y, scratch, memory.nodes, nodes * NODE_WIDTH)
            if c.touched[n]:
                _add_pusher(n, c, shift_x, shift_y, scratch, memory.edges, edges * EDGE_WIDTH)
                memory.receiver[edges], memory.sender[edges] = nodes, -1
                edges += 1
            nodes += 1
    for k in range(pairs):
        i, j = c.pair[k, 0], c.pair[k, 1]
        if c.awake[i] and c.awake[j]:
            a, b = first, first
            for n in range(j):
                a, b = a + (n < i and c.awake[n]), b + c.awake[n]
            for receiver, sender, is_first in ((a, b, True), (b, a, False)):
                _add_neighbour(k, is_first, c, scratch, memory.edges, edges * EDGE_WIDTH)
                memory.receiver[edges], memory.sender[edges] = receiver, sender
                edges += 1
    return nodes, edges


@numba.njit(**HELPER)
def _choose_frame(n, pairs, c, scratch) -> None:
    """The frame of an object, whose x axis points where it is being pushed to, and c of the limit surface."""
    x, y = c.linear[n, 0], c.linear[n, 1]
    speed = np.sqrt(x * x + y * y)
    x, y = (x / speed, y / speed) if speed > _RESTS else (ONE, ZERO)
    closest = ONE
    for k in range(pairs):
        i, j = c.pair[k, 0], c.pair[k, 1]
        if (i == n or j == n) and c.gap[k, 0] <= closest and c.awake[i]:
            closest = c.gap[k, 0]
            if closest < _CLOSE or (closest < ONE and speed <= _RESTS):
                sign = -ONE if i == n else ONE
                x, y = sign * c.gap[k, 1], sign * c.gap[k, 2]
    if c.touched[n]:
        x, y = -c.after[n, 1], -c.after[n, 2]
    scratch[n, 0], scratch[n, 1], radii = x, y, ZERO
    for k in range(OUTLINE):
        u, v = c.outline_x[n, k] - c.centre[n, 0], c.outline_y[n, k] - c.centre[n, 1]
        radii += np.sqrt(u * u + v * v)
    scratch[n, 2] = _ARM * radii


@numba.njit(**HELPER)
def _sliding(n, gaps, c, shift_x, shift_y, scratch):
    """Sliding at a contact, so far that the pusher's last position is free; in units of the answer."""
    if not c.touched[n]:
        return ZERO, ZERO, ZERO
    depth = max(-c.after[n, 0], ZERO)
    x, y = gaps[n, 3] - c.centre[n, 0], gaps[n, 4] - c.centre[n, 1]
    vx, vy, turn = push_motion(x, y, -gaps[n, 1], -gaps[n, 2], depth, shift_x, shift_y, scratch[n, 2])
    vx, vy = _turned(scratch, n, vx, vy)
    return vx * _PER_SHIFT, vy * _PER_SHIFT, turn * _PER_TURN


@numba.njit(**HELPER)
def _turned(scratch, n, x, y):
    """A horizontal vector in an object's frame."""
    return scratch[n, 0] * x + scratch[n, 1] * y, scratch[n, 0] * y - scratch[n, 1] * x


@numba.njit(**HELPER)
def _put(rows, at, x, y):
    rows[at], rows[at + 1] = x, y
    return at + 2


@numba.njit(**HELPER)
def _put_vector(rows, at, scratch, n, x, y, z, scale):
    """A vector in an object's frame; where the next number goes."""
    x, y = _turned(scratch, n, x, y)
    rows[at], rows[at + 1], rows[at + 2] = scale * x, scale * y, scale * z
    return at + 3


@numba.njit(**HELPER)
def _add_node(shapes, body, n, c, shift_x, shift_y, scratch, rows, at) -> None:
    start = at
    for k in range(len(_EXTENTS)):
        x, y, z = _EXTENTS[k, 0], _EXTENTS[k, 1], _EXTENTS[k, 2]
        x, y = _from_frame(scratch, n, x, y)
        rows[at] = extent_along(shapes.support, body, c.rotation, n, x, y, z) * _PER_LENGTH
        at += 1
    rows[at] = _MAGNIFIED * (c.centre[n, 2] * _PER_LENGTH - rows[start + _DOWN])
    at = _put_vector(rows, at + 1, scratch, n, c.linear[n, 0], c.linear[n, 1], c.linear[n, 2], _PER_SHIFT)
    at = _put_vector(rows, at, scratch, n, c.angular[n, 0], c.angular[n, 1], c.angular[n, 2], _PER_TURN)
    x, y = _turned(scratch, n, shift_x, shift_y)
    at = _put(rows, at, x * _PER_SHIFT, y * _PER_SHIFT)
    rows[at], rows[at + 1], rows[at + 2] = scratch[n, 3], scratch[n, 4], scratch[n, 5]
    at += 3
    far = ZERO
    for k in range(FOOT):
        x, y = _from_frame(scratch, n, _FEET[k, 0], _FEET[k, 1])
        x, y, z = farthest_point(shapes.support, body, c.rotation, n, x, y, _FEET[k, 2])
        x, y = _turned(scratch, n, x, y)
        rows[at + k], rows[at + FOOT + k] = x * _PER_LENGTH, y * _PER_LENGTH
        rows[at + 2 * FOOT + k] = _MAGNIFIED * (z + c.centre[n, 2]) * _PER_LENGTH
        far += np.sqrt(x * x + y * y)
    rows[at + 3 * FOOT] = far / np.float32(FOOT) * _PER_LENGTH


@numba.njit(**HELPER)
def _from_frame(scratch, n, x, y):
    """The inverse of `_turned`."""
    return scratch[n, 0] * x - scratch[n, 1] * y, scratch[n, 1] * x + scratch[n, 0] * y


@numba.njit(**HELPER)
def _put_gaps(rows, at, kind, before, halfway, after):
    rows[at], rows[at + 4] = kind, after * _PER_LENGTH
    for k, gap in enumerate((before, halfway, after)):
        rows[at + _GAPS_AT + k] = min(max(gap * _PER_GAP, -_MOST_NEAR), _MOST_NEAR)
    return at + 5


@numba.njit(**HELPER)
def _put_point(rows, at, scratch, n, c, x, y):
    """A point from an object's centre of mass, in its frame; where the next number goes."""
    x, y = _turned(scratch, n, x - c.centre[n, 0], y - c.centre[n, 1])
    return _put(rows, at, x * _PER_LENGTH, y * _PER_LENGTH)


@numba.njit(**HELPER)
def _put_direction(rows, at, scratch, n, x, y):
    x, y = _turned(scratch, n, x, y)
    return _put(rows, at, x, y)


@numba.njit(**HELPER)
def _add_pusher(n, c, shift_x, shift_y, scratch, rows, at) -> None:
    before, after = c.before, c.after
    at = _put_gaps(rows, at, ONE, before[n, 0], c.halfway[n, 0], after[n, 0])
    rows[at], rows[at + 1], rows[at + 2] = _sliding(n, before, c, shift_x, shift_y, scratch)
    at = _put_vector(rows, at + 3, scratch, n, -c.centre[n, 0], -c.centre[n, 1], -c.centre[n, 2], _PER_LENGTH)
    at = _put_vector(rows, at, scratch, n, shift_x, shift_y, ZERO, _PER_SHIFT)
    at = _put_vector(rows, at, scratch, n, ZERO, ZERO, ZERO, ONE)
    at = _put_point(rows, at, scratch, n, c, before[n, 3], before[n, 4])
    at = _put_point(rows, at, scratch, n, c, after[n, 3], after[n, 4])
    at = _put_point(rows, at, scratch, n, c, c.face[n, 0], c.face[n, 1])
    at = _put_point(rows, at, scratch, n, c, c.face[n, 2], c.face[n, 3])
    for _ in range(2):
        at = _put_point(rows, at, scratch, n, c, -_RIM * before[n, 1], -_RIM * before[n, 2])
    at = _put_direction(rows, at, scratch, n, before[n, 1], before[n, 2])
    at = _put_direction(rows, at, scratch, n, after[n, 1], after[n, 2])
    _put_direction(rows, at, scratch, n, shift_x * _PER_SHIFT, shift_y * _PER_SHIFT)


@numba.njit(**HELPER)
def _add_neighbour(k, is_first, c, scratch, rows, at) -> None:
    """The edge to one object of pair k from the other one."""
    i, j = (c.pair[k, 0], c.pair[k, 1]) if is_first else (c.pair[k, 1], c.pair[k, 0])
    distance, x, y, px, py = c.gap[k, 0], c.gap[k, 1], c.gap[k, 2], c.gap[k, 3], c.gap[k, 4]
    own, other = (0, 4) if is_first else (4, 0)
    if not is_first:
        px, py, x, y = px + distance * x, py + distance * y, -x, -y
    dx, dy = c.linear[j, 0] - c.linear[i, 0], c.linear[j, 1] - c.linear[i, 1]
    later = distance + dx * x + dy * y
    at = _put_gaps(rows, at, ZERO, distance, HALF * (distance + later), later)
    rows[at], rows[at + 1], rows[at + 2] = ZERO, ZERO, ZERO
    away_x, away_y, away_z = (
        c.centre[j, 0] - c.centre[i, 0],
        c.centre[j, 1] - c.centre[i, 1],
        c.centre[j, 2] - c.centre[i, 2],
    )
    at = _put_vector(rows, at + 3, scratch, i, away_x, away_y, away_z, _PER_LENGTH)
    at = _put_vector(rows, at, scratch, i, c.linear[j, 0], c.linear[j, 1], c.linear[j, 2], _PER_SHIFT)
    at = _put_vector(rows, at, scratch, i, c.angular[j, 0], c.angular[j, 1], c.angular[j, 2], _PER_TURN)
    at = _put_point(rows, at, scratch, i, c, px, py)
    at = _put_point(rows, at, scratch, i, c, px + dx, py + dy)
    for side in (own, own + 2, other, other + 2):
        at = _put_point(rows, at, scratch, i, c, c.faces[k, side], c.faces[k, side + 1])
    for _ in range(2):
        at = _put_direction(rows, at, scratch, i, x, y)
    _put_direction(rows, at, scratch, i, scratch[j, 0], scratch[j, 1])
