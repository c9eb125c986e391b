"""Compiled ray marching through several fields at once, with shadows. Only `launch.py` calls it.

Everything happens in voxel coordinates: those of object n in which its grid's corners are whole numbers. Samples of
object n lie at t = (k + 1/2) * step_n from the camera, those of a shadow ray at the same spacing from the point that
asks for light; t is in metres throughout. Arrays are indexed in full, never sliced, integers are made float32 before
they meet one, and helpers are inlined and count no references (`_nrt=False`; they allocate nothing): slices, double
precision and counting would each cost more than the arithmetic here.
"""
# ruff: noqa: ANN001, ANN202 - compiled helpers; types are given by their callers

from __future__ import annotations

from typing import NamedTuple

import numba
import numpy as np

from osfcore.fields.kiloosf import FEATURES, MACRO_BITS, MOST_HIDDEN, NETWORK_INPUTS
from osfcore.fields.ray_marching import interpolate, inverted, leave_blocks, optical_density, within
from osfcore.render.table_kernels import FAR, HELPER, KERNEL, TINY, meet_table, pixel_ray, table_colour

MOST_OBJECTS = 24
NO_OUTLINE = np.float32(1e8)
BAND_ROWS = 8  # rows of an image that one thread draws at a time
_ZERO, _HALF, _ONE, _TWO = np.float32(0), np.float32(0.5), np.float32(1), np.float32(2)


class _Work(NamedTuple):
    """What one thread writes on."""

    direction: np.ndarray
    inverse: np.ndarray
    inputs: np.ndarray
    h1: np.ndarray
    h2: np.ndarray
    out: np.ndarray
    ks: np.ndarray
    lasts: np.ndarray
    depths: np.ndarray
    lit: np.ndarray
    where: np.ndarray
    near: np.ndarray
    result: np.ndarray
    total: np.ndarray
    spans: np.ndarray


@numba.njit(error_model="numpy")
def _workspace():
    n, f = MOST_OBJECTS, np.float32
    return _Work(
        np.empty((n, 3), f), np.empty((n, 3), f), np.empty(NETWORK_INPUTS, f), np.empty(MOST_HIDDEN, f),
        np.empty(MOST_HIDDEN, f), np.empty(6, f), np.empty(n, np.int64), np.empty(n, np.int64), np.empty(n, f),
        np.empty(n, f), np.empty(1, np.int64), np.zeros(n, np.bool_), np.empty(5 + n, f),
        np.empty(5 + n, f), np.empty((n, 4), np.int64),
    )  # fmt: skip


@numba.njit(**HELPER)
def _clip(reach, n, ox, oy, oz, ix, iy, iz, far, step):
    """First and last sample of a ray within the occupied part of object n; last < first: none."""
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
def _next_sample(pack, a, ox, oy, oz, dx, dy, dz, ix, iy, iz, k, last, step, step_voxels):
    """The next sample k <= last of field a with any density, and its optical depth; k > last if there is none."""
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
def _depth_to_light(pack, a, n, reach, lit, lit_inverse, b, x, y, z, step, step_voxels, enough):
    """Optical depth of object n between a point, in its voxel coordinates, and the light; stops when it is enough."""
    dx, dy, dz = lit[b, n, 0], lit[b, n, 1], lit[b, n, 2]
    ix, iy, iz = lit_inverse[b, n, 0], lit_inverse[b, n, 1], lit_inverse[b, n, 2]
    k, last = _clip(reach, n, x, y, z, ix, iy, iz, FAR, step)
    total = _ZERO
    while k <= last and total < enough:
        k, depth = _next_sample(pack, a, x, y, z, dx, dy, dz, ix, iy, iz, k, last, step, step_voxels)
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
def _visibility(pack, fields, scene, b, n, x, y, z, step_voxels, enough):
    """Share of the light that reaches a point in object n's voxel coordinates past all others; n = N: of the world."""
    depth = _ZERO
    for m in range(len(fields)):
        if m != n and depth < enough:
            a = fields[m]
            qx, qy, qz = _transform(scene.between, b, n, m, x, y, z)
            step = step_voxels * pack.scales[a, 3]
            depth += _depth_to_light(pack, a, m, scene.reach, scene.lit, scene.lit_inverse, b, qx, qy, qz, step,
                                     step_voxels, enough - depth)  # fmt: skip
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
def _colour_at(pack, fields, scene, b, n, t, rules, work):
    """Rho of object n where the ray of `work` is at t, in out[0:6], and the light that reaches it."""
    d, inputs, h1, h2, out = work.direction, work.inputs, work.h1, work.h2, work.out
    a, view = fields[n], work.where[0]
    x = within(scene.eye[b, view, n, 0] + t * d[n, 0], pack.shapes[a, 0])
    y = within(scene.eye[b, view, n, 1] + t * d[n, 1], pack.shapes[a, 1])
    z = within(scene.eye[b, view, n, 2] + t * d[n, 2], pack.shapes[a, 2])
    s = pack.scales[a, 3]
    _scatter(pack, a, x, y, z, scene.lit[b, n, 0] * s, scene.lit[b, n, 1] * s, scene.lit[b, n, 2] * s,
             d[n, 0] * s, d[n, 1] * s, d[n, 2] * s, inputs, h1, h2, out)  # fmt: skip
    if out[3] + out[4] + out[5] <= _ZERO:
        return _ZERO
    if rules.one_shadow and work.lit[n] >= _ZERO:
        return work.lit[n]
    work.lit[n] = _visibility(pack, fields, scene, b, n, x, y, z, rules.shadow_voxels, rules.enough)
    return work.lit[n]


