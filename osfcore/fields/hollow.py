"""Which parts of a visual hull's surface are the object's, and which are lids over hollows that no silhouette shows.

A point of a surface has one colour and one normal, whoever looks at it: under all views and lights its brightness is
that of Lambert's law, or the ambient part of it in shadow. A point of a lid shows each view another point of the inside
behind it, for which no colour and normal can be found. So every voxel of the hull's surface gets the normal that
explains best what is seen of it, and what no normal explains is opened (Kutulakos and Seitz's photo-consistency,
with the light known). The hull holds the object: whatever it leaves in view or in the light truly is.
"""

from __future__ import annotations

import numba
import numpy as np
from jaxtyping import Bool, Float32
from scipy import ndimage

from osfcore.fields.kiloosf import KiloOSF
from osfcore.fields.rays import FIRST_AMBIENT, FIRST_NORMAL, ONE_AT_A_TIME, shell_field
from osfcore.io.image_set import ImageSet

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
    """The same field with nothing but a layer under the part of its surface on which views agree, and fog around that.

    Args:
        field: a solid visual hull.
        images: the views.
        fog_g: density feature of the fog, from which edges grow back that were opened wrongly.
    """
    solid = field.density > 0
    misfit = surface_misfit(field, images, solid)
    seen = np.isfinite(misfit)
    weight = ndimage.gaussian_filter(seen.astype(np.float32), _BLUR_VOXELS)
    smooth = ndimage.gaussian_filter(np.where(seen, misfit, 0), _BLUR_VOXELS) / np.maximum(weight, 1e-6)
    away = np.asarray(ndimage.distance_transform_edt(~_largest(seen & (smooth < MOST_MISFIT))))
    features = field.rows[field.index]
    features[..., 0] = np.where(away < _LAYER_VOXELS, features[..., 0], np.minimum(features[..., 0], fog_g))
    keep = (field.index > 0) & (away <= _FOG_VOXELS)
    return shell_field(field.origin, field.voxel, features, keep, field.cells, field.networks, field.ambient)


def without_fog(field: KiloOSF) -> KiloOSF:
    """The field without the corners that are neither opaque nor next to one that is: they can never become so again."""
    keep = np.asarray(ndimage.binary_dilation(field.density > _OPAQUE_G), bool) & (field.index > 0)
    features = field.rows[field.index]
    return shell_field(field.origin, field.voxel, features, keep, field.cells, field.networks, field.ambient)


def _largest(mask: Bool[np.ndarray, "nx ny nz"]) -> Bool[np.ndarray, "nx ny nz"]:
    """The largest piece, over small gaps: an object is in one, while the middle of a lid may look right and float."""
    joined = np.asarray(ndimage.binary_dilation(mask, np.ones((3, 3, 3)), iterations=_GAP_VOXELS))
    pieces = np.zeros(mask.shape, np.int32)
    if not ndimage.label(joined, output=pieces):
        return mask
    return mask & (pieces == 1 + np.argmax(np.bincount(pieces.ravel())[1:]))


def surface_misfit(
    field: KiloOSF, images: ImageSet, solid: Bool[np.ndarray, "nx ny nz"]
) -> Float32[np.ndarray, "nx ny nz"]:
    """How badly the best Lambertian point explains what views see of each voxel of a surface.

    The robust mean over views of e^2 / (1 + e^2), with e the difference of brightness in tolerances: 0 where all
    agree, 1 where nothing does.

    Args:
        field: gives the grid.
        images: the views.
        solid: corners of the grid that hold the object.

    Returns:
        NaN inside, outside, and where too few views look.
    """
    points = np.argwhere(solid & ~np.asarray(ndimage.binary_erosion(solid), bool))
    cameras = images.cameras
    matrices = [c.intrinsics @ c.T_world_camera.inverse().matrix()[:3] for c in cameras]
    to_pixels = np.array(matrices)
    to_pixels[..., 3] += to_pixels[..., :3] @ field.origin.astype(float)  # takes voxel coordinates
    to_pixels[..., :3] *= field.voxel
    eyes = (np.array([c.T_world_camera.position for c in cameras]) - field.origin) / field.voxel
    brightness = images.rgba[..., :3].sum(axis=-1, dtype=np.float32) / (3 * 255)
    found = np.empty(len(points), np.float32)
    single = (points, to_pixels, eyes, images.light_directions, brightness, _directions(_NORMALS))
    arrays = [np.ascontiguousarray(a, np.float32) for a in single]
    with ONE_AT_A_TIME:
        _judge(found, solid, np.ascontiguousarray(images.rgba[..., 3] >= _OPAQUE), *arrays)
    misfit = np.full(solid.shape, np.nan, np.float32)
    misfit[tuple(points.T)] = np.where(found < 0, np.nan, found)
    return misfit


def _directions(count: int) -> Float32[np.ndarray, "count 3"]:
    """Unit vectors spread evenly: a Fibonacci lattice."""
    number = np.arange(count) + 0.5
    z, angle = 1 - 2 * number / count, np.pi * (1 + np.sqrt(5)) * number
    r = np.sqrt(1 - z * z)
    return np.stack([r * np.cos(angle), r * np.sin(angle), z], axis=1).astype(np.float32)


@numba.njit(fastmath=True, error_model="numpy")
def _is_blocked(solid, x, y, z, dx, dy, dz):  # noqa: ANN001, ANN202
    """Whether something solid stands in the way from a voxel into a direction."""
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
def _brightness_at(image, opaque, to_pixels, point):  # noqa: ANN001, ANN202
    """Bilinear brightness where an image shows a point; -1 outside of it and where the background mixes in."""
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
def _look(solid, opaque, point, to_pixels, eyes, lights, brightness, seen, towards, is_lit):  # noqa: ANN001, ANN202
    """Collect what views see of a point: brightness, view's number, direction to the eye, and whether light gets there.

    Returns how many see it.
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
def _misfit(normal, lights, seen, towards, is_lit, shade):  # noqa: ANN001, ANN202
    """Robust misfit of a sheet with this normal, its albedo fitted; `shade` is scratch."""
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


@numba.njit(parallel=True, fastmath=True, error_model="numpy", cache=True, nogil=True)
def _judge(misfit, solid, opaque, points, to_pixels, eyes, lights, brightness, normals):  # noqa: ANN001, ANN202
    """The least misfit of every point over all normals; -1 where too few views look."""
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
