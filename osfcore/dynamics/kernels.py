"""Rollouts of many scenes, compiled for the CPU: contacts, features, network and motion of each substep.

It computes the same as `graph.py` in PyTorch, which training needs for its gradients. Only `rollout.py` calls it.
"""

# ruff: noqa: ANN001, ANN201, ANN202, D417 - compiled helpers; types are given by their callers

from __future__ import annotations

import math
from collections import namedtuple
from typing import Any, NamedTuple

import numba
import numpy as np
from torch import Tensor, nn

from osfcore.dynamics.graph import (
    AROUND,
    CLOSE_M,
    EDGE_FEATURES,
    FOOT,
    FOOT_ANGLE,
    GAP_M,
    LENGTH_M,
    LOOKUP_M,
    MAGNIFIED,
    MOTION,
    NODE_FEATURES,
    SHIFT_M,
    SLANTED,
    TRAVEL_M,
    TURN_RAD,
    PropagationNetwork,
)
from osfcore.dynamics.motion import ARM_RATIO, ASIDE, FRICTION, SLEEP_M, SLEEP_RAD, SUBSTEPS
from osfcore.dynamics.shapes import (
    CLEAR_M,
    FAR_M,
    MAP_SIDE,
    OUTLINE,
    PAIR_REACH_M,
    PAIR_STRIDE,
    PUSHER_TOP_M,
    SLACK_M,
    TOUCH_M,
    ShapeTable,
)
from osfcore.geometry.workspace import PUSHER_RADIUS_M
from osfcore.objects.kernel_cache import kept_kernel

# How kernels and their helpers are compiled, and the numbers that all of them know.


HELPER: dict[str, Any] = {"fastmath": True, "error_model": "numpy", "_nrt": False}
KERNEL: dict[str, Any] = {"fastmath": True, "error_model": "numpy", "nogil": True}
ZERO, HALF, ONE, TWO = np.float32(0), np.float32(0.5), np.float32(1), np.float32(2)
NEVER = np.float32(1e9)  # more than any distance


# The propagation network on the nodes and edges of many scenes at once.
#
# Indices are unsigned: signed ones may count from the end in numba, which is decided at each access, so that
# numbers are gathered one by one instead of loaded sixteen at once. Products take four rows and four inputs at a
# time, so that weights are loaded and outputs stored less often. That is as fast as OpenBLAS, whose threads would
# get in each other's way here.


