"""Reader of MuJoCo's binary mesh format.

Four int32 counts (vertices, normals, texture coordinates, faces), then float32 vertices, normals and texture
coordinates, then int32 faces. Here v runs downwards; it is turned to run upwards as in OBJ.
"""

from dataclasses import dataclass
from pathlib import Path

import numpy as np
from jaxtyping import Float, Int

from osfcore.errors import CorruptFile

_HEADER_BYTES = 16
_MAX_COUNT = 10_000_000


@dataclass(frozen=True, eq=False, slots=True)
class MshMesh:
    """What a .msh file holds.

    Attributes:
        vertices: as in the file, [m] for the objects used here.
        uv: texture coordinates with v upwards.
        faces: vertex indices.
    """

    vertices: Float[np.ndarray, "P 3"]
    uv: Float[np.ndarray, "P 2"]
    faces: Int[np.ndarray, "F 3"]


def read_msh(path: Path) -> MshMesh:
    """Read a MuJoCo .msh file that has one texture coordinate a vertex; its normals are left out.

    Raises:
        CorruptFile: if the counts do not fit the length of the file or each other.
    """
    data = path.read_bytes()
    if len(data) < _HEADER_BYTES:
        raise CorruptFile(path, "it is too short for a .msh file")
    vertices, normals, texcoords, faces = (int(n) for n in np.frombuffer(data, "<i4", 4))
    if not 0 < vertices <= _MAX_COUNT or not 0 < faces <= _MAX_COUNT or normals not in (0, vertices):
        raise CorruptFile(path, f"it claims {vertices} vertices, {normals} normals and {faces} faces")
    if texcoords != vertices:
        raise CorruptFile(path, f"it has {texcoords} texture coordinates for {vertices} vertices")
    expected = _HEADER_BYTES + 4 * (3 * vertices + 3 * normals + 2 * texcoords + 3 * faces)
    if len(data) != expected:
        raise CorruptFile(path, f"it is {len(data)} bytes long instead of {expected}")
    floats = np.frombuffer(data, "<f4", 3 * vertices + 3 * normals + 2 * texcoords, _HEADER_BYTES)
    uv = floats[-2 * texcoords :].reshape(-1, 2).astype(np.float32)
    uv[:, 1] = 1 - uv[:, 1]
    indices = np.frombuffer(data, "<i4", 3 * faces, expected - 12 * faces).reshape(-1, 3)
    return MshMesh(floats[: 3 * vertices].reshape(-1, 3).astype(np.float32), uv, indices.astype(np.int32))
