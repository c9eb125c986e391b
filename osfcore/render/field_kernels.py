"""Compiled sampling of fields along rays: next samples, shadows, scattered radiance. Only `kernels.py` calls it.

Conventions of coordinates, types and inlining are those of `kernels.py`.
"""
# ruff: noqa: ANN001, ANN201, ANN202, D417 - compiled helpers; types are given by their callers

from __future__ import annotations

import numba
import numpy as np

from osfcore.fields.dense_kernels import ANY, dense_layer, three_outputs
from osfcore.fields.kiloosf import FEATURES, MACRO_BITS, NETWORK_INPUTS
from osfcore.fields.ray_marching import interpolate, inverted, leave_blocks, optical_density, within
from osfcore.render.lamp_kernels import lamp_gain, toward_lamp
from osfcore.render.numba_options import FAR, GONE, HELPER

_ZERO, _HALF, _ONE, _TWO = np.float32(0), np.float32(0.5), np.float32(1), np.float32(2)
_NEXT = np.uint64(1)


@numba.njit(**HELPER)
def clip_to_extent(reach, n, ox, oy, oz, ix, iy, iz, far, step):
    """First and last sample of a ray within the occupied part of an object; last < first: none.

    Args:
        reach, n: occupied parts (`launch.Scene`), and which one.
        ox, oy, oz: ray origin in the object's voxel coordinates.
        ix, iy, iz: components of its direction [voxels/m], inverted.
        far: where the ray ends [m].
        step: between samples [m].
    """
    a, b = (reach[n, 0] - ox) * ix, (reach[n, 3] - ox) * ix
    t0, t1 = max(_ZERO, min(a, b)), min(far, max(a, b))
    a, b = (reach[n, 1] - oy) * iy, (reach[n, 4] - oy) * iy
    t0, t1 = max(t0, min(a, b)), min(t1, max(a, b))
    a, b = (reach[n, 2] - oz) * iz, (reach[n, 5] - oz) * iz
    t0, t1 = max(t0, min(a, b)), min(t1, max(a, b))
    if t0 >= t1:
        return 0, -1
    return int(np.ceil(t0 / step - _HALF)), int(np.floor(t1 / step - _HALF))


@numba.njit(**HELPER)
def next_sample(pack, a, ox, oy, oz, dx, dy, dz, ix, iy, iz, k, last, step, step_voxels):
    """The next sample of a field with any density, and its optical depth; past `last` if there is none.

    Args:
        pack, a: fields (`packing.Packed`), and which one.
        ox, oy, oz: ray origin in the field's voxel coordinates.
        dx, dy, dz: its direction [voxels/m]; ix, iy, iz: each component inverted.
        k, last: sample to begin with, and the ray's last one.
        step, step_voxels: between samples, in [m] and in [voxels].
    """
    corners, blocks = pack.starts[a, 0], pack.starts[a, 2]
    nx, ny, nz = pack.shapes[a, 0], pack.shapes[a, 1], pack.shapes[a, 2]
    my, mz = pack.shapes[a, 4], pack.shapes[a, 5]
    depth = _ZERO
    while k <= last:
        t = (np.float32(k) + _HALF) * step
        # Rounding must not lead out of the grid, however far away the ray began.
        px, py, pz = within(ox + t * dx, nx), within(oy + t * dy, ny), within(oz + t * dz, nz)
        bx, by, bz = int(px) >> MACRO_BITS, int(py) >> MACRO_BITS, int(pz) >> MACRO_BITS
        free = np.int64(pack.macro[np.uint64(blocks + (bx * my + by) * mz + bz)])
        if free > 0:
            skip = min(leave_blocks(px, dx, ix, bx, free), leave_blocks(py, dy, iy, by, free))
            skip = min(skip, leave_blocks(pz, dz, iz, bz, free))
            k = max(k + 1, int(np.ceil((t + skip) / step - _HALF)))
            continue
        depth = optical_density(interpolate(pack.density, corners, ny, nz, px, py, pz)) * step_voxels
        if depth > _ZERO:
            break
        k += 1
    return k, depth


