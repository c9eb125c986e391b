"""Rays and triangles by Intel's Embree."""

from __future__ import annotations

import numpy as np
from embreex.mesh_construction import TriangleMesh
from embreex.rtcore_scene import EmbreeScene
from jaxtyping import Bool, Float, Float32, Int, Int32


class Triangles:
    """Triangles that rays meet.

    Args:
        vertices: corners.
        faces: indices of each triangle's corners.
    """

    def __init__(self, vertices: Float32[np.ndarray, "W 3"], faces: Int32[np.ndarray, "F 3"]) -> None:
        self._scene = EmbreeScene()
        TriangleMesh(self._scene, vertices, faces)
        self._scene.run(np.zeros((1, 3), np.float32), np.array([[0, 0, 1]], np.float32))  # builds the structure now

    def intersect(
        self, origins: Float[np.ndarray, "S 3"], directions: Float[np.ndarray, "S 3"]
    ) -> tuple[Float[np.ndarray, "S"], Int[np.ndarray, "S"], Float[np.ndarray, "S 2"]]:
        """Find each ray's first hit: distance [ray lengths; infinite for none], face, barycentric coordinates."""
        hits = self._scene.run(origins, directions, output=1)
        distance = np.where(hits["primID"] < 0, np.float32(np.inf), hits["tfar"])
        return distance, hits["primID"], np.stack([hits["u"], hits["v"]], axis=-1)

    def occludes(
        self, origins: Float[np.ndarray, "S 3"], directions: Float[np.ndarray, "S 3"], end: float | None = None
    ) -> Bool[np.ndarray, "S"]:
        """Return whether a triangle stands in each ray's way, up to `end` [ray lengths] if it is given."""
        return self._scene.run(origins, directions, end, query="OCCLUDED") >= 0
