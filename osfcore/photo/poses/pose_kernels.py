"""Compiled comparison of an object's surfels in many poses with one photograph. Only `pose_objective.py` calls it."""

# ruff: noqa: ANN001, D417 - compiled code; types are given by its caller

from __future__ import annotations

import numba
import numpy as np

NOTHING = -1
TERMS = 4  # of what `compare_poses` writes: IoU, relative residual, correlation, share of the mask that was compared
_LIGHTS = 4  # ambient and first-order harmonics
_NEAREST_M = np.float32(0.02)
_OPTIONS = {"fastmath": True, "error_model": "numpy", "cache": True, "nogil": True}
_SMALL, _LARGE = 1, 5  # half sides of the band-pass's windows [px]
_CONTRAST_FLOOR = 0.02  # of the mean luminance: contrast below it counts as noise
_AMBIENT_RIDGE, _HARMONIC_RIDGE = 1e-4, 2e-2  # of the ambient term's weight


@numba.njit(**_OPTIONS)
def _close_gaps(nearest, index) -> None:
    """Fill pixels between two drawn ones: slanted surfaces are sampled with gaps."""
    height, width = index.shape
    for row in range(height):
        for column in range(width):
            if index[row, column] >= 0:
                continue
            if 0 < column < width - 1 and index[row, column - 1] >= 0 and index[row, column + 1] >= 0:
                index[row, column], nearest[row, column] = index[row, column - 1], nearest[row, column - 1]
            elif 0 < row < height - 1 and index[row - 1, column] >= 0 and index[row + 1, column] >= 0:
                index[row, column], nearest[row, column] = index[row - 1, column], nearest[row - 1, column]


@numba.njit(**_OPTIONS)
def draw_surfels(points, normals, half, r, t, lens, nearest, index) -> None:
    """Draw surfels by z-buffer.

    Args:
        points, normals: S x 3, in the object's frame [m].
        half: half the side of a surfel's square [m].
        r, t: 3 x 3 and 3, from the object's frame to the camera's.
        lens: focal lengths and principal point (fx, fy, cx, cy) [px].
        nearest, index: h x w, results: depth along z [m] and number of the surfel, -1 where there is none.
    """
    height, width = index.shape
    nearest[:] = np.float32(1e9)
    index[:] = NOTHING
    fx, fy, cx, cy = lens[0], lens[1], lens[2], lens[3]
    for s in range(len(points)):
        px, py, pz = points[s, 0], points[s, 1], points[s, 2]
        x = r[0, 0] * px + r[0, 1] * py + r[0, 2] * pz + t[0]
        y = r[1, 0] * px + r[1, 1] * py + r[1, 2] * pz + t[1]
        z = r[2, 0] * px + r[2, 1] * py + r[2, 2] * pz + t[2]
        if z < _NEAREST_M:
            continue
        qx, qy, qz = normals[s, 0], normals[s, 1], normals[s, 2]
        nx = r[0, 0] * qx + r[0, 1] * qy + r[0, 2] * qz
        ny = r[1, 0] * qx + r[1, 1] * qy + r[1, 2] * qz
        nz = r[2, 0] * qx + r[2, 1] * qy + r[2, 2] * qz
        if nx * x + ny * y + nz * z > np.float32(0):  # it looks away
            continue
        u, v = fx * x / z + cx, fy * y / z + cy
        # A disc of normal n extends by half * sqrt(1 - n_x^2) along x: edge-on ones do not widen outlines.
        side_x = half * np.sqrt(max(np.float32(1) - nx * nx, np.float32(0))) * fx / z
        side_y = half * np.sqrt(max(np.float32(1) - ny * ny, np.float32(0))) * fy / z
        x0, x1 = int(np.ceil(u - side_x - np.float32(0.5))), int(np.floor(u + side_x - np.float32(0.5)))
        y0, y1 = int(np.ceil(v - side_y - np.float32(0.5))), int(np.floor(v + side_y - np.float32(0.5)))
        for row in range(max(y0, 0), min(y1, height - 1) + 1):
            for column in range(max(x0, 0), min(x1, width - 1) + 1):
                if z < nearest[row, column]:
                    nearest[row, column] = z
                    index[row, column] = s
    _close_gaps(nearest, index)


@numba.njit(**_OPTIONS)
def _fit_light(albedo, normals, r, index, compared, image, fitted) -> float:
    """Least squares of I = albedo * (a + b . n) for each colour on compared pixels; returns the squared residual."""
    height, width = index.shape
    count = 0
    for row in range(height):
        for column in range(width):
            count += compared[row, column]
    where, basis = np.empty((count, 2), np.int64), np.ones((count, _LIGHTS))
    k = 0
    for row in range(height):
        for column in range(width):
            if compared[row, column]:
                s = index[row, column]
                for c in range(3):
                    basis[k, c + 1] = r[c, 0] * normals[s, 0] + r[c, 1] * normals[s, 1] + r[c, 2] * normals[s, 2]
                where[k, 0], where[k, 1] = row, column
                k += 1
    fitted[:] = 0
    residual = 0.0
    normal, right = np.zeros((_LIGHTS, _LIGHTS)), np.zeros(_LIGHTS)
    for colour in range(3):
        normal[:], right[:] = 0.0, 0.0
        for k in range(count):
            a = albedo[index[where[k, 0], where[k, 1]], colour]
            y = image[where[k, 0], where[k, 1], colour]
            for i in range(_LIGHTS):
                right[i] += a * basis[k, i] * y
                for j in range(i + 1):
                    normal[i, j] += a * a * basis[k, i] * basis[k, j]
        whole = normal[0, 0] + 1e-6
        for i in range(_LIGHTS):
            for j in range(i):
                normal[j, i] = normal[i, j]
            normal[i, i] += (_HARMONIC_RIDGE if i else _AMBIENT_RIDGE) * whole
        light = np.linalg.solve(normal, right)
        for k in range(count):
            row, column = where[k, 0], where[k, 1]
            value = 0.0
            for i in range(_LIGHTS):
                value += light[i] * basis[k, i]
            value *= albedo[index[row, column], colour]
            residual += (value - image[row, column, colour]) ** 2
            fitted[row, column] += value / 3
    return residual