@numba.njit(**HELPER)
def _trace(pack, table, fields, scene, directs, cameras, b, view, u, v, near, rules, work, result):
    """Follow one ray.

    It leaves radiance in result[0:3], distance times weight in result[3], weight in result[4] and the seen share of
    object n in result[5 + n]. `near` marks the objects whose screen box holds the pixel.
    """
    count = len(fields)
    ks, lasts, depths, d, inv = work.ks, work.lasts, work.depths, work.direction, work.inverse
    for c in range(5 + count):
        result[c] = _ZERO
    dx, dy, dz, unit = pixel_ray(cameras, view, u, v)
    table_t = meet_table(table, cameras, view, dx, dy, dz)
    work.where[0] = view
    for n in range(count):
        ks[n], lasts[n] = 0, -1
        if not near[n]:
            continue
        a = fields[n]
        for c in range(3):
            row = 3 * c
            value = scene.ray[b, view, n, row] * u + scene.ray[b, view, n, row + 1] * v + scene.ray[b, view, n, row + 2]
            d[n, c] = value * unit
            inv[n, c] = inverted(d[n, c])
        step = rules.step_voxels * pack.scales[a, 3]
        ox, oy, oz = scene.eye[b, view, n, 0], scene.eye[b, view, n, 1], scene.eye[b, view, n, 2]
        k, last = _clip(scene.reach, n, ox, oy, oz, inv[n, 0], inv[n, 1], inv[n, 2], table_t, step)
        if k <= last:
            k, depths[n] = _next_sample(pack, a, ox, oy, oz, d[n, 0], d[n, 1], d[n, 2], inv[n, 0], inv[n, 1], inv[n, 2],
                                        k, last, step, rules.step_voxels)  # fmt: skip
        ks[n], lasts[n] = k, last
        work.lit[n] = -_ONE
    left, coloured, out = _ONE, _ZERO, work.out
    while left > rules.stop:
        n, t = -1, FAR
        for m in range(count):  # the nearest of all objects' next samples
            if ks[m] <= lasts[m]:
                candidate = (np.float32(ks[m]) + _HALF) * rules.step_voxels * pack.scales[fields[m], 3]
                if candidate < t:
                    n, t = m, candidate
        if n < 0:
            break
        passed = np.exp(-depths[n])
        weight = left * (_ONE - passed)
        left *= passed
        result[3] += weight * t
        result[4] += weight
        result[5 + n] += weight
        if weight > rules.min_weight:
            lit = _colour_at(pack, fields, scene, b, n, t, rules, work)
            coloured += weight
            for c in range(3):
                result[c] += weight * (out[c] + lit * out[3 + c])
        ks[n] += 1
        if ks[n] <= lasts[n]:
            step = rules.step_voxels * pack.scales[fields[n], 3]
            ks[n], depths[n] = _next_sample(
                pack, fields[n], scene.eye[b, view, n, 0], scene.eye[b, view, n, 1], scene.eye[b, view, n, 2],
                d[n, 0], d[n, 1], d[n, 2], inv[n, 0], inv[n, 1], inv[n, 2], ks[n], lasts[n], step, rules.step_voxels,
            )  # fmt: skip
    if coloured > _ZERO:  # what was too faint to be coloured looks like the rest
        for c in range(3):
            result[c] *= result[4] / coloured
    if left <= rules.stop:  # what lies behind no longer shows; what was found stands for all
        whole = _ONE / result[4]
        for c in range(5 + count):
            result[c] *= whole
        return
    if table_t < FAR:
        x, y = cameras[view, 0] + table_t * dx, cameras[view, 1] + table_t * dy
        visible = _visibility(pack, fields, scene, b, count, x, y, _ZERO, rules.shadow_voxels, rules.enough)
        r, g, blue = table_colour(table, directs, b, x, y, visible)
        result[0] += left * r
        result[1] += left * g
        result[2] += left * blue
        result[3] += left * table_t
        result[4] += left
    elif table.exists:
        for c in range(3):
            result[c] += left * table.background[c]


