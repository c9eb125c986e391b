"""Descent on the voxels of a field alone, without networks: where nothing sees the view, no lid explains a hollow.

Each corner has a density, an albedo and its own dependence on the light, of second order in l, which learns shadows:

    radiance = albedo * (ambient + max(c . Y(l), 0))
    Y(l) = (1, l, l_x l_y, l_y l_z, l_x l_z, l_x^2 - l_y^2, 3 l_z^2 - 1)

Errors count relative to brightness, since the inside of a hollow is mostly in shadow. Compiled for the CPU.
"""

from __future__ import annotations

from dataclasses import replace

import numba
import numpy as np
from jaxtyping import Float32

from osfcore.fields.kiloosf import EMPTY_G, FLOOR_G, KiloOSF
from osfcore.fields.ray_marching import ONE_AT_A_TIME, clip_axis, optical_density, within
from osfcore.fields.ray_sampling import RayBatch, RaySource
from osfcore.fields.voxel_shell import FIRST_AMBIENT, FIRST_NORMAL
from osfcore.io.image_set import ImageSet

_FEATURES = 13  # g, albedo (3), c (9)
_FIRST_GAIN = 0.2
_RATES = np.array([0.06] + [0.03] * 7 + [0.01] * 5, np.float32)  # of Adam, for each feature
_COLOUR_STEPS = 60  # at first, in which density waits
_MOST_G = 10.0
_DARK = np.float32(0.05)  # brightness below which errors count as they are
_ALPHA_WEIGHT = np.float32(0.5)
_MOST_SAMPLES = 256
_MOST_DEPTH = np.float32(6)  # optical depth at which a ray ends
_PARTS = 4  # of a batch, each with its own sum: the same result on any number of threads
_FLOOR_G, _AMBIENT = np.float32(FLOOR_G), np.float32(FIRST_AMBIENT)
_ZERO, _ONE = np.float32(0), np.float32(1)


def fit_voxels(field: KiloOSF, images: ImageSet, *, steps: int, rays: int, rng: np.random.Generator) -> KiloOSF:
    """The field with density, albedo and dipole as some steps of descent leave them.

    Args:
        field: where to begin; its albedo is not looked at, nor are its networks.
        images: what to learn from.
        steps: of Adam.
        rays: for each.
        rng: chooses pixels and the offsets of samples.
    """
    source = RaySource(images)
    pixels = source.silhouette_pixels()
    values = np.zeros((len(field.rows), _FEATURES), np.float32)
    values[:, 0], values[:, 1:4], values[:, 4] = field.rows[:, 0], 0.3, _FIRST_GAIN
    values[:, 5:8] = field.rows[:, 4:7] * (0.3 / FIRST_NORMAL)
    mean, square = np.zeros_like(values), np.zeros_like(values)
    for step in range(1, steps + 1):
        _keep_within(values)
        batch = source.batch(rng.choice(pixels, rays))
        gradient = _gradient(values, field, batch, rng.random(rays, dtype=np.float32))
        mean += 0.1 * (gradient - mean)
        square += 0.01 * (gradient * gradient - square)
        change = _RATES * (mean / (1 - 0.9**step)) / (np.sqrt(square / (1 - 0.99**step)) + 1e-12)
        values -= change if step > _COLOUR_STEPS else np.where(np.arange(_FEATURES) == 0, 0, change)
    _keep_within(values)
    rows = field.rows.copy()
    rows[1:, :4], rows[1:, 4:7] = values[1:, :4], values[1:, 5:8]
    return replace(field, rows=rows)


def _keep_within(values: Float32[np.ndarray, "M 13"]) -> None:
    """Clip to what features may be; row 0 is empty space."""
    np.clip(values[:, 0], -_MOST_G, _MOST_G, out=values[:, 0])
    np.clip(values[:, 1:4], 0, 1, out=values[:, 1:4])
    values[0] = 0
    values[0, 0] = EMPTY_G


def _gradient(
    values: Float32[np.ndarray, "M 13"], field: KiloOSF, rays: RayBatch, offsets: Float32[np.ndarray, "R"]
) -> Float32[np.ndarray, "M 13"]:
    """Of the loss, which is the mean over rays."""
    parts = np.zeros((_PARTS, *values.shape), np.float32)
    origins = (rays.origins - field.origin) / np.float32(field.voxel)
    arrays = (origins, rays.directions, rays.lights, rays.rgb, rays.alpha, offsets)
    with ONE_AT_A_TIME:
        _descend(parts, values, field.index, *(np.ascontiguousarray(a, np.float32) for a in arrays))
    return parts.sum(axis=0) / np.float32(len(offsets))


@numba.njit(fastmath=True, error_model="numpy")
def _harmonics(light, out):  # noqa: ANN001, ANN202
    """Y(l)."""
    x, y, z = light
    out[0], out[1], out[2], out[3], out[4], out[5], out[6] = _ONE, x, y, z, x * y, y * z, x * z
    out[7], out[8] = x * x - y * y, 3 * z * z - _ONE


