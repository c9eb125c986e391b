"""Objects with hollows that no silhouette shows, such as bowls: the visual hull is opened, and its voxels are fitted.

The visual hull closes a bowl with a lid. A true surface point has one colour and one normal for all views: its
brightness follows Lambert's law, or is the ambient part of it in shadow. A point of a lid shows each view another point
of the inside, so that no colour and normal explain it. Each voxel of the hull's surface gets the normal that explains
its images best, and voxels that no normal explains are removed (photo-consistency of Kutulakos and Seitz, with known
light). The object lies within the hull, so that points which the hull leaves visible or lit are truly visible or lit.

The remaining voxels are fitted to the images by descent, without networks.
"""

from __future__ import annotations

from dataclasses import replace

import numba
import numpy as np
from jaxtyping import Bool, Float32
from scipy import ndimage

from osfcore.fields.kiloosf import EMPTY_G, FLOOR_G, KiloOSF
from osfcore.fields.rays import (
    FIRST_AMBIENT,
    FIRST_NORMAL,
    ONE_AT_A_TIME,
    RayBatch,
    RaySource,
    clip_axis,
    optical_density,
    reshelled,
    within,
)
from osfcore.geometry.poses import fibonacci_sphere
from osfcore.io.image_set import ImageSet
from osfcore.objects.kernel_cache import kept_kernel

# ruff: noqa: ANN001, ANN202 - compiled functions; types are given by their callers

MOST_MISFIT = 0.22  # of a surface: true ones have 0.1, the lids of bowl and mug 0.3 and 0.5 (medians)
_NORMALS = 48  # that are tried
_TOLERANCE, _DARK_TOLERANCE = np.float32(0.2), np.float32(0.02)  # of brightness: relative, and of albedo
_CLEAR_VOXELS = np.float32(1.5)  # before a voxel that do not hide it: its neighbours
_STEP_VOXELS = np.float32(0.5)
_LEAST_VIEWS = 8  # fewer prove nothing
_OPAQUE = 250  # alpha of pixels without background
_BLUR_VOXELS = 1.0
_LAYER_VOXELS, _FOG_VOXELS = 1.5, 5.0  # around the surface on which views agree
_GAP_VOXELS = 2  # half of what separates two pieces
_OPAQUE_G = -1.5  # of what stays when fog is cleared
_ROUNDS = 3  # of fitting the albedo
_AMBIENT, _DIRECT = np.float32(FIRST_AMBIENT), np.float32(FIRST_NORMAL)
_ZERO, _ONE = np.float32(0), np.float32(1)


def open_hollows(field: KiloOSF, images: ImageSet, *, fog_g: float) -> KiloOSF:
    """Keep a layer of a solid hull under the surface on which the views agree, with fog around it.

    Args:
        field: a solid visual hull.
        images: the views.
        fog_g: density feature of the fog, from which wrongly removed edges can grow again.
    """
    solid = field.density > 0
    misfit = surface_misfit(field, images, solid)
    seen = np.isfinite(misfit)
    weight = ndimage.gaussian_filter(seen.astype(np.float32), _BLUR_VOXELS)
    smooth = ndimage.gaussian_filter(np.where(seen, misfit, 0), _BLUR_VOXELS) / np.maximum(weight, 1e-6)
    away = np.asarray(ndimage.distance_transform_edt(~_largest(seen & (smooth < MOST_MISFIT))))
    features = field.rows[field.index]
    features[..., 0] = np.where(away < _LAYER_VOXELS, features[..., 0], np.minimum(features[..., 0], fog_g))
    return reshelled(field, (field.index > 0) & (away <= _FOG_VOXELS), features)


def without_fog(field: KiloOSF) -> KiloOSF:
    """Remove corners that are neither opaque nor next to an opaque corner."""
    return reshelled(field, np.asarray(ndimage.binary_dilation(field.density > _OPAQUE_G), bool) & (field.index > 0))


