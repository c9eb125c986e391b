"""Walking along a ray through one field's density; compiled for the CPU.

Samples lie at t = (k + 1/2) * step from the ray's origin, whatever the field's box, so that a ray meets the same
samples however it is cut into pieces.
"""

from __future__ import annotations

import threading

import numba
import numpy as np
from jaxtyping import Bool, Float32, Int64

from osfcore.fields.kiloosf import DENSITY_FLOOR, FLOOR_G, MACRO, MACRO_BITS, KiloOSF

# Where neither OpenMP nor TBB is there, numba's threads end the process when two calls into parallel code overlap.
ONE_AT_A_TIME = threading.Lock()
_FLOOR = np.float32(DENSITY_FLOOR)
_FLOOR_G = np.float32(FLOOR_G)
_ONE = np.float32(1)
_NEXT = np.uint64(1)
_EDGE = np.float32(1.001)  # before the last corner, so that there is always a next one


@numba.njit(fastmath=True, error_model="numpy", inline="always")
def optical_density(g):  # noqa: ANN001, ANN201
    """Sigma * voxel of a density feature g."""
    if g <= _FLOOR_G:
        return np.float32(0)
    if g > np.float32(15):
        return g - _FLOOR
    return np.log(_ONE + np.exp(g)) - _FLOOR


@numba.njit(fastmath=True, error_model="numpy", inline="always")
def interpolate(flat, start, ny, nz, px, py, pz):  # noqa: ANN001, ANN201, D417
    """Trilinear value at a point of a grid.

    Args:
        flat: values on the corners of one or several grids.
        start: where the grid begins in it.
        ny, nz: corners along y and z.
        px, py, pz: the point in voxel coordinates, moved into the grid by `within`.
    """
    i, j, k = int(px), int(py), int(pz)
    fx, fy, fz = px - np.float32(i), py - np.float32(j), pz - np.float32(k)  # int64 would promote to double
    at = np.uint64(start + (i * ny + j) * nz + k)  # unsigned: numba need not ask whether to count from the end
    side, far = at + np.uint64(nz), at + np.uint64(ny * nz)
    corner = far + np.uint64(nz)
    a = flat[at] + (flat[at + _NEXT] - flat[at]) * fz
    b = flat[side] + (flat[side + _NEXT] - flat[side]) * fz
    c = flat[far] + (flat[far + _NEXT] - flat[far]) * fz
    d = flat[corner] + (flat[corner + _NEXT] - flat[corner]) * fz
    a += (b - a) * fy
    c += (d - c) * fy
    return a + (c - a) * fx


@numba.njit(fastmath=True, error_model="numpy", inline="always")
def within(p, count):  # noqa: ANN001, ANN201
    """A voxel coordinate moved between the first and the last of `count` corners."""
    return min(max(p, np.float32(0)), np.float32(count) - _EDGE)


@numba.njit(fastmath=True, error_model="numpy", inline="always")
def clip_axis(origin, direction, low, high, t0, t1):  # noqa: ANN001, ANN201, D417
    """The part of a ray that lies between two bounds on one axis; it ends before it begins where there is none.

    Args:
        origin, direction: of the ray on this axis.
        low, high: the bounds.
        t0, t1: the part of the ray that is left so far.
    """
    if abs(direction) < np.float32(1e-9):
        return (t0, t1) if low < origin < high else (_ONE, -_ONE)
    a, b = (low - origin) / direction, (high - origin) / direction
    return max(t0, min(a, b)), min(t1, max(a, b))


@numba.njit(fastmath=True, error_model="numpy", inline="always")
def leave_blocks(p, d, inverse, block, distance):  # noqa: ANN001, ANN201
    """How far along a ray it stays, on one axis, among the blocks known to be empty.

    Args:
        p: where the ray is [voxels].
        d: component of its direction [voxels per unit of t].
        inverse: of d.
        block: number of its block on this axis.
        distance: blocks less than this far away are empty (`KiloOSF.macro`).
    """
    if d >= np.float32(0):
        return (np.float32((block + distance) * MACRO) - p) * inverse
    return (p - np.float32((block + 1 - distance) * MACRO)) * abs(inverse)


@numba.njit(fastmath=True, error_model="numpy", inline="always")
def inverted(d):  # noqa: ANN001, ANN201
    """1 / d; very large for (almost) 0."""
    if abs(d) > np.float32(1e-9):
        return _ONE / d
    return np.float32(1e9)


