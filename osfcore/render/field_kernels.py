"""Compiled sampling of fields along rays: next samples, shadows, scattered radiance. Only `kernels.py` calls it.

Conventions of coordinates, types and inlining are those of `kernels.py`.
"""
# ruff: noqa: ANN001, ANN201, ANN202, D417 - compiled helpers; types are given by their callers

from __future__ import annotations

import numba
import numpy as np

from osfcore.fields.kiloosf import FEATURES, MACRO_BITS, NETWORK_INPUTS
from osfcore.fields.ray_marching import interpolate, inverted, leave_blocks, optical_density, within
from osfcore.render.lamp_kernels import lamp_gain, toward_lamp
from osfcore.render.numba_options import FAR, HELPER

_ZERO, _HALF, _ONE, _TWO = np.float32(0), np.float32(0.5), np.float32(1), np.float32(2)


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
        free = np.int64(pack.macro[blocks + (bx * my + by) * mz + bz])
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
        if m != n and depth < enough:
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
    i, j, k = int(px), int(py), int(pz)
    fx, fy, fz = px - np.float32(i), py - np.float32(j), pz - np.float32(k)
    f1 = f2 = f3 = f4 = f5 = f6 = f7 = _ZERO
    start, first = pack.starts[a, 0] + (i * ny + j) * nz + k, pack.starts[a, 1]
    for corner in range(8):
        ci, cj, ck = corner >> 2, (corner >> 1) & 1, corner & 1
        w = (fx if ci else _ONE - fx) * (fy if cj else _ONE - fy) * (fz if ck else _ONE - fz)
        row = (first + pack.index[start + (ci * ny + cj) * nz + ck]) * FEATURES
        f1 += w * pack.rows[row + 1]
        f2 += w * pack.rows[row + 2]
        f3 += w * pack.rows[row + 3]
        f4 += w * pack.rows[row + 4]
        f5 += w * pack.rows[row + 5]
        f6 += w * pack.rows[row + 6]
        f7 += w * pack.rows[row + 7]
    dipole = f4 * lx + f5 * ly + f6 * lz
    cx, cy, cz = pack.shapes[a, 6], pack.shapes[a, 7], pack.shapes[a, 8]
    qx = px * np.float32(cx) / np.float32(nx - 1)
    qy = py * np.float32(cy) / np.float32(ny - 1)
    qz = pz * np.float32(cz) / np.float32(nz - 1)
    i, j, k = min(int(qx), cx - 1), min(int(qy), cy - 1), min(int(qz), cz - 1)
    inputs[0], inputs[1] = dipole, f7
    inputs[2], inputs[3], inputs[4] = lx, ly, lz
    inputs[5], inputs[6], inputs[7] = vx, vy, vz
    inputs[8] = _TWO * (qx - np.float32(i)) - _ONE
    inputs[9] = _TWO * (qy - np.float32(j)) - _ONE
    inputs[10] = _TWO * (qz - np.float32(k)) - _ONE
    network = pack.starts[a, 4] + pack.cells[pack.starts[a, 3] + (i * cy + j) * cz + k]
    z0, z1, z2 = _run_network(pack.networks, network * pack.parameters, pack.hidden, inputs, h1, h2)
    out[0], out[1], out[2] = f1 * pack.ambient[a, 0], f2 * pack.ambient[a, 1], f3 * pack.ambient[a, 2]
    out[3], out[4], out[5] = f1 * max(dipole + z0, _ZERO), f2 * max(dipole + z1, _ZERO), f3 * max(dipole + z2, _ZERO)


@numba.njit(**HELPER)
def _run_network(flat, at, hidden, inputs, h1, h2):
    """The three outputs of a tiny network whose parameters begin at `at`."""
    bias = at + NETWORK_INPUTS * hidden
    for n in range(hidden):
        h1[n] = flat[bias + n]
    for m in range(NETWORK_INPUTS):
        value, row = inputs[m], at + m * hidden
        for n in range(hidden):
            h1[n] += value * flat[row + n]
    at = bias + hidden
    bias = at + hidden * hidden
    for n in range(hidden):
        h2[n] = flat[bias + n]
    for m in range(hidden):
        value, row = max(h1[m], _ZERO), at + m * hidden
        for n in range(hidden):
            h2[n] += value * flat[row + n]
    at = bias + hidden
    bias = at + 3 * hidden
    z0, z1, z2 = flat[bias], flat[bias + 1], flat[bias + 2]
    for m in range(hidden):
        value, row = max(h2[m], _ZERO), at + 3 * m
        z0 += value * flat[row]
        z1 += value * flat[row + 1]
        z2 += value * flat[row + 2]
    return z0, z1, z2


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