def _largest(mask: Bool[np.ndarray, "nx ny nz"]) -> Bool[np.ndarray, "nx ny nz"]:
    """Return the largest connected piece, across small gaps. It removes floating remains of lids."""
    joined = np.asarray(ndimage.binary_dilation(mask, np.ones((3, 3, 3)), iterations=_GAP_VOXELS))
    pieces = np.zeros(mask.shape, np.int32)
    if not ndimage.label(joined, output=pieces):
        return mask
    return mask & (pieces == 1 + np.argmax(np.bincount(pieces.ravel())[1:]))


def surface_misfit(
    field: KiloOSF, images: ImageSet, solid: Bool[np.ndarray, "nx ny nz"]
) -> Float32[np.ndarray, "nx ny nz"]:
    """Return how badly the best Lambertian point explains the images of each voxel of a surface.

    It is the robust mean over views of e^2 / (1 + e^2), with e the difference of brightness in units of the tolerance:
    0 if all views agree, 1 if none does.

    Args:
        field: field whose grid is used.
        images: the views.
        solid: corners of the grid inside the object.

    Returns:
        The misfit of each corner; NaN inside, outside, and where too few views see the surface.
    """
    points = np.argwhere(solid & ~np.asarray(ndimage.binary_erosion(solid), bool))
    cameras = images.cameras
    to_pixels = np.array([c.intrinsics @ c.T_world_camera.inverse().matrix()[:3] for c in cameras])
    to_pixels[..., 3] += to_pixels[..., :3] @ field.origin.astype(float)  # takes voxel coordinates
    to_pixels[..., :3] *= field.voxel
    eyes = (np.array([c.T_world_camera.position for c in cameras]) - field.origin) / field.voxel
    brightness = images.rgba[..., :3].sum(axis=-1, dtype=np.float32) / (3 * 255)
    found = np.empty(len(points), np.float32)
    single = (points, to_pixels, eyes, images.light_directions, brightness, fibonacci_sphere(_NORMALS))
    arrays = [np.ascontiguousarray(a, np.float32) for a in single]
    with ONE_AT_A_TIME:
        _judge(found, solid, np.ascontiguousarray(images.rgba[..., 3] >= _OPAQUE), *arrays)
    misfit = np.full(solid.shape, np.nan, np.float32)
    misfit[tuple(points.T)] = np.where(found < 0, np.nan, found)
    return misfit


@numba.njit(fastmath=True, error_model="numpy")
def _is_blocked(solid, x, y, z, dx, dy, dz):
    """Return whether something solid blocks the way from a voxel in a direction."""
    nx, ny, nz = solid.shape
    t = _CLEAR_VOXELS
    while True:
        px, py, pz = x + t * dx + np.float32(0.5), y + t * dy + np.float32(0.5), z + t * dz + np.float32(0.5)
        if not (0 <= px < nx and 0 <= py < ny and 0 <= pz < nz):
            return False
        if solid[int(px), int(py), int(pz)]:
            return True
        t += _STEP_VOXELS


@numba.njit(fastmath=True, error_model="numpy")
def _brightness_at(image, opaque, to_pixels, point):
    """Interpolate the brightness of a point in an image; -1 outside the image and at the border to the background."""
    p = to_pixels[:, 0] * point[0] + to_pixels[:, 1] * point[1] + to_pixels[:, 2] * point[2] + to_pixels[:, 3]
    if p[2] <= 0:
        return -_ONE
    u, v = p[0] / p[2] - np.float32(0.5), p[1] / p[2] - np.float32(0.5)
    if not (0 <= u < image.shape[1] - 1 and 0 <= v < image.shape[0] - 1):
        return -_ONE
    i, j = int(u), int(v)
    if not (opaque[j, i] and opaque[j, i + 1] and opaque[j + 1, i] and opaque[j + 1, i + 1]):
        return -_ONE
    fu, fv = u - np.float32(i), v - np.float32(j)
    top = image[j, i] + fu * (image[j, i + 1] - image[j, i])
    return top + fv * (image[j + 1, i] + fu * (image[j + 1, i + 1] - image[j + 1, i]) - top)


