"""The paper's renderer: scenes of KiloOSFs as published, composed by eq. 3, with shadow maps."""

# ruff: noqa: ANN001, ANN201, ANN202, D417 - compiled helpers; types are given by their callers

from __future__ import annotations

from collections import namedtuple
from collections.abc import Mapping, Sequence

import numba
import numpy as np
from jaxtyping import Bool, Float, Int
from scipy import ndimage

from osfcore.errors import InvalidInput
from osfcore.fields.kiloosf import MACRO_BITS
from osfcore.fields.rays import ONE_AT_A_TIME, inverted, leave_blocks
from osfcore.fields.table import TableField
from osfcore.geometry.cameras import Camera
from osfcore.geometry.light import AMBIENT, DIFFUSE
from osfcore.geometry.poses import quaternion_to_matrix
from osfcore.geometry.workspace import PUSHER_ALBEDO, PUSHER_HEIGHT_M, PUSHER_RADIUS_M
from osfcore.objects.kernel_cache import kept_kernel
from osfcore.paper.fields import (
    DIRECTION_INPUTS,
    DIRECTION_OCTAVES,
    MOST_WIDTH,
    POSITION_INPUTS,
    POSITION_OCTAVES,
    TinyField,
    network_size,
)
from osfcore.render.kernels import FAR, HELPER, KERNEL, TINY, meet_table, pixel_ray, table_colour
from osfcore.render.renderer import plain_table, screen_boxes, z_depth
from osfcore.render.types import EXACT, MASK_OPACITY, Quality, Rendered, SceneBatch, camera_numbers, check_request

# Compiled evaluation of tiny networks along rays: next occupied sample, density, radiance transfer.
#
# Conventions of types and inlining are those of `osfcore.render.kernels`. Positions are in voxel coordinates, in
# which the corners of a field's grid are whole numbers.


_ZERO, _HALF, _ONE, _TWO = np.float32(0), np.float32(0.5), np.float32(1), np.float32(2)


@numba.njit(**HELPER)
def next_occupied(pack, a, o, d, inverse, n, k, last, step):
    """Return the next sample of a ray in an occupied voxel of field a; past `last` if there is none.

    Args:
        pack, a: fields (`PackedTiny`), and which one.
        o, d, inverse, n: rows n hold the ray's origin [voxels], direction [voxels/m], and each component inverted.
        k, last: sample to begin with, and the ray's last one; sample k lies at (k + 1/2) * step.
        step: between samples [m].
    """
    solid, blocks = pack.starts[a, 0], pack.starts[a, 1]
    nx, ny, nz = pack.shapes[a, 0], pack.shapes[a, 1], pack.shapes[a, 2]
    my, mz = pack.shapes[a, 4], pack.shapes[a, 5]
    while k <= last:
        t = (np.float32(k) + _HALF) * step
        px, py, pz = o[n, 0] + t * d[n, 0], o[n, 1] + t * d[n, 1], o[n, 2] + t * d[n, 2]
        i, j, m = min(max(int(px), 0), nx - 1), min(max(int(py), 0), ny - 1), min(max(int(pz), 0), nz - 1)
        bx, by, bz = i >> MACRO_BITS, j >> MACRO_BITS, m >> MACRO_BITS
        free = np.int64(pack.macro[blocks + (bx * my + by) * mz + bz])
        if free > 0:
            skip = leave_blocks(px, d[n, 0], inverse[n, 0], bx, free)
            skip = min(skip, leave_blocks(py, d[n, 1], inverse[n, 1], by, free))
            skip = min(skip, leave_blocks(pz, d[n, 2], inverse[n, 2], bz, free))
            k = max(k + 1, int(np.ceil((t + skip) / step - _HALF)))
            continue
        if pack.solid[solid + (i * ny + j) * nz + m] != 0:
            break
        k += 1
    return k


@numba.njit(**HELPER)
def _encode(value, c, octaves, out, at) -> None:
    """Write component c of a positional encoding (`osfcore.fields.osf.encoding`) that begins at out[at]."""
    s, co = np.sin(value), np.cos(value)
    out[at + c] = value
    for octave in range(octaves):
        out[at + 3 + 3 * octave + c] = s
        out[at + 3 + 3 * octaves + 3 * octave + c] = co
        s, co = _TWO * s * co, co * co - s * s


