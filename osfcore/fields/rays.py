"""Rays through a field: the rays of an image set, ray marching, and the voxel shell that they need."""

from __future__ import annotations

import threading
from collections.abc import Iterator, Sequence
from dataclasses import dataclass
from itertools import product

import cv2
import numba
import numpy as np
from jaxtyping import Bool, Float, Float32, Int64
from scipy import ndimage

from osfcore.fields.kiloosf import (
    DENSITY_FLOOR,
    EMPTY_G,
    EMPTY_ROW,
    FEATURES,
    FLOOR_G,
    MACRO,
    MACRO_BITS,
    NETWORK_INPUTS,
    KiloOSF,
    network_size,
    numbered,
)
from osfcore.geometry.cameras import Camera
from osfcore.io.image_set import ImageSet
from osfcore.objects.kernel_cache import kept_kernel

# Walking along a ray through one field's density; compiled for the CPU.
#
# Samples lie at t = (k + 1/2) * step from the ray's origin, independent of the field's box. A ray then meets the same
# samples in whatever pieces it is marched.


# Without OpenMP and TBB, numba's threads end the process if two calls into parallel code overlap.
ONE_AT_A_TIME = threading.Lock()
_FLOOR = np.float32(DENSITY_FLOOR)
_FLOOR_G = np.float32(FLOOR_G)
_ONE = np.float32(1)
_NEXT = np.uint64(1)
_EDGE = np.float32(1.001)  # before the last corner, so that there is always a next one


@numba.njit(fastmath=True, error_model="numpy", inline="always")
def optical_density(g):  # noqa: ANN001, ANN201
    """Return sigma * voxel for a density feature g."""
    if g <= _FLOOR_G:
        return np.float32(0)
    if g > np.float32(15):
        return g - _FLOOR
    return np.log(_ONE + np.exp(g)) - _FLOOR


@numba.njit(fastmath=True, error_model="numpy", inline="always")
def interpolate(flat, start, ny, nz, px, py, pz):  # noqa: ANN001, ANN201, D417
    """Interpolate between the eight corners around a point of a grid.

    Args:
        flat: values on the corners of one or several grids.
        start: where the grid begins in it.
        ny, nz: corners along y and z.
        px, py, pz: the point in voxel coordinates, moved into the grid by `within`.
    """
    i, j, k = int(px), int(py), int(pz)
    fx, fy, fz = px - np.float32(i), py - np.float32(j), pz - np.float32(k)  # int64 would promote to double
    at = np.uint64(start + (i * ny + j) * nz + k)  # unsigned: numba need not ask whether to count from the end
    side, far = at + np.uint64(nz), at + np.uint64(ny * nz)
    corner = far + np.uint64(nz)
    a = flat[at] + (flat[at + _NEXT] - flat[at]) * fz
    b = flat[side] + (flat[side + _NEXT] - flat[side]) * fz
    c = flat[far] + (flat[far + _NEXT] - flat[far]) * fz
    d = flat[corner] + (flat[corner + _NEXT] - flat[corner]) * fz
    a += (b - a) * fy
    c += (d - c) * fy
    return a + (c - a) * fx


@numba.njit(fastmath=True, error_model="numpy", inline="always")
def within(p, count):  # noqa: ANN001, ANN201
    """Move a voxel coordinate between the first and the last of `count` corners."""
    return min(max(p, np.float32(0)), np.float32(count) - _EDGE)


@numba.njit(fastmath=True, error_model="numpy", inline="always")
def clip_axis(origin, direction, low, high, t0, t1):  # noqa: ANN001, ANN201, D417
    """Return the part of a ray between two bounds on one axis. If there is none, the end is before the beginning.

    Args:
        origin, direction: of the ray on this axis.
        low, high: the bounds.
        t0, t1: the part of the ray that is left so far.
    """
    if abs(direction) < np.float32(1e-9):
        return (t0, t1) if low < origin < high else (_ONE, -_ONE)
    a, b = (low - origin) / direction, (high - origin) / direction
    return max(t0, min(a, b)), min(t1, max(a, b))


