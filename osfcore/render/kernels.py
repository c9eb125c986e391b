"""Compiled ray marching through several fields on a table, with shadows, under distant and near lamps.

It has everything from the layers of tiny networks to whole images. Only `renderer.py` calls it.
"""

# ruff: noqa: ANN001, ANN201, ANN202, D417 - compiled helpers; types are given by their callers

from __future__ import annotations

from typing import Any, NamedTuple

import numba
import numpy as np

from osfcore.fields.kiloosf import FEATURES, MACRO_BITS, MOST_HIDDEN, NETWORK_INPUTS
from osfcore.fields.rays import interpolate, inverted, leave_blocks, optical_density, within
from osfcore.objects.kernel_cache import kept_kernel

# How kernels and their helpers are compiled, and the numbers that all of them use.


FAR = np.float32(1e9)
TINY = np.float32(1e-9)
_ZERO, _HALF, _ONE, _TWO, _THREE = (np.float32(n) for n in (0, 0.5, 1, 2, 3))
_1, _2, _3, _4 = (np.uint64(n) for n in (1, 2, 3, 4))  # steps of indices
GONE, STILL, MOVES = 0, 1, 2  # an object that is not there, or that is in the base, or in the scene alone
HELPER: dict[str, Any] = {"fastmath": True, "error_model": "numpy", "forceinline": True, "_nrt": False}
KERNEL: dict[str, Any] = {"parallel": True, "fastmath": True, "error_model": "numpy", "nogil": True}


# Layers of tiny networks, compiled for the CPU.
#
# Indices are unsigned: signed ones may count from the end in numba, which is decided at each access, so that
# numbers are gathered one by one instead of loaded eight or sixteen at once. Four inputs are taken at a time, so
# that outputs are stored and loaded less often.


ANY = np.float32(-np.finfo(np.float32).max)  # floor of inputs that are taken as they are


@numba.njit(**HELPER)
def dense_layer(flat, at, inputs, floor, count, width, outputs):
    """Compute outputs[n] = b[n] + sum_m max(inputs[m], floor) * W[m, n].

    Args:
        flat: parameters: W row by row, then b.
        at: where they begin.
        inputs: only the first `count` are used.
        floor: 0 for the outputs of a layer that is followed by ReLU; `ANY` otherwise.
        count: number of inputs.
        width: number of outputs.
        outputs: result.

    Returns:
        Where the parameters end.
    """
    size, row, first = np.uint64(width), np.uint64(at), np.uint64(((count - 1) & 3) + 1)
    bias = row + np.uint64(count) * size
    a = max(inputs[np.uint64(0)], floor)
    b = max(inputs[_1], floor) if first > _1 else _ZERO
    c = max(inputs[_2], floor) if first > _2 else _ZERO
    d = max(inputs[_3], floor) if first > _3 else _ZERO
    second = row + size if first > _1 else row
    third = row + _2 * size if first > _2 else row
    fourth = row + _3 * size if first > _3 else row
    for k in range(width):
        n = np.uint64(k)
        some = a * flat[row + n] + b * flat[second + n] + c * flat[third + n] + d * flat[fourth + n]
        outputs[n] = flat[bias + n] + some
    m, row = first, row + first * size
    for _ in range((count - 1) >> 2):
        a, b = max(inputs[m], floor), max(inputs[m + _1], floor)
        c, d = max(inputs[m + _2], floor), max(inputs[m + _3], floor)
        second, third, fourth = row + size, row + _2 * size, row + _3 * size
        for k in range(width):
            n = np.uint64(k)
            outputs[n] += a * flat[row + n] + b * flat[second + n] + c * flat[third + n] + d * flat[fourth + n]
        m, row = m + _4, row + _4 * size
    return at + (count + 1) * width