@numba.njit(**HELPER)
def density_at(pack, a, px, py, pz, place, h1, h2, n):
    """Return the density at a point, and where the parameters of its network begin (-1: no network, no density).

    Args:
        pack, a: fields, and which one.
        px, py, pz: the point [voxels].
        place, h1: memory.
        h2, n: row n keeps the second hidden layer, for `transfer_at`.

    Returns:
        sigma [1/m], and the offset.
    """
    nx, ny, nz = pack.shapes[a, 0], pack.shapes[a, 1], pack.shapes[a, 2]
    cx, cy, cz = pack.shapes[a, 6], pack.shapes[a, 7], pack.shapes[a, 8]
    qx = px * np.float32(cx) / np.float32(nx)
    qy = py * np.float32(cy) / np.float32(ny)
    qz = pz * np.float32(cz) / np.float32(nz)
    i, j, k = min(max(int(qx), 0), cx - 1), min(max(int(qy), 0), cy - 1), min(max(int(qz), 0), cz - 1)
    number = pack.cells[pack.starts[a, 2] + (i * cy + j) * cz + k]
    if number < 0:
        return _ZERO, -1
    _encode(_TWO * (qx - np.float32(i)) - _ONE, 0, POSITION_OCTAVES, place, 0)
    _encode(_TWO * (qy - np.float32(j)) - _ONE, 1, POSITION_OCTAVES, place, 0)
    _encode(_TWO * (qz - np.float32(k)) - _ONE, 2, POSITION_OCTAVES, place, 0)
    flat, width = pack.networks, pack.width
    begin = pack.starts[a, 3] + np.int64(number) * pack.parameters
    at = begin
    bias = at + POSITION_INPUTS * width
    for u in range(width):
        h1[u] = flat[bias + u]
    for m in range(POSITION_INPUTS):
        value, row = place[m], at + m * width
        for u in range(width):
            h1[u] += value * flat[row + u]
    at = bias + width
    bias = at + width * width
    for u in range(width):
        h2[n, u] = flat[bias + u]
    for m in range(width):
        value, row = max(h1[m], _ZERO), at + m * width
        for u in range(width):
            h2[n, u] += value * flat[row + u]
    at = bias + width
    s = flat[at + width * (width + 1) + width]
    for m in range(width):
        h2[n, m] = max(h2[n, m], _ZERO)
        s += h2[n, m] * flat[at + m * (width + 1) + width]
    softplus = s if s > np.float32(15) else np.log(_ONE + np.exp(s))
    return softplus * pack.scales[a, 4], begin


@numba.njit(**HELPER)
def transfer_at(pack, begin, h2, n, directions, h1, h3, out) -> None:
    """Write rho of the network that begins at `begin` into out[0:3], from its second hidden layer.

    Args:
        pack, begin: as from `density_at`.
        h2, n: its row.
        directions: the encoded light and view of one object after another.
        h1, h3: memory.
        out: result.
    """
    flat, width = pack.networks, pack.width
    at = begin + (POSITION_INPUTS + 1) * width + (width + 1) * width
    bias = at + width * (width + 1)
    for u in range(width):
        h1[u] = flat[bias + u]
    for m in range(width):
        value, row = h2[n, m], at + m * (width + 1)
        for u in range(width):
            h1[u] += value * flat[row + u]
    at = bias + width + 1
    bias = at + (width + DIRECTION_INPUTS) * width
    for u in range(width):
        h3[u] = flat[bias + u]
    for m in range(width):
        value, row = h1[m], at + m * width
        for u in range(width):
            h3[u] += value * flat[row + u]
    for m in range(DIRECTION_INPUTS):
        value, row = directions[n * DIRECTION_INPUTS + m], at + (width + m) * width
        for u in range(width):
            h3[u] += value * flat[row + u]
    at = bias + width
    bias = at + 3 * width
    z0, z1, z2 = flat[bias], flat[bias + 1], flat[bias + 2]
    for m in range(width):
        value, row = max(h3[m], _ZERO), at + 3 * m
        z0 += value * flat[row]
        z1 += value * flat[row + 1]
        z2 += value * flat[row + 2]
    out[0] = _ONE / (_ONE + np.exp(-z0))
    out[1] = _ONE / (_ONE + np.exp(-z1))
    out[2] = _ONE / (_ONE + np.exp(-z2))