@numba.njit(parallel=True, fastmath=True, error_model="numpy", cache=True, nogil=True)
def _march(origins, directions, density, macro, low, voxel, step, offsets, min_weight, min_transmittance, ts, counts):  # noqa: ANN001, ANN202
    nx, ny, nz = density.shape
    my, mz = macro.shape[1], macro.shape[2]
    flat, blocks = density.ravel(), macro.ravel()
    most = ts.shape[1]
    for r in numba.prange(len(origins)):
        # In voxel coordinates the box is [0, n - 1].
        ox, oy, oz = (
            (origins[r, 0] - low[0]) / voxel,
            (origins[r, 1] - low[1]) / voxel,
            (origins[r, 2] - low[2]) / voxel,
        )
        dx, dy, dz = directions[r, 0] / voxel, directions[r, 1] / voxel, directions[r, 2] / voxel
        ix, iy, iz = inverted(dx), inverted(dy), inverted(dz)
        t0, t1 = clip_axis(ox, dx, np.float32(0), np.float32(nx) - _EDGE, np.float32(0), np.float32(1e9))
        t0, t1 = clip_axis(oy, dy, np.float32(0), np.float32(ny) - _EDGE, t0, t1)
        t0, t1 = clip_axis(oz, dz, np.float32(0), np.float32(nz) - _EDGE, t0, t1)
        found, transmittance = 0, _ONE
        k = int(np.ceil(t0 / step - offsets[r]))
        while found < most and transmittance > min_transmittance:
            t = (np.float32(k) + offsets[r]) * step
            if t >= t1:
                break
            # Rounding must not lead out of the grid, however far away the ray began.
            px, py, pz = within(ox + t * dx, nx), within(oy + t * dy, ny), within(oz + t * dz, nz)
            bx, by, bz = int(px) >> MACRO_BITS, int(py) >> MACRO_BITS, int(pz) >> MACRO_BITS
            free = np.int64(blocks[(bx * my + by) * mz + bz])
            if free > 0:
                skip = min(leave_blocks(px, dx, ix, bx, free), leave_blocks(py, dy, iy, by, free))
                skip = min(skip, leave_blocks(pz, dz, iz, bz, free))
                k = max(k + 1, int(np.ceil((t + skip) / step - offsets[r])))
                continue
            depth = optical_density(interpolate(flat, 0, ny, nz, px, py, pz)) * (step / voxel)
            if depth > 0:
                alpha = _ONE - np.exp(-depth)
                if alpha * transmittance > min_weight:
                    ts[r, found] = t
                    found += 1
                transmittance *= _ONE - alpha
            k += 1
        counts[r] = found


def march(
    field: KiloOSF,
    origins: Float32[np.ndarray, "R 3"],
    directions: Float32[np.ndarray, "R 3"],
    *,
    step: float,
    offsets: Float32[np.ndarray, "R"] | None = None,
    min_weight: float = 1e-3,
    min_transmittance: float = 1e-3,
    most: int = 24,
) -> tuple[Float32[np.ndarray, "R most"], Bool[np.ndarray, "R most"]]:
    """Where rays meet a field: distances of the samples that matter, front to back, and which of the slots are used.

    Args:
        field: what is looked at.
        origins: of the rays in the field's frame [m].
        directions: unit vectors.
        step: between samples [m].
        offsets: of each ray's first sample, in steps; 1/2 by default, random in training.
        min_weight: samples that would contribute less are left out.
        min_transmittance: where less light passes, a ray ends.
        most: samples a ray at most.
    """
    count = len(origins)
    ts = np.zeros((count, most), np.float32)
    counts: Int64[np.ndarray, "R"] = np.zeros(count, np.int64)
    offsets = np.full(count, 0.5, np.float32) if offsets is None else offsets
    # Other memory layouts and types would be compiled anew, which takes half a minute.
    origins, directions, offsets = (np.array(a, np.float32, order="C") for a in (origins, directions, offsets))
    numbers = (
        np.float32(field.voxel),
        np.float32(step),
        offsets,
        np.float32(min_weight),
        np.float32(min_transmittance),
    )
    with ONE_AT_A_TIME:
        _march(origins, directions, field.density, field.macro, field.origin, *numbers, ts, counts)
    return ts, np.arange(most) < counts[:, None]