@numba.njit(**HELPER)
def three_outputs(flat, at, inputs, count):
    """Return the outputs of a layer that has three, of inputs after ReLU; arguments as in `dense_layer`."""
    row, bias = np.uint64(at), np.uint64(at) + _3 * np.uint64(count)
    x, y, z = flat[bias], flat[bias + _1], flat[bias + _2]
    for m in range(count):
        value = max(inputs[np.uint64(m)], _ZERO)
        x += value * flat[row]
        y += value * flat[row + _1]
        z += value * flat[row + _2]
        row += _3
    return x, y, z


# Compiled light of near lamps: where it comes from at a point, and how much of it arrives.
#
# Kernels and helpers take `lamps`: `renderer.Lamps`, or None under distant lights. Numba compiles one version for
# each, without the branches of the other: distant lights cost nothing more because there are lamps, and their images
# stay the same to the bit.


@numba.njit(**HELPER)
def toward_lamp(lamps, b, n, x, y, z, voxel):
    """Return the unit vector from a point toward the lamp of scene b, along the axes of object n, and its distance [m].

    Args:
        lamps: `renderer.Lamps`.
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
    """Return the share of the diffuse light that arrives unshaded: `SpotLamp.spot_factor` times `SpotLamp.falloff`.

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
    """Return direct light of three colours on a white table at a point of it [m] where nothing shades it."""
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


# Compiled sampling of fields along rays: next samples, shadows, scattered radiance.
#
# Conventions of coordinates, types and inlining are those of the ray marching below.


@numba.njit(**HELPER)
def clip_to_extent(reach, n, ox, oy, oz, ix, iy, iz, far, step):
    """Return the first and last sample of a ray within the occupied part of an object; last < first: none.

    Args:
        reach, n: occupied parts (`renderer.Scene`), and which one.
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
    """Find the next sample of a field with any density, and its optical depth; past `last` if there is none.

    Args:
        pack, a: fields (`renderer.Packed`), and which one.
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
    """Return the optical depth of object n between a point, in its voxel coordinates, and the light, up to `enough`."""
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
    """Turn a point in object n's voxel coordinates into those of object m; n = N stands for the world."""
    return (
        matrix[b, n, m, 0] * x + matrix[b, n, m, 1] * y + matrix[b, n, m, 2] * z + matrix[b, n, m, 3],
        matrix[b, n, m, 4] * x + matrix[b, n, m, 5] * y + matrix[b, n, m, 6] * z + matrix[b, n, m, 7],
        matrix[b, n, m, 8] * x + matrix[b, n, m, 9] * y + matrix[b, n, m, 10] * z + matrix[b, n, m, 11],
    )


@numba.njit(**HELPER)
def light_transmittance(pack, fields, scene, lamps, b, n, x, y, z, step_voxels, enough):
    """Return the share of the light that reaches a point of object n past all others; n = N: a point of the world.

    Args:
        pack, fields, scene, lamps: as in `render_batch`.
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
    """Evaluate rho of field a at voxel coordinates: ambient part into out[0:3], direct part into out[3:6]."""
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
    """Interpolate the features of field a between the eight corners around a point, into mixed[0:FEATURES]."""
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
        two = np.uint64((first + pack.index[here + _1]) * FEATURES)
        low, high = w * (_ONE - fz), w * fz
        for c in range(FEATURES):
            mixed[np.uint64(c)] += low * pack.rows[one + np.uint64(c)] + high * pack.rows[two + np.uint64(c)]


@numba.njit(**HELPER)
def radiance_at(pack, fields, scene, lamps, b, n, t, rules, work):
    """Evaluate rho of object n where the ray of `work` is at t, into work.out[0:6].

    Args:
        pack, fields, scene, lamps, rules: as in `render_batch`.
        b, n: scene and object.
        t: distance from the camera [m].
        work: the thread's ray and memory; light found before is kept in it, for `rules.one_shadow`.

    Returns:
        Transmittance from there toward the light, times what a lamp's distance and cone leave of it; 0 without a
        shadow ray where the object scatters no direct light or the lamp sheds none.
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


# Compiled rays from pixels to the table, and the table where nothing stands on it.