@numba.njit(fastmath=True, error_model="numpy", inline="always")
def leave_blocks(p, d, inverse, block, distance):  # noqa: ANN001, ANN201
    """Return how far a ray stays, on one axis, within blocks that are known to be empty.

    Args:
        p: where the ray is [voxels].
        d: component of its direction [voxels per unit of t].
        inverse: 1 / d.
        block: number of its block on this axis.
        distance: blocks less than this far away are empty (`KiloOSF.macro`).
    """
    if d >= np.float32(0):
        return (np.float32((block + distance) * MACRO) - p) * inverse
    return (p - np.float32((block + 1 - distance) * MACRO)) * abs(inverse)


@numba.njit(fastmath=True, error_model="numpy", inline="always")
def inverted(d):  # noqa: ANN001, ANN201
    """Return 1 / d; a very large number where d is almost 0."""
    if abs(d) > np.float32(1e-9):
        return _ONE / d
    return np.float32(1e9)


@kept_kernel(parallel=True, fastmath=True, error_model="numpy", nogil=True)
def _march(origins, directions, density, macro, low, voxel, step, offsets, min_weight, min_transmittance, ts, counts):  # noqa: ANN001, ANN202
    nx, ny, nz = density.shape
    my, mz = macro.shape[1], macro.shape[2]
    flat, blocks = density.ravel(), macro.ravel()
    most = ts.shape[1]
    for r in numba.prange(len(origins)):
        # In voxel coordinates the box is [0, n - 1].
        ox, oy = (origins[r, 0] - low[0]) / voxel, (origins[r, 1] - low[1]) / voxel
        oz = (origins[r, 2] - low[2]) / voxel
        dx, dy, dz = directions[r, 0] / voxel, directions[r, 1] / voxel, directions[r, 2] / voxel
        ix, iy, iz = inverted(dx), inverted(dy), inverted(dz)
        t0, t1 = clip_axis(ox, dx, np.float32(0), np.float32(nx) - _EDGE, np.float32(0), np.float32(1e9))
        t0, t1 = clip_axis(oy, dy, np.float32(0), np.float32(ny) - _EDGE, t0, t1)
        t0, t1 = clip_axis(oz, dz, np.float32(0), np.float32(nz) - _EDGE, t0, t1)
        found, transmittance = 0, _ONE
        k = int(np.ceil(t0 / step - offsets[r]))
        while found < most and transmittance > min_transmittance:
            t = (np.float32(k) + offsets[r]) * step
            if t >= t1:
                break
            # Rounding must not lead out of the grid, however far away the ray began.
            px, py, pz = within(ox + t * dx, nx), within(oy + t * dy, ny), within(oz + t * dz, nz)
            bx, by, bz = int(px) >> MACRO_BITS, int(py) >> MACRO_BITS, int(pz) >> MACRO_BITS
            free = np.int64(blocks[(bx * my + by) * mz + bz])
            if free > 0:
                skip = min(leave_blocks(px, dx, ix, bx, free), leave_blocks(py, dy, iy, by, free))
                skip = min(skip, leave_blocks(pz, dz, iz, bz, free))
                k = max(k + 1, int(np.ceil((t + skip) / step - offsets[r])))
                continue
            depth = optical_density(interpolate(flat, 0, ny, nz, px, py, pz)) * (step / voxel)
            if depth > 0:
                alpha = _ONE - np.exp(-depth)
                if alpha * transmittance > min_weight:
                    ts[r, found] = t
                    found += 1
                transmittance *= _ONE - alpha
            k += 1
        counts[r] = found