@numba.njit(**_OPTIONS)
def _summed(values, weights, table) -> None:
    """Summed-area table of values * weights."""
    height, width = weights.shape
    table[0, :] = 0.0
    for row in range(height):
        line = 0.0
        table[row + 1, 0] = 0.0
        for column in range(width):
            if weights[row, column]:
                line += values[row, column]
            table[row + 1, column + 1] = table[row, column + 1] + line


@numba.njit(**_OPTIONS)
def _window(table, row, column, half) -> float:
    """Sum of a square window."""
    r0, c0 = max(row - half, 0), max(column - half, 0)
    r1, c1 = min(row + half + 1, table.shape[0] - 1), min(column + half + 1, table.shape[1] - 1)
    return table[r1, c1] - table[r0, c1] - table[r1, c0] + table[r0, c0]


@numba.njit(**_OPTIONS)
def _correlation(fitted, luminance, compared, tables) -> float:
    """Correlation of two band-passed images on compared pixels."""
    ones = np.ones_like(fitted)
    _summed(ones, compared, tables[0])
    _summed(fitted, compared, tables[1])
    _summed(luminance, compared, tables[2])
    a2 = b2 = ab = level = 0.0
    count = 0
    for row in range(compared.shape[0]):
        for column in range(compared.shape[1]):
            if compared[row, column]:
                near = _window(tables[0], row, column, _SMALL)
                wide = _window(tables[0], row, column, _LARGE)
                a = _window(tables[1], row, column, _SMALL) / near - _window(tables[1], row, column, _LARGE) / wide
                b = _window(tables[2], row, column, _SMALL) / near - _window(tables[2], row, column, _LARGE) / wide
                a2 += a * a
                b2 += b * b
                ab += a * b
                level += luminance[row, column]
                count += 1
    floor = (_CONTRAST_FLOOR * level / max(count, 1)) ** 2 * count
    return ab / np.sqrt((a2 + floor) * (b2 + floor) + 1e-12)


@numba.njit(parallel=True, **_OPTIONS)
def compare_poses(
    points, normals, albedo, half, rotations, positions, lens, image, luminance, mask, known, plain, terms
) -> None:
    """Compare B poses with one window of a photograph.

    Args:
        points, normals, albedo, half: surfels, see `draw_surfels`.
        rotations, positions: B x 3 x 3 and B x 3, from the object's frame to the camera's.
        lens: of the window.
        image, luminance: linear radiance, h x w x 3, and its mean over colours.
        mask, known, plain: pixels of the object; pixels where that is known; well exposed pixels within the mask.
        terms: B x 4, results.
    """
    height, width = mask.shape
    for b in numba.prange(len(positions)):
        nearest, index = np.empty((height, width), np.float32), np.empty((height, width), np.int32)
        draw_surfels(points, normals, half, rotations[b], positions[b], lens, nearest, index)
        compared = np.zeros((height, width), np.uint8)
        common = either = count = own = 0
        energy = missing = 0.0
        for row in range(height):
            for column in range(width):
                shown = index[row, column] >= 0
                if known[row, column]:
                    common += shown and mask[row, column]
                    either += shown or mask[row, column]
                if plain[row, column]:
                    own += 1
                    bright = 0.0
                    for c in range(3):
                        bright += image[row, column, c] ** 2
                    energy += bright
                    if shown:
                        compared[row, column] = 1
                        count += 1
                    else:  # a smaller outline must not leave out what fits worst
                        missing += bright
        terms[b, 0], terms[b, 1], terms[b, 2] = common / max(either, 1), 1.0, 0.0
        terms[b, 3] = count / max(own, 1)
        if count < 12 or energy <= 0:
            continue
        fitted = np.empty((height, width))
        residual = _fit_light(albedo, normals, rotations[b], index, compared, image, fitted)
        terms[b, 1] = min(np.sqrt((residual + missing) / energy), 1.0)
        terms[b, 2] = _correlation(fitted, luminance, compared, np.empty((3, height + 1, width + 1)))


@numba.njit(parallel=True, **_OPTIONS)
def draw_poses(points, normals, half, rotations, positions, lens, nearest, index) -> None:
    """`draw_surfels` for B poses; nearest and index are B x h x w."""
    for b in numba.prange(len(positions)):
        draw_surfels(points, normals, half, rotations[b], positions[b], lens, nearest[b], index[b])
