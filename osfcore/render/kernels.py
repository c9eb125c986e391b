"""Compiled ray marching through several fields at once, with shadows. Only `fast.py` calls it.

Conventions: float32; `a` is a field's number within the pack; positions along a ray are t [m]. Samples of field a lie at
t = (k + 1/2) * step_a from the camera, those of a shadow ray at the same spacing from the point that asks for light.
Field and light vectors are in each object's own frame: rotation matrices take world vectors there.
"""
# ruff: noqa: ANN001, ANN202, PLR0913, D103 - compiled helpers; types are given by their callers

from __future__ import annotations

import numba
import numpy as np

from osfcore.fields.kiloosf import FEATURES, MACRO, NETWORK_INPUTS
from osfcore.fields.marching import clip_axis, interpolate, leave_block, optical_density

MOST_OBJECTS = 24
MOST_HIDDEN = 64
_FAR = np.float32(1e9)
_ZERO, _ONE, _TWO = np.float32(0), np.float32(1), np.float32(2)
_EDGE = np.float32(1.001)


@numba.njit(fastmath=True, inline="always")
def _depth_at(pack, a, px, py, pz, step_voxels):
    """Optical depth of one sample of field a at voxel coordinates."""
    shape = pack.shapes[a]
    g = interpolate(pack.density, pack.starts[a, 0], shape[1], shape[2], px, py, pz)
    return optical_density(g) * step_voxels


@numba.njit(fastmath=True)
def _next_sample(pack, a, o, d, k, last, step, step_voxels):
    """The next sample k <= last of field a with any density: its number and optical depth; k > last if there is none.

    o and d are in voxel coordinates.
    """
    shape, blocks = pack.shapes[a], pack.starts[a, 2]
    while k <= last:
        t = (k + np.float32(0.5)) * step
        px, py, pz = max(o[0] + t * d[0], _ZERO), max(o[1] + t * d[1], _ZERO), max(o[2] + t * d[2], _ZERO)
        bx, by, bz = int(px) // MACRO, int(py) // MACRO, int(pz) // MACRO
        if pack.macro[blocks + (bx * shape[4] + by) * shape[5] + bz] == 0:
            skip = min(leave_block(px, d[0], bx), leave_block(py, d[1], by), leave_block(pz, d[2], bz))
            k = max(k + 1, int(np.ceil((t + skip) / step - np.float32(0.5))))
            continue
        depth = _depth_at(pack, a, px, py, pz, step_voxels)
        if depth > _ZERO:
            return k, depth
        k += 1
    return k, _ZERO


@numba.njit(fastmath=True)
def _to_field(pack, a, R, p, x, y, z, dx, dy, dz, o, d):
    """A world ray in field a's voxel coordinates; t keeps its meaning."""
    inv = _ONE / pack.scales[a, 3]
    x, y, z = x - p[0], y - p[1], z - p[2]
    for c in range(3):
        o[c] = (R[c, 0] * x + R[c, 1] * y + R[c, 2] * z - pack.scales[a, c]) * inv
        d[c] = (R[c, 0] * dx + R[c, 1] * dy + R[c, 2] * dz) * inv


@numba.njit(fastmath=True)
def _range(pack, a, o, d, step, far):
    """First and last sample of a ray within field a's occupied extent, given in voxel coordinates; last < first: none."""
    inv = _ONE / pack.scales[a, 3]
    t0, t1 = _ZERO, far
    for c in range(3):
        low = (pack.extents[a, c] - pack.scales[a, c]) * inv
        high = (pack.extents[a, 3 + c] - pack.scales[a, c]) * inv
        most = np.float32(pack.shapes[a, c]) - _EDGE
        t0, t1 = clip_axis(o[c], d[c], max(low, _ZERO), min(high, most), t0, t1)
    if t0 >= t1:
        return 0, -1
    return int(np.ceil(t0 / step - np.float32(0.5))), int(np.floor(t1 / step - np.float32(0.5)))


@numba.njit(fastmath=True)
def _visibility(pack, fields, R, p, skip, x, y, z, l, step_voxels, stop, o, d):
    """Share of the light that reaches a point past all objects but `skip`."""
    depth = _ZERO
    for n in range(len(fields)):
        a = fields[n]
        if n == skip:
            continue
        _to_field(pack, a, R[n], p[n], x, y, z, l[0], l[1], l[2], o, d)
        step = step_voxels * pack.scales[a, 3]
        k, last = _range(pack, a, o, d, step, _FAR)
        while k <= last:
            k, more = _next_sample(pack, a, o, d, k, last, step, step_voxels)
            depth += more
            k += 1
            if depth > stop:
                return _ZERO
    return np.exp(-depth)


