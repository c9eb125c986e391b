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
_ZERO = np.float32(0)
_ONE, _TWO, _THREE, _FOUR = np.uint64(1), np.uint64(2), np.uint64(3), np.uint64(4)


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
    b = max(inputs[_ONE], floor) if first > _ONE else _ZERO
    c = max(inputs[_TWO], floor) if first > _TWO else _ZERO
    d = max(inputs[_THREE], floor) if first > _THREE else _ZERO
    second = row + size if first > _ONE else row
    third = row + _TWO * size if first > _TWO else row
    fourth = row + _THREE * size if first > _THREE else row
    for k in range(width):
        n = np.uint64(k)
        some = a * flat[row + n] + b * flat[second + n] + c * flat[third + n] + d * flat[fourth + n]
        outputs[n] = flat[bias + n] + some
    m, row = first, row + first * size
    for _ in range((count - 1) >> 2):
        a, b = max(inputs[m], floor), max(inputs[m + _ONE], floor)
        c, d = max(inputs[m + _TWO], floor), max(inputs[m + _THREE], floor)
        second, third, fourth = row + size, row + _TWO * size, row + _THREE * size
        for k in range(width):
            n = np.uint64(k)
            outputs[n] += a * flat[row + n] + b * flat[second + n] + c * flat[third + n] + d * flat[fourth + n]
        m, row = m + _FOUR, row + _FOUR * size
    return at + (count + 1) * width


@numba.njit(**_LAYER)
def three_outputs(flat, at, inputs, count):
    """The outputs of a layer that has three, of inputs after ReLU; arguments as in `dense_layer`."""
    row, bias = np.uint64(at), np.uint64(at) + _THREE * np.uint64(count)
    x, y, z = flat[bias], flat[bias + _ONE], flat[bias + _TWO]
    for m in range(count):
        value = max(inputs[np.uint64(m)], _ZERO)
        x += value * flat[row]
        y += value * flat[row + _ONE]
        z += value * flat[row + _TWO]
        row += _THREE
    return x, y, z