# Fields of tiny networks laid end to end in flat arrays, as compiled code likes them.


class PackedTiny(namedtuple("PackedTiny", "solid macro cells networks starts shapes scales reach width parameters")):
    """F fields. `starts` says where each one begins in the flat arrays.

    Attributes:
        solid: 1 for voxels with an occupied corner.
        macro: distances between blocks of voxels and occupied ones.
        cells: numbers of networks, -1 for none.
        networks: parameters, one network after another.
        starts: F x 4: offsets into solid, macro, cells, networks.
        shapes: F x 9: voxels, blocks, cells.
        scales: F x 5: origin [m], voxel [m], density scale [1/m].
        reach: F x 6: lowest and highest corner of the occupied part, a voxel wider [m].
        width: units of the networks' layers, the same for all.
        parameters: of one network.
    """


def pack(fields: Sequence[TinyField]) -> PackedTiny:
    """Lay fields end to end.

    Raises:
        InvalidInput: if their networks differ in width.
    """
    widths = {field.width for field in fields}
    if len(widths) != 1:
        raise InvalidInput("widths of the fields' networks", sorted(widths), "the same for all fields of a scene")
    # a voxel is solid if one of its corners is occupied
    solids = [ndimage.maximum_filter(f.occupied.astype(np.uint8), size=2, origin=-1)[:-1, :-1, :-1] for f in fields]
    parts = [
        [array.ravel() for array in (solid, field.macro, field.cells, field.networks)]
        for solid, field in zip(solids, fields, strict=True)
    ]
    starts = np.zeros((len(fields), 4), np.int64)
    starts[1:] = np.cumsum([[len(array) for array in part] for part in parts], axis=0)[:-1]
    shapes = [[*solid.shape, *f.macro.shape, *f.cells.shape] for solid, f in zip(solids, fields, strict=True)]
    reach = [np.stack([f.extent[0] - f.voxel, f.extent[1] + f.voxel]).clip(*f.box).reshape(-1) for f in fields]
    return PackedTiny(
        *(np.concatenate(arrays) for arrays in zip(*parts, strict=True)),
        starts=starts,
        shapes=np.array(shapes, np.int64),
        scales=np.array([[*f.origin, f.voxel, f.density_scale] for f in fields], np.float32),
        reach=np.array(reach, np.float32),
        width=fields[0].width,
        parameters=fields[0].networks.shape[1],
    )


# Shadow mapping (Williams 1978): each object's first surface as its distant light sees it.
#
# A map is orthographic and lies in the object's own frame: it depends on the light's direction in that frame alone,
# so that objects which only slide share one. A point is in the shadow of an object if it lies behind the surface of
# the map.


NOTHING = np.float32(-1e9)
_DECIMALS = 2  # of a light's direction up to which objects share a map: 0.3 degrees
_OPAQUE = np.float32(0.5)
_BIAS_VOXELS = np.float32(2)


class ShadowMaps(namedtuple("ShadowMaps", "surface axes centre radius bias map_of")):
    """M maps, and which of them each object of each scene has.

    Attributes:
        surface: M x side x side, how far the first surface lies toward the light from the middle [m]; NOTHING for none.
        axes: M x 3 x 3: the map's two axes and the direction toward the light, in the object's frame.
        centre: M x 3, middle of the map in the object's frame [m].
        radius: M, half of the map's side [m].
        bias: M, by which a point must lie behind the surface [m].
        map_of: B x N.
    """


