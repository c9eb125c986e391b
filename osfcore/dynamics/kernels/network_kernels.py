"""The propagation network on the nodes and edges of many scenes at once.

Indices are unsigned: signed ones may count from the end in numba, which is decided at each access, so that numbers are
gathered one by one instead of loaded sixteen at once. Products take four rows and four inputs at a time, so that
weights are loaded and outputs stored less often. That is as fast as OpenBLAS, whose threads would get in each
other's way here.
"""
# ruff: noqa: ANN001, ANN201, ANN202 - compiled helpers; types are given by their callers

from __future__ import annotations

from typing import NamedTuple

import numba
import numpy as np
from torch import Tensor, nn

from osfcore.dynamics.features import EDGE_FEATURES, NODE_FEATURES
from osfcore.dynamics.kernels.options import HELPER, ONE, ZERO
from osfcore.dynamics.propagation_network import MOTION, PropagationNetwork

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


class Memory(NamedTuple):
    """Graphs of many scenes, and what the network writes on: rows of numbers, one after another.

    Attributes:
        nodes, edges: features, `NODE_WIDTH` and `EDGE_WIDTH` a row.
        receiver, sender: node at the end and at the beginning of each edge, -1 for the pusher.
        own, state, effect: of nodes.
        relation: of edges.
        a, b, c: of nodes or edges.
        motion: the answer, `MOTION_WIDTH` a row.
    """

    nodes: np.ndarray
    edges: np.ndarray
    receiver: np.ndarray
    sender: np.ndarray
    own: np.ndarray
    state: np.ndarray
    effect: np.ndarray
    relation: np.ndarray
    a: np.ndarray
    b: np.ndarray
    c: np.ndarray
    motion: np.ndarray


def packed_weights(network: PropagationNetwork) -> Weights:
    """The weights of a network."""
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
    """With rows and columns of zeros up to multiples of four."""
    rows, columns = matrix.shape
    return nn.functional.pad(matrix, (0, -columns % 4, 0, -rows % 4))


@numba.njit(error_model="numpy")
def new_memory(nodes, edges, hidden):
    """Room for so many nodes and edges."""
    f, a, e = np.float32, (nodes + 3) // 4 * 4, (edges + 3) // 4 * 4
    most = max(a, e) * hidden
    return Memory(
        np.zeros(a * NODE_WIDTH, f), np.zeros(e * EDGE_WIDTH, f), np.empty(e, np.int64), np.empty(e, np.int64),
        np.zeros(a * hidden, f), np.zeros(a * hidden, f), np.zeros(a * hidden, f), np.zeros(e * hidden, f),
        np.zeros(most, f), np.zeros(most, f), np.zeros(most, f), np.zeros(a * MOTION_WIDTH, f),
    )  # fmt: skip


@numba.njit(**HELPER)
def predict_motions(weights, memory, nodes, edges) -> None:
    """The network's answer, into `memory.motion`, for the first rows of features."""
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
    """A linear layer, SiLU, another linear layer, its norm; where the weights end."""
    for k in range(rows * hidden):
        outputs[_u(k)] = ZERO
    _set_rows(flat, at + count * hidden, rows, hidden, m.a)
    _add_product(flat, at, inputs, count, rows, hidden, m.a)
    return _add_second_layer(flat, at + (count + 1) * hidden, rows, hidden, m, outputs)


@numba.njit(**HELPER)
def _add_second_layer(flat, at, rows, hidden, m, outputs):
    """Add the norm of a linear layer of SiLU of `m.a`, which is lost, as is `m.b`; where the weights end."""
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
    """All rows, rounded up to a multiple of four, become the bias."""
    bias = _u(at)
    for r in range((rows + 3) // 4 * 4):
        row = _u(r * width)
        for k in range(width):
            outputs[row + _u(k)] = flat[bias + _u(k)]


@numba.njit(**HELPER)
def _add_product(w, at, x, count, rows, width, out) -> None:
    """out[r, n] += sum_k x[r, k] w[k, n] for all rows, rounded up to a multiple of four."""
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
