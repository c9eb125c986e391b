"""Boxes as objects: shapes for which shadows, masses and gaps are known in closed form."""

import numpy as np
import trimesh

from osfcore.geometry.cameras import Camera
from osfcore.objects.asset import ObjectAsset, ObjectInfo, RestingPoses, Symmetry, TexturedMesh


def box_asset(name: str, size: tuple[float, float, float], *, mass_kg: float = 0.2, colour: int = 204) -> ObjectAsset:
    """A one-coloured box with flat faces that rests on its bottom."""
    box = trimesh.creation.box(size)
    corners = box.vertices[box.faces].reshape(-1, 3)
    normals = np.repeat(box.face_normals, 3, axis=0)
    mesh = TexturedMesh(
        corners.astype(np.float32),
        normals.astype(np.float32),
        np.arange(len(corners), dtype=np.int32).reshape(-1, 3),
        np.full((len(corners), 2), 0.5, np.float32),
        np.full((4, 4, 3), colour, np.uint8),
    )
    info = ObjectInfo(name, name, mass_kg, Symmetry("none"), "CC0-1.0", "tests")
    resting = RestingPoses(np.array([[1.0, 0, 0, 0]]), np.ones(1))
    return ObjectAsset(info, mesh, (np.array(box.vertices),), resting)


def slab_spans(half, origins: np.ndarray, directions: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """Where rays enter and leave a box of these half sides around the origin [ray lengths], by the slab method."""
    with np.errstate(divide="ignore"):
        near, far = np.sort([(-half - origins) / directions, (half - origins) / directions], axis=0)
    return near.max(axis=-1), far.min(axis=-1)


def table_points(camera: Camera) -> np.ndarray:
    """Where the rays through pixel centres meet the table [m]."""
    y, x = np.mgrid[: camera.height, : camera.width] + 0.5
    directions = camera.ray_directions(np.stack([x, y], axis=-1))
    origin = camera.T_world_camera.position
    return origin + directions * (-origin[2] / directions[..., 2:])