def shadow_maps(
    pack: PackedTiny, numbers: Int[np.ndarray, "N"], rotations: Float[np.ndarray, "B N 3 3"],
    lights: Float[np.ndarray, "B 3"], side: int,
) -> ShadowMaps:  # fmt: skip
    """Render the maps of all objects of B scenes.

    Args:
        pack: fields.
        numbers: which of them each object has.
        rotations: from the world into each object's frame.
        lights: unit vectors toward the light.
        side: of the maps [px].
    """
    local = np.einsum("bnij,bj->bni", rotations, lights)
    keys = np.concatenate([np.broadcast_to(numbers[None, :, None], (*local.shape[:2], 1)), local.round(_DECIMALS)], -1)
    rows, first, map_of = np.unique(keys.reshape(-1, 4), axis=0, return_index=True, return_inverse=True)
    which, toward = rows[:, 0].astype(np.int64), local.reshape(-1, 3)[first]
    helper = np.where(np.abs(toward[:, 2:]) < 0.9, (0.0, 0.0, 1.0), (1.0, 0.0, 0.0))
    across = np.cross(helper, toward)
    across /= np.linalg.norm(across, axis=1, keepdims=True)
    axes = np.stack([across, np.cross(toward, across), toward], axis=1).astype(np.float32)
    reach = pack.reach[which].reshape(-1, 2, 3)
    radius = (np.linalg.norm(reach[:, 1] - reach[:, 0], axis=1) / 2).astype(np.float32)
    centre = reach.mean(axis=1).astype(np.float32)
    surface = np.empty((len(which), side, side), np.float32)
    bias = (_BIAS_VOXELS * pack.scales[which, 3]).astype(np.float32)
    render_surfaces(pack, which, axes, centre, radius, surface)
    return ShadowMaps(surface, axes, centre, radius, bias, map_of.reshape(local.shape[:2]))


@kept_kernel(**KERNEL)
def render_surfaces(pack, which, axes, centre, radius, surface) -> None:
    """Fill the maps; arguments as in `ShadowMaps`, and the field of each map."""
    count, side = len(which), surface.shape[1]
    for job in numba.prange(count * side):
        m, row = job // side, job % side
        a = which[m]
        place, h1 = np.empty(POSITION_INPUTS, np.float32), np.empty(MOST_WIDTH, np.float32)
        h2 = np.empty((1, MOST_WIDTH), np.float32)
        o, d, inverse = np.empty((1, 3), np.float32), np.empty((1, 3), np.float32), np.empty((1, 3), np.float32)
        voxel = pack.scales[a, 3]
        last = int(_TWO * radius[m] / voxel)
        for column in range(side):
            u = (_TWO * (np.float32(column) + _HALF) / np.float32(side) - _ONE) * radius[m]
            v = (_TWO * (np.float32(row) + _HALF) / np.float32(side) - _ONE) * radius[m]
            for c in range(3):
                begin = centre[m, c] + u * axes[m, 0, c] + v * axes[m, 1, c] + radius[m] * axes[m, 2, c]
                o[0, c] = (begin - pack.scales[a, c]) / voxel
                d[0, c] = -axes[m, 2, c] / voxel
                inverse[0, c] = inverted(d[0, c])
            surface[m, row, column] = NOTHING
            left, k = _ONE, next_inside(pack, a, o, d, inverse, 0, last, voxel)
            while k <= last:
                t = (np.float32(k) + _HALF) * voxel
                x, y, z = o[0, 0] + t * d[0, 0], o[0, 1] + t * d[0, 1], o[0, 2] + t * d[0, 2]
                sigma, begin = density_at(pack, a, x, y, z, place, h1, h2, 0)
                left *= np.exp(-sigma * voxel)
                if left < _OPAQUE:
                    surface[m, row, column] = radius[m] - t
                    break
                k = next_inside(pack, a, o, d, inverse, k + 1, last, voxel)


@numba.njit(**HELPER)
def next_inside(pack, a, o, d, inverse, k, last, step):
    """Return what `next_occupied` does for row 0, for rays that begin outside the grid."""
    t0, t1 = _ZERO, np.float32(1e9)
    for c in range(3):
        low, high = -o[0, c] * inverse[0, c], (np.float32(pack.shapes[a, c]) - o[0, c]) * inverse[0, c]
        t0, t1 = max(t0, min(low, high)), min(t1, max(low, high))
    if t0 >= t1:
        return last + 1
    first = max(k, int(np.ceil(t0 / step - _HALF)))
    end = min(last, int(np.floor(t1 / step - _HALF)))
    found = next_occupied(pack, a, o, d, inverse, 0, first, end, step)
    return found if found <= end else last + 1