@numba.njit(fastmath=True)
def _scatter(pack, a, px, py, pz, lx, ly, lz, vx, vy, vz, features, inputs, h1, h2, out):
    """rho of field a at voxel coordinates: ambient part in out[0:3], direct part in out[3:6]."""
    shape, starts = pack.shapes[a], pack.starts[a]
    ny, nz = shape[1], shape[2]
    i, j, k = int(px), int(py), int(pz)
    fx, fy, fz = px - i, py - j, pz - k
    for c in range(FEATURES):
        features[c] = _ZERO
    for ci in range(2):
        wx = fx if ci else _ONE - fx
        for cj in range(2):
            wxy = wx * (fy if cj else _ONE - fy)
            at = starts[0] + ((i + ci) * ny + (j + cj)) * nz + k
            for ck in range(2):
                w = wxy * (fz if ck else _ONE - fz)
                row = pack.rows[starts[1] + pack.index[at + ck]]
                for c in range(FEATURES):
                    features[c] += w * row[c]
    dipole = features[4] * lx + features[5] * ly + features[6] * lz
    inputs[0], inputs[1] = dipole, features[7]
    inputs[2], inputs[3], inputs[4] = lx, ly, lz
    inputs[5], inputs[6], inputs[7] = vx, vy, vz
    cx, cy, cz = shape[6], shape[7], shape[8]
    qx, qy, qz = px * cx / (shape[0] - 1), py * cy / (ny - 1), pz * cz / (nz - 1)
    i, j, k = min(int(qx), cx - 1), min(int(qy), cy - 1), min(int(qz), cz - 1)
    inputs[8], inputs[9], inputs[10] = _TWO * (qx - i) - _ONE, _TWO * (qy - j) - _ONE, _TWO * (qz - k) - _ONE
    network = pack.networks[starts[4] + pack.cells[starts[3] + (i * cy + j) * cz + k]]
    hidden = pack.hidden
    at = NETWORK_INPUTS * hidden
    for n in range(hidden):
        h1[n] = network[at + n]
    for m in range(NETWORK_INPUTS):
        value, row = inputs[m], m * hidden
        for n in range(hidden):
            h1[n] += value * network[row + n]
    at += hidden
    bias = at + hidden * hidden
    for n in range(hidden):
        h2[n] = network[bias + n]
    for m in range(hidden):
        value, row = max(h1[m], _ZERO), at + m * hidden
        for n in range(hidden):
            h2[n] += value * network[row + n]
    at = bias + hidden
    bias = at + 3 * hidden
    z0, z1, z2 = network[bias], network[bias + 1], network[bias + 2]
    for m in range(hidden):
        value, row = max(h2[m], _ZERO), at + 3 * m
        z0 += value * network[row]
        z1 += value * network[row + 1]
        z2 += value * network[row + 2]
    for c in range(3):
        out[c] = features[1 + c] * pack.ambient[a, c]
    out[3] = features[1] * max(dipole + z0, _ZERO)
    out[4] = features[2] * max(dipole + z1, _ZERO)
    out[5] = features[3] * max(dipole + z2, _ZERO)


@numba.njit(fastmath=True)
def _table_colour(table, x, y, direct, visible, out):
    """Radiance of the table at (x, y), which lies on it."""
    g = len(table.albedo)
    u = (x / table.half_side + _ONE) * np.float32(0.5) * np.float32(g - 1)
    v = (y / table.half_side + _ONE) * np.float32(0.5) * np.float32(g - 1)
    i, j = min(max(int(u), 0), g - 2), min(max(int(v), 0), g - 2)
    fu, fv = u - i, v - j
    for c in range(3):
        low = table.albedo[i, j, c] * (_ONE - fv) + table.albedo[i, j + 1, c] * fv
        high = table.albedo[i + 1, j, c] * (_ONE - fv) + table.albedo[i + 1, j + 1, c] * fv
        out[c] = (low * (_ONE - fu) + high * fu) * (table.ambient[c] + direct[c] * visible)


@numba.njit(fastmath=True)
def _meet_table(table, has_table, camera, dx, dy, dz):
    """Distance along a ray to the table; very far if it misses."""
    if has_table and dz < np.float32(-1e-9) and camera[2] > _ZERO:
        t = -camera[2] / dz
        if abs(camera[0] + t * dx) <= table.half_side and abs(camera[1] + t * dy) <= table.half_side:
            return t
    return _FAR


