"""The loss of an object's pose in photographs: which pixels it explains better than what surrounds it, and print."""

from __future__ import annotations

import itertools
from collections.abc import Sequence
from dataclasses import dataclass
from typing import Literal

import cv2
import numba
import numpy as np
import torch
from jaxtyping import Bool, Float, Float32, Int32
from scipy.ndimage import gaussian_filter
from scipy.spatial import KDTree

from osfcore.errors import InvalidInput
from osfcore.estimation.objective import RestingOrientations
from osfcore.fields.kiloosf import KiloOSF
from osfcore.fields.kiloosf_query import KiloQuery
from osfcore.fields.rays import ONE_AT_A_TIME, march
from osfcore.geometry.cameras import Camera
from osfcore.geometry.poses import (
    Pose,
    fibonacci_sphere,
    orthogonal_basis,
    quaternion_conjugate,
    quaternion_to_matrix,
    rotate,
)
from osfcore.objects.kernel_cache import kept_kernel
from osfcore.photo.photograph import Photograph, WindowFrame, mask_box

# Compiled comparison of an object's surfels in many poses with one photograph.


# ruff: noqa: ANN001, D417 - compiled code; types are given by its caller


_NOTHING = -1
_TERMS = 4  # of what `compare_poses` writes: IoU, what is explained, correlation, misfit of the box
_FEWEST_COMPARED = 12  # pixels
_NARROW, _WIDE, _WIDE_SHARE = 0.08, 0.35, 0.25  # the two parts of the error of a drawn colour, see `compare_poses`
_MOST_LOG_ODDS = 3.0  # of one pixel
_REWEIGHTED = 2  # fits of the light
_BOX_STD, _FARTHEST_STD = 0.04, 4.0  # of a side, per side of the box; beyond, a side counts no more
_LIGHTS = 4  # ambient and first-order harmonics
_NEAREST_M = np.float32(0.02)
_OPTIONS = {"fastmath": True, "error_model": "numpy", "nogil": True}
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


@kept_kernel(**_OPTIONS)
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
    index[:] = _NOTHING
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
def _fit_light(albedo, normals, r, index, compared, image, light) -> None:
    """Least squares of I = albedo * (a + b . n) for each colour on compared pixels, reweighted by Cauchy's function.

    Shadows, highlights and what hides the object are outliers. `light` is 3 x 4, the result.
    """
    where = np.argwhere(compared)
    count = len(where)
    basis, weights, errors = np.ones((count, _LIGHTS)), np.ones(count), np.empty(count)
    for k in range(count):
        s = index[where[k, 0], where[k, 1]]
        for c in range(3):
            basis[k, c + 1] = r[c, 0] * normals[s, 0] + r[c, 1] * normals[s, 1] + r[c, 2] * normals[s, 2]
    normal, right = np.zeros((_LIGHTS, _LIGHTS)), np.zeros(_LIGHTS)
    for _ in range(_REWEIGHTED):
        errors[:] = 0.0
        for colour in range(3):
            normal[:], right[:] = 0.0, 0.0
            for k in range(count):
                a = albedo[index[where[k, 0], where[k, 1]], colour]
                y = image[where[k, 0], where[k, 1], colour]
                for i in range(_LIGHTS):
                    right[i] += weights[k] * a * basis[k, i] * y
                    for j in range(i + 1):
                        normal[i, j] += weights[k] * a * a * basis[k, i] * basis[k, j]
            whole = normal[0, 0] + 1e-6
            for i in range(_LIGHTS):
                for j in range(i):
                    normal[j, i] = normal[i, j]
                normal[i, i] += (_HARMONIC_RIDGE if i else _AMBIENT_RIDGE) * whole
            light[colour] = np.linalg.solve(normal, right)
            for k in range(count):
                value = 0.0
                for i in range(_LIGHTS):
                    value += light[colour, i] * basis[k, i]
                value *= albedo[index[where[k, 0], where[k, 1]], colour]
                root = np.sqrt(max(value, 0.0)) - np.sqrt(image[where[k, 0], where[k, 1], colour])
                errors[k] += root * root
        scale = 2 * np.median(errors) + 1e-6
        for k in range(count):
            weights[k] = 1 / (1 + errors[k] / scale)


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
def _window_sum(table, row, column, half) -> float:
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
                near = _window_sum(tables[0], row, column, _SMALL)
                wide = _window_sum(tables[0], row, column, _LARGE)
                a = (
                    _window_sum(tables[1], row, column, _SMALL) / near
                    - _window_sum(tables[1], row, column, _LARGE) / wide
                )
                b = (
                    _window_sum(tables[2], row, column, _SMALL) / near
                    - _window_sum(tables[2], row, column, _LARGE) / wide
                )
                a2 += a * a
                b2 += b * b
                ab += a * b
                level += luminance[row, column]
                count += 1
    floor = (_CONTRAST_FLOOR * level / max(count, 1)) ** 2 * count
    return ab / np.sqrt((a2 + floor) * (b2 + floor) + 1e-12)