@numba.njit(fastmath=True, error_model="numpy")
def _look(solid, opaque, point, to_pixels, eyes, lights, brightness, seen, towards, is_lit):
    """Collect the views of a point: brightness, index of the view, direction to the camera, and whether it is lit.

    Returns:
        The number of views that see it.
    """
    count = 0
    x, y, z = point
    for v in range(len(eyes)):
        value = _brightness_at(brightness[v], opaque[v], to_pixels[v], point)
        if value < 0:
            continue
        dx, dy, dz = eyes[v, 0] - x, eyes[v, 1] - y, eyes[v, 2] - z
        inverse = _ONE / np.sqrt(dx * dx + dy * dy + dz * dz)
        dx, dy, dz = dx * inverse, dy * inverse, dz * inverse
        if _is_blocked(solid, x, y, z, dx, dy, dz):
            continue
        seen[count, 0], seen[count, 1] = value, v
        towards[count, 0], towards[count, 1], towards[count, 2] = dx, dy, dz
        is_lit[count] = not _is_blocked(solid, x, y, z, lights[v, 0], lights[v, 1], lights[v, 2])
        count += 1
    return count


@numba.njit(fastmath=True, error_model="numpy")
def _misfit(normal, lights, seen, towards, is_lit, shade):
    """Return the robust misfit of a sheet with this normal and the best albedo; `shade` is scratch memory."""
    count = len(shade)
    ratio = np.empty(count, np.float32)
    for k in range(count):
        light = lights[int(seen[k, 1])]
        facing = normal[0] * light[0] + normal[1] * light[1] + normal[2] * light[2]
        if normal[0] * towards[k, 0] + normal[1] * towards[k, 1] + normal[2] * towards[k, 2] < 0:
            facing = -facing  # thin walls are seen from both sides
        shade[k] = _AMBIENT + _DIRECT * max(facing, _ZERO)
        ratio[k] = seen[k, 0] / shade[k]
    albedo = max(np.float32(np.median(ratio)), np.float32(1e-3))
    total = _ZERO
    for _ in range(_ROUNDS):
        total, above, below = _ZERO, _ZERO, _ZERO
        for k in range(count):
            expected = shade[k]
            is_dark = abs(seen[k, 0] - albedo * _AMBIENT) < abs(seen[k, 0] - albedo * expected)
            if is_dark and not is_lit[k]:  # what the hull hides from the light may lie in shadow or not
                expected = _AMBIENT
            tolerance = expected * _TOLERANCE + _DARK_TOLERANCE
            e = (seen[k, 0] / albedo - expected) / tolerance
            near = _ONE / (_ONE + e * e)
            total += _ONE - near
            weight = near * near / (tolerance * tolerance) * expected
            above += weight * seen[k, 0]
            below += weight * expected
        albedo = max(above / below, np.float32(1e-3))
    return total / np.float32(count)


@kept_kernel(parallel=True, fastmath=True, error_model="numpy", nogil=True)
def _judge(misfit, solid, opaque, points, to_pixels, eyes, lights, brightness, normals):
    """Fill in the least misfit of every point over all normals; -1 if too few views see the point."""
    views = len(eyes)
    for n in numba.prange(len(points)):
        seen, towards = np.empty((views, 2), np.float32), np.empty((views, 3), np.float32)
        is_lit = np.empty(views, np.bool_)
        count = _look(solid, opaque, points[n], to_pixels, eyes, lights, brightness, seen, towards, is_lit)
        misfit[n] = -_ONE
        if count < _LEAST_VIEWS:
            continue
        least = _ONE
        shade = np.empty(count, np.float32)
        for a in range(len(normals)):
            least = min(least, _misfit(normals[a], lights, seen, towards, is_lit, shade))
        misfit[n] = least


