"""Compiled compositional volume rendering of tiny networks (paper eq. 3). Only `renderer.py` calls it.

Sample k of every object lies at t = (k + 1/2) * step from the camera, so that densities and radiances of objects that
overlap are summed at the same points, as eq. 3 has it:

    L = sum_k T_k (1 - exp(-sigma_k step)) L_k + T_end L_behind,   sigma_k = sum_n sigma_n,   L_k = sum_n rho_n L_light
"""
# ruff: noqa: ANN001, ANN202, D417 - compiled helpers; types are given by their callers

from __future__ import annotations

from typing import NamedTuple

import numba
import numpy as np

from osfcore.fields.ray_marching import inverted
from osfcore.geometry.light import AMBIENT, DIFFUSE
from osfcore.geometry.workspace import PUSHER_ALBEDO
from osfcore.paper.fields.tiny_field import DIRECTION_INPUTS, MOST_WIDTH, POSITION_INPUTS
from osfcore.paper.rendering.network_kernels import density_at, encode_direction, next_occupied, transfer_at
from osfcore.paper.rendering.shadow_maps import light_reaches, pusher_distance
from osfcore.render.numba_options import FAR, HELPER, KERNEL
from osfcore.render.table_kernels import meet_table, pixel_ray, table_colour

MOST_OBJECTS = 24
_RED, _GREEN, _BLUE = (np.float32(value) for value in PUSHER_ALBEDO)


class Scene(NamedTuple):
    """Where everything is.

    Attributes:
        rotations: B x N x 9, from the world into each object's frame.
        positions: B x N x 3 [m].
        lights: B x 3, toward the light.
        local_lights: B x N x 3, in each object's frame.
        kept: B, share of an object's radiance that a shadow leaves.
        pusher: B x 3 [m].
        has_pusher: whether there is one.
    """

    rotations: np.ndarray
    positions: np.ndarray
    lights: np.ndarray
    local_lights: np.ndarray
    kept: np.ndarray
    pusher: np.ndarray
    has_pusher: bool


class _Work(NamedTuple):
    """What one thread writes on; one row for each object."""

    o: np.ndarray
    d: np.ndarray
    inverse: np.ndarray
    directions: np.ndarray
    is_encoded: np.ndarray
    h2: np.ndarray
    sigma: np.ndarray
    begin: np.ndarray
    ks: np.ndarray
    lasts: np.ndarray
    place: np.ndarray
    h1: np.ndarray
    h3: np.ndarray
    rho: np.ndarray
    result: np.ndarray
    total: np.ndarray


@numba.njit(error_model="numpy")
def _workspace():
    n, f = MOST_OBJECTS, np.float32
    return _Work(
        np.empty((n, 3), f), np.empty((n, 3), f), np.empty((n, 3), f), np.empty((n, DIRECTION_INPUTS), f),
        np.zeros(n, np.bool_), np.empty((n, MOST_WIDTH), f), np.empty(n, f), np.empty(n, np.int64),
        np.empty(n, np.int64), np.empty(n, np.int64), np.empty(POSITION_INPUTS, f), np.empty(MOST_WIDTH, f),
        np.empty(MOST_WIDTH, f), np.empty(3, f), np.empty(5 + n, f), np.empty(5 + n, f),
    )  # fmt: skip


@numba.njit(**HELPER)
def _start_ray(pack, fields, scene, cameras, b, view, dx, dy, dz, boxes, row, column, far, step, work) -> None:
    """The ray in each object's voxel coordinates, and its first occupied sample there; none where its box is missed."""
    for n in range(len(fields)):
        work.ks[n], work.lasts[n], work.is_encoded[n] = 0, -1, False
        if not (boxes[b, view, n, 0] <= column < boxes[b, view, n, 1]):
            continue
        if not (boxes[b, view, n, 2] <= row < boxes[b, view, n, 3]):
            continue
        a = fields[n]
        voxel = pack.scales[a, 3]
        t0, t1 = _ZERO, far
        x = cameras[view, 0] - scene.positions[b, n, 0]
        y = cameras[view, 1] - scene.positions[b, n, 1]
        z = cameras[view, 2] - scene.positions[b, n, 2]
        for c in range(3):
            r0, r1, r2 = (
                scene.rotations[b, n, 3 * c],
                scene.rotations[b, n, 3 * c + 1],
                scene.rotations[b, n, 3 * c + 2],
            )
            work.o[n, c] = (r0 * x + r1 * y + r2 * z - pack.scales[a, c]) / voxel
            work.d[n, c] = (r0 * dx + r1 * dy + r2 * dz) / voxel
            work.inverse[n, c] = inverted(work.d[n, c])
            low = ((pack.reach[a, c] - pack.scales[a, c]) / voxel - work.o[n, c]) * work.inverse[n, c]
            high = ((pack.reach[a, 3 + c] - pack.scales[a, c]) / voxel - work.o[n, c]) * work.inverse[n, c]
            t0, t1 = max(t0, min(low, high)), min(t1, max(low, high))
        if t0 < t1:
            first, last = int(np.ceil(t0 / step - _HALF)), int(np.floor(t1 / step - _HALF))
            work.ks[n] = next_occupied(pack, a, work.o, work.d, work.inverse, n, first, last, step)
            work.lasts[n] = last