def march(
    field: KiloOSF,
    origins: Float32[np.ndarray, "R 3"],
    directions: Float32[np.ndarray, "R 3"],
    *,
    step: float,
    offsets: Float32[np.ndarray, "R"] | None = None,
    min_weight: float = 1e-3,
    min_transmittance: float = 1e-3,
    most: int = 24,
) -> tuple[Float32[np.ndarray, "R most"], Bool[np.ndarray, "R most"]]:
    """Return the samples of rays that matter: their distances from front to back [m], and which slots are used.

    Args:
        field: field that the rays meet.
        origins: origins of the rays in the field's frame [m].
        directions: unit vectors.
        step: distance between samples [m].
        offsets: offsets of each ray's first sample, in steps; 1/2 by default, random in training.
        min_weight: smallest weight of a sample that is kept.
        min_transmittance: transmittance at which a ray ends.
        most: largest number of samples per ray.
    """
    count = len(origins)
    ts = np.zeros((count, most), np.float32)
    counts: Int64[np.ndarray, "R"] = np.zeros(count, np.int64)
    offsets = np.full(count, 0.5, np.float32) if offsets is None else offsets
    # Other memory layouts and types would need another compilation, which takes half a minute.
    origins, directions, offsets = (np.array(a, np.float32, order="C") for a in (origins, directions, offsets))
    voxel, every, least, passing = (np.float32(n) for n in (field.voxel, step, min_weight, min_transmittance))
    grid = field.density, field.macro, field.origin, voxel
    with ONE_AT_A_TIME:
        _march(origins, directions, *grid, every, offsets, least, passing, ts, counts)
    return ts, np.arange(most) < counts[:, None]


# Rays and pixel colours of an image set, by pixel number.


_MARGIN_PX = 3  # beyond the silhouette, so that its edge is learned from both sides


@dataclass(frozen=True, eq=False, slots=True)
class RayBatch:
    """R rays in the frame of an image set, with the colours of their pixels.

    Attributes:
        origins: camera centres [m].
        directions: unit vectors into the scene.
        lights: unit vectors toward the light.
        rgb: linear colour times opacity, that is, over black.
        alpha: opacity.
    """

    origins: Float32[np.ndarray, "R 3"]
    directions: Float32[np.ndarray, "R 3"]
    lights: Float32[np.ndarray, "R 3"]
    rgb: Float32[np.ndarray, "R 3"]
    alpha: Float32[np.ndarray, "R"]

    def at(self, ts: Float32[np.ndarray, "R S"]) -> Float32[np.ndarray, "R S 3"]:
        """Return the points at S distances along each ray [m]."""
        return self.origins[:, None] + ts[..., None] * self.directions[:, None]


class RaySource:
    """The rays of an image set's pixels. Pixels are numbered through images, rows and columns."""

    def __init__(self, images: ImageSet) -> None:
        """Use an image set. Its pixels are not copied."""
        self._images = images
        self._origins = np.array([c.T_world_camera.position for c in images.cameras], np.float32)
        matrices = [c.T_world_camera.matrix()[:3, :3] @ np.linalg.inv(c.intrinsics) for c in images.cameras]
        self._from_pixels = np.array(matrices, np.float32)
        self.image_shape = images.rgba.shape[1:3]

    def silhouette_pixels(self) -> Int64[np.ndarray, "n"]:
        """Return the numbers of the pixels in and close around the silhouettes."""
        kernel = np.ones((2 * _MARGIN_PX + 1,) * 2, np.uint8)
        parts = []
        for number, rgba in enumerate(self._images.rgba):
            near = cv2.dilate((rgba[..., 3] > 0).astype(np.uint8), kernel)
            parts.append(np.flatnonzero(near) + number * near.size)
        return np.concatenate(parts)

    def image_pixels(self, number: int) -> Int64[np.ndarray, "n"]:
        """Return the numbers of all pixels of one image."""
        size = self.image_shape[0] * self.image_shape[1]
        return np.arange(number * size, (number + 1) * size)

    def batch(self, pixels: Int64[np.ndarray, "R"]) -> RayBatch:
        """Return the rays through the centres of pixels."""
        height, width = self.image_shape
        image, rest = np.divmod(pixels, height * width)
        row, column = np.divmod(rest, width)
        places = np.stack([column + 0.5, row + 0.5, np.ones(len(pixels))], axis=1).astype(np.float32)
        directions = np.einsum("rij,rj->ri", self._from_pixels[image], places)
        directions /= np.linalg.norm(directions, axis=1, keepdims=True)
        rgba = self._images.rgba[image, row, column].astype(np.float32) / 255
        lights = self._images.light_directions[image].astype(np.float32)
        return RayBatch(self._origins[image], directions, lights, rgba[:, :3] * rgba[:, 3:], rgba[:, 3])