# Descent on the voxels of a field alone: without networks, which see the view, no lid can imitate a hollow.
#
# Each corner has a density, an albedo and its own dependence on the light, of second order in l, which learns
# shadows:
#
#     radiance = albedo * (ambient + max(c . Y(l), 0))
#     Y(l) = (1, l, l_x l_y, l_y l_z, l_x l_z, l_x^2 - l_y^2, 3 l_z^2 - 1)
#
# Errors count relative to brightness, since the inside of a hollow is mostly in shadow. Compiled for the CPU.


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
_FLOOR_G = np.float32(FLOOR_G)


def fit_voxels(field: KiloOSF, images: ImageSet, *, steps: int, rays: int, rng: np.random.Generator) -> KiloOSF:
    """Fit density, albedo and dipole of a field's voxels by some steps of descent.

    Args:
        field: initial field. Its albedo and its networks are ignored.
        images: training images.
        steps: steps of Adam.
        rays: pixels per step.
        rng: random generator of pixels and sample offsets.
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
    """Clip features to their ranges; row 0 is empty space."""
    np.clip(values[:, 0], -_MOST_G, _MOST_G, out=values[:, 0])
    np.clip(values[:, 1:4], 0, 1, out=values[:, 1:4])
    values[0] = 0
    values[0, 0] = EMPTY_G


def _gradient(
    values: Float32[np.ndarray, "M 13"], field: KiloOSF, rays: RayBatch, offsets: Float32[np.ndarray, "R"]
) -> Float32[np.ndarray, "M 13"]:
    """Return the gradient of the loss, which is the mean over rays."""
    parts = np.zeros((_PARTS, *values.shape), np.float32)
    origins = (rays.origins - field.origin) / np.float32(field.voxel)
    arrays = (origins, rays.directions, rays.lights, rays.rgb, rays.alpha, offsets)
    with ONE_AT_A_TIME:
        _descend(parts, values, field.index, *(np.ascontiguousarray(a, np.float32) for a in arrays))
    return parts.sum(axis=0) / np.float32(len(offsets))


@numba.njit(fastmath=True, error_model="numpy")
def _harmonics(light, out):
    """Fill in Y(l)."""
    x, y, z = light
    out[0], out[1], out[2], out[3], out[4], out[5], out[6] = _ONE, x, y, z, x * y, y * z, x * z
    out[7], out[8] = x * x - y * y, 3 * z * z - _ONE


@numba.njit(fastmath=True, error_model="numpy")
def _corners(index, p, rows, weights):
    """Fill in rows and weights of the eight corners around a point in voxel coordinates."""
    i, j, k = int(p[0]), int(p[1]), int(p[2])
    fx, fy, fz = p[0] - np.float32(i), p[1] - np.float32(j), p[2] - np.float32(k)
    for q in range(8):
        a, b, c = q >> 2, (q >> 1) & 1, q & 1
        rows[q] = index[i + a, j + b, k + c]
        weights[q] = (fx if a else _ONE - fx) * (fy if b else _ONE - fy) * (fz if c else _ONE - fz)


@numba.njit(fastmath=True, error_model="numpy")
def _walk(values, index, origin, direction, offset, rows, weights, features):
    """Fill in the features along a ray, one sample per voxel with density; return the number of samples."""
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
def _shade(features, count, light, gains, colour):
    """Composite the samples of a ray: fill in their gains and the ray's colour, and return its optical depth."""
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
def _spread(rows, weights, features, gains, count, depth, light, slope, slope_alpha, out):
    """Add a ray's part to the gradient: from back to front, while summing the light from behind."""
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


@kept_kernel(parallel=True, fastmath=True, error_model="numpy", nogil=True)
def _descend(parts, values, index, origins, directions, lights, rgb, alpha, offsets):
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
