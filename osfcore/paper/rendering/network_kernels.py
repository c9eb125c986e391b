"""Compiled evaluation of tiny networks along rays: next occupied sample, density, radiance transfer.

Conventions of types and inlining are those of `osfcore.render.kernels`. Positions are in voxel coordinates, in which
the corners of a field's grid are whole numbers.
"""
# ruff: noqa: ANN001, ANN201, D417 - compiled helpers; types are given by their callers

from __future__ import annotations

import numba
import numpy as np

from osfcore.fields.kiloosf import MACRO_BITS
from osfcore.fields.ray_marching import leave_blocks
from osfcore.paper.fields.tiny_field import DIRECTION_INPUTS, DIRECTION_OCTAVES, POSITION_INPUTS, POSITION_OCTAVES
from osfcore.render.numba_options import HELPER

_ZERO, _HALF, _ONE, _TWO = np.float32(0), np.float32(0.5), np.float32(1), np.float32(2)


@numba.njit(**HELPER)
def next_occupied(pack, a, o, d, inverse, n, k, last, step):
    """The next sample of a ray in an occupied voxel of field a; past `last` if there is none.

    Args:
        pack, a: fields (`packing.PackedTiny`), and which one.
        o, d, inverse, n: rows n hold the ray's origin [voxels], direction [voxels/m], and each component inverted.
        k, last: sample to begin with, and the ray's last one; sample k lies at (k + 1/2) * step.
        step: between samples [m].
    """
    solid, blocks = pack.starts[a, 0], pack.starts[a, 1]
    nx, ny, nz = pack.shapes[a, 0], pack.shapes[a, 1], pack.shapes[a, 2]
    my, mz = pack.shapes[a, 4], pack.shapes[a, 5]
    while k <= last:
        t = (np.float32(k) + _HALF) * step
        px, py, pz = o[n, 0] + t * d[n, 0], o[n, 1] + t * d[n, 1], o[n, 2] + t * d[n, 2]
        i, j, m = min(max(int(px), 0), nx - 1), min(max(int(py), 0), ny - 1), min(max(int(pz), 0), nz - 1)
        bx, by, bz = i >> MACRO_BITS, j >> MACRO_BITS, m >> MACRO_BITS
        free = np.int64(pack.macro[blocks + (bx * my + by) * mz + bz])
        if free > 0:
            skip = min(
                leave_blocks(px, d[n, 0], inverse[n, 0], bx, free), leave_blocks(py, d[n, 1], inverse[n, 1], by, free)
            )
            skip = min(skip, leave_blocks(pz, d[n, 2], inverse[n, 2], bz, free))
            k = max(k + 1, int(np.ceil((t + skip) / step - _HALF)))
            continue
        if pack.solid[solid + (i * ny + j) * nz + m] != 0:
            break
        k += 1
    return k


@numba.njit(**HELPER)
def encode_direction(x, y, z, row, at, out) -> None:
    """Positional encoding of a unit vector: `osfcore.fields.osf.encoding`, into out[row, at:]."""
    values = x, y, z
    for c in range(3):
        s, co = np.sin(values[c]), np.cos(values[c])
        out[row, at + c] = values[c]
        for octave in range(DIRECTION_OCTAVES):
            out[row, at + 3 + 3 * octave + c] = s
            out[row, at + 3 + 3 * DIRECTION_OCTAVES + 3 * octave + c] = co
            s, co = _TWO * s * co, co * co - s * s


@numba.njit(**HELPER)
def _encode_place(value, c, out) -> None:
    s, co = np.sin(value), np.cos(value)
    out[c] = value
    for octave in range(POSITION_OCTAVES):
        out[3 + 3 * octave + c] = s
        out[3 + 3 * POSITION_OCTAVES + 3 * octave + c] = co
        s, co = _TWO * s * co, co * co - s * s


