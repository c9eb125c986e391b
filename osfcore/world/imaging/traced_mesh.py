"""One textured mesh as rays meet it: intersection and occlusion by Embree, prefiltered texture lookup.

The ray structure is built once per object, in the object's own frame; scenes move rays, not meshes.
"""

from __future__ import annotations

from dataclasses import dataclass

import cv2
import numpy as np
from embreex.mesh_construction import TriangleMesh
from embreex.rtcore_scene import EmbreeScene
from jaxtyping import Bool, Float, Int

from osfcore.geometry.poses import Pose, quaternion_to_matrix
from osfcore.objects.asset import TexturedMesh

NO_HIT = np.float32(1e30)


@dataclass(frozen=True, eq=False, slots=True)
class Surface:
    """What rays hit.

    Attributes:
        normals: smooth unit normals in the object frame, turned toward the side that was hit.
        uv: texture coordinates, v upwards.
    """

    normals: Float[np.ndarray, "S 3"]
    uv: Float[np.ndarray, "S 2"]


class TracedMesh:
    """A textured mesh that answers ray queries in its own frame.

    Args:
        mesh: what to trace.
    """

    def __init__(self, mesh: TexturedMesh) -> None:
        vertices = np.ascontiguousarray(mesh.vertices, np.float32)
        faces = np.ascontiguousarray(mesh.faces, np.int32)
        self._scene = EmbreeScene()
        TriangleMesh(self._scene, vertices, faces)
        corners = vertices[faces]
        self._face_normals = np.cross(corners[:, 1] - corners[:, 0], corners[:, 2] - corners[:, 0])
        self._corner_normals = mesh.normals[faces].astype(np.float32)
        self._corner_uv = mesh.uv[faces].astype(np.float32)
        self._pyramid = _mip_pyramid(mesh.texture)
        self._texels_per_m = _texels_per_metre(mesh)
        self.bounds = np.stack([vertices.min(0), vertices.max(0)])
        self.radius_m = float(np.linalg.norm(vertices, axis=1).max())
        self._scene.run(np.zeros((1, 3), np.float32), np.array([[0, 0, 1]], np.float32))  # builds the structure now

    def intersect(
        self, origins: Float[np.ndarray, "S 3"], directions: Float[np.ndarray, "S 3"]
    ) -> tuple[Float[np.ndarray, "S"], Int[np.ndarray, "S"], Float[np.ndarray, "S 2"]]:
        """First hit of each ray: distance [ray lengths] or NO_HIT, face index, barycentric coordinates."""
        hits = self._scene.run(origins, directions, output=1)
        missed = hits["primID"] < 0
        distance = np.where(missed, NO_HIT, hits["tfar"])
        return distance, hits["primID"], np.stack([hits["u"], hits["v"]], axis=-1)

    def occludes(
        self, origins: Float[np.ndarray, "S 3"], directions: Float[np.ndarray, "S 3"], end: float | None = None
    ) -> Bool[np.ndarray, "S"]:
        """Whether the mesh stands in each ray's way, before it ends [ray lengths] if it does."""
        return self._scene.run(origins, directions, end, query="OCCLUDED") >= 0

    def surface(
        self, faces: Int[np.ndarray, "S"], barycentric: Float[np.ndarray, "S 2"], directions: Float[np.ndarray, "S 3"]
    ) -> Surface:
        """Interpolated normals and texture coordinates where rays hit.

        Args:
            faces: that were hit.
            barycentric: weights of each face's second and third corner.
            directions: of the rays in the object's frame.
        """
        u, v = barycentric[:, :1], barycentric[:, 1:]
        weights = np.concatenate([1 - u - v, u, v], axis=1)[:, :, None]
        normals = (self._corner_normals[faces] * weights).sum(axis=1)
        normals /= np.maximum(np.linalg.norm(normals, axis=1, keepdims=True), 1e-9)
        # Which side was hit is decided by the flat face: smooth normals tilt away from the eye at silhouettes.
        behind = np.einsum("ij,ij->i", self._face_normals[faces], directions) > 0
        normals[behind] *= -1
        return Surface(normals, (self._corner_uv[faces] * weights).sum(axis=1))

    def albedo(self, uv: Float[np.ndarray, "S 2"], footprint_m: float) -> Float[np.ndarray, "S 3"]:
        """Texture colours averaged over about `footprint_m` [m] on the surface; 0 takes the finest level."""
        level = float(np.log2(max(footprint_m * self._texels_per_m, 1.0)))
        level = min(level, len(self._pyramid) - 1.0)
        fine = int(level)
        colours = _bilinear(self._pyramid[fine], uv)
        if level > fine:
            colours += (level - fine) * (_bilinear(self._pyramid[fine + 1], uv) - colours)
        return colours

    def screen_box(
        self, T_camera_object: Pose, intrinsics: Float[np.ndarray, "3 3"], width: int, height: int
    ) -> tuple[int, int, int, int] | None:
        """Pixel rectangle (left, top, right, bottom; right and bottom excluded) that holds the mesh.

        None where it is out of view. The whole image where the mesh reaches behind the camera.

        Args:
            T_camera_object: pose in the camera's frame (OpenCV axes) [m].
            intrinsics: camera matrix [px].
            width: of the image [px].
            height: of the image [px].
        """
        corners = np.stack(np.meshgrid(*self.bounds.T, indexing="ij"), axis=-1).reshape(-1, 3)
        points = T_camera_object.apply(corners)
        if points[:, 2].max() <= 0:
            return None
        if points[:, 2].min() <= 1e-3:
            return 0, 0, width, height
        pixels = points @ intrinsics.T
        pixels = pixels[:, :2] / pixels[:, 2:]
        left, top = np.clip(np.floor(pixels.min(0)).astype(int), 0, (width, height))
        right, bottom = np.clip(np.ceil(pixels.max(0)).astype(int), 0, (width, height))
        return (int(left), int(top), int(right), int(bottom)) if right > left and bottom > top else None