@numba.njit(**HELPER)
def _depth_to_light(pack, a, n, scene, lamps, b, x, y, z, step, step_voxels, enough):
    """Optical depth of object n between a point, in its voxel coordinates, and the light; stops when it is enough."""
    if lamps is None:
        dx, dy, dz, far = scene.lit[b, n, 0], scene.lit[b, n, 1], scene.lit[b, n, 2], FAR
        ix, iy, iz = scene.lit_inverse[b, n, 0], scene.lit_inverse[b, n, 1], scene.lit_inverse[b, n, 2]
    else:
        voxel = pack.scales[a, 3]
        dx, dy, dz, far = toward_lamp(lamps, b, n, x, y, z, voxel)
        dx, dy, dz = dx / voxel, dy / voxel, dz / voxel
        ix, iy, iz = inverted(dx), inverted(dy), inverted(dz)
    k, last = clip_to_extent(scene.reach, n, x, y, z, ix, iy, iz, far, step)
    total = _ZERO
    while k <= last and total < enough:
        k, depth = next_sample(pack, a, x, y, z, dx, dy, dz, ix, iy, iz, k, last, step, step_voxels)
        total += depth
        k += 1
    return total


@numba.njit(**HELPER)
def _transform(matrix, b, n, m, x, y, z):
    """A point in object n's voxel coordinates in those of object m; n = N stands for the world."""
    return (
        matrix[b, n, m, 0] * x + matrix[b, n, m, 1] * y + matrix[b, n, m, 2] * z + matrix[b, n, m, 3],
        matrix[b, n, m, 4] * x + matrix[b, n, m, 5] * y + matrix[b, n, m, 6] * z + matrix[b, n, m, 7],
        matrix[b, n, m, 8] * x + matrix[b, n, m, 9] * y + matrix[b, n, m, 10] * z + matrix[b, n, m, 11],
    )


@numba.njit(**HELPER)
def light_transmittance(pack, fields, scene, lamps, b, n, x, y, z, step_voxels, enough):
    """Share of the light that reaches a point of object n past all other objects; n = N: a point of the world.

    Args:
        pack, fields, scene, lamps: as in `kernels.render_batch`.
        b, n: scene, and object that does not shade the point.
        x, y, z: the point, in voxel coordinates of object n or in the world [m].
        step_voxels: between samples of the shadow ray [voxels].
        enough: optical depth past which no light counts.
    """
    depth = _ZERO
    for m in range(len(fields)):
        if m != n and scene.part[b, m] != GONE and depth < enough:
            a = fields[m]
            qx, qy, qz = _transform(scene.between, b, n, m, x, y, z)
            step = step_voxels * pack.scales[a, 3]
            depth += _depth_to_light(pack, a, m, scene, lamps, b, qx, qy, qz, step, step_voxels, enough - depth)
    if depth >= enough:
        return _ZERO
    return np.exp(-depth)


@numba.njit(**HELPER)
def _scatter(pack, a, px, py, pz, lx, ly, lz, vx, vy, vz, inputs, h1, h2, out):
    """Rho of field a at voxel coordinates: ambient part in out[0:3], direct part in out[3:6]."""
    nx, ny, nz = pack.shapes[a, 0], pack.shapes[a, 1], pack.shapes[a, 2]
    _mix_features(pack, a, px, py, pz, ny, nz, h1)
    f1, f2, f3 = h1[1], h1[2], h1[3]
    dipole = h1[4] * lx + h1[5] * ly + h1[6] * lz
    cx, cy, cz = pack.shapes[a, 6], pack.shapes[a, 7], pack.shapes[a, 8]
    qx = px * np.float32(cx) / np.float32(nx - 1)
    qy = py * np.float32(cy) / np.float32(ny - 1)
    qz = pz * np.float32(cz) / np.float32(nz - 1)
    i, j, k = min(int(qx), cx - 1), min(int(qy), cy - 1), min(int(qz), cz - 1)
    inputs[0], inputs[1] = dipole, h1[7]
    inputs[2], inputs[3], inputs[4] = lx, ly, lz
    inputs[5], inputs[6], inputs[7] = vx, vy, vz
    inputs[8] = _TWO * (qx - np.float32(i)) - _ONE
    inputs[9] = _TWO * (qy - np.float32(j)) - _ONE
    inputs[10] = _TWO * (qz - np.float32(k)) - _ONE
    network = pack.starts[a, 4] + pack.cells[np.uint64(pack.starts[a, 3] + (i * cy + j) * cz + k)]
    at = dense_layer(pack.networks, network * pack.parameters, inputs, ANY, NETWORK_INPUTS, pack.hidden, h1)
    at = dense_layer(pack.networks, at, h1, _ZERO, pack.hidden, pack.hidden, h2)
    x, y, z = three_outputs(pack.networks, at, h2, pack.hidden)
    out[0], out[1], out[2] = f1 * pack.ambient[a, 0], f2 * pack.ambient[a, 1], f3 * pack.ambient[a, 2]
    out[3], out[4], out[5] = f1 * max(dipole + x, _ZERO), f2 * max(dipole + y, _ZERO), f3 * max(dipole + z, _ZERO)