@numba.njit(**HELPER)
def _add_transfer(pack, fields, scene, maps, b, n, x, y, z, weight, work) -> None:
    """Add the radiance of object n at the sample where its density was just evaluated."""
    voxel = pack.scales[fields[n], 3]
    if not work.is_encoded[n]:
        light = scene.local_lights
        encode_direction(light[b, n, 0], light[b, n, 1], light[b, n, 2], n, 0, work.directions)
        encode_direction(work.d[n, 0] * voxel, work.d[n, 1] * voxel, work.d[n, 2] * voxel, n, DIRECTION_INPUTS // 2,
                         work.directions)  # fmt: skip
        work.is_encoded[n] = True
    transfer_at(pack, work.begin[n], work.h2, n, work.directions, work.h1, work.h3, work.rho)
    visible = light_reaches(scene, maps, b, n, x, y, z)
    factor = weight * (scene.kept[b] + (_ONE - scene.kept[b]) * visible)
    for c in range(3):
        work.result[c] += factor * work.rho[c]


@numba.njit(**HELPER)
def _add_behind(
    table, scene, maps, directs, cameras, b, view, dx, dy, dz, table_t, pusher_t, is_cap, left, work
) -> None:
    """Add what passes all objects: the pusher, the table with its shadows, or the surroundings."""
    ox, oy, oz = cameras[view, 0], cameras[view, 1], cameras[view, 2]
    t = min(table_t, pusher_t)
    if t >= FAR:
        if table.exists:
            for c in range(3):
                work.result[c] += left * table.background[c]
        return
    x, y, z = ox + t * dx, oy + t * dy, oz + t * dz
    if pusher_t < table_t:
        lx, ly, lz = scene.lights[b, 0], scene.lights[b, 1], scene.lights[b, 2]
        if is_cap:
            cosine = lz if dz < _ZERO else -lz
        else:
            nx, ny = x - scene.pusher[b, 0], y - scene.pusher[b, 1]
            cosine = (nx * lx + ny * ly) / np.sqrt(nx * nx + ny * ny)
        visible = light_reaches(scene, maps, b, -2, x, y, z) if cosine > _ZERO else _ZERO
        shade = np.float32(AMBIENT) + np.float32(DIFFUSE) * max(cosine, _ZERO) * visible
        red, green, blue = _RED * shade, _GREEN * shade, _BLUE * shade
    else:
        visible = light_reaches(scene, maps, b, -1, x, y, _ZERO)
        red, green, blue = table_colour(table, directs, None, b, x, y, visible)
    work.result[0] += left * red
    work.result[1] += left * green
    work.result[2] += left * blue
    work.result[3] += left * t
    work.result[4] += left