@kept_kernel(parallel=True, **_OPTIONS)
def compare_poses(
    points, normals, albedo, half, rotations, positions, lens, image, luminance, mask, known, usable, evidence, level,
    box, terms,
) -> None:  # fmt: skip
    """Compare B poses with one window of a photograph.

    A drawn pixel counts the log odds of its colour I under the object drawn there, I', and under what is around it,

        g = log (0.75 N(e; 0.08) + 0.25 N(e; 0.35)) + evidence,   e = (sqrt(I') - sqrt(I)) / level,

    clipped to +-3; N is the normal density over three colours, and `evidence` has the rest (see `ObjectWindow`).

    Args:
        points, normals, albedo, half: surfels, see `draw_surfels`.
        rotations, positions: B x 3 x 3 and B x 3, from the object's frame to the camera's.
        lens: lens of the window.
        image, luminance: linear radiance, h x w x 3, and its mean over colours.
        mask, known, usable: pixels of the object; pixels where that is known; those of them that are well exposed.
        evidence, level, box: see `ObjectWindow`.
        terms: B x 4, results: IoU; sum of g per pixel of the box; correlation of the band-passed images; distance
            of the drawn outline's sides from those of the box, the mean of four [0.04 of a side].
    """
    height, width = mask.shape
    across, down = box[2] - box[0], box[3] - box[1]
    narrow = np.log(1 - _WIDE_SHARE) - 3 * np.log(_NARROW) - 1.5 * np.log(2 * np.pi)
    wide = np.log(_WIDE_SHARE) - 3 * np.log(_WIDE) - 1.5 * np.log(2 * np.pi)
    for b in numba.prange(len(positions)):
        nearest, index = np.empty((height, width), np.float32), np.empty((height, width), np.int32)
        draw_surfels(points, normals, half, rotations[b], positions[b], lens, nearest, index)
        compared = np.zeros((height, width), np.uint8)
        common = either = count = 0
        left, top, right, bottom = width, height, 0, 0
        for row in range(height):
            for column in range(width):
                shown = index[row, column] >= 0
                if known[row, column]:
                    common += shown and mask[row, column]
                    either += shown or mask[row, column]
                if shown:
                    left, right = min(left, column), max(right, column + 1)
                    top, bottom = min(top, row), max(bottom, row + 1)
                    if usable[row, column]:
                        compared[row, column] = 1
                        count += 1
        sides = (
            abs(left - box[0]) / across,
            abs(right - box[2]) / across,
            abs(top - box[1]) / down,
            abs(bottom - box[3]) / down,
        )
        misfit = 0.0
        for side in sides:
            misfit += min(side / _BOX_STD, _FARTHEST_STD) / 4
        terms[b, 0], terms[b, 1], terms[b, 2], terms[b, 3] = common / max(either, 1), -_MOST_LOG_ODDS, 0.0, misfit
        if count < _FEWEST_COMPARED:
            continue
        light, fitted, r, total = np.zeros((3, _LIGHTS)), np.zeros((height, width)), rotations[b], 0.0
        _fit_light(albedo, normals, r, index, compared, image, light)
        for row in range(height):
            for column in range(width):
                if compared[row, column]:
                    s, error = index[row, column], 0.0
                    nx = r[0, 0] * normals[s, 0] + r[0, 1] * normals[s, 1] + r[0, 2] * normals[s, 2]
                    ny = r[1, 0] * normals[s, 0] + r[1, 1] * normals[s, 1] + r[1, 2] * normals[s, 2]
                    nz = r[2, 0] * normals[s, 0] + r[2, 1] * normals[s, 1] + r[2, 2] * normals[s, 2]
                    for c in range(3):
                        value = light[c, 0] + light[c, 1] * nx + light[c, 2] * ny + light[c, 3] * nz
                        value = max(value * albedo[s, c], 0.0)
                        fitted[row, column] += value / 3
                        error += ((np.sqrt(value) - np.sqrt(image[row, column, c])) / level) ** 2
                    a, b_ = narrow - 0.5 * error / _NARROW**2, wide - 0.5 * error / _WIDE**2
                    odds = max(a, b_) + np.log(1 + np.exp(-abs(a - b_))) + evidence[row, column]
                    total += min(max(odds, -_MOST_LOG_ODDS), _MOST_LOG_ODDS)
        terms[b, 1] = total / (across * down)
        terms[b, 2] = _correlation(fitted, luminance, compared, np.empty((3, height + 1, width + 1)))