@numba.njit(fastmath=True)
def trace(pack, table, has_table, fields, R, p, l, direct, camera, dx, dy, dz, near, rules, work, result):
    """One ray: radiance in result[0:3], distance times weight in result[3], weight in result[4], and the seen share of
    object n in result[5 + n].

    fields: number in the pack of each object, R and p: world to object frame and position, l: light, direct: what the
    table adds under it; near: the objects whose screen box holds the pixel.
    """
    step_voxels, min_weight, stop, one_shadow, shadow_voxels = rules
    o, d, features, inputs, h1, h2, out, ks, lasts, depths, steps, oo, dd = work
    count = len(fields)
    for c in range(5 + count):
        result[c] = _ZERO
    table_t = _meet_table(table, has_table, camera, dx, dy, dz)
    for n in range(count):
        ks[n], lasts[n] = 0, -1
        if not near[n]:
            continue
        a = fields[n]
        steps[n] = step_voxels * pack.scales[a, 3]
        _to_field(pack, a, R[n], p[n], camera[0], camera[1], camera[2], dx, dy, dz, o[n], d[n])
        k, last = _range(pack, a, o[n], d[n], steps[n], table_t)
        if k <= last:
            k, depths[n] = _next_sample(pack, a, o[n], d[n], k, last, steps[n], step_voxels)
        ks[n], lasts[n] = k, last
    left, most_depth = _ONE, -np.log(stop)
    shaded, visible = -1, _ONE
    while left > stop:
        n, t = -1, _FAR
        for m in range(count):  # the nearest of all objects' next samples
            if ks[m] <= lasts[m] and (ks[m] + np.float32(0.5)) * steps[m] < t:
                n, t = m, (ks[m] + np.float32(0.5)) * steps[m]
        if n < 0:
            break
        a = fields[n]
        weight = left * (_ONE - np.exp(-depths[n]))
        if weight > min_weight:
            px, py, pz = o[n, 0] + t * d[n, 0], o[n, 1] + t * d[n, 1], o[n, 2] + t * d[n, 2]
            Rn, scale = R[n], pack.scales[a, 3]
            lx = Rn[0, 0] * l[0] + Rn[0, 1] * l[1] + Rn[0, 2] * l[2]
            ly = Rn[1, 0] * l[0] + Rn[1, 1] * l[1] + Rn[1, 2] * l[2]
            lz = Rn[2, 0] * l[0] + Rn[2, 1] * l[1] + Rn[2, 2] * l[2]
            vx, vy, vz = d[n, 0] * scale, d[n, 1] * scale, d[n, 2] * scale
            _scatter(pack, a, max(px, _ZERO), max(py, _ZERO), max(pz, _ZERO), lx, ly, lz, vx, vy, vz,
                     features, inputs, h1, h2, out)  # fmt: skip
            if out[3] + out[4] + out[5] > _ZERO and not (one_shadow and shaded == n):
                x, y, z = camera[0] + t * dx, camera[1] + t * dy, camera[2] + t * dz
                visible = _visibility(pack, fields, R, p, n, x, y, z, l, shadow_voxels, most_depth, oo, dd)
                shaded = n
            for c in range(3):
                result[c] += weight * (out[c] + visible * out[3 + c])
            result[3] += weight * t
            result[4] += weight
            result[5 + n] += weight
        left *= np.exp(-depths[n])
        ks[n] += 1
        if ks[n] <= lasts[n]:
            ks[n], depths[n] = _next_sample(pack, a, o[n], d[n], ks[n], lasts[n], steps[n], step_voxels)
    if left <= stop:  # what lies behind no longer shows; what was found stands for all
        whole = _ONE / max(result[4], np.float32(1e-6))
        for c in range(5 + count):
            result[c] *= whole
        return
    if table_t < _FAR:
        x, y = camera[0] + table_t * dx, camera[1] + table_t * dy
        visible = _visibility(pack, fields, R, p, -1, x, y, _ZERO, l, shadow_voxels, most_depth, oo, dd)
        _table_colour(table, x, y, direct, visible, out)
        for c in range(3):
            result[c] += left * out[c]
        result[3] += left * table_t
        result[4] += left
    elif has_table:
        for c in range(3):
            result[c] += left * table.background[c]


@numba.njit(fastmath=True)
def _pixel_ray(camera, u, v):
    """Unit direction through pixel coordinates; camera: position (3), matrix from pixels to directions (9)."""
    x = camera[3] * u + camera[4] * v + camera[5]
    y = camera[6] * u + camera[7] * v + camera[8]
    z = camera[9] * u + camera[10] * v + camera[11]
    inv = _ONE / np.sqrt(x * x + y * y + z * z)
    return x * inv, y * inv, z * inv


