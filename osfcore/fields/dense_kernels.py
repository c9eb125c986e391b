"""Layers of tiny networks, compiled for the CPU.

Indices are unsigned: signed ones may count from the end in numba, which is decided at each access, so that numbers are
gathered one by one instead of loaded eight or sixteen at once. Four inputs are taken at a time, so that outputs are
stored and loaded less often.
"""
# ruff: noqa: ANN001, ANN201 - compiled helpers; types are given by their callers

from __future__ import annotations

from typing import Any

import numba
import numpy as np

_LAYER: dict[str, Any] = {"fastmath": True, "error_model": "numpy", "forceinline": True, "_nrt": False}
ANY = np.float32(-np.finfo(np.float32).max)  # floor of inputs that are taken as they are
_BYTE_1, _BYTE_2, _BYTE_3, _BYTE_4 = np.uint64(1), np.uint64(2), np.uint64(3), np.uint64(4)


@numba.njit(**_LAYER)
def dense_layer(flat, at, inputs, floor, count, width, outputs):
    """outputs[n] = b[n] + sum_m max(inputs[m], floor) * W[m, n].

    Args:
        flat: parameters: W row by row, then b.
        at: where they begin.
        inputs: the first `count` count.
        floor: 0 for the outputs of a layer that is followed by ReLU; `ANY` otherwise.
        count: of inputs.
        width: number of outputs.
        outputs: result.

    Returns:
        Where the parameters end.
    """
    size, row, first = np.uint64(width), np.uint64(at), np.uint64(((count - 1) & 3) + 1)
    bias = row + np.uint64(count) * size
    a = max(inputs[np.uint64(0)], floor)
    b = max(inputs[_BYTE_1], floor) if first > _BYTE_1 else _ZERO
    c = max(inputs[_BYTE_2], floor) if first > _BYTE_2 else _ZERO
    d = max(inputs[_BYTE_3], floor) if first > _BYTE_3 else _ZERO
    second = row + size if first > _BYTE_1 else row
    third = row + _BYTE_2 * size if first > _BYTE_2 else row
    fourth = row + _BYTE_3 * size if first > _BYTE_3 else row
    for k in range(width):
        n = np.uint64(k)
        some = a * flat[row + n] + b * flat[second + n] + c * flat[third + n] + d * flat[fourth + n]
        outputs[n] = flat[bias + n] + some
    m, row = first, row + first * size
    for _ in range((count - 1) >> 2):
        a, b = max(inputs[m], floor), max(inputs[m + _BYTE_1], floor)
        c, d = max(inputs[m + _BYTE_2], floor), max(inputs[m + _BYTE_3], floor)
        second, third, fourth = row + size, row + _BYTE_2 * size, row + _BYTE_3 * size
        for k in range(width):
            n = np.uint64(k)
            outputs[n] += a * flat[row + n] + b * flat[second + n] + c * flat[third + n] + d * flat[fourth + n]
        m, row = m + _BYTE_4, row + _BYTE_4 * size
    return at + (count + 1) * width


@numba.njit(**_LAYER)
def three_outputs(flat, at, inputs, count):
    """The outputs of a layer that has three, of inputs after ReLU; arguments as in `dense_layer`."""
    row, bias = np.uint64(at), np.uint64(at) + _BYTE_3 * np.uint64(count)
    x, y, z = flat[bias], flat[bias + _BYTE_1], flat[bias + _BYTE_2]
    for m in range(count):
        value = max(inputs[np.uint64(m)], _ZERO)
        x += value * flat[row]
        y += value * flat[row + _BYTE_1]
        z += value * flat[row + _BYTE_2]
        row += _BYTE_3
    return x, y, z
