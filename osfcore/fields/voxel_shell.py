"""The voxel shell of a field in training: its beginning from silhouettes, and its refinement."""

from __future__ import annotations

from itertools import product

import cv2
import numpy as np
from jaxtyping import Bool, Float, Float32
from scipy import ndimage

from osfcore.fields.kiloosf import EMPTY_G, FEATURES, FLOOR_G, NETWORK_INPUTS, KiloOSF, network_size
from osfcore.fields.ray_marching import march
from osfcore.fields.ray_sampling import RaySource, shares_of_views
from osfcore.io.image_set import ImageSet

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
    """A coarse field that fills the visual hull, grey all over.

    Args:
        images: whose silhouettes carve.
        box: of the object [m].
        across: voxels along the longest side of the box.
        cells: tiny networks along the longest side.
        hidden: their width.
        inside_g: density feature inside the hull; thin fog lets light reach what silhouettes cannot carve.
        rng: for the networks' first weights.
    """
    origin, voxel, shape = grid_over(box, across)
    points = origin + voxel * np.moveaxis(np.indices(shape), 0, -1).reshape(-1, 3)
    alphas = [cv2.GaussianBlur(a.astype(np.float32) / 255, (0, 0), _BLUR_PX) for a in images.rgba[..., 3]]
    misses = int(_MISSED_SHARE * len(alphas))
    least = shares_of_views(points.astype(np.float32), images.cameras, alphas, misses)[0].reshape(shape)
    g = np.clip((least - _HULL_EDGE) * _EDGE_GAIN, EMPTY_G, inside_g).astype(np.float32)
    smooth = ndimage.gaussian_filter(least, 1.5)
    normals = -np.stack(np.gradient(smooth), axis=-1)
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
    """Origin [m], voxel side [m] and shape of a grid over a box, one voxel wider on every side."""
    voxel = float((box[1] - box[0]).max() / across)
    shape = np.ceil((box[1] - box[0]) / voxel - 1e-6).astype(int) + 3
    middle = (box[0] + box[1]) / 2
    return middle - voxel * (shape - 1) / 2, voxel, (int(shape[0]), int(shape[1]), int(shape[2]))


def shell_field(
    origin: np.ndarray, voxel: float, features: Float32[np.ndarray, "nx ny nz 8"], keep: Bool[np.ndarray, "nx ny nz"],
    cells: np.ndarray, networks: np.ndarray, ambient: np.ndarray,
) -> KiloOSF:  # fmt: skip
    """A field of some corners of a grid; those on the grid's faces stay empty, so that nothing is cut off.

    Args:
        origin: corner (0, 0, 0) of the grid [m].
        voxel: side of a voxel [m].
        features: of all corners.
        keep: corners that belong to the shell.
        cells: number of the tiny network of each cell.
        networks: parameters of the tiny networks; their width follows from them.
        ambient: what an unlit white point sends out, per colour.
    """
    keep = keep.copy()
    for axis in range(3):
        np.moveaxis(keep, axis, 0)[[0, -1]] = False
    index = np.zeros(keep.shape, np.int32)
    index[keep] = 1 + np.arange(keep.sum(), dtype=np.int32)
    empty = np.zeros((1, FEATURES), np.float32)
    empty[0, 0] = EMPTY_G
    rows = np.concatenate([empty, features[keep]]).astype(np.float32)
    hidden = next(h for h in range(1, 257) if network_size(h) == networks.shape[1])
    return KiloOSF(origin.astype(np.float32), voxel, index, rows, cells, networks, hidden, ambient)


def refine(field: KiloOSF, images: ImageSet, *, across: int, rng: np.random.Generator) -> KiloOSF:
    """The same field on a finer grid, kept only around the surfaces that some view sees.

    Args:
        field: on the coarse grid.
        images: the views.
        across: voxels along the longest side of what is occupied.
        rng: chooses the pixels to look at, where there are very many.
    """
    origin, voxel, shape = grid_over(field.extent, across)
    coarse = np.where((field.index > 0)[..., None], field.rows[field.index], 0)
    coarse[..., 0] = field.density
    # Interpolation near the shell's rim must not mix colours with the nothing outside.
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
    """The grid corners next to which some pixel's ray finds something.

    Args:
        field: what is looked at.
        images: the views.
        rng: chooses the pixels to look at, where there are very many.
    """
    source = RaySource(images)
    pixels = source.silhouette_pixels()
    pixels = rng.permutation(pixels)[:_PIXELS_LOOKED_AT]
    seen = np.zeros(field.index.shape, bool)
    for part in np.array_split(pixels, max(1, len(pixels) // 50_000)):
        rays = source.batch(part)
        ts, used = march(field, rays.origins, rays.directions, step=field.voxel / 2, min_weight=_VISIBLE_WEIGHT)
        points = (rays.origins[:, None] + ts[..., None] * rays.directions[:, None])[used]
        corners = np.round((points - field.origin) / field.voxel).astype(int)
        seen[tuple(corners.T)] = True
    return seen


def trim(field: KiloOSF, images: ImageSet, needed_weight: float) -> KiloOSF:
    """The field without the corners that no view of its training set needs: smaller, and it renders the same.

    Args:
        field: what was trained.
        images: what it was trained on.
        needed_weight: samples that show less in every view need no corners; above 0.05 it begins to cost quality.
    """
    source = RaySource(images)
    used = np.zeros(field.index.shape, bool)
    pixels = source.silhouette_pixels()
    for part in np.array_split(pixels, max(1, len(pixels) // 50_000)):
        rays = source.batch(part)
        ts, found = march(field, rays.origins, rays.directions, step=field.voxel / 2, min_weight=needed_weight)
        points = (rays.origins[:, None] + ts[..., None] * rays.directions[:, None])[found]
        used[tuple(np.floor((points - field.origin) / field.voxel).astype(int).T)] = True
    corners = used.copy()
    nx, ny, nz = field.index.shape
    for i, j, k in product((0, 1), repeat=3):  # a voxel needs its eight corners
        corners[i:, j:, k:] |= used[: nx - i, : ny - j, : nz - k]
    keep = corners & (field.index > 0)
    features = field.rows[field.index]
    return shell_field(field.origin, field.voxel, features, keep, field.cells, field.networks, field.ambient)


def _moved_cells(
    field: KiloOSF, origin: np.ndarray, voxel: float, shape: tuple[int, ...]
) -> tuple[np.ndarray, np.ndarray]:
    """The networks for a box of another size: each new cell starts from the old cell at its centre."""
    counts = np.array(field.cells.shape)
    size = voxel * (np.array(shape) - 1)
    centres = origin + size * (np.moveaxis(np.indices(counts.tolist()), 0, -1).reshape(-1, 3) + 0.5) / counts
    low, high = field.box
    old = np.clip(np.floor((centres - low) / (high - low) * counts), 0, counts - 1).astype(int)
    numbers = np.arange(np.prod(counts), dtype=np.int32).reshape(counts)
    return numbers, field.networks[field.cells[tuple(old.T)]]


def _first_networks(count: int, hidden: int, rng: np.random.Generator) -> Float32[np.ndarray, "C P"]:
    """The same weights in every cell, so that neighbours start in agreement; the output starts near zero."""
    parts = []
    for inputs, outputs, gain in ((NETWORK_INPUTS, hidden, 1.0), (hidden, hidden, 1.0), (hidden, 3, 0.3)):
        bound = gain * np.sqrt(3 / inputs)
        parts += [rng.uniform(-bound, bound, inputs * outputs), np.zeros(outputs)]
    return np.tile(np.concatenate(parts).astype(np.float32), (count, 1))