@numba.njit(parallel=True, fastmath=True, cache=True, nogil=True)
def render_base(table, has_table, camera, direct, side, samples):
    """The empty, unshaded table from one camera under one light: radiance, distance (0 where there is nothing)."""
    height, width = side
    rgb, distance = np.zeros((height, width, 3), np.float32), np.zeros((height, width), np.float32)
    for row in numba.prange(height):
        out = np.zeros(3, np.float32)
        for column in range(width):
            u, v = np.float32(column + 0.5), np.float32(row + 0.5)
            dx, dy, dz = _pixel_ray(camera, u, v)
            t = _meet_table(table, has_table, camera, dx, dy, dz)
            hits = 0
            for s in range(4):  # a pixel that straddles the table's edge shows a part of it
                cx, cy, cz = _pixel_ray(camera, np.float32(column + s % 2), np.float32(row + s // 2))
                hits += _meet_table(table, has_table, camera, cx, cy, cz) < _FAR
            count = samples if 0 < hits < 4 else 1
            for s in range(count * count):
                us, vs = column + (s % count + 0.5) / count, row + (s // count + 0.5) / count
                sx, sy, sz = _pixel_ray(camera, np.float32(us), np.float32(vs))
                ts = _meet_table(table, has_table, camera, sx, sy, sz)
                if ts < _FAR:
                    _table_colour(table, camera[0] + ts * sx, camera[1] + ts * sy, direct, _ONE, out)
                    for c in range(3):
                        rgb[row, column, c] += out[c] / (count * count)
                elif has_table:
                    for c in range(3):
                        rgb[row, column, c] += table.background[c] / (count * count)
            distance[row, column] = t if t < _FAR else _ZERO
    return rgb, distance


@numba.njit(parallel=True, fastmath=True, cache=True, nogil=True)
def render_batch(pack, table, has_table, fields, R, p, lights, directs, cameras, bases, base_of, boxes, shadows, rules,
                 samples, rgb, opacity, distance):  # fmt: skip
    """Every image of a batch; what no object and no shadow can touch is copied from the empty table.

    fields: N; R: B x N x 3 x 3; p: B x N x 3; cameras: V x 12; bases: radiance and distance of the empty table by number;
    base_of: B x V; boxes, shadows: B x V x N x 4 (columns from, to, rows from, to); rgb: B x V x h x w x 3;
    opacity: B x V x N x h x w or empty; distance: B x V x h x w or empty.
    """
    scenes, views, height, width = rgb.shape[:4]
    count = len(fields)
    wants_opacity, wants_distance = opacity.size > 0, distance.size > 0
    inv = _ONE / np.float32(samples * samples)
    for job in numba.prange(scenes * views * height):
        row = job % height
        view = (job // height) % views
        b = job // (height * views)
        base = base_of[b, view]
        rgb[b, view, row] = bases[0][base, row]
        if wants_distance:
            distance[b, view, row] = bases[1][base, row]
        first, last = width, 0
        for n in range(count):
            for box in (boxes[b, view, n], shadows[b, view, n]):
                if box[2] <= row < box[3]:
                    first, last = min(first, box[0]), max(last, box[1])
        if first >= last:
            continue
        work = (
            np.empty((MOST_OBJECTS, 3), np.float32), np.empty((MOST_OBJECTS, 3), np.float32),
            np.empty(FEATURES, np.float32), np.empty(NETWORK_INPUTS, np.float32), np.empty(MOST_HIDDEN, np.float32),
            np.empty(MOST_HIDDEN, np.float32), np.empty(6, np.float32), np.empty(MOST_OBJECTS, np.int64),
            np.empty(MOST_OBJECTS, np.int64), np.empty(MOST_OBJECTS, np.float32), np.empty(MOST_OBJECTS, np.float32),
            np.empty(3, np.float32), np.empty(3, np.float32),
        )  # fmt: skip
        near = np.zeros(MOST_OBJECTS, np.bool_)
        result = np.empty(5 + MOST_OBJECTS, np.float32)
        total = np.empty(5 + MOST_OBJECTS, np.float32)
        camera = cameras[view]
        for column in range(first, last):
            touched = False
            for n in range(count):
                box, shadow = boxes[b, view, n], shadows[b, view, n]
                near[n] = box[0] <= column < box[1] and box[2] <= row < box[3]
                touched = touched or near[n] or (shadow[0] <= column < shadow[1] and shadow[2] <= row < shadow[3])
            if not touched:
                continue
            total[: 5 + count] = _ZERO
            for s in range(samples * samples):
                u, v = column + (s % samples + 0.5) / samples, row + (s // samples + 0.5) / samples
                dx, dy, dz = _pixel_ray(camera, np.float32(u), np.float32(v))
                trace(pack, table, has_table, fields, R[b], p[b], lights[b], directs[b], camera, dx, dy, dz, near,
                      rules, work, result)  # fmt: skip
                for c in range(5 + count):
                    total[c] += result[c]
            for c in range(3):
                rgb[b, view, row, column, c] = total[c] * inv
            if wants_distance:
                distance[b, view, row, column] = total[3] / total[4] if total[4] > 1e-3 else _ZERO
            if wants_opacity:
                for n in range(opacity.shape[2]):
                    opacity[b, view, n, row, column] = total[5 + n] * inv