def into_frame(
    pose: Pose, origins: Float[np.ndarray, "S 3"], directions: Float[np.ndarray, "S 3"]
) -> tuple[Float[np.ndarray, "S 3"], Float[np.ndarray, "S 3"]]:
    """World rays in the frame of an object, contiguous float32 as Embree wants them.

    Args:
        pose: T_world_object.
        origins: in the world [m].
        directions: in the world, of any length, which they keep.
    """
    rotation = quaternion_to_matrix(pose.quaternion).astype(np.float32)
    position = pose.position.astype(np.float32)
    return np.ascontiguousarray((origins - position) @ rotation), np.ascontiguousarray(directions @ rotation)


def _mip_pyramid(texture: np.ndarray) -> tuple[np.ndarray, ...]:
    """The texture and its halvings down to 1 texel, each level the area average of the one before."""
    levels = [np.ascontiguousarray(texture)]
    while max(levels[-1].shape[:2]) > 1:
        height, width = levels[-1].shape[:2]
        half = (max(width // 2, 1), max(height // 2, 1))
        levels.append(cv2.resize(levels[-1], half, interpolation=cv2.INTER_AREA))
    return tuple(levels)


def _texels_per_metre(mesh: TexturedMesh) -> float:
    """Mean texture density: square root of texture area [texel^2] over surface area [m^2]."""
    corners = mesh.vertices[mesh.faces].astype(float)
    area = np.linalg.norm(np.cross(corners[:, 1] - corners[:, 0], corners[:, 2] - corners[:, 0]), axis=1).sum()
    height, width = mesh.texture.shape[:2]
    uv = mesh.uv[mesh.faces].astype(float) * (width, height)
    a, b = uv[:, 1] - uv[:, 0], uv[:, 2] - uv[:, 0]
    return float(np.sqrt(max(np.abs(a[:, 0] * b[:, 1] - a[:, 1] * b[:, 0]).sum(), 1e-12) / max(area, 1e-12)))


def _bilinear(image: np.ndarray, uv: np.ndarray) -> np.ndarray:
    """Colours in [0, 1] of an 8-bit image at texture coordinates, clamped at its border."""
    height, width = image.shape[:2]
    count = len(uv)
    rows = -(-count // _REMAP_COLUMNS)
    x, y = np.zeros((2, rows * _REMAP_COLUMNS), np.float32)
    x[:count] = uv[:, 0] * width - 0.5
    y[:count] = (1 - uv[:, 1]) * height - 0.5
    shape = (rows, _REMAP_COLUMNS)
    flat = cv2.remap(image, x.reshape(shape), y.reshape(shape), cv2.INTER_LINEAR, borderMode=cv2.BORDER_REPLICATE)
    return flat.reshape(-1, 3)[:count].astype(np.float32) / 255