@numba.njit(**HELPER)
def _row_span(outlines, boxes, b, view, n, row):
    """The columns of a row of pixels, from and to, that the outline of object n may touch.

    The outline is the convex hull of eight points; between any two of them a line lies in it, and some are its edges.
    """
    if not boxes[b, view, n, 2] <= row < boxes[b, view, n, 3]:
        return 0, 0
    first, last = boxes[b, view, n, 0], boxes[b, view, n, 1]
    if outlines[b, view, n, 0, 0] >= NO_OUTLINE:  # the box must do
        return first, last
    top, bottom = np.float32(row), np.float32(row + 1)
    low, high = FAR, -FAR
    for i in range(8):
        x0, y0 = outlines[b, view, n, i, 0], outlines[b, view, n, i, 1]
        for j in range(i):
            x1, y1 = outlines[b, view, n, j, 0], outlines[b, view, n, j, 1]
            if max(y0, y1) < top or min(y0, y1) > bottom:
                continue
            slope = (x1 - x0) / (y1 - y0) if abs(y1 - y0) > TINY else _ZERO
            a = x0 if top <= y0 <= bottom else x0 + ((top if y0 < top else bottom) - y0) * slope
            c = x1 if top <= y1 <= bottom else x1 + ((top if y1 < top else bottom) - y1) * slope
            low, high = min(low, a, c), max(high, a, c)
    if low > high:
        return 0, 0
    return max(first, np.int64(np.floor(low))), min(last, np.int64(np.ceil(high)))


@numba.njit(**KERNEL)
def render_batch(pack, table, fields, scene, directs, cameras, base_rgb, base_distance, base_of, boxes, shadows,
                 outlines, rules, only, rgb, opacity, distance) -> None:  # fmt: skip
    """Every image of a batch; what no object and no shadow can touch is copied from the empty table.

    fields: N; scene: see `launch.Scene`; cameras: V x 12; base_of: number of the base light of each scene; boxes,
    shadows: B x V x N x 4 (columns from, to, rows from, to); outlines: see `launch.Outlines`; only: V x h x w, 0 for
    pixels that stay black, or empty; rgb: B x V x h x w x 3;
    opacity: B x V x N' x h x w or empty; distance: B x V x h x w or empty.
    """
    scenes, views, height, width = rgb.shape[0], rgb.shape[1], rgb.shape[2], rgb.shape[3]
    count = len(fields)
    wants_opacity, wants_distance, wants_some = opacity.size > 0, distance.size > 0, only.size > 0
    samples = rules.samples
    share = _ONE / np.float32(samples * samples)
    bands = (height + BAND_ROWS - 1) // BAND_ROWS
    for job in numba.prange(scenes * views * bands):
        band, view, b = job % bands, (job // bands) % views, job // (bands * views)
        base = base_of[b]
        work = _workspace()
        near, result, total, spans = work.near, work.result, work.total, work.spans
        for row in range(band * BAND_ROWS, min(height, (band + 1) * BAND_ROWS)):
            first, last = width, 0
            for n in range(count):
                spans[n, 0], spans[n, 1] = _row_span(outlines.objects, boxes, b, view, n, row)
                spans[n, 2], spans[n, 3] = _row_span(outlines.shadows, shadows, b, view, n, row)
                if spans[n, 0] < spans[n, 1]:
                    first, last = min(first, spans[n, 0]), max(last, spans[n, 1])
                if spans[n, 2] < spans[n, 3]:
                    first, last = min(first, spans[n, 2]), max(last, spans[n, 3])
            for column in range(width):
                if wants_some and only[view, row, column] == 0:
                    for c in range(3):
                        rgb[b, view, row, column, c] = _ZERO
                    if wants_distance:
                        distance[b, view, row, column] = _ZERO
                    continue
                touched = False
                if first <= column < last:
                    for n in range(count):
                        near[n] = spans[n, 0] <= column < spans[n, 1]
                        touched = touched or near[n] or spans[n, 2] <= column < spans[n, 3]
                if not touched:
                    for c in range(3):
                        rgb[b, view, row, column, c] = base_rgb[base, view, row, column, c]
                    if wants_distance:
                        distance[b, view, row, column] = base_distance[base, view, row, column]
                    continue
                for c in range(5 + count):
                    total[c] = _ZERO
                for s in range(samples * samples):
                    u = np.float32(column + (s % samples + 0.5) / samples)
                    v = np.float32(row + (s // samples + 0.5) / samples)
                    _trace(pack, table, fields, scene, directs, cameras, b, view, u, v, near, rules, work, result)
                    for c in range(5 + count):
                        total[c] += result[c]
                for c in range(3):
                    rgb[b, view, row, column, c] = total[c] * share
                if wants_distance:
                    distance[b, view, row, column] = total[3] / total[4] if total[4] * share > 1e-3 else _ZERO
                if wants_opacity:
                    for n in range(opacity.shape[2]):
                        opacity[b, view, n, row, column] = total[5 + n] * share