@numba.njit(**HELPER)
def pixel_ray(cameras, view, u, v):
    """Return the unit direction in the world through a place of the image, and 1 / the length it had.

    Args:
        cameras, view: V x 12 numbers of `types.camera_numbers`, and which camera.
        u, v: the place [px], columns and rows.
    """
    x = cameras[view, 3] * u + cameras[view, 4] * v + cameras[view, 5]
    y = cameras[view, 6] * u + cameras[view, 7] * v + cameras[view, 8]
    z = cameras[view, 9] * u + cameras[view, 10] * v + cameras[view, 11]
    inverse = _ONE / np.sqrt(x * x + y * y + z * z)
    return x * inverse, y * inverse, z * inverse, inverse


@numba.njit(**HELPER)
def meet_table(table, cameras, view, dx, dy, dz):
    """Return the distance along a camera's ray to the table [m]; `FAR` if it misses.

    Args:
        table: `renderer.Table`.
        cameras, view: as in `pixel_ray`.
        dx, dy, dz: unit direction in the world.
    """
    if table.exists and dz < -TINY and cameras[view, 2] > _ZERO:
        t = -cameras[view, 2] / dz
        x, y = cameras[view, 0] + t * dx, cameras[view, 1] + t * dy
        if abs(x) <= table.half_side and abs(y) <= table.half_side:
            return t
    return FAR


@numba.njit(**HELPER)
def table_colour(table, directs, lamps, b, x, y, visible):
    """Return the radiance of the table at a point of it.

    Args:
        table: `renderer.Table`.
        directs, lamps, b: direct light of distant lights on a white table (a row for each), lamps, and which row.
        x, y: the point in the world [m].
        visible: transmittance from there toward the light.
    """
    g = len(table.albedo)
    u = (x / table.half_side + _ONE) * _HALF * np.float32(g - 1)
    v = (y / table.half_side + _ONE) * _HALF * np.float32(g - 1)
    i, j = min(max(int(u), 0), g - 2), min(max(int(v), 0), g - 2)
    fu, fv = u - np.float32(i), v - np.float32(j)
    w00, w01, w10, w11 = (_ONE - fu) * (_ONE - fv), (_ONE - fu) * fv, fu * (_ONE - fv), fu * fv
    al = table.albedo
    r = al[i, j, 0] * w00 + al[i, j + 1, 0] * w01 + al[i + 1, j, 0] * w10 + al[i + 1, j + 1, 0] * w11
    g_ = al[i, j, 1] * w00 + al[i, j + 1, 1] * w01 + al[i + 1, j, 1] * w10 + al[i + 1, j + 1, 1] * w11
    b_ = al[i, j, 2] * w00 + al[i, j + 1, 2] * w01 + al[i + 1, j, 2] * w10 + al[i + 1, j + 1, 2] * w11
    if lamps is None:
        return (
            r * (table.ambient[0] + directs[b, 0] * visible),
            g_ * (table.ambient[1] + directs[b, 1] * visible),
            b_ * (table.ambient[2] + directs[b, 2] * visible),
        )
    red, green, blue = light_on_table(lamps, b, x, y)
    return (
        r * (table.ambient[0] + red * visible),
        g_ * (table.ambient[1] + green * visible),
        b_ * (table.ambient[2] + blue * visible),
    )


