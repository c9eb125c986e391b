"""The pusher: a known cylinder, drawn, shading and colliding like everything else."""

import numpy as np

from osfcore.geometry.workspace import PUSHER_ALBEDO, PUSHER_HEIGHT_M, PUSHER_RADIUS_M
from osfcore.objects.asset import TexturedMesh

_SIDES = 96


def pusher_mesh() -> TexturedMesh:
    """The cylinder around its centre, with a round wall, flat caps and one colour."""
    angles = np.linspace(0, 2 * np.pi, _SIDES, endpoint=False)
    circle = np.stack([np.cos(angles), np.sin(angles)], axis=1)
    half = PUSHER_HEIGHT_M / 2
    rings = [np.column_stack([PUSHER_RADIUS_M * circle, np.full(_SIDES, z)]) for z in (-half, half)]
    wall = np.column_stack([circle, np.zeros(_SIDES)])
    down, up = np.tile([0.0, 0, -1], (_SIDES, 1)), np.tile([0.0, 0, 1], (_SIDES, 1))
    vertices = np.concatenate([rings[0], rings[1], rings[0], rings[1]])
    normals = np.concatenate([wall, wall, down, up])
    i = np.arange(_SIDES)
    j = (i + 1) % _SIDES
    faces = [np.stack([i, j, j + _SIDES], axis=1), np.stack([i, j + _SIDES, i + _SIDES], axis=1)]
    k = np.arange(1, _SIDES - 1)
    bottom, top = 2 * _SIDES, 3 * _SIDES
    faces.append(np.stack([np.full_like(k, bottom), bottom + k + 1, bottom + k], axis=1))
    faces.append(np.stack([np.full_like(k, top), top + k, top + k + 1], axis=1))
    texture = np.round(np.array(PUSHER_ALBEDO) * 255).astype(np.uint8).reshape(1, 1, 3)
    return TexturedMesh(
        vertices.astype(np.float32),
        normals.astype(np.float32),
        np.concatenate(faces).astype(np.int32),
        np.full((len(vertices), 2), 0.5, np.float32),
        texture,
    )