NODE_WIDTH, EDGE_WIDTH, MOTION_WIDTH = (np.int64(-(-n // 4) * 4) for n in (NODE_FEATURES, EDGE_FEATURES, MOTION))
_u = np.uint64
_U1, _U2, _U3, _U4 = (np.uint64(n) for n in range(1, 5))
_LOG2_E, _LARGEST = np.float32(np.log2(np.e)), np.float32(126)
_C1, _C2, _C3, _C4, _C5, _C6 = (  # of 2^f for 0 <= f <= 1: least squares, relative error 2e-9
    np.float32(c) for c in (0.693147042, 0.240229325, 0.0554852202, 0.00967553263, 0.00124673764, 0.000216138082)
)
_EPSILON = np.float32(1e-5)  # of layer norms


class Weights(NamedTuple):
    """A propagation network as compiled code takes it.

    Attributes:
        flat: all numbers, layer after layer: the matrix input by input, padded with zeros to multiples of four inputs
            and outputs, then the bias; after two layers the scale and the shift of their norm.
        hidden: width of all layers.
        steps: propagation steps.
    """

    flat: np.ndarray
    hidden: int
    steps: int


class Memory(namedtuple("Memory", "nodes edges receiver sender own state effect relation a b c motion")):
    """Graphs of many scenes, and what the network writes on: rows of numbers, one after another.

    Attributes:
        nodes, edges: features, `NODE_WIDTH` and `EDGE_WIDTH` a row.
        receiver, sender: node at the end and at the beginning of each edge, -1 for the pusher.
        own, state, effect: of nodes.
        relation: state of edges.
        a, b, c: of nodes or edges.
        motion: the answer, `MOTION_WIDTH` a row.
    """


def packed_weights(network: PropagationNetwork) -> Weights:
    """Return the weights of a network."""
    propagators = zip(network.edge_propagators, network.node_propagators, strict=True)
    blocks = [network.node_encoder, network.edge_encoder, *(block for pair in propagators for block in pair)]
    parts: list[Tensor] = []
    for block in (*blocks, network.decoder):
        for layer in block.children():
            if isinstance(layer, nn.Linear):
                parts += [_padded(layer.weight.T), _padded(layer.bias[None])[:1]]
            elif isinstance(layer, nn.LayerNorm):
                parts += [layer.weight, layer.bias]
    flat = [part.detach().float().cpu().numpy().ravel() for part in parts]
    return Weights(np.concatenate(flat), network.hidden, network.steps)


def _padded(matrix: Tensor) -> Tensor:
    """Return a matrix with rows and columns of zeros up to multiples of four."""
    rows, columns = matrix.shape
    return nn.functional.pad(matrix, (0, -columns % 4, 0, -rows % 4))


@numba.njit(error_model="numpy")
def new_memory(nodes, edges, hidden):
    """Return room for so many nodes and edges."""
    f, a, e = np.float32, (nodes + 3) // 4 * 4, (edges + 3) // 4 * 4
    most = max(a, e) * hidden
    return Memory(
        np.zeros(a * NODE_WIDTH, f), np.zeros(e * EDGE_WIDTH, f), np.empty(e, np.int64), np.empty(e, np.int64),
        np.zeros(a * hidden, f), np.zeros(a * hidden, f), np.zeros(a * hidden, f), np.zeros(e * hidden, f),
        np.zeros(most, f), np.zeros(most, f), np.zeros(most, f), np.zeros(a * MOTION_WIDTH, f),
    )  # fmt: skip


@numba.njit(**HELPER)
def predict_motions(weights, memory, nodes, edges) -> None:
    """Write the network's answer for the first rows of features into `memory.motion`."""
    flat, hidden, m = weights.flat, weights.hidden, memory
    at = _encode(flat, np.int64(0), m.nodes, NODE_WIDTH, nodes, hidden, m, m.own)
    at = _encode(flat, at, m.edges, EDGE_WIDTH, edges, hidden, m, m.relation)
    for k in range(nodes * hidden):
        m.state[_u(k)] = m.own[_u(k)]
    for _ in range(weights.steps):
        at = _propagate_edges(flat, at, m, nodes, edges, hidden)
        at = _propagate_nodes(flat, at, m, nodes, edges, hidden)
    size = hidden * hidden
    _set_rows(flat, at + 2 * size, nodes, hidden, m.a)
    _add_product(flat, at, m.own, hidden, nodes, hidden, m.a)
    _add_product(flat, at + size, m.state, hidden, nodes, hidden, m.a)
    _silu(m.a, nodes * hidden)
    at += 2 * size + hidden
    _set_rows(flat, at + size, nodes, hidden, m.b)
    _add_product(flat, at, m.a, hidden, nodes, hidden, m.b)
    _silu(m.b, nodes * hidden)
    at += size + hidden
    _set_rows(flat, at + hidden * MOTION_WIDTH, nodes, MOTION_WIDTH, m.motion)
    _add_product(flat, at, m.b, hidden, nodes, MOTION_WIDTH, m.motion)


@numba.njit(**HELPER)
def _propagate_edges(flat, at, m, nodes, edges, hidden):
    """Add P_edge(relation, state of the receiver, state of the sender) to the relation."""
    size = hidden * hidden
    _set_rows(flat, at + 3 * size, edges, hidden, m.a)
    _add_product(flat, at, m.relation, hidden, edges, hidden, m.a)
    for k in range((nodes + 3) // 4 * 4 * hidden):
        m.b[_u(k)], m.c[_u(k)] = ZERO, ZERO
    _add_product(flat, at + size, m.state, hidden, nodes, hidden, m.b)
    _add_product(flat, at + 2 * size, m.state, hidden, nodes, hidden, m.c)
    for e in range(edges):
        row, to = _u(e * hidden), _u(m.receiver[e] * hidden)
        for k in range(hidden):
            m.a[row + _u(k)] += m.b[to + _u(k)]
        if m.sender[e] >= 0:
            by = _u(m.sender[e] * hidden)
            for k in range(hidden):
                m.a[row + _u(k)] += m.c[by + _u(k)]
    return _add_second_layer(flat, at + 3 * size + hidden, edges, hidden, m, m.relation)


@numba.njit(**HELPER)
def _propagate_nodes(flat, at, m, nodes, edges, hidden):
    """Add P_node(own, state, the sum of the relations of all edges that end here) to the state."""
    size = hidden * hidden
    for k in range(nodes * hidden):
        m.effect[_u(k)] = ZERO
    for e in range(edges):
        row, to = _u(e * hidden), _u(m.receiver[e] * hidden)
        for k in range(hidden):
            m.effect[to + _u(k)] += m.relation[row + _u(k)]
    _set_rows(flat, at + 3 * size, nodes, hidden, m.a)
    _add_product(flat, at, m.own, hidden, nodes, hidden, m.a)
    _add_product(flat, at + size, m.state, hidden, nodes, hidden, m.a)
    _add_product(flat, at + 2 * size, m.effect, hidden, nodes, hidden, m.a)
    return _add_second_layer(flat, at + 3 * size + hidden, nodes, hidden, m, m.state)


@numba.njit(**HELPER)
def _encode(flat, at, inputs, count, rows, hidden, m, outputs):
    """Write a linear layer, SiLU, another linear layer and its norm to the outputs; return where the weights end."""
    for k in range(rows * hidden):
        outputs[_u(k)] = ZERO
    _set_rows(flat, at + count * hidden, rows, hidden, m.a)
    _add_product(flat, at, inputs, count, rows, hidden, m.a)
    return _add_second_layer(flat, at + (count + 1) * hidden, rows, hidden, m, outputs)


@numba.njit(**HELPER)
def _add_second_layer(flat, at, rows, hidden, m, outputs):
    """Add the norm of a linear layer of SiLU of `m.a`, which is lost, as is `m.b`; return where the weights end."""
    size, between = hidden * hidden, m.b  # not the outputs: two names for one array would be computed one by one
    _silu(m.a, rows * hidden)
    _set_rows(flat, at + size, rows, hidden, between)
    _add_product(flat, at, m.a, hidden, rows, hidden, between)
    scale, shift, count = _u(at + size + hidden), _u(at + size + 2 * hidden), np.float32(hidden)
    for r in range(rows):
        row, mean, square = _u(r * hidden), ZERO, ZERO
        for k in range(hidden):
            mean += between[row + _u(k)]
        mean /= count
        for k in range(hidden):
            square += (between[row + _u(k)] - mean) ** 2
        inverse = ONE / np.sqrt(square / count + _EPSILON)
        for k in range(hidden):
            n = _u(k)
            outputs[row + n] += (between[row + n] - mean) * inverse * flat[scale + n] + flat[shift + n]
    return at + size + 3 * hidden


@numba.njit(**HELPER)
def _set_rows(flat, at, rows, width, outputs) -> None:
    """Set all rows, rounded up to a multiple of four, to the bias."""
    bias = _u(at)
    for r in range((rows + 3) // 4 * 4):
        row = _u(r * width)
        for k in range(width):
            outputs[row + _u(k)] = flat[bias + _u(k)]


@numba.njit(**HELPER)
def _add_product(w, at, x, count, rows, width, out) -> None:
    """Add sum_k x[r, k] w[k, n] to out[r, n] for all rows, rounded up to a multiple of four."""
    size, length = _u(width), _u(count)
    for r in range((rows + 3) // 4):
        a = _u(4 * r) * length
        b, c, d = a + length, a + _U2 * length, a + _U3 * length
        p = _u(4 * r) * size
        q, s, t = p + size, p + _U2 * size, p + _U3 * size
        row = _u(at)
        for _ in range(count // 4):
            second, third, fourth = row + size, row + _U2 * size, row + _U3 * size
            a0, a1, a2, a3 = x[a], x[a + _U1], x[a + _U2], x[a + _U3]
            b0, b1, b2, b3 = x[b], x[b + _U1], x[b + _U2], x[b + _U3]
            c0, c1, c2, c3 = x[c], x[c + _U1], x[c + _U2], x[c + _U3]
            d0, d1, d2, d3 = x[d], x[d + _U1], x[d + _U2], x[d + _U3]
            for k in range(width):
                n = _u(k)
                w0, w1, w2, w3 = w[row + n], w[second + n], w[third + n], w[fourth + n]
                out[p + n] += a0 * w0 + a1 * w1 + a2 * w2 + a3 * w3
                out[q + n] += b0 * w0 + b1 * w1 + b2 * w2 + b3 * w3
                out[s + n] += c0 * w0 + c1 * w1 + c2 * w2 + c3 * w3
                out[t + n] += d0 * w0 + d1 * w1 + d2 * w2 + d3 * w3
            row += _U4 * size
            a, b, c, d = a + _U4, b + _U4, c + _U4, d + _U4


@numba.njit(**HELPER)
def _silu(x, count) -> None:
    """Divide x by 1 + exp(-x), exp by a polynomial of the fraction: library calls are ten times as slow."""
    for k in range(count):
        value = x[_u(k)]
        power = min(max(-value * _LOG2_E, -_LARGEST), _LARGEST)
        whole = np.floor(power)
        f = power - whole
        part = ONE + f * (_C1 + f * (_C2 + f * (_C3 + f * (_C4 + f * (_C5 + f * _C6)))))
        scale = np.int32((np.int32(whole) + np.int32(127)) << np.int32(23)).view(np.float32)
        x[_u(k)] = value / (ONE + scale * part)


# Support functions of bodies, their outlines seen from above, gaps between outlines, and pushes at a contact.
#
# The same as `ShapeTable`, `osfcore.geometry.polygons` and `motion.push_motion`, for one body or pair at a time. A gap
# is the distance, the normal out of the first outline (x, y) and the point of it that is nearest (x, y).


CIRCLE_X, CIRCLE_Y = (
    f(2 * np.pi / OUTLINE * np.arange(OUTLINE)).astype(np.float32) for f in (np.cos, np.sin)
)  # as `polygons.circle`
_SIDES, _HALF_SIDE, _LAST = np.int64(MAP_SIDE), np.float32(MAP_SIDE / 2), np.int64(MAP_SIDE - 1)
_FRICTION = np.float32(FRICTION)
_TINIER, _REPEATED = np.float32(1e-14), np.float32(1e-4)
_LEAST_GAIN = np.float32(1e-3)


class Shapes(namedtuple("Shapes", "support first_part part_count radius half_extent")):
    """A `ShapeTable` as compiled code takes it; attributes as there."""


def packed_shapes(table: ShapeTable) -> Shapes:
    """Return the arrays of a table."""
    return Shapes(*(getattr(table, name).cpu().numpy() for name in Shapes._fields))


@numba.njit(**HELPER)
def support_row(body, x, y, z):
    """Return the row of `Shapes.support` for a direction in the body's frame, of any length but 0."""
    length = abs(x) + abs(y) + abs(z)
    x, y = x / length, y / length
    if z < ZERO:
        x, y = math.copysign(ONE - abs(y), x), math.copysign(ONE - abs(x), y)
    i = min(max(np.int64((x + ONE) * _HALF_SIDE), 0), _LAST)
    j = min(max(np.int64((y + ONE) * _HALF_SIDE), 0), _LAST)
    return (body * _SIDES + i) * _SIDES + j


@numba.njit(**HELPER)
def farthest_point(support, body, r, n, x, y, z):
    """Return the farthest point in a direction, relative to the centre of mass; r[n] rotates from the body's frame."""
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
    """Return how far a body reaches in a direction, a unit vector."""
    a, b, c = farthest_point(support, body, r, n, x, y, z)
    return a * x + b * y + c * z


@numba.njit(**HELPER)
def draw_outline(support, body, r, n, centre_x, centre_y, xs, ys, row) -> None:
    """Write the outline seen from above into xs[row] and ys[row]."""
    for k in range(OUTLINE):
        x, y, _ = farthest_point(support, body, r, n, CIRCLE_X[k], CIRCLE_Y[k], ZERO)
        xs[row, k], ys[row, k] = x + centre_x, y + centre_y


@numba.njit(**HELPER)
def direction_number(x, y, count):
    """Return the number of the nearest of `count` equally spaced directions."""
    return np.int64(np.rint(math.atan2(y, x) * np.float32(count / (2 * np.pi)))) % count


@numba.njit(**HELPER)
def outline_to_point(xs, ys, row, px, py):
    """Return the gap from an outline to a point."""
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
    """Return the largest separation of two outlines along normals of the first one's sides, and that normal."""
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
    """Return the gap out of the outline xs[a], ys[a] to us[b], vs[b]: the best separating axis."""
    distance, x, y = _separation(xs, ys, a, us, vs, b)
    other, other_x, other_y = _separation(us, vs, b, xs, ys, a)
    if other > distance:
        distance, x, y = other, -other_x, -other_y
    corner = PAIR_STRIDE * direction_number(x, y, OUTLINE // PAIR_STRIDE)
    return distance, x, y, xs[a, corner], ys[a, corner]


@numba.njit(**HELPER)
def push_motion(x, y, inward_x, inward_y, depth, shift_x, shift_y, arm):
    """Return displacement (x, y) and turn of an object pushed at a contact; as `motion.push_motion`."""
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


# What may move in a substep of one scene, and where it touches: the contacts of `osfcore.dynamics.graph` and
# `osfcore.dynamics.shapes`, compiled.


_TRAVEL, _TOUCH, _RIM = (np.float32(x) for x in (TRAVEL_M, TOUCH_M, PUSHER_RADIUS_M))
_REACH, _TOP, _FAR = (np.float32(x) for x in (PAIR_REACH_M, PUSHER_TOP_M, FAR_M))
_CLEAR, _SLACK = np.float32(CLEAR_M), np.float32(SLACK_M)
_NEAR = np.float32(PUSHER_RADIUS_M + TOUCH_M + LOOKUP_M)
_PAIR = np.float32(PAIR_REACH_M + 2 * LOOKUP_M)
_TINY, _SHORT = np.float32(1e-12), np.float32(1e-6)


class Scenes(namedtuple("Scenes", "number centre quaternion linear angular pusher floor")):
    """Scenes that are rolled out; attributes as those of `Motion`, `number` the shape of each object."""


class Contacts(
    namedtuple(
        "Contacts",
        "centre linear angular rotation outline_x outline_y first many part_x part_y low high reach "
        "before halfway after face moving near possible touched awake couples touching pair gap faces",
    )
):
    """One scene's N objects, along the pusher's heading with its centre as the origin.

    Attributes:
        centre, linear, angular: of each object.
        rotation: from its frame.
        outline_x, outline_y: seen from above.
        first, many: its first convex part and how many it has; -1 before they are drawn.
        part_x, part_y, low, high: of the parts: outlines, lowest and highest point.
        reach: reach of each part in all directions of the circle.
        before, halfway, after: gaps to the pusher's rim at its start, halfway and at its end; `face` at its start.
        moving, near, possible, touched, awake: whether it moves, may be touched by the pusher, may take part at all, is
            touched, takes part.
        couples, touching: pairs that may touch, and that do.
        pair, gap, faces: the pairs that touch; out of the first one; both ends of both sides.
    """


@numba.njit(error_model="numpy")
def new_contacts(n, parts):
    """Return room for n objects that together have so many parts."""
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
    """Mark which objects move, and which the pusher may touch: a cheap upper bound."""
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
    """Return how far an object reaches horizontally from its centre of mass."""
    if length <= _SHORT:
        x, y, length = ONE, ZERO, ONE
    return extent_along(shapes.support, body, c.rotation, n, x / length, y / length, ZERO)


@numba.njit(**HELPER)
def rotation_of(quaternion, b, n, rotation) -> None:
    """Write the rotation matrix of object n in scene b into rotation[n]."""
    w, x, y, z = quaternion[b, n, 0], quaternion[b, n, 1], quaternion[b, n, 2], quaternion[b, n, 3]
    r = rotation
    r[n, 0, 0], r[n, 1, 1] = ONE - TWO * (y * y + z * z), ONE - TWO * (x * x + z * z)
    r[n, 2, 2] = ONE - TWO * (x * x + y * y)
    r[n, 0, 1], r[n, 1, 0] = TWO * (x * y - w * z), TWO * (x * y + w * z)
    r[n, 0, 2], r[n, 2, 0] = TWO * (x * z + w * y), TWO * (x * z - w * y)
    r[n, 1, 2], r[n, 2, 1] = TWO * (y * z - w * x), TWO * (y * z + w * x)


@numba.njit(**HELPER)
def _couple(shapes, scenes, b, c) -> None:
    """Mark pairs that could collide (eq. 8) and are not clear of each other along the line between their centres."""
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
    """Choose everything connected to what is chosen by any number of links."""
    changed = True
    while changed:
        changed = False
        for i in range(len(chosen)):
            for j in range(len(chosen)):
                if chosen[i] and links[i, j] and not chosen[j]:
                    chosen[j], changed = True, True


@numba.njit(**HELPER)
def _place(shapes, scenes, b, n, heading_x, heading_y, c) -> None:
    """Write an object along the heading, and its outline."""
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
    """Write the convex parts of an object from number `used` on; return where the next ones go."""
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
    """Write the gaps between the pusher's rim and the nearest part of an object."""
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
    """Write both ends of the side of an outline that faces a direction."""
    middle = direction_number(x, y, OUTLINE)
    for end, step in ((0, -1), (2, 1)):
        corner = (middle + step) % OUTLINE
        faces[at, column + end], faces[at, column + end + 1] = xs[row, corner], ys[row, corner]


@numba.njit(**HELPER)
def _find_pairs(count, c):
    """Write the pairs of objects that can touch within a substep; return how many there are."""
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
    """Return the nearest two of all parts of two objects, and their gap; a bound rules out far ones."""
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
    """Return a bound of the distance of two parts, a few millimetres less at most; far where one is well above."""
    if max(c.low[p] - c.high[q], c.low[q] - c.high[p]) > _CLEAR:
        return _FAR
    least = NEVER
    for k in range(OUTLINE // 2):
        least = min(least, c.reach[p, k] + c.reach[q, k + OUTLINE // 2], c.reach[p, k + OUTLINE // 2] + c.reach[q, k])
    return -least


# What the network sees of one scene's contacts: `osfcore.dynamics.graph`, compiled.


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
    """Write rows for the objects of a scene that take part, and for what touches them.

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
    """Write the frame of an object, whose x axis points where it is pushed to, and c of the limit surface."""
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
    """Return the sliding at a contact, so far that the pusher's last position is free; in units of the answer."""
    if not c.touched[n]:
        return ZERO, ZERO, ZERO
    depth = max(-c.after[n, 0], ZERO)
    x, y = gaps[n, 3] - c.centre[n, 0], gaps[n, 4] - c.centre[n, 1]
    vx, vy, turn = push_motion(x, y, -gaps[n, 1], -gaps[n, 2], depth, shift_x, shift_y, scratch[n, 2])
    vx, vy = _turned(scratch, n, vx, vy)
    return vx * _PER_SHIFT, vy * _PER_SHIFT, turn * _PER_TURN


@numba.njit(**HELPER)
def _turned(scratch, n, x, y):
    """Return a horizontal vector in an object's frame."""
    return scratch[n, 0] * x + scratch[n, 1] * y, scratch[n, 0] * y - scratch[n, 1] * x


@numba.njit(**HELPER)
def _put(rows, at, x, y):
    rows[at], rows[at + 1] = x, y
    return at + 2


@numba.njit(**HELPER)
def _put_vector(rows, at, scratch, n, x, y, z, scale):
    """Write a vector in an object's frame; return where the next number goes."""
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
    """Return a vector of an object's frame along the heading: the inverse of `_turned`."""
    return scratch[n, 0] * x - scratch[n, 1] * y, scratch[n, 1] * x + scratch[n, 0] * y


@numba.njit(**HELPER)
def _put_gaps(rows, at, kind, before, halfway, after):
    rows[at], rows[at + 4] = kind, after * _PER_LENGTH
    for k, gap in enumerate((before, halfway, after)):
        rows[at + _GAPS_AT + k] = min(max(gap * _PER_GAP, -_MOST_NEAR), _MOST_NEAR)
    return at + 5


@numba.njit(**HELPER)
def _put_point(rows, at, scratch, n, c, x, y):
    """Write a point from an object's centre of mass, in its frame; return where the next number goes."""
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
    """Write the edge to one object of pair k from the other one."""
    i, j = (c.pair[k, 0], c.pair[k, 1]) if is_first else (c.pair[k, 1], c.pair[k, 0])
    distance, x, y, px, py = c.gap[k, 0], c.gap[k, 1], c.gap[k, 2], c.gap[k, 3], c.gap[k, 4]
    own, other = (0, 4) if is_first else (4, 0)
    if not is_first:
        px, py, x, y = px + distance * x, py + distance * y, -x, -y
    dx, dy = c.linear[j, 0] - c.linear[i, 0], c.linear[j, 1] - c.linear[i, 1]
    later = distance + dx * x + dy * y
    at = _put_gaps(rows, at, ZERO, distance, HALF * (distance + later), later)
    rows[at], rows[at + 1], rows[at + 2] = ZERO, ZERO, ZERO
    away_x, away_y = c.centre[j, 0] - c.centre[i, 0], c.centre[j, 1] - c.centre[i, 1]
    at = _put_vector(rows, at + 3, scratch, i, away_x, away_y, c.centre[j, 2] - c.centre[i, 2], _PER_LENGTH)
    at = _put_vector(rows, at, scratch, i, c.linear[j, 0], c.linear[j, 1], c.linear[j, 2], _PER_SHIFT)
    at = _put_vector(rows, at, scratch, i, c.angular[j, 0], c.angular[j, 1], c.angular[j, 2], _PER_TURN)
    at = _put_point(rows, at, scratch, i, c, px, py)
    at = _put_point(rows, at, scratch, i, c, px + dx, py + dy)
    for side in (own, own + 2, other, other + 2):
        at = _put_point(rows, at, scratch, i, c, c.faces[k, side], c.faces[k, side + 1])
    for _ in range(2):
        at = _put_direction(rows, at, scratch, i, x, y)
    _put_direction(rows, at, scratch, i, scratch[j, 0], scratch[j, 1])


# Rollouts of many scenes, compiled: `osfcore.dynamics.graph` with all that it calls.


_ANGLES = 2 * np.pi / 8 * np.arange(8)
_DOWN_X, _DOWN_Y = (np.float32(ASIDE) * np.append(f(_ANGLES), 0).astype(np.float32) for f in (np.cos, np.sin))
_SHIFT, _TURN = np.float32(SHIFT_M), np.float32(TURN_RAD)
_SLEEP_M, _SLEEP_RAD = np.float32(SLEEP_M), np.float32(SLEEP_RAD)
_STANDS, _AT_REST, _TINIEST = np.float32(1e-6), np.float32(1e-9), np.float32(1e-20)


@kept_kernel(**KERNEL)
def unroll_block(
    shapes, weights, number, start, begins, velocity, shifts, first, last, centre, quaternion, has_moved
) -> None:
    """Roll out some of K sequences of T actions from one state of N objects, which go through the network together.

    Args:
        shapes, weights: `Shapes`, `Weights`.
        number: shape of each object.
        start: N x 3, x 4, x 3, x 3 and N: centres, orientations, displacements, rotation vectors and floors.
        begins: K x 2, the pusher [m].
        velocity: K x T x 2, of the pusher [m/s].
        shifts: K x S x 2, of the pusher in each substep [m].
        first, last: numbers of the first sequence, and of the one after the last.
        centre, quaternion, has_moved: results after each action: K x T x N x 3, x 4, and without.
    """
    objects, size = len(number), last - first
    parts = 0
    for n in range(objects):
        parts += shapes.part_count[number[n]]
    scenes = _new_scenes(number, start, begins, first, size)
    memory = new_memory(size * objects, size * objects * objects, weights.hidden)
    contacts, scratch = new_contacts(objects, parts), np.empty((objects, 6), np.float32)
    places, frames = np.empty((size * objects, 2), np.int64), np.empty((size * objects, 5), np.float32)
    moved = np.zeros((size, objects), np.bool_)
    for step in range(shifts.shape[1]):
        nodes, edges = np.int64(0), np.int64(0)
        for b in range(size):
            k = first + b
            shift_x, shift_y = shifts[k, step, 0], shifts[k, step, 1]
            x, y = _heading(scenes, b, velocity[k, step // SUBSTEPS, 0], velocity[k, step // SUBSTEPS, 1])
            pairs = find_contacts(shapes, scenes, b, x, y, shift_x, shift_y, contacts)
            scenes.pusher[b, 0] += shift_x
            scenes.pusher[b, 1] += shift_y
            if pairs < 0:
                continue
            before = nodes
            shift_x, shift_y = x * shift_x + y * shift_y, x * shift_y - y * shift_x
            nodes, edges = add_features(
                shapes, scenes, contacts, pairs, shift_x, shift_y, scratch, memory, nodes, edges
            )
            _stop(scenes, b, contacts, scratch, x, y, places, frames, before)
        if nodes > 0:
            predict_motions(weights, memory, nodes, edges)
            for node in range(nodes):
                _move(shapes, scenes, places[node, 0], places[node, 1], frames, node, memory.motion, moved,
                      contacts.rotation)  # fmt: skip
        if (step + 1) % SUBSTEPS == 0:
            centre[first:last, step // SUBSTEPS] = scenes.centre
            quaternion[first:last, step // SUBSTEPS] = scenes.quaternion
            has_moved[first:last, step // SUBSTEPS] = moved


@numba.njit(error_model="numpy")
def _new_scenes(number, start, begins, first, size):
    """Return a block of scenes, all of them in the same state."""
    centre, quaternion, linear, angular, floor = start
    n = len(number)
    scenes = Scenes(
        number, np.empty((size, n, 3), np.float32), np.empty((size, n, 4), np.float32),
        np.empty((size, n, 3), np.float32), np.empty((size, n, 3), np.float32), np.empty((size, 2), np.float32), floor,
    )  # fmt: skip
    scenes.centre[:], scenes.quaternion[:] = centre, quaternion
    scenes.linear[:], scenes.angular[:] = linear, angular
    scenes.pusher[:] = begins[first : first + size]
    return scenes


@numba.njit(**HELPER)
def _heading(scenes, b, x, y):
    """Return the direction of the velocity of the pusher or, if it stands still, of the fastest object."""
    speed = np.sqrt(x * x + y * y)
    if speed > _STANDS:
        return x / speed, y / speed
    fastest, x, y = ZERO, ONE, ZERO
    for n in range(len(scenes.number)):
        u, v = scenes.linear[b, n, 0], scenes.linear[b, n, 1]
        speed = np.sqrt(u * u + v * v)
        if speed > fastest:
            fastest, x, y = speed, u / speed, v / speed
    return (x, y) if fastest > _AT_REST else (ONE, ZERO)


@numba.njit(**HELPER)
def _stop(scenes, b, contacts, scratch, x, y, places, frames, node) -> None:
    """Put a scene at rest, and keep what is needed to move the objects that take part afterwards.

    Args:
        x, y: the heading.
        places, frames: of each node: scene and slot; cosine and sine from the world to its frame, how it would slide.
        node: number of the first one.
    """
    for n in range(len(scenes.number)):
        for k in range(3):
            scenes.linear[b, n, k], scenes.angular[b, n, k] = ZERO, ZERO
        if contacts.awake[n]:
            places[node, 0], places[node, 1] = b, n
            u, v = scratch[n, 0], scratch[n, 1]
            frames[node, 0], frames[node, 1] = u * x - v * y, v * x + u * y
            frames[node, 2], frames[node, 3], frames[node, 4] = scratch[n, 3], scratch[n, 4], scratch[n, 5]
            node += 1


@numba.njit(**HELPER)
def _move(shapes, scenes, b, n, frames, node, motion, moved, rotation) -> None:
    """Move an object by the network's answer and the sliding that it corrects; it rests if that is next to nothing."""
    at, x, y = node * MOTION_WIDTH, frames[node, 0], frames[node, 1]
    u, v = _SHIFT * (motion[at] + frames[node, 2]), _SHIFT * (motion[at + 1] + frames[node, 3])
    dz = _SHIFT * motion[at + 2]
    dx, dy = x * u - y * v, y * u + x * v
    u, v, wz = _TURN * motion[at + 3], _TURN * motion[at + 4], _TURN * (motion[at + 5] + frames[node, 4])
    wx, wy = x * u - y * v, y * u + x * v
    angle = np.sqrt(wx * wx + wy * wy + wz * wz + _TINIEST)
    if np.sqrt(dx * dx + dy * dy + dz * dz) <= _SLEEP_M and angle <= _SLEEP_RAD:
        return
    moved[b, n] = True
    _turn(scenes.quaternion, b, n, wx, wy, wz, angle)
    scenes.centre[b, n, 0] += dx
    scenes.centre[b, n, 1] += dy
    lift = max(scenes.floor[n] - _lowest(shapes, scenes, b, n, scenes.centre[b, n, 2] + dz, rotation), ZERO)
    scenes.centre[b, n, 2] += dz + lift
    scenes.linear[b, n, 0], scenes.linear[b, n, 1], scenes.linear[b, n, 2] = dx, dy, dz + lift
    scenes.angular[b, n, 0], scenes.angular[b, n, 1], scenes.angular[b, n, 2] = wx, wy, wz


@numba.njit(**HELPER)
def _turn(quaternion, b, n, x, y, z, angle) -> None:
    """Turn an object by a rotation vector."""
    cosine, share = math.cos(HALF * angle), math.sin(HALF * angle) / angle
    x, y, z = share * x, share * y, share * z
    q = quaternion
    w, i, j, k = q[b, n, 0], q[b, n, 1], q[b, n, 2], q[b, n, 3]
    a = cosine * w - x * i - y * j - z * k
    c = cosine * i + w * x + y * k - z * j
    d = cosine * j + w * y + z * i - x * k
    e = cosine * k + w * z + x * j - y * i
    inverse = ONE / np.sqrt(a * a + c * c + d * d + e * e)
    q[b, n, 0], q[b, n, 1], q[b, n, 2], q[b, n, 3] = inverse * a, inverse * c, inverse * d, inverse * e


@numba.njit(**HELPER)
def _lowest(shapes, scenes, b, n, height, rotation):
    """Return the height of the lowest point of an object whose centre is at a height; as `motion.lowest_point`."""
    rotation_of(scenes.quaternion, b, n, rotation)
    least = ZERO
    for k in range(len(_DOWN_X)):
        _, _, z = farthest_point(shapes.support, scenes.number[n], rotation, n, _DOWN_X[k], _DOWN_Y[k], -ONE)
        least = min(least, z)
    return height + least