@numba.njit(**HELPER)
def density_at(pack, a, px, py, pz, place, h1, h2, n):
    """Density at a point, and where the parameters of its network begin (-1: no network, no density).

    Args:
        pack, a: fields, and which one.
        px, py, pz: the point [voxels].
        place, h1: memory.
        h2, n: row n keeps the second hidden layer, for `transfer_at`.

    Returns:
        sigma [1/m], and the offset.
    """
    nx, ny, nz = pack.shapes[a, 0], pack.shapes[a, 1], pack.shapes[a, 2]
    cx, cy, cz = pack.shapes[a, 6], pack.shapes[a, 7], pack.shapes[a, 8]
    qx = px * np.float32(cx) / np.float32(nx)
    qy = py * np.float32(cy) / np.float32(ny)
    qz = pz * np.float32(cz) / np.float32(nz)
    i, j, k = min(max(int(qx), 0), cx - 1), min(max(int(qy), 0), cy - 1), min(max(int(qz), 0), cz - 1)
    number = pack.cells[pack.starts[a, 2] + (i * cy + j) * cz + k]
    if number < 0:
        return _ZERO, -1
    _encode_place(_TWO * (qx - np.float32(i)) - _ONE, 0, place)
    _encode_place(_TWO * (qy - np.float32(j)) - _ONE, 1, place)
    _encode_place(_TWO * (qz - np.float32(k)) - _ONE, 2, place)
    flat, width = pack.networks, pack.width
    begin = pack.starts[a, 3] + np.int64(number) * pack.parameters
    at = begin
    bias = at + POSITION_INPUTS * width
    for u in range(width):
        h1[u] = flat[bias + u]
    for m in range(POSITION_INPUTS):
        value, row = place[m], at + m * width
        for u in range(width):
            h1[u] += value * flat[row + u]
    at = bias + width
    bias = at + width * width
    for u in range(width):
        h2[n, u] = flat[bias + u]
    for m in range(width):
        value, row = max(h1[m], _ZERO), at + m * width
        for u in range(width):
            h2[n, u] += value * flat[row + u]
    at = bias + width
    s = flat[at + width * (width + 1) + width]
    for m in range(width):
        h2[n, m] = max(h2[n, m], _ZERO)
        s += h2[n, m] * flat[at + m * (width + 1) + width]
    softplus = s if s > np.float32(15) else np.log(_ONE + np.exp(s))
    return softplus * pack.scales[a, 4], begin


@numba.njit(**HELPER)
def transfer_at(pack, begin, h2, n, directions, h1, h3, out) -> None:
    """Rho of the network that begins at `begin`, from its second hidden layer, into out[0:3].

    Args:
        pack, begin: as from `density_at`.
        h2, n: its row.
        directions: row n holds the encoded light and view.
        h1, h3: memory.
        out: result.
    """
    flat, width = pack.networks, pack.width
    at = begin + (POSITION_INPUTS + 1) * width + (width + 1) * width
    bias = at + width * (width + 1)
    for u in range(width):
        h1[u] = flat[bias + u]
    for m in range(width):
        value, row = h2[n, m], at + m * (width + 1)
        for u in range(width):
            h1[u] += value * flat[row + u]
    at = bias + width + 1
    bias = at + (width + DIRECTION_INPUTS) * width
    for u in range(width):
        h3[u] = flat[bias + u]
    for m in range(width):
        value, row = h1[m], at + m * width
        for u in range(width):
            h3[u] += value * flat[row + u]
    for m in range(DIRECTION_INPUTS):
        value, row = directions[n, m], at + (width + m) * width
        for u in range(width):
            h3[u] += value * flat[row + u]
    at = bias + width
    bias = at + 3 * width
    z0, z1, z2 = flat[bias], flat[bias + 1], flat[bias + 2]
    for m in range(width):
        value, row = max(h3[m], _ZERO), at + 3 * m
        z0 += value * flat[row]
        z1 += value * flat[row + 1]
        z2 += value * flat[row + 2]
    out[0] = _ONE / (_ONE + np.exp(-z0))
    out[1] = _ONE / (_ONE + np.exp(-z1))
    out[2] = _ONE / (_ONE + np.exp(-z2))