@numba.njit(**HELPER)
def empty_pixel(table, cameras, directs, lamps, b, view, row, column, samples):
    """Return the colour of a pixel of the empty, unshaded table, and its distance [m], 0 where there is no table.

    Args:
        table: `renderer.Table`.
        cameras, directs, lamps, b: as in `table_colour`.
        view, row, column: the pixel.
        samples: rays along each side of a pixel that straddles the table's edge; elsewhere one ray is exact enough,
            except for the edge of a lamp's cone.
    """
    hits = 0
    for s in range(4 if samples > 1 else 0):  # a pixel that straddles the table's edge shows a part of it
        u, v = np.float32(column + s % 2), np.float32(row + s // 2)
        dx, dy, dz, _ = pixel_ray(cameras, view, u, v)
        hits += meet_table(table, cameras, view, dx, dy, dz) < FAR
    count = samples if 0 < hits < 4 or lamps is not None else 1
    share = _ONE / np.float32(count * count)
    red = green = blue = reach = _ZERO
    hits = 0
    for s in range(count * count):
        u = np.float32(column + (s % count + 0.5) / count)
        v = np.float32(row + (s // count + 0.5) / count)
        dx, dy, dz, _ = pixel_ray(cameras, view, u, v)
        t = meet_table(table, cameras, view, dx, dy, dz)
        if t < FAR:
            x, y = cameras[view, 0] + t * dx, cameras[view, 1] + t * dy
            r, g, bl = table_colour(table, directs, lamps, b, x, y, _ONE)
            hits, reach = hits + 1, reach + t
        else:
            r, g, bl = table.background[0], table.background[1], table.background[2]
        red, green, blue = red + share * r, green + share * g, blue + share * bl
    return red, green, blue, reach / np.float32(max(hits, 1))


# Compiled ray marching through several fields at once, with shadows.
#
# Everything happens in voxel coordinates: those of object n in which its grid's corners are whole numbers. Samples
# of object n lie at t = (k + 1/2) * step_n from the camera, those of a shadow ray at the same spacing from the
# point that asks for light; t is in metres throughout. Arrays are indexed in full, never sliced, integers are made
# float32 before they meet one, and helpers are inlined and count no references (`_nrt=False`; they allocate
# nothing): slices, double precision and counting would each cost more than the arithmetic here.


MOST_OBJECTS = 24
NO_OUTLINE = np.float32(1e8)
BAND_ROWS = 4  # rows of an image that one thread draws at a time
_FAINT = np.float32(1e-3)  # weight of what a pixel shows below which its distance is 0


class _Work(NamedTuple):
    """The memory of one thread."""

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
        np.empty(5 + n, f), np.empty((n, 6), np.int64),
    )  # fmt: skip


@numba.njit(**HELPER)
def _start_ray(pack, fields, scene, b, view, u, v, unit, table_t, near, rules, work) -> None:
    """Set up a ray in the voxel coordinates of each object near the pixel, and find its first sample there."""
    ks, lasts, depths, d, inv = work.ks, work.lasts, work.depths, work.direction, work.inverse
    for n in range(len(fields)):
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
        k, last = clip_to_extent(scene.reach, n, ox, oy, oz, inv[n, 0], inv[n, 1], inv[n, 2], table_t, step)
        if k <= last:
            k, depths[n] = next_sample(pack, a, ox, oy, oz, d[n, 0], d[n, 1], d[n, 2], inv[n, 0], inv[n, 1], inv[n, 2],
                                        k, last, step, rules.step_voxels)  # fmt: skip
        ks[n], lasts[n] = k, last
        work.lit[n] = -_ONE


@numba.njit(**HELPER)
def _nearest_sample(pack, fields, rules, work):
    """Return the object whose next sample is nearest, and its distance [m]; -1 if all are past their last."""
    n, t = -1, FAR
    for m in range(len(fields)):
        if work.ks[m] <= work.lasts[m]:
            candidate = (np.float32(work.ks[m]) + _HALF) * rules.step_voxels * pack.scales[fields[m], 3]
            if candidate < t:
                n, t = m, candidate
    return n, t


@numba.njit(**HELPER)
def _add_background(pack, table, fields, scene, lamps, cameras, b, view, dx, dy, table_t, left, rules, result) -> None:
    """Add what passes all objects: the table with its shadows, or the surroundings."""
    if table_t < FAR:
        x, y = cameras[view, 0] + table_t * dx, cameras[view, 1] + table_t * dy
        visible = light_transmittance(
            pack, fields, scene, lamps, b, len(fields), x, y, _ZERO, rules.shadow_voxels, rules.enough
        )
        r, g, blue = table_colour(table, scene.direct, lamps, b, x, y, visible)
        result[0] += left * r
        result[1] += left * g
        result[2] += left * blue
        result[3] += left * table_t
        result[4] += left
    elif table.exists:
        for c in range(3):
            result[c] += left * table.background[c]


@numba.njit(**HELPER)
def _trace(pack, table, fields, scene, lamps, cameras, b, view, u, v, near, rules, work, result):
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
    _start_ray(pack, fields, scene, b, view, u, v, unit, table_t, near, rules, work)
    left, coloured, out = _ONE, _ZERO, work.out
    while left > rules.stop:
        n, t = _nearest_sample(pack, fields, rules, work)
        if n < 0:
            break
        passed = np.exp(-depths[n])
        weight = left * (_ONE - passed)
        left *= passed
        result[3] += weight * t
        result[4] += weight
        result[5 + n] += weight
        if weight > rules.min_weight:
            lit = radiance_at(pack, fields, scene, lamps, b, n, t, rules, work)
            coloured += weight
            for c in range(3):
                result[c] += weight * (out[c] + lit * out[3 + c])
        ks[n] += 1
        if ks[n] <= lasts[n]:
            step = rules.step_voxels * pack.scales[fields[n], 3]
            ks[n], depths[n] = next_sample(
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
    _add_background(pack, table, fields, scene, lamps, cameras, b, view, dx, dy, table_t, left, rules, result)


@numba.njit(**HELPER)
def _row_span(outlines, boxes, b, view, n, row, count):
    """Return the columns of a row of pixels, from and to, that the outline of object n may touch.

    The outline is the convex hull of `count` points; between any two of them a line lies in it, and some are its edges.
    """
    if not boxes[b, view, n, 2] <= row < boxes[b, view, n, 3]:
        return 0, 0
    first, last = boxes[b, view, n, 0], boxes[b, view, n, 1]
    if outlines[b, view, n, 0, 0] >= NO_OUTLINE:  # the box must do
        return first, last
    top, bottom = np.float32(row), np.float32(row + 1)
    low, high = FAR, -FAR
    for i in range(count):
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


@numba.njit(**HELPER)
def _row_spans(scene, b, view, row, count, width, spans):
    """Fill in the columns of a row that each object (spans 0, 1) and the shadow of each that moves (2, 3) may touch.

    Spans 4 and 5 hold what these may shade; they are empty where no other objects are still.

    Returns:
        Columns, from and to, that moving objects may change.
    """
    first, last, has_still = width, 0, False
    for n in range(count):
        has_still = has_still or scene.part[b, n] == STILL
    for n in range(count):
        for c in range(6):
            spans[n, c] = 0
        if scene.part[b, n] == GONE:
            continue
        spans[n, 0], spans[n, 1] = _row_span(scene.outline, scene.box, b, view, n, row, 8)
        if scene.part[b, n] == MOVES:
            spans[n, 2], spans[n, 3] = _row_span(scene.shadow, scene.shadow_box, b, view, n, row, 8)
            if has_still:
                spans[n, 4], spans[n, 5] = _row_span(scene.swept, scene.swept_box, b, view, n, row, 16)
            for c in range(3):
                if spans[n, 2 * c] < spans[n, 2 * c + 1]:
                    first, last = min(first, spans[n, 2 * c]), max(last, spans[n, 2 * c + 1])
    return first, last


@numba.njit(**HELPER)
def _is_touched(scene, b, column, count, spans, near):
    """Return whether a pixel may show anything but the base, and mark the objects that it may show."""
    touched = shaded = shows_still = False
    for n in range(count):
        near[n] = spans[n, 0] <= column < spans[n, 1]
        if scene.part[b, n] == MOVES:
            touched = touched or near[n] or spans[n, 2] <= column < spans[n, 3]
            shaded = shaded or spans[n, 4] <= column < spans[n, 5]
        else:
            shows_still = shows_still or near[n]
    return touched or (shaded and shows_still)


@numba.njit(**HELPER)
def _trace_pixel(pack, table, fields, scene, lamps, cameras, b, view, row, column, rules, work) -> None:
    """Sum up the rays of one pixel in work.total."""
    total, result, samples = work.total, work.result, rules.samples
    for c in range(5 + len(fields)):
        total[c] = _ZERO
    for s in range(samples * samples):
        u = np.float32(column + (s % samples + 0.5) / samples)
        v = np.float32(row + (s // samples + 0.5) / samples)
        _trace(pack, table, fields, scene, lamps, cameras, b, view, u, v, work.near, rules, work, result)
        for c in range(5 + len(fields)):
            total[c] += result[c]


@numba.njit(**HELPER)
def _show_base(table, scene, lamps, cameras, base, b, view, row, column, rules, rgb, opacity, distance) -> None:
    """Draw a pixel that shows nothing of the scene's own: the base, or the empty table where there is none."""
    at = base.of[b]
    if at < 0:
        red, green, blue, t = empty_pixel(table, cameras, scene.direct, lamps, b, view, row, column, rules.samples)
        _put(rgb, distance, b, view, row, column, red, green, blue, t)
        return
    for c in range(3):
        rgb[b, view, row, column, c] = base.rgb[at, view, row, column, c]
    for n in range(opacity.shape[2]):
        opacity[b, view, n, row, column] = base.opacity[at, view, n, row, column]
    if distance.size > 0:
        distance[b, view, row, column] = base.distance[at, view, row, column]


@numba.njit(**HELPER)
def _put(rgb, distance, b, view, row, column, red, green, blue, t) -> None:
    rgb[b, view, row, column, 0], rgb[b, view, row, column, 1], rgb[b, view, row, column, 2] = red, green, blue
    if distance.size > 0:
        distance[b, view, row, column] = t


@kept_kernel(**KERNEL)
def render_batch(pack, table, fields, scene, lamps, cameras, base, rules, only, stride, rgb, opacity, distance) -> None:
    """Render every image of a batch.

    Args:
        pack, fields: packed fields, and that of each of N objects.
        table, scene, base, rules: types of `renderer`.
        lamps, cameras: `Lamps`, or None; V x 12 `types.camera_numbers`.
        only: V x h x w, 0 for pixels that stay black, or empty.
        stride: from one band of rows to the next that a thread draws, coprime to the number of bands: threads share
            the bands equally, and half an image may hold all objects.
        rgb, opacity, distance: results: B x V x h x w x 3; zeros of B x V x N' x h x w or empty; B x V x h x w or
            empty.
    """
    scenes, views, height, width = rgb.shape[0], rgb.shape[1], rgb.shape[2], rgb.shape[3]
    count, wants_some = len(fields), only.size > 0
    share = _ONE / np.float32(rules.samples * rules.samples)
    bands = (height + BAND_ROWS - 1) // BAND_ROWS
    jobs = scenes * views * bands
    for number in numba.prange(jobs):
        job = np.int64(number) * stride % jobs
        band, view, b = job % bands, (job // bands) % views, job // (bands * views)
        work = _workspace()
        total = work.total
        for row in range(band * BAND_ROWS, min(height, (band + 1) * BAND_ROWS)):
            first, last = _row_spans(scene, b, view, row, count, width, work.spans)
            for column in range(width):
                if wants_some and only[view, row, column] == 0:
                    _put(rgb, distance, b, view, row, column, _ZERO, _ZERO, _ZERO, _ZERO)
                    continue
                if not (first <= column < last and _is_touched(scene, b, column, count, work.spans, work.near)):
                    _show_base(table, scene, lamps, cameras, base, b, view, row, column, rules, rgb, opacity, distance)
                    continue
                _trace_pixel(pack, table, fields, scene, lamps, cameras, b, view, row, column, rules, work)
                t = total[3] / total[4] if total[4] * share > _FAINT else _ZERO
                _put(rgb, distance, b, view, row, column, total[0] * share, total[1] * share, total[2] * share, t)
                for n in range(opacity.shape[2]):
                    opacity[b, view, n, row, column] = total[5 + n] * share