@numba.njit(**HELPER)
def _mix_features(pack, a, px, py, pz, ny, nz, mixed) -> None:
    """The features at voxel coordinates of field a, interpolated between eight corners, into mixed[0:FEATURES]."""
    i, j, k = int(px), int(py), int(pz)
    fx, fy, fz = px - np.float32(i), py - np.float32(j), pz - np.float32(k)
    start, first = pack.starts[a, 0] + (i * ny + j) * nz + k, pack.starts[a, 1]
    for c in range(FEATURES):
        mixed[c] = _ZERO
    for side in range(4):
        ci, cj = side >> 1, side & 1
        w = (fx if ci else _ONE - fx) * (fy if cj else _ONE - fy)
        here = np.uint64(start + (ci * ny + cj) * nz)
        one = np.uint64((first + pack.index[here]) * FEATURES)
        two = np.uint64((first + pack.index[here + _NEXT]) * FEATURES)
        low, high = w * (_ONE - fz), w * fz
        for c in range(FEATURES):
            mixed[np.uint64(c)] += low * pack.rows[one + np.uint64(c)] + high * pack.rows[two + np.uint64(c)]


@numba.njit(**HELPER)
def radiance_at(pack, fields, scene, lamps, b, n, t, rules, work):
    """Rho of object n where the ray of `work` is at t, left in work.out[0:6].

    Args:
        pack, fields, scene, lamps, rules: as in `kernels.render_batch`.
        b, n: scene and object.
        t: distance from the camera [m].
        work: the thread's ray and memory; light found before is kept in it, for `rules.one_shadow`.

    Returns:
        Transmittance from there toward the light, times what a lamp's distance and cone leave of it; 0, unasked, where
        the object scatters no direct light or the lamp sheds none.
    """
    d, inputs, h1, h2, out = work.direction, work.inputs, work.h1, work.h2, work.out
    a, view = fields[n], work.where[0]
    x = within(scene.eye[b, view, n, 0] + t * d[n, 0], pack.shapes[a, 0])
    y = within(scene.eye[b, view, n, 1] + t * d[n, 1], pack.shapes[a, 1])
    z = within(scene.eye[b, view, n, 2] + t * d[n, 2], pack.shapes[a, 2])
    s = pack.scales[a, 3]
    if lamps is None:
        lx, ly, lz, gain = scene.lit[b, n, 0] * s, scene.lit[b, n, 1] * s, scene.lit[b, n, 2] * s, _ONE
    else:
        lx, ly, lz, distance = toward_lamp(lamps, b, n, x, y, z, s)
        gain = lamp_gain(lamps, b, n, lx, ly, lz, distance)
    _scatter(pack, a, x, y, z, lx, ly, lz, d[n, 0] * s, d[n, 1] * s, d[n, 2] * s, inputs, h1, h2, out)
    if out[3] + out[4] + out[5] <= _ZERO or gain <= _ZERO:
        return _ZERO
    if not rules.one_shadow or work.lit[n] < _ZERO:
        work.lit[n] = light_transmittance(pack, fields, scene, lamps, b, n, x, y, z, rules.shadow_voxels, rules.enough)
    return gain * work.lit[n]