@numba.njit(**HELPER)
def light_reaches(scene, maps, b, skip, x, y, z):
    """Return 1 if the light reaches a point of the world past all objects but one and the pusher, else 0.

    Args:
        scene, maps: of `render_batch`.
        b, skip: scene, and the object that does not shade the point, or -1.
        x, y, z: the point [m].
    """
    for n in range(maps.map_of.shape[1]):
        if n == skip:
            continue
        m = maps.map_of[b, n]
        dx, dy, dz = x - scene.positions[b, n, 0], y - scene.positions[b, n, 1], z - scene.positions[b, n, 2]
        qx = scene.rotations[b, n, 0] * dx + scene.rotations[b, n, 1] * dy + scene.rotations[b, n, 2] * dz
        qy = scene.rotations[b, n, 3] * dx + scene.rotations[b, n, 4] * dy + scene.rotations[b, n, 5] * dz
        qz = scene.rotations[b, n, 6] * dx + scene.rotations[b, n, 7] * dy + scene.rotations[b, n, 8] * dz
        qx, qy, qz = qx - maps.centre[m, 0], qy - maps.centre[m, 1], qz - maps.centre[m, 2]
        u = qx * maps.axes[m, 0, 0] + qy * maps.axes[m, 0, 1] + qz * maps.axes[m, 0, 2]
        v = qx * maps.axes[m, 1, 0] + qy * maps.axes[m, 1, 1] + qz * maps.axes[m, 1, 2]
        s = qx * maps.axes[m, 2, 0] + qy * maps.axes[m, 2, 1] + qz * maps.axes[m, 2, 2]
        radius = maps.radius[m]
        if abs(u) >= radius or abs(v) >= radius:
            continue
        side = maps.surface.shape[1]
        column = int((u / radius + _ONE) * _HALF * np.float32(side))
        row = int((v / radius + _ONE) * _HALF * np.float32(side))
        if s < maps.surface[m, min(row, side - 1), min(column, side - 1)] - maps.bias[m]:
            return _ZERO
    if scene.has_pusher and skip != -2:
        lx, ly, lz = scene.lights[b, 0], scene.lights[b, 1], scene.lights[b, 2]
        t = pusher_distance(scene, b, x, y, z, lx, ly, lz)[0]
        if t < np.float32(1e8):
            return _ZERO
    return _ONE


@numba.njit(**HELPER)
def pusher_distance(scene, b, ox, oy, oz, dx, dy, dz):
    """Return the distance along a ray to the pusher, a cylinder, and whether it meets a cap; very far if it misses."""
    far = np.float32(1e9)
    x, y, z = ox - scene.pusher[b, 0], oy - scene.pusher[b, 1], oz - scene.pusher[b, 2]
    half, radius = np.float32(PUSHER_HEIGHT_M / 2), np.float32(PUSHER_RADIUS_M)
    a, h, c = dx * dx + dy * dy, x * dx + y * dy, x * x + y * y - radius * radius
    best, cap = far, False
    root = h * h - a * c
    if a > TINY and root >= _ZERO:
        t = (-h - np.sqrt(root)) / a
        if t > _ZERO and abs(z + t * dz) <= half:
            best = t
    if abs(dz) > TINY:
        t = ((half if dz < _ZERO else -half) - z) / dz
        px, py = x + t * dx, y + t * dy
        if t > _ZERO and t < best and px * px + py * py <= radius * radius:
            best, cap = t, True
    return best, cap


# Compiled compositional volume rendering of tiny networks (paper eq. 3).
#
# Sample k of every object lies at t = (k + 1/2) * step from the camera, so that densities and radiances of objects
# that overlap are summed at the same points, as eq. 3 has it:
#
#     L = sum_k T_k (1 - exp(-sigma_k step)) L_k + T_end L_behind,  sigma_k = sum_n sigma_n,  L_k = sum_n rho_n L_light


MOST_OBJECTS = 24
_RED, _GREEN, _BLUE = (np.float32(value) for value in PUSHER_ALBEDO)


class Scene(namedtuple("Scene", "rotations positions lights local_lights kept pusher has_pusher")):
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


class _Work(
    namedtuple("_Work", "o d inverse directions is_encoded h2 sigma begin ks lasts place h1 h3 rho result total")
):
    """What one thread writes on; most of it has a row for each object."""


@numba.njit(error_model="numpy")
def _workspace():
    n, f = MOST_OBJECTS, np.float32
    return _Work(
        np.empty((n, 3), f), np.empty((n, 3), f), np.empty((n, 3), f), np.empty(n * DIRECTION_INPUTS, f),
        np.zeros(n, np.bool_), np.empty((n, MOST_WIDTH), f), np.empty(n, f), np.empty(n, np.int64),
        np.empty(n, np.int64), np.empty(n, np.int64), np.empty(POSITION_INPUTS, f), np.empty(MOST_WIDTH, f),
        np.empty(MOST_WIDTH, f), np.empty(3, f), np.empty(5 + n, f), np.empty(5 + n, f),
    )  # fmt: skip


