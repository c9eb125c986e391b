"""Compiled ray marching through several fields at once, with shadows. Only `launch.py` calls it.

Everything happens in voxel coordinates: those of object n in which its grid's corners are whole numbers. Samples of
object n lie at t = (k + 1/2) * step_n from the camera, those of a shadow ray at the same spacing from the point that
asks for light; t is in metres throughout. Arrays are indexed in full, never sliced, integers are made float32 before
they meet one, and helpers are inlined and count no references (`_nrt=False`; they allocate nothing): slices, double
precision and counting would each cost more than the arithmetic here.
"""
# ruff: noqa: ANN001, ANN202, D417 - compiled helpers; types are given by their callers

from __future__ import annotations

from typing import NamedTuple

import numba
import numpy as np

from osfcore.fields.kiloosf import MOST_HIDDEN, NETWORK_INPUTS
from osfcore.fields.ray_marching import inverted
from osfcore.render.field_kernels import clip_to_extent, light_transmittance, next_sample, radiance_at
from osfcore.render.numba_options import FAR, GONE, HELPER, KERNEL, MOVES, STILL, TINY
from osfcore.render.table_kernels import empty_pixel, meet_table, pixel_ray, table_colour

MOST_OBJECTS = 24
NO_OUTLINE = np.float32(1e8)
BAND_ROWS = 4  # rows of an image that one thread draws at a time
_FAINT = np.float32(1e-3)  # of a pixel that shows anything less, the distance is not told


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
    """The object whose next sample is nearest and the distance of that sample [m]; -1 if all are past their last."""
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
    """The columns of a row of pixels, from and to, that the outline of object n may touch.

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
    """Columns of a row that each object may touch (spans 0, 1), and the shadow of each that moves (2, 3).

    And what these may shade (4, 5), which is left empty where no other objects are still.

    Returns:
        Columns, from and to, that what moves may change.
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
    """Whether a pixel may show anything but the base; marks the objects that it may show."""
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
    """Sum of the rays of one pixel, left in work.total."""
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
    """A pixel that shows nothing of the scene's own: the base, or the empty table where there is none."""
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


@numba.njit(**KERNEL)
def render_batch(pack, table, fields, scene, lamps, cameras, base, rules, only, stride, rgb, opacity, distance) -> None:
    """Every image of a batch.

    Args:
        pack, fields: packed fields, and that of each of N objects.
        table, scene, base, rules: types of `launch`.
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