@numba.njit(**HELPER)
def _trace(pack, fields, table, scene, maps, directs, cameras, boxes, rules, b, view, u, v, row, column, work) -> None:
    """Follow one ray: radiance to result[0:3], distance times weight, weight, and each object's share of the pixel."""
    result, step, count = work.result, rules[0], len(fields)
    for c in range(5 + count):
        result[c] = _ZERO
    dx, dy, dz, _ = pixel_ray(cameras, view, u, v)
    ox, oy, oz = cameras[view, 0], cameras[view, 1], cameras[view, 2]
    table_t, pusher_t, is_cap = meet_table(table, cameras, view, dx, dy, dz), FAR, False
    if scene.has_pusher:
        pusher_t, is_cap = pusher_distance(scene, b, ox, oy, oz, dx, dy, dz)
    _start_ray(
        pack, fields, scene, cameras, b, view, dx, dy, dz, boxes, row, column, min(table_t, pusher_t), step, work
    )
    left, coloured = _ONE, _ZERO
    while left > rules[2]:
        k = np.int64(1) << 40
        for n in range(count):
            if work.ks[n] <= work.lasts[n]:
                k = min(k, work.ks[n])
        if k == np.int64(1) << 40:
            break
        t = (np.float32(k) + _HALF) * step
        x, y, z, sigma = ox + t * dx, oy + t * dy, oz + t * dz, _ZERO
        for n in range(count):
            work.sigma[n] = _ZERO
            if work.ks[n] == k and k <= work.lasts[n]:
                o, d = work.o, work.d
                work.sigma[n], work.begin[n] = density_at(
                    pack, fields[n], o[n, 0] + t * d[n, 0], o[n, 1] + t * d[n, 1], o[n, 2] + t * d[n, 2], work.place,
                    work.h1, work.h2, n)  # fmt: skip
                sigma += work.sigma[n]
        weight = left * (_ONE - np.exp(-sigma * step))
        for n in range(count):
            if work.ks[n] == k and k <= work.lasts[n]:
                if work.sigma[n] > _ZERO:
                    result[5 + n] += weight * work.sigma[n] / sigma
                    if weight > rules[1]:
                        _add_transfer(pack, fields, scene, maps, b, n, x, y, z, weight, work)
                work.ks[n] = next_occupied(
                    pack, fields[n], work.o, work.d, work.inverse, n, k + 1, work.lasts[n], step
                )  # fmt: skip
        result[3] += weight * t
        result[4] += weight
        left -= weight
        if weight > rules[1]:
            coloured += weight
    if coloured > _ZERO:  # what was too faint to be coloured looks like the rest
        for c in range(3):
            result[c] *= result[4] / coloured
    _add_behind(table, scene, maps, directs, cameras, b, view, dx, dy, dz, table_t, pusher_t, is_cap, left, work)


@numba.njit(**KERNEL)
def render_batch(pack, fields, table, scene, maps, directs, cameras, boxes, rules, samples, only, rgb, opacity,
                 distance) -> None:  # fmt: skip
    """Every image of a batch.

    Args:
        pack, fields: packed fields, and that of each of N objects; table: `osfcore.render.launch.Table`.
        scene, maps: `Scene` and `shadow_maps.ShadowMaps`.
        directs, cameras: B x 3 direct light on a white table; V x 12 numbers of `render.types.camera_numbers`.
        boxes: B x V x N x 4, pixels of objects (columns from, to, rows from, to).
        rules: step between samples [m], least weight of a sample that is coloured, transmittance at which a ray ends.
        samples: rays along each side of a pixel.
        only: V x h x w, 0 for pixels that stay black, or empty.
        rgb, opacity, distance: results: B x V x h x w x 3; B x V x N' x h x w or empty; B x V x h x w or empty.
    """
    scenes, views, height, width = rgb.shape[0], rgb.shape[1], rgb.shape[2], rgb.shape[3]
    count, share = len(fields), _ONE / np.float32(samples * samples)
    for job in numba.prange(scenes * views * height):
        row, view, b = job % height, (job // height) % views, job // (views * height)
        work = _workspace()
        total = work.total
        for column in range(width):
            for c in range(5 + count):
                total[c] = _ZERO
            if only.size == 0 or only[view, row, column] != 0:
                for s in range(samples * samples):
                    u = np.float32(column + (s % samples + 0.5) / samples)
                    v = np.float32(row + (s // samples + 0.5) / samples)
                    _trace(pack, fields, table, scene, maps, directs, cameras, boxes, rules, b, view, u, v, row, column,
                           work)  # fmt: skip
                    for c in range(5 + count):
                        total[c] += work.result[c]
            for c in range(3):
                rgb[b, view, row, column, c] = total[c] * share
            if distance.size > 0:
                distance[b, view, row, column] = total[3] / total[4] if total[4] * share > 1e-3 else _ZERO
            for n in range(opacity.shape[2] if opacity.size > 0 else 0):
                opacity[b, view, n, row, column] = total[5 + n] * share
