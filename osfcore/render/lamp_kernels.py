"""Compiled light of near lamps: where it comes from at a point, and how much of it arrives.

Kernels and helpers take `lamps`: `lamps.Lamps`, or None under distant lights. Numba compiles one version for each, and
leaves out of it what the other one asks for: distant lights cost nothing because there are lamps, and change no bit.
"""
# ruff: noqa: ANN001, ANN201, D417 - compiled helpers; types are given by their callers

from __future__ import annotations

import numba
import numpy as np

from osfcore.render.numba_options import HELPER, TINY

_THREE = np.float32(3)


@numba.njit(**HELPER)
def toward_lamp(lamps, b, n, x, y, z, voxel):
    """Unit vector from a point toward the lamp of scene b, along the axes of object n, and the distance [m].

    Args:
        lamps: `lamps.Lamps`.
        b, n: scene, and object; n = N stands for the world.
        x, y, z: the point, in voxel coordinates of the object or in the world.
        voxel: the unit of these coordinates [m].
    """
    dx, dy, dz = lamps.position[b, n, 0] - x, lamps.position[b, n, 1] - y, lamps.position[b, n, 2] - z
    length = max(np.sqrt(dx * dx + dy * dy + dz * dz), TINY)
    inverse = _ONE / length
    return dx * inverse, dy * inverse, dz * inverse, length * voxel


@numba.njit(**HELPER)
def lamp_gain(lamps, b, n, lx, ly, lz, distance):
    """Share of the diffuse light that arrives unshaded, `SpotLamp.spot_factor` times `SpotLamp.falloff`.

    Args:
        lamps, b, n: as in `toward_lamp`.
        lx, ly, lz, distance: what that returns.
    """
    cosine = -(lamps.axis[b, n, 0] * lx + lamps.axis[b, n, 1] * ly + lamps.axis[b, n, 2] * lz)
    angle = np.arccos(min(max(cosine, -_ONE), _ONE))
    s = min(max((lamps.cone[b, 0] - angle) * lamps.cone[b, 1], _ZERO), _ONE)
    return s * s * (_THREE - _TWO * s) * lamps.cone[b, 2] / (distance * distance)


@numba.njit(**HELPER)
def light_on_table(lamps, b, x, y):
    """Direct light of three colours on a white table at a point of it [m] where nothing shades it."""
    n = lamps.position.shape[1] - 1
    lx, ly, lz, distance = toward_lamp(lamps, b, n, x, y, _ZERO, _ONE)
    red, green, blue = lamps.b2[0], lamps.b2[1], lamps.b2[2]
    for h in range(len(lamps.b1)):
        value = lamps.b1[h] + lx * lamps.w1[0, h] + ly * lamps.w1[1, h] + lz * lamps.w1[2, h]
        value = max(value, _ZERO)
        red += value * lamps.w2[h, 0]
        green += value * lamps.w2[h, 1]
        blue += value * lamps.w2[h, 2]
    gain = lamp_gain(lamps, b, n, lx, ly, lz, distance) * max(lz, _ZERO)
    return max(red, _ZERO) * gain, max(green, _ZERO) * gain, max(blue, _ZERO) * gain