@numba.njit(fastmath=True, error_model="numpy")
def _corners(index, p, rows, weights):  # noqa: ANN001, ANN202
    """Rows and weights of the eight corners around a point in voxel coordinates."""
    i, j, k = int(p[0]), int(p[1]), int(p[2])
    fx, fy, fz = p[0] - np.float32(i), p[1] - np.float32(j), p[2] - np.float32(k)
    for q in range(8):
        a, b, c = q >> 2, (q >> 1) & 1, q & 1
        rows[q] = index[i + a, j + b, k + c]
        weights[q] = (fx if a else _ONE - fx) * (fy if b else _ONE - fy) * (fz if c else _ONE - fz)


@numba.njit(fastmath=True, error_model="numpy")
def _walk(values, index, origin, direction, offset, rows, weights, features):  # noqa: ANN001, ANN202
    """Features along a ray, one sample a voxel, where there is density; returns how many samples there are."""
    start, end = _ZERO, np.float32(1e9)
    for axis in range(3):
        start, end = clip_axis(
            origin[axis], direction[axis], _ZERO, np.float32(index.shape[axis]) - np.float32(1.001), start, end
        )
    count, depth, t = 0, _ZERO, start + offset
    p = np.empty(3, np.float32)
    while t < end and count < _MOST_SAMPLES and depth < _MOST_DEPTH:
        for axis in range(3):
            p[axis] = within(origin[axis] + t * direction[axis], index.shape[axis])
        t += _ONE
        _corners(index, p, rows[count], weights[count])
        g = _ZERO
        for q in range(8):
            g += weights[count, q] * values[rows[count, q], 0]
        if g <= _FLOOR_G:
            continue
        for c in range(_FEATURES):
            total = _ZERO
            for q in range(8):
                total += weights[count, q] * values[rows[count, q], c]
            features[count, c] = total
        depth += optical_density(g)
        count += 1
    return count


@numba.njit(fastmath=True, error_model="numpy")
def _shade(features, count, light, gains, colour):  # noqa: ANN001, ANN202
    """Composite the samples of a ray: fills their gains and the ray's colour, and returns its optical depth."""
    colour[:] = 0
    depth = _ZERO
    for s in range(count):
        gain = _ZERO
        for c in range(9):
            gain += features[s, 4 + c] * light[c]
        gains[s] = gain
        own = optical_density(features[s, 0])
        weight = np.exp(-depth) * (_ONE - np.exp(-own)) * (_AMBIENT + max(gain, _ZERO))
        for c in range(3):
            colour[c] += weight * features[s, 1 + c]
        depth += own
    return depth


@numba.njit(fastmath=True, error_model="numpy")
def _spread(rows, weights, features, gains, count, depth, light, slope, slope_alpha, out):  # noqa: ANN001, ANN202
    """Add a ray's part to the gradient: back to front, with the light from behind summed up on the way."""
    behind, through = _ZERO, np.exp(-depth)
    own = np.empty(_FEATURES, np.float32)
    for s in range(count - 1, -1, -1):
        g = features[s, 0]
        after = np.exp(-depth)
        depth -= optical_density(g)
        weight = np.exp(-depth) - after
        shade = _AMBIENT + max(gains[s], _ZERO)
        toward = slope[0] * features[s, 1] + slope[1] * features[s, 2] + slope[2] * features[s, 3]
        own[0] = (after * toward * shade - behind + slope_alpha * through) / (_ONE + np.exp(-g))
        behind += weight * toward * shade
        for c in range(3):
            own[1 + c] = weight * slope[c] * shade
        for c in range(9):
            own[4 + c] = weight * toward * light[c] if gains[s] > 0 else _ZERO
        for q in range(8):
            for c in range(_FEATURES):
                out[rows[s, q], c] += weights[s, q] * own[c]


@numba.njit(parallel=True, fastmath=True, error_model="numpy", cache=True, nogil=True)
def _descend(parts, values, index, origins, directions, lights, rgb, alpha, offsets):  # noqa: ANN001, ANN202
    for part in numba.prange(len(parts)):
        rows, weights = np.empty((_MOST_SAMPLES, 8), np.int32), np.empty((_MOST_SAMPLES, 8), np.float32)
        features, gains = np.empty((_MOST_SAMPLES, _FEATURES), np.float32), np.empty(_MOST_SAMPLES, np.float32)
        light, colour, slope = np.empty(9, np.float32), np.empty(3, np.float32), np.empty(3, np.float32)
        for r in range(part, len(origins), len(parts)):
            count = _walk(values, index, origins[r], directions[r], offsets[r], rows, weights, features)
            _harmonics(lights[r], light)
            depth = _shade(features, count, light, gains, colour)
            level = (colour[0] + colour[1] + colour[2]) / np.float32(3) + _DARK
            for c in range(3):
                slope[c] = 2 * (colour[c] - rgb[r, c]) / (level * level)
            miss = 2 * _ALPHA_WEIGHT * (_ONE - np.exp(-depth) - alpha[r])
            _spread(rows, weights, features, gains, count, depth, light, slope, miss, parts[part])
