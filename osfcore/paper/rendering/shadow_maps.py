"""Shadow mapping (Williams 1978): each object's first surface as its distant light sees it.

A map is orthographic and lies in the object's own frame: it depends on the light's direction in that frame alone, so
that objects which only slide share one. A point is in the shadow of an object if it lies behind the surface of the map.
"""
# ruff: noqa: ANN001, ANN201, D417 - compiled helpers; types are given by their callers

from __future__ import annotations

from typing import NamedTuple

import numba
import numpy as np
from jaxtyping import Float, Int

from osfcore.fields.ray_marching import inverted
from osfcore.geometry.workspace import PUSHER_HEIGHT_M, PUSHER_RADIUS_M
from osfcore.paper.fields.tiny_field import MOST_WIDTH, POSITION_INPUTS
from osfcore.paper.rendering.network_kernels import density_at, next_occupied
from osfcore.paper.rendering.packing import PackedTiny
from osfcore.render.numba_options import HELPER, KERNEL, TINY

NOTHING = np.float32(-1e9)
_DECIMALS = 2  # of a light's direction up to which objects share a map: 0.3 degrees
_OPAQUE = np.float32(0.5)
_BIAS_VOXELS = np.float32(2)


class ShadowMaps(NamedTuple):
    """M maps, and which of them each object of each scene has.

    Attributes:
        surface: M x side x side, how far the first surface lies toward the light from the middle [m]; NOTHING for none.
        axes: M x 3 x 3: the map's two axes and the direction toward the light, in the object's frame.
        centre: M x 3, middle of the map in the object's frame [m].
        radius: M, half of the map's side [m].
        bias: M, by which a point must lie behind the surface [m].
        map_of: B x N.
    """

    surface: np.ndarray
    axes: np.ndarray
    centre: np.ndarray
    radius: np.ndarray
    bias: np.ndarray
    map_of: np.ndarray


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


@numba.njit(**KERNEL)
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
                sigma, begin = density_at(
                    pack, a, o[0, 0] + t * d[0, 0], o[0, 1] + t * d[0, 1], o[0, 2] + t * d[0, 2], place, h1, h2, 0
                )
                left *= np.exp(-sigma * voxel)
                if left < _OPAQUE:
                    surface[m, row, column] = radius[m] - t
                    break
                k = next_inside(pack, a, o, d, inverse, k + 1, last, voxel)


@numba.njit(**HELPER)
def next_inside(pack, a, o, d, inverse, k, last, step):
    """As `next_occupied` for row 0, for rays that begin outside the grid."""
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
    """1 if the light reaches a point of the world past all objects but one and the pusher, else 0.

    Args:
        scene, maps: of `kernels.render_batch`.
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
    """Distance along a ray to the pusher, an upright cylinder, and whether it meets a cap; very far if it misses."""
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