@numba.njit(**HELPER)
def _start_ray(pack, fields, scene, cameras, b, view, dx, dy, dz, boxes, row, column, far, step, work) -> None:
    """Find the ray in each object's voxel coordinates and its first occupied sample; none where its box is missed."""
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
            r, at = scene.rotations, 3 * c
            r0, r1, r2 = r[b, n, at], r[b, n, at + 1], r[b, n, at + 2]
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
        at = n * DIRECTION_INPUTS
        for c in range(3):
            _encode(scene.local_lights[b, n, c], c, DIRECTION_OCTAVES, work.directions, at)
            _encode(work.d[n, c] * voxel, c, DIRECTION_OCTAVES, work.directions, at + DIRECTION_INPUTS // 2)
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
    far = min(table_t, pusher_t)
    _start_ray(pack, fields, scene, cameras, b, view, dx, dy, dz, boxes, row, column, far, step, work)
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
                px, py, pz = o[n, 0] + t * d[n, 0], o[n, 1] + t * d[n, 1], o[n, 2] + t * d[n, 2]
                found = density_at(pack, fields[n], px, py, pz, work.place, work.h1, work.h2, n)
                work.sigma[n], work.begin[n] = found
                sigma += work.sigma[n]
        weight = left * (_ONE - np.exp(-sigma * step))
        for n in range(count):
            if work.ks[n] == k and k <= work.lasts[n]:
                if work.sigma[n] > _ZERO:
                    result[5 + n] += weight * work.sigma[n] / sigma
                    if weight > rules[1]:
                        _add_transfer(pack, fields, scene, maps, b, n, x, y, z, weight, work)
                last = work.lasts[n]
                work.ks[n] = next_occupied(pack, fields[n], work.o, work.d, work.inverse, n, k + 1, last, step)
        result[3] += weight * t
        result[4] += weight
        left -= weight
        if weight > rules[1]:
            coloured += weight
    if coloured > _ZERO:  # what was too faint to be coloured looks like the rest
        for c in range(3):
            result[c] *= result[4] / coloured
    _add_behind(table, scene, maps, directs, cameras, b, view, dx, dy, dz, table_t, pusher_t, is_cap, left, work)


@kept_kernel(**KERNEL)
def render_batch(pack, fields, table, scene, maps, directs, cameras, boxes, rules, samples, only, rgb, opacity,
                 distance) -> None:  # fmt: skip
    """Render every image of a batch.

    Args:
        pack, fields: packed fields, and that of each of N objects; table: `osfcore.render.renderer.Table`.
        scene, maps: `Scene` and `ShadowMaps`.
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


# The paper's renderer: scenes of KiloOSFs as published, composed by eq. 3, with shadow maps.
#
# It is called as `osfcore.render.renderer.SceneRenderer` is. Readings of what the paper leaves open: table and lamp
# are modelled as in ours; the pusher, a known part of the robot, is an exact cylinder; an object is left out of its
# own shadow, since rho holds that already; and where the light is blocked, an object keeps the share of its
# radiance that the table keeps there, for rho alone does not separate its ambient part.


_FINE_MAP, _COARSE_MAP = 96, 32  # sides of shadow maps [px]
_CORNERS = np.array(list(np.ndindex(2, 2, 2)), bool)


class PaperRenderer:
    """Renders scenes of known fields.

    Args:
        fields: by name.
        table: None for black surroundings.
    """

    def __init__(self, fields: Mapping[str, TinyField], table: TableField | None) -> None:
        self._fields, self._table = dict(fields), table
        self._packs: dict[tuple[str, ...], tuple[PackedTiny, np.ndarray]] = {}

    @property
    def names(self) -> tuple[str, ...]:
        """Objects that can be drawn."""
        return tuple(self._fields)

    def render(
        self,
        batch: SceneBatch,
        cameras: Sequence[Camera],
        *,
        quality: Quality = EXACT,
        outputs: frozenset[str] | set[str] = frozenset({"rgb"}),
        only: Bool[np.ndarray, "V h w"] | None = None,
    ) -> Rendered:
        """Render every scene of a batch from every camera; arguments as for `SceneRenderer.render`.

        Raises:
            UnknownName: if an object has no field here.
            InvalidInput: if cameras differ in size, an output is unknown, `only` is of another shape, or there are
                near lamps.
        """
        size = check_request(self._fields, batch, cameras, outputs)
        if batch.spots is not None:
            raise InvalidInput("light of the published renderer", "a lamp at a finite distance", "a distant one")
        if only is not None and only.shape != (len(cameras), *size):
            raise InvalidInput("shape of the pixels to look at", only.shape, f"{(len(cameras), *size)}")
        packed, numbers = self._packed(batch.names)
        rotations = np.swapaxes(quaternion_to_matrix(batch.quaternions), -1, -2)
        shape, count = (len(batch.lights), len(cameras), *size), len(batch.names)
        wants_opacity = bool({"opacity", "masks"} & set(outputs))
        rgb = np.empty((*shape, 3), np.float32)
        opacity = np.zeros((shape[0], shape[1], count, *size) if wants_opacity else (0,) * 5, np.float32)
        distance = np.empty(shape if "depth" in outputs else (0,) * 4, np.float32)
        directs = np.zeros((shape[0], 3), np.float32) if self._table is None else self._table.direct(batch.lights)
        reach = packed.reach[numbers]
        boxes_m = np.where(_CORNERS, reach[:, None, 3:], reach[:, None, :3])
        corners = np.einsum("bnji,ncj->bnci", rotations, boxes_m) + batch.positions[:, :, None]
        boxes = np.stack([screen_boxes(corners, camera)[0] for camera in cameras], axis=1)
        lenses = np.array([camera_numbers(camera) for camera in cameras]).astype(np.float32)
        step = quality.step_voxels * float(packed.scales[numbers, 3].mean()) if count else 1.0
        rules = np.array([step, quality.min_weight, quality.stop], np.float32)
        side = _COARSE_MAP if quality.one_shadow else _FINE_MAP
        mask = np.zeros((0, 0, 0), np.uint8) if only is None else np.ascontiguousarray(only).view(np.uint8)
        with ONE_AT_A_TIME:
            maps = shadow_maps(packed, numbers, rotations, batch.lights, side)
            render_batch(packed, numbers, plain_table(self._table), self._scene(batch, rotations, directs), maps,
                         directs, lenses, boxes, rules, quality.samples_per_side, mask, rgb, opacity,
                         distance)  # fmt: skip
        return Rendered(
            rgb,
            opacity if "opacity" in outputs else None,
            opacity >= MASK_OPACITY if "masks" in outputs else None,
            z_depth(distance, cameras) if "depth" in outputs else None,
        )

    def _packed(self, names: tuple[str, ...]) -> tuple[PackedTiny, np.ndarray]:
        """Return the fields of some objects, each packed once, and which of them each object has."""
        if names not in self._packs:
            different = list(dict.fromkeys(names))
            fields = [self._fields[name] for name in different] or [_nothing()]
            self._packs[names] = pack(fields), np.array([different.index(name) for name in names], np.int64)
        return self._packs[names]

    def _scene(self, batch: SceneBatch, rotations: np.ndarray, directs: np.ndarray) -> Scene:
        kept = np.full(len(batch.lights), AMBIENT, np.float32)
        if self._table is not None:
            ambient = float(self._table.ambient.mean())
            kept = (ambient / (ambient + directs.mean(axis=1))).astype(np.float32)
        pusher = np.zeros((len(batch.lights), 3)) if batch.pusher is None else batch.pusher
        matrices = rotations.reshape(*rotations.shape[:2], 9)
        local_lights = np.einsum("bnij,bj->bni", rotations, batch.lights)
        arrays = (matrices, batch.positions, batch.lights, local_lights, kept, pusher)
        # one memory layout for all batches: any other would be compiled anew
        return Scene(*(np.array(array, np.float32, order="C") for array in arrays), has_pusher=batch.pusher is not None)


def _nothing() -> TinyField:
    """Return a field that shows nothing, for scenes without objects."""
    cells, networks = np.full((1, 1, 1), -1, np.int32), np.zeros((1, network_size(1)), np.float32)
    return TinyField(np.zeros(3, np.float32), 1.0, np.zeros((2, 2, 2), bool), cells, networks, 1)
