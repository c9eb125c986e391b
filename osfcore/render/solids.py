"""Fields of known shapes: the pusher, and slabs for tests. They need no training."""

from __future__ import annotations

from collections.abc import Callable

import numpy as np
from jaxtyping import Float

from osfcore.fields.kiloosf import EMPTY_G, FEATURES, KiloOSF, network_size
from osfcore.fields.voxel_shell import shell_field
from osfcore.geometry.light import AMBIENT, DIFFUSE
from osfcore.geometry.workspace import PUSHER_ALBEDO, PUSHER_HEIGHT_M, PUSHER_RADIUS_M

_PUSHER_VOXEL_M = 0.0025
_EDGE_G = 8.0  # g per voxel across a surface
_SOLID_G = 10.0


def pusher_field(hidden: int) -> KiloOSF:
    """The pusher, around its centre: a matte cylinder of known colour."""
    half = PUSHER_HEIGHT_M / 2

    def depth(x: Float[np.ndarray, "*s 3"]) -> Float[np.ndarray, "*s"]:
        return np.minimum(PUSHER_RADIUS_M - np.hypot(x[..., 0], x[..., 1]), half - np.abs(x[..., 2]))

    def normal(x: Float[np.ndarray, "*s 3"]) -> Float[np.ndarray, "*s 3"]:
        is_cap = half - np.abs(x[..., 2]) < PUSHER_RADIUS_M - np.hypot(x[..., 0], x[..., 1])
        wall = x * (1, 1, 0) / np.maximum(np.hypot(x[..., 0], x[..., 1]), 1e-9)[..., None]
        return np.where(is_cap[..., None], np.sign(x) * (0, 0, 1), wall)

    size = np.array([PUSHER_RADIUS_M, PUSHER_RADIUS_M, half])
    return solid_field(depth, normal, size, PUSHER_ALBEDO, voxel=_PUSHER_VOXEL_M, hidden=hidden)


def solid_field(
    depth: Callable[[np.ndarray], np.ndarray],
    normal: Callable[[np.ndarray], np.ndarray],
    half_size: Float[np.ndarray, "3"],
    albedo: tuple[float, float, float],
    *,
    voxel: float,
    hidden: int,
    g: float = _SOLID_G,
    edge_g: float = _EDGE_G,
) -> KiloOSF:
    """A matte solid under the world's lamp.

    Args:
        depth: how deep points lie inside the solid, negative outside [m].
        normal: outward unit vectors at points near the surface.
        half_size: of its box around the origin [m].
        albedo: its reflectance.
        voxel: side of the voxels [m].
        hidden: width of the (empty) networks: that of the fields it is drawn with.
        g: density feature inside.
        edge_g: how fast the density feature grows across the surface, per voxel.
    """
    count = 2 * (np.ceil(np.asarray(half_size) / voxel).astype(int) + 2) + 1
    origin = -(count - 1) / 2 * voxel
    points = origin + voxel * np.moveaxis(np.indices(count.tolist()), 0, -1)
    features = np.zeros((*count, FEATURES), np.float32)
    features[..., 0] = np.clip(edge_g * depth(points) / voxel, EMPTY_G, g)
    features[..., 1:4] = albedo
    features[..., 4:7] = DIFFUSE * normal(points)
    keep = features[..., 0] > EMPTY_G
    networks = np.zeros((1, network_size(hidden)), np.float32)
    cells = np.zeros((1, 1, 1), np.int32)
    return shell_field(origin, voxel, features, keep, cells, networks, np.full(3, AMBIENT, np.float32))
