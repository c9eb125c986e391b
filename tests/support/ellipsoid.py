"""A matte ellipsoid as a field, whose surface and colours are known."""

import numpy as np

from osfcore.render.reference import solid_field

HALF = np.array([0.03, 0.02, 0.04])
ALBEDO = (0.8, 0.5, 0.2)


def ellipsoid_field():
    return solid_field(
        lambda x: (1 - np.linalg.norm(x / HALF, axis=-1)) * HALF.min(),
        lambda x: x / HALF**2 / np.maximum(np.linalg.norm(x / HALF**2, axis=-1, keepdims=True), 1e-9),
        HALF, ALBEDO, voxel=0.002, hidden=4,
    )  # fmt: skip


def ellipsoid_normals(points):
    normals = points / HALF**2
    return normals / np.linalg.norm(normals, axis=1, keepdims=True)