def least_opacity(
    points: Float32[np.ndarray, "n 3"], cameras: Sequence[Camera], alphas: Sequence[np.ndarray], allowed_misses: int
) -> Float32[np.ndarray, "n"]:
    """Return the smallest opacity of points in any view; 1 for points outside all images.

    Args:
        points: points in the frame of the image set [m].
        cameras: V views.
        alphas: V images of opacity in [0, 1], float32.
        allowed_misses: number of smallest values that are ignored, so that single wrong silhouettes remove nothing.
    """
    least = np.ones((allowed_misses + 1, len(points)), np.float32)
    for camera, alpha in zip(cameras, alphas, strict=True):
        pixels = camera.project(points).astype(np.float32) - 0.5
        inside = np.all((pixels > 0) & (pixels < (camera.width - 1, camera.height - 1)), axis=1)
        worst = np.where(inside, _sample(alpha, pixels), 1)
        for row in least:  # keep the few smallest, sorted
            row[:], worst = np.minimum(row, worst), np.maximum(row, worst)
    return least[-1]


def _sample(image: Float32[np.ndarray, "h w"], pixels: Float32[np.ndarray, "n 2"]) -> Float32[np.ndarray, "n"]:
    """Interpolate an image at pixels; OpenCV wants its maps as images of less than 32,768 columns."""
    width = 4096
    padded = np.zeros((-(-len(pixels) // width) * width, 2), np.float32)
    padded[: len(pixels)] = pixels
    maps = padded.reshape(-1, width, 2)
    values = [
        cv2.remap(image, np.ascontiguousarray(part[..., 0]), np.ascontiguousarray(part[..., 1]), cv2.INTER_LINEAR)
        for part in np.array_split(maps, max(1, len(maps) // 16_384))
    ]
    return np.concatenate(values).ravel()[: len(pixels)]


# The voxel shell of a field in training: its beginning from silhouettes, and its refinement.


FIRST_ALBEDO = 0.5
FIRST_AMBIENT = 0.25
FIRST_NORMAL = 0.75  # length of the dipole: the direct light that a white surface facing the lamp sends out
_HULL_EDGE = 0.5  # smallest opacity over the views on the surface of the visual hull
_EDGE_GAIN = 20.0  # of g across that surface, per unit of opacity
_INSIDE_G = 6.0
_BLUR_PX = 1.0
_MISSED_SHARE = 0.01  # of the views may contradict a voxel
_VISIBLE_WEIGHT = 5e-3
_PIXELS_LOOKED_AT = 400_000


def first_shell(images: ImageSet, box: Float[np.ndarray, "2 3"], *, across: int, cells: int, hidden: int,
                inside_g: float, rng: np.random.Generator) -> KiloOSF:  # fmt: skip
    """Fill the visual hull with a coarse grey field.

    Args:
        images: images whose silhouettes carve the hull.
        box: box of the object [m].
        across: voxels along the longest side of the box.
        cells: tiny networks along the longest side.
        hidden: width of the tiny networks.
        inside_g: density feature inside the hull. Thin fog lets light reach hollows that silhouettes cannot carve.
        rng: random generator of the networks' initial weights.
    """
    origin, voxel, shape = grid_over(box, across)
    points = origin + voxel * np.moveaxis(np.indices(shape), 0, -1).reshape(-1, 3)
    alphas = [cv2.GaussianBlur(a.astype(np.float32) / 255, (0, 0), _BLUR_PX) for a in images.rgba[..., 3]]
    misses = int(_MISSED_SHARE * len(alphas))
    least = least_opacity(points.astype(np.float32), images.cameras, alphas, misses).reshape(shape)
    g = np.clip((least - _HULL_EDGE) * _EDGE_GAIN, EMPTY_G, inside_g).astype(np.float32)
    smooth = ndimage.gaussian_filter(least, 1.5)
    normals = -np.stack([np.gradient(smooth, axis=axis) for axis in range(3)], axis=-1)
    normals /= np.maximum(np.linalg.norm(normals, axis=-1, keepdims=True), 1e-6)
    features = np.zeros((*shape, FEATURES), np.float32)
    features[..., 0], features[..., 1:4], features[..., 4:7] = g, FIRST_ALBEDO, FIRST_NORMAL * normals
    keep = ndimage.binary_dilation(g > FLOOR_G, iterations=1)
    size = voxel * (np.array(shape) - 1)
    counts = np.maximum(np.ceil(size / (size.max() / cells) - 1e-3), 1).astype(int)
    numbers = np.arange(np.prod(counts), dtype=np.int32).reshape(counts)
    networks = _first_networks(len(numbers.ravel()), hidden, rng)
    return shell_field(origin, voxel, features, keep, numbers, networks, np.full(3, FIRST_AMBIENT, np.float32))


def grid_over(box: Float[np.ndarray, "2 3"], across: int) -> tuple[np.ndarray, float, tuple[int, int, int]]:
    """Return origin [m], voxel side [m] and shape of a grid over a box, with a margin of one voxel."""
    voxel = float((box[1] - box[0]).max() / across)
    shape = np.ceil((box[1] - box[0]) / voxel - 1e-6).astype(int) + 3
    middle = (box[0] + box[1]) / 2
    return middle - voxel * (shape - 1) / 2, voxel, (int(shape[0]), int(shape[1]), int(shape[2]))


def shell_field(
    origin: np.ndarray, voxel: float, features: Float32[np.ndarray, "nx ny nz 8"], keep: Bool[np.ndarray, "nx ny nz"],
    cells: np.ndarray, networks: np.ndarray, ambient: np.ndarray,
) -> KiloOSF:  # fmt: skip
    """Return a field with some corners of a grid. Corners on the grid's faces stay empty, so that nothing is cut off.

    Args:
        origin: corner (0, 0, 0) of the grid [m].
        voxel: side of a voxel [m].
        features: features of all corners.
        keep: corners that belong to the shell.
        cells: number of the tiny network of each cell.
        networks: parameters of the tiny networks, from which their width follows.
        ambient: radiance of an unlit white point, per colour.
    """
    keep = keep.copy()
    for axis in range(3):
        np.moveaxis(keep, axis, 0)[[0, -1]] = False
    rows = np.concatenate([EMPTY_ROW, features[keep]]).astype(np.float32)
    hidden = next(h for h in range(1, 257) if network_size(h) == networks.shape[1])
    return KiloOSF(origin.astype(np.float32), voxel, numbered(keep), rows, cells, networks, hidden, ambient)


def reshelled(
    field: KiloOSF, keep: Bool[np.ndarray, "nx ny nz"], features: Float32[np.ndarray, "nx ny nz 8"] | None = None
) -> KiloOSF:
    """Return a field with another shell on the same grid.

    Args:
        field: field with the grid, the networks and the ambient light.
        keep: corners that belong to the shell.
        features: features of all corners; the field's own by default.
    """
    features = field.rows[field.index] if features is None else features
    return shell_field(field.origin, field.voxel, features, keep, field.cells, field.networks, field.ambient)


def refine(field: KiloOSF, images: ImageSet, *, across: int, rng: np.random.Generator) -> KiloOSF:
    """Return the same field on a finer grid, only around surfaces that some view sees.

    Args:
        field: field on the coarse grid.
        images: the views.
        across: voxels along the longest side of the occupied part.
        rng: random generator, which chooses pixels if there are very many.
    """
    origin, voxel, shape = grid_over(field.extent, across)
    coarse = np.where((field.index > 0)[..., None], field.rows[field.index], 0)
    coarse[..., 0] = field.density
    # Interpolation near the shell's rim must not mix colours with empty space outside.
    nearest = ndimage.distance_transform_edt(field.index == 0, return_distances=False, return_indices=True)
    coarse[..., 1:] = coarse[tuple(np.asarray(nearest))][..., 1:]
    places = (origin[:, None] + voxel * np.indices(shape).reshape(3, -1) - field.origin[:, None]) / field.voxel
    parts = [ndimage.map_coordinates(coarse[..., c], places, order=1, mode="nearest") for c in range(FEATURES)]
    features = np.stack(parts, axis=-1).reshape(*shape, FEATURES).astype(np.float32)
    everything = shell_field(origin, voxel, features, np.ones(shape, bool), field.cells, field.networks, field.ambient)
    keep = ndimage.binary_dilation(seen_corners(everything, images, rng), iterations=2)
    cells, networks = _moved_cells(field, origin, voxel, shape)
    return shell_field(origin, voxel, features, keep, cells, networks, field.ambient)


def seen_corners(field: KiloOSF, images: ImageSet, rng: np.random.Generator) -> Bool[np.ndarray, "nx ny nz"]:
    """Return the grid corners near which some pixel's ray meets density.

    Args:
        field: field that the rays meet.
        images: the views.
        rng: random generator, which chooses pixels if there are very many.
    """
    seen = np.zeros(field.index.shape, bool)
    for places in _met(field, images, _VISIBLE_WEIGHT, rng):
        seen[tuple(np.round(places).astype(int).T)] = True
    return seen


def trim(field: KiloOSF, images: ImageSet, needed_weight: float) -> KiloOSF:
    """Remove the corners that no training view needs. The field becomes smaller and renders the same.

    Args:
        field: the trained field.
        images: its training images.
        needed_weight: smallest weight of a sample, in any view, whose corners are kept. Above 0.05 quality decreases.
    """
    used = np.zeros(field.index.shape, bool)
    for places in _met(field, images, needed_weight):
        used[tuple(np.floor(places).astype(int).T)] = True
    corners = used.copy()
    nx, ny, nz = field.index.shape
    for i, j, k in product((0, 1), repeat=3):  # a voxel needs its eight corners
        corners[i:, j:, k:] |= used[: nx - i, : ny - j, : nz - k]
    return reshelled(field, corners & (field.index > 0))


def _met(
    field: KiloOSF, images: ImageSet, min_weight: float, rng: np.random.Generator | None = None
) -> Iterator[Float32[np.ndarray, "n 3"]]:
    """Yield the samples on the pixels' rays, in voxel coordinates; `rng` chooses pixels if there are very many."""
    source = RaySource(images)
    pixels = source.silhouette_pixels()
    if rng is not None:
        pixels = rng.permutation(pixels)[:_PIXELS_LOOKED_AT]
    for part in np.array_split(pixels, max(1, len(pixels) // 50_000)):
        rays = source.batch(part)
        ts, used = march(field, rays.origins, rays.directions, step=field.voxel / 2, min_weight=min_weight)
        yield (rays.at(ts)[used] - field.origin) / field.voxel


def _moved_cells(
    field: KiloOSF, origin: np.ndarray, voxel: float, shape: tuple[int, ...]
) -> tuple[np.ndarray, np.ndarray]:
    """Return cells and networks for a box of another size: a new cell starts from the old cell at its centre."""
    counts = np.array(field.cells.shape)
    size = voxel * (np.array(shape) - 1)
    centres = origin + size * (np.moveaxis(np.indices(counts.tolist()), 0, -1).reshape(-1, 3) + 0.5) / counts
    low, high = field.box
    old = np.clip(np.floor((centres - low) / (high - low) * counts), 0, counts - 1).astype(int)
    numbers = np.arange(np.prod(counts), dtype=np.int32).reshape(counts)
    return numbers, field.networks[field.cells[tuple(old.T)]]


def _first_networks(count: int, hidden: int, rng: np.random.Generator) -> Float32[np.ndarray, "C P"]:
    """Draw the same weights for every cell, so that neighbours start in agreement; the output starts near zero."""
    parts = []
    for inputs, outputs, gain in ((NETWORK_INPUTS, hidden, 1.0), (hidden, hidden, 1.0), (hidden, 3, 0.3)):
        bound = gain * np.sqrt(3 / inputs)
        parts += [rng.uniform(-bound, bound, inputs * outputs), np.zeros(outputs)]
    return np.tile(np.concatenate(parts).astype(np.float32), (count, 1))