@kept_kernel(parallel=True, **_OPTIONS)
def draw_poses(points, normals, half, rotations, positions, lens, nearest, index) -> None:
    """`draw_surfels` for B poses; nearest and index are B x h x w."""
    for b in numba.prange(len(positions)):
        draw_surfels(points, normals, half, rotations[b], positions[b], lens, nearest[b], index[b])


# Surfels of a field: points of its surface with normal and albedo, which are drawn in a millisecond.
#
# The surface is where rays from outside have lost half of their light (transmittance 1/2). The normal is the
# direction of the field's dipole; the albedo is the field's radiance where light and view both fall along the
# normal, where ambient + diffuse = 1.


_DIRECTIONS = 64  # views from all sides
_AVERAGED = 6  # points of a cell whose albedo is averaged
_NEIGHBOURS = 6  # whose normals are averaged


@dataclass(frozen=True, eq=False, slots=True)
class Surfels:
    """Points of an object's surface, in its frame.

    Attributes:
        points: [m].
        normals: outward, unit.
        albedo: linear reflectance per colour.
        spacing: distance between neighbours [m].
    """

    points: Float32[np.ndarray, "S 3"]
    normals: Float32[np.ndarray, "S 3"]
    albedo: Float32[np.ndarray, "S 3"]
    spacing: float

    @property
    def radius(self) -> float:
        """Distance of the farthest point from the origin [m]."""
        return float(np.linalg.norm(self.points, axis=1).max())


def surfels_of(field: KiloOSF, spacing: float) -> Surfels:
    """Sample the surface of a field.

    Args:
        field: field of the object.
        spacing: wanted distance between points [m].
    """
    low, high = field.extent
    centre, radius = (low + high) / 2, float(np.linalg.norm(high - low)) / 2
    points = np.concatenate([_seen_from(field, d, centre, radius, spacing) for d in fibonacci_sphere(_DIRECTIONS)])
    cells = np.floor(points / spacing).astype(np.int64)
    _, number, counts = np.unique(cells, axis=0, return_inverse=True, return_counts=True)
    number = number.reshape(-1)
    order = np.argsort(number, kind="stable")
    rank = np.arange(len(order)) - np.repeat(np.cumsum(counts) - counts, counts)  # within the cell
    used = order[rank < _AVERAGED]
    normals, albedo = _appearance(field, points[used])
    mean, normal, colour = (_means(a, number[used], len(counts)) for a in (points[used], normals, albedo))
    return Surfels(mean, _smoothed(mean, normal), colour, spacing)


def _means(values: np.ndarray, number: np.ndarray, count: int) -> Float32[np.ndarray, "S 3"]:
    """Return the mean of the values of each cell."""
    sums = np.stack([np.bincount(number, column, count) for column in values.T], axis=1)
    return (sums / np.bincount(number, minlength=count)[:, None]).astype(np.float32)


def _seen_from(field: KiloOSF, direction: np.ndarray, centre: np.ndarray, radius: float, step: float) -> np.ndarray:
    """Find points where parallel rays along -direction have lost half of their light [m]."""
    right, up = orthogonal_basis(direction)
    line = np.arange(-radius, radius, step)
    a, b = np.meshgrid(line, line, indexing="ij")
    origins = centre + 1.5 * radius * direction + a.reshape(-1, 1) * right + b.reshape(-1, 1) * up
    rays = np.tile(-direction, (len(origins), 1))
    delta = field.voxel / 2
    ts, used = march(field, origins, rays, step=delta, min_weight=1e-4, min_transmittance=0.3, most=48)
    points = (origins[:, None] + ts[..., None] * rays[:, None]).astype(np.float32)
    taus = np.zeros(used.shape)
    with torch.no_grad():
        taus[used] = KiloQuery(field).density(torch.as_tensor(points[used])).numpy() * delta
    passed_half = np.cumsum(taus, axis=1) > np.log(2)
    return points[np.arange(len(points)), np.argmax(passed_half, axis=1)][passed_half.any(axis=1)]


def _appearance(field: KiloOSF, points: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """Return the field's normals and albedos at points."""
    query = KiloQuery(field)
    with torch.no_grad():
        x = torch.as_tensor(points)
        normals = torch.nn.functional.normalize(query.features(x)[:, 4:7], dim=-1)
        scatter = query(x, normals, -normals)
        albedo = scatter.ambient + scatter.direct
    return normals.numpy(), albedo.numpy()


def _smoothed(points: np.ndarray, normals: np.ndarray) -> np.ndarray:
    """Return unit normals, each the mean of those of its nearest neighbours."""
    unit = normals / np.maximum(np.linalg.norm(normals, axis=1, keepdims=True), 1e-9)
    _, near = KDTree(points).query(points, k=_NEIGHBOURS)
    mean = unit[near].mean(axis=1)
    return (mean / np.maximum(np.linalg.norm(mean, axis=1, keepdims=True), 1e-9)).astype(np.float32)


# The part of a photograph around one object's mask, at the resolution that a search asks for.


_MARGIN = 0.4  # of the mask's longest side, on each side
_MIN_PIXELS = 30  # of a mask in the photograph
_LOOSE = 0.037  # of a side of the box that a person drew, on each side
_LEAST_LEVEL = 1e-3
_FAR_PX = 1e4  # from the border of a mask that is empty or fills its window
_BINS, _BRIGHTEST, _BIN_SIGMA, _ANY_COLOUR = 24, 3.0, 0.7, 0.1  # of the histogram of colours around a box


@dataclass(frozen=True, eq=False, slots=True)
class ObjectWindow:
    """A window of a photograph.

    Attributes:
        image: linear radiance.
        luminance: its mean over colours.
        mask: pixels of the object.
        is_trusted: whether it was given, and not proposed from a box.
        known: pixels at which the mask is known. Pixels that another object may hide, or outside the photograph, are
            not.
        plain: well exposed pixels within the mask, one pixel away from its border.
        signed_distance: to the mask's border, positive inside [px].
        usable: well exposed pixels that no other object may hide.
        evidence: -log of the density of a pixel's colour (square root of radiance over `level`) around the box.
        level: square root of the median luminance.
        box: where the outline's sides should be: left, top, right, bottom [px].
        intrinsics: intrinsics of the window [px].
        T_camera_world: the inverse of the camera's pose.
        cut: share of the mask's border that lies on the photograph's edge.
        frame: which part of the photograph it is.
    """

    image: Float32[np.ndarray, "h w 3"]
    luminance: Float32[np.ndarray, "h w"]
    mask: Bool[np.ndarray, "h w"]
    is_trusted: bool
    known: Bool[np.ndarray, "h w"]
    plain: Bool[np.ndarray, "h w"]
    signed_distance: Float32[np.ndarray, "h w"]
    usable: Bool[np.ndarray, "h w"]
    evidence: Float32[np.ndarray, "h w"]
    level: float
    box: Float[np.ndarray, "4"]
    intrinsics: Float[np.ndarray, "3 3"]
    T_camera_world: Pose
    cut: float
    frame: WindowFrame

    @property
    def size(self) -> tuple[int, int]:
        """Height and width [px]."""
        height, width = self.mask.shape
        return height, width

    @property
    def centroid(self) -> Float[np.ndarray, "2"]:
        """Centroid of the mask (x, y) [px]."""
        rows, columns = np.nonzero(self.mask)
        return np.array([columns.mean(), rows.mean()]) + 0.5

    def camera(self, name: str) -> Camera:
        """The window's camera, for renderers."""
        height, width = self.size
        return Camera(name, self.T_camera_world.inverse(), self.intrinsics, width, height)


def object_windows(photos: Sequence[Photograph], name: str, side: int) -> tuple[ObjectWindow, ...]:
    """Cut a window out of each photograph with a mask of the object.

    Args:
        photos: photos of one scene.
        name: name of the object.
        side: longest side of the mask in the window [px]. Smaller masks are not enlarged.

    Raises:
        InvalidInput: if no photograph has a mask of the object, or it has too few pixels.
    """
    windows = tuple(_window(photo, name, side) for photo in photos if name in photo.masks)
    if not windows:
        raise InvalidInput(f"mask of {name}", "missing", "given in at least one photo; draw a box around the object")
    return windows


def _window(photo: Photograph, name: str, side: int) -> ObjectWindow:
    mask = photo.masks[name]
    if mask.sum() < _MIN_PIXELS:
        allowed = f"{_MIN_PIXELS} pixels or more; come closer or take a larger photo"
        raise InvalidInput(f"size of the mask of {name}", f"{int(mask.sum())} pixels", allowed)
    others = np.any([np.zeros_like(mask), *(its for other, its in photo.masks.items() if other != name)], axis=0)
    drawn = photo.boxes.get(name)
    corners = mask_box(mask) if drawn is None else np.array(drawn, float)
    frame = _frame(corners, side)
    own = frame.cut(mask.astype(np.float32)) > 0.5
    hidden = frame.cut((others & ~mask).astype(np.float32)) > 0.5
    beyond = frame.cut(np.zeros(mask.shape, np.float32), 1.0) > 0.5
    exposed = frame.cut(photo.well_exposed.astype(np.float32)) > 0.99
    image = np.ascontiguousarray(frame.cut(photo.image), np.float32)
    distance, box = signed_distance(own), frame.points(corners.reshape(2, 2)).ravel()
    level = float(np.sqrt(np.median(image[~beyond].mean(axis=-1)))) + _LEAST_LEVEL
    evidence = -_log_density(np.sqrt(np.maximum(image, 0)) / level, _outside(own.shape, box) & ~beyond)
    if drawn is not None:
        inset = _LOOSE * np.tile(np.ptp(box.reshape(2, 2), axis=0), 2)
        box = box + inset * (1, 1, -1, -1)
    at_edge = int(mask[[0, -1]].sum() + mask[:, [0, -1]].sum())
    border = int((mask & ~_eroded(mask)).sum())
    known = ~(hidden | beyond)
    return ObjectWindow(
        image=image,
        luminance=image.mean(axis=-1),
        mask=own,
        known=known,
        is_trusted=drawn is None,
        plain=_eroded(own) & exposed,
        signed_distance=distance,
        usable=known & exposed,
        evidence=evidence.astype(np.float32),
        level=level,
        box=box,
        intrinsics=frame.intrinsics(photo.intrinsics),
        T_camera_world=photo.T_world_camera.inverse(),
        cut=at_edge / max(border + at_edge, 1),
        frame=frame,
    )


def _outside(shape: tuple[int, ...], box: Float[np.ndarray, "4"]) -> Bool[np.ndarray, "h w"]:
    rows, columns = np.mgrid[: shape[0], : shape[1]] + 0.5
    return ~((columns > box[0]) & (columns < box[2]) & (rows > box[1]) & (rows < box[3]))


def _log_density(colours: Float[np.ndarray, "h w 3"], sample: Bool[np.ndarray, "h w"]) -> Float[np.ndarray, "h w"]:
    """Return the log density of each colour among those of a sample: a smoothed histogram and some of every colour."""
    cells = np.clip(colours / _BRIGHTEST * _BINS, 0, _BINS - 1).astype(int)
    counts = np.zeros((_BINS,) * 3)
    np.add.at(counts, tuple(cells[sample].T), 1.0)
    shares = gaussian_filter(counts, _BIN_SIGMA, mode="nearest") / max(float(sample.sum()), 1.0)
    shares = (1 - _ANY_COLOUR) * shares + _ANY_COLOUR / _BINS**3
    return np.log(shares[cells[..., 0], cells[..., 1], cells[..., 2]] * (_BINS / _BRIGHTEST) ** 3)


def _eroded(mask: Bool[np.ndarray, "h w"]) -> Bool[np.ndarray, "h w"]:
    """Return a mask without the pixels at its border."""
    return cv2.erode(mask.astype(np.uint8), np.ones((3, 3), np.uint8)) > 0


def _frame(box: Float[np.ndarray, "4"], side: int) -> WindowFrame:
    longest = float(np.ptp(box.reshape(2, 2), axis=0).max())
    margin = int(_MARGIN * longest)
    (left, top), (right, bottom) = np.floor(box[:2]).astype(int) - margin, np.ceil(box[2:]).astype(int) + margin
    scale = min(1.0, side / longest)
    width, height = max(round((right - left) * scale), 1), max(round((bottom - top) * scale), 1)
    return WindowFrame(int(left), int(top), int(right), int(bottom), width, height)


def signed_distance(mask: Bool[np.ndarray, "h w"]) -> Float32[np.ndarray, "h w"]:
    """Return the distance from each pixel's centre to the border of a mask, positive inside [px]."""
    inside, outside = (
        cv2.distanceTransform(part.astype(np.uint8), cv2.DIST_L2, cv2.DIST_MASK_PRECISE) for part in (mask, ~mask)
    )
    return np.clip(np.where(mask, inside - 0.5, 0.5 - outside), -_FAR_PX, _FAR_PX)


# Prior on an object's pose over a known table: it probably stands on the table in one of its stable orientations.


_HEIGHT_STD_M = 2e-3
_TILT_STD_RAD = np.deg2rad(1.5)
_FARTHEST = 20.0  # deviations, beyond which a refined object may as well lean or lie on another one
_MOST_PENALTY = 10.0  # deviations that count at most while orientations are compared
_DOWN = np.array([0.0, 0.0, -1.0])


class TablePrior:
    """Height of the lowest point above z = 0 and tilt from the nearest stable orientation, both normally distributed.

    Beyond ten standard deviations the penalty is constant: objects may lie on objects.

    Args:
        resting: resting orientations of the object.
    """

    def __init__(self, resting: RestingOrientations) -> None:
        self._hull = resting.hull
        self._stable = np.unique(np.round(rotate(quaternion_conjugate(resting.quaternions), _DOWN), 6), axis=0)

    def downs(self, pose: Pose) -> Float[np.ndarray, "K 3"]:
        """Return directions in the pose's outer frame, one of which is down if the object stands stably."""
        return rotate(pose.quaternion, self._stable)

    def extent(self, pose: Pose, direction: Float[np.ndarray, "3"]) -> float:
        """Return how far the object reaches along a direction, from the outer frame's origin [m]."""
        return float((pose.apply(self._hull) @ direction).max())

    def penalties(self, poses: Pose) -> Float[np.ndarray, "B"]:
        """Return squared deviations of B poses, each of the two at most 100."""
        lowest = rotate(poses.quaternion[:, None], self._hull)[..., 2].min(axis=1) + poses.position[:, 2]
        cosines = (rotate(poses.quaternion[:, None], self._stable) @ _DOWN).max(axis=1)
        heights = np.abs(lowest) / _HEIGHT_STD_M
        tilts = np.arccos(np.clip(cosines, -1, 1)) / _TILT_STD_RAD
        return np.minimum(heights, _MOST_PENALTY) ** 2 + np.minimum(tilts, _MOST_PENALTY) ** 2

    def normal_equations(self, pose: Pose) -> tuple[Float[np.ndarray, "6 6"], Float[np.ndarray, "6"]]:
        """J^T J and -J^T r of one pose's deviations, for a shift [m] and a turn about its origin [rad] in the world."""
        points = rotate(pose.quaternion, self._hull)
        low = points[np.argmin(points[:, 2])]
        height = low[2] + pose.position[2]
        rows, residuals = [], []
        if abs(height) < _FARTHEST * _HEIGHT_STD_M:
            rows.append(np.concatenate([[0.0, 0.0, 1.0], np.cross(low, [0.0, 0.0, 1.0])]) / _HEIGHT_STD_M)
            residuals.append(height / _HEIGHT_STD_M)
        down = self.downs(pose)
        nearest = down[np.argmax(down @ _DOWN)]
        if np.arccos(np.clip(nearest @ _DOWN, -1, 1)) < _FARTHEST * _TILT_STD_RAD:
            rows.extend(np.eye(6)[3:5] / _TILT_STD_RAD)  # a turn by nearest x down brings it there
            residuals.extend(-np.cross(nearest, _DOWN)[:2] / _TILT_STD_RAD)
        jacobian = np.reshape(rows, (-1, 6))
        return jacobian.T @ jacobian, -jacobian.T @ np.array(residuals)


# The loss of an object's pose in photographs.
#
#     L = [1 - IoU] + w_c (1 - correlation) + w_b misfit - w_g G [+ w_p * penalty of the table]
#
# IoU compares the drawn outline with the mask, where that is known and the mask was given; of kind "iou", as in the
# paper for real photographs, it is all that counts. G is the sum over drawn pixels of the log odds that the object, not
# what is around its box, has the colour that is seen (`compare_poses`). Its colours are I' = albedo * (a + b . n):
# ambient light and first-order harmonics for each colour and view, by robust least squares, so that exposure, white
# balance and the lamp need not be known. So no mask has to be trusted: the outline ends where the background explains
# more (as in region-based tracking; Prisacariu and Reid 2012). Correlation is that of both images after a band pass: it
# sees labels and edges, and no shading. The misfit is that of the outline's sides and the box's.


LossKind = Literal["all", "iou"]
Indices = Int32[np.ndarray, "B h w"]
Depths = Float32[np.ndarray, "B h w"]
_EXPLAINED, _CORRELATION, _MISFIT, _TABLE = 0.5, 0.5, 0.1, 1e-3  # weights
_HALF_SIDE = 0.6  # of a surfel, in spacings: at 0.7 outlines are 0.4 % too wide, at 0.5 drawings have holes


@dataclass(frozen=True, eq=False, slots=True)
class PoseTerms:
    """Parts of the loss of B poses, means over the photographs.

    Attributes:
        iou: intersection over union of drawn outline and mask.
        explained: mean log odds that pixels show the object, per pixel of the box.
        correlation: correlation of the band-passed images.
        losses: total losses.
    """

    iou: Float[np.ndarray, "B"]
    explained: Float[np.ndarray, "B"]
    correlation: Float[np.ndarray, "B"]
    losses: Float[np.ndarray, "B"]


@dataclass(frozen=True, eq=False, slots=True)
class PoseLoss:
    """The loss of one object's poses in the world.

    Attributes:
        windows: windows of the photographs.
        surfels: surfels of the object.
        table: prior of the known table; None if the table is not known.
        kind: "all", or "iou" for the outline alone, as in the paper.
    """

    windows: tuple[ObjectWindow, ...]
    surfels: Surfels
    table: TablePrior | None = None
    kind: LossKind = "all"

    def __call__(self, poses: Pose) -> Float[np.ndarray, "B"]:
        """Compute the losses of B poses."""
        return self.terms(poses).losses

    def terms(self, poses: Pose) -> PoseTerms:
        """Compute the losses of B poses and their parts."""
        found = np.mean([_compare(self.surfels, window, poses) for window in self.windows], axis=0)
        iou, explained, correlation, misfit = found.T
        losses = 1 - iou
        if self.kind == "all":
            trusted = np.mean([window.is_trusted for window in self.windows])
            losses = trusted * losses + _CORRELATION * (1 - correlation) + _MISFIT * misfit - _EXPLAINED * explained
        if self.table is not None:
            losses = losses + _TABLE * self.table.penalties(poses)
        return PoseTerms(iou, explained, correlation, losses)


def draw(surfels: Surfels, window: ObjectWindow, poses: Pose) -> tuple[Indices, Depths]:
    """Draw which surfel each pixel of a window shows in B poses, -1 for none, and its depth along z [m]."""
    index = np.empty((len(poses.position), *window.size), np.int32)
    depth = np.empty(index.shape, np.float32)
    camera = *rotation_and_position(window.T_camera_world @ poses), lens(window.intrinsics)
    with ONE_AT_A_TIME:
        draw_poses(surfels.points, surfels.normals, _half(surfels), *camera, depth, index)
    return index, depth


def lens(intrinsics: Float[np.ndarray, "3 3"]) -> Float32[np.ndarray, "4"]:
    """Return focal lengths and principal point for compiled code."""
    return intrinsics[[0, 1, 0, 1], [0, 1, 2, 2]].astype(np.float32)


def _compare(surfels: Surfels, window: ObjectWindow, poses: Pose) -> Float[np.ndarray, "B 4"]:
    terms = np.empty((len(poses.position), _TERMS))
    mask, known, usable = (np.ascontiguousarray(a).view(np.uint8) for a in (window.mask, window.known, window.usable))
    points, camera = (surfels.points, surfels.normals, surfels.albedo, _half(surfels)), lens(window.intrinsics)
    local, images = rotation_and_position(window.T_camera_world @ poses), (window.image, window.luminance)
    with ONE_AT_A_TIME:
        compare_poses(
            *points, *local, camera, *images, mask, known, usable, window.evidence, window.level, window.box, terms
        )
    return terms


def rotation_and_position(local: Pose) -> tuple[np.ndarray, np.ndarray]:
    """Return poses as single-precision matrices and positions for compiled code."""
    rotations = np.ascontiguousarray(quaternion_to_matrix(local.quaternion), np.float32)
    return rotations, np.ascontiguousarray(local.position, np.float32)


def _half(surfels: Surfels) -> np.float32:
    return np.float32(_HALF_SIDE * surfels.spacing)


# Whether what is printed on an object is found again where a pose shows it, patch by patch.
#
# The drawn albedo A and the photograph I are band-passed, and each patch p of the drawing is looked for within a few
# pixels d of its place:
#
#     m = sum_p w_p max_d corr(A_p, I_p+d) / sum_p w_p,   w_p = |A_p| |I_p|.
#
# Right poses are seldom exact to a pixel, so that labels do not quite cover each other and their correlation falls;
# patches that may move are found all the same. In a wrong pose they find what looks like them by chance.


_PATCH_PX, _STEP_PX, _REACH_PX = 28, 14, 5
_BAND_PX = 1.2, 7.0  # standard deviations, between which details count
_FILLED, _FEWEST_PATCHES = 0.6, 8  # share of a patch that must show the object; fewer patches agree by chance
_RIM = np.ones((5, 5), np.uint8)


def print_match(loss: PoseLoss, pose: Pose) -> float:
    """Return m of one pose over all windows: 1 where all of its print is found, 0 where too little of it is seen."""
    found, weights, count = 0.0, 0.0, 0
    for window in loss.windows:
        index = draw(loss.surfels, window, pose[None])[0][0]
        shown = index >= 0
        albedo = loss.surfels.albedo[np.maximum(index, 0)].mean(axis=-1)
        drawn, seen = _details(albedo, shown), _details(window.luminance, window.plain)
        inside = cv2.erode((shown & window.plain).astype(np.uint8), _RIM).astype(np.float32)
        places = (range(_REACH_PX, side - _PATCH_PX - _REACH_PX, _STEP_PX) for side in shown.shape)
        for top, left in itertools.product(*places):
            patch = np.s_[top : top + _PATCH_PX, left : left + _PATCH_PX]
            if inside[patch].mean() < _FILLED:
                continue
            around = seen[top - _REACH_PX :, left - _REACH_PX :][
                : _PATCH_PX + 2 * _REACH_PX, : _PATCH_PX + 2 * _REACH_PX
            ]
            template = drawn[patch] * inside[patch]
            weight = float(np.linalg.norm(template) * np.linalg.norm(seen[patch] * inside[patch]))
            if weight > 0:
                alike = cv2.matchTemplate(around, template, cv2.TM_CCORR_NORMED, mask=inside[patch])
                found += weight * float(np.nan_to_num(alike, posinf=0.0, neginf=0.0).max())
                weights, count = weights + weight, count + 1
    return found / weights if count >= _FEWEST_PATCHES else 0.0


def _details(image: np.ndarray, mask: Bool[np.ndarray, "h w"]) -> Float32[np.ndarray, "h w"]:
    """Return what of an image's square root, about what people see, lies between two scales within a mask."""
    inside = mask.astype(np.float32)
    values = np.sqrt(np.maximum(image, 0)).astype(np.float32) * inside
    fine, coarse = (
        cv2.GaussianBlur(values, (0, 0), sigma) / np.maximum(cv2.GaussianBlur(inside, (0, 0), sigma), 1e-3)
        for sigma in _BAND_PX
    )
    return (fine - coarse) * inside
