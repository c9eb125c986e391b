"""Textured meshes from files, brought into the object frame and checked.

Whatever comes in (a scan, a modelled GLB with several materials, vertex colours only) leaves as one `TexturedMesh`:
centred, wound outward, with smooth normals across texture seams and one clean texture.
"""

from __future__ import annotations

from pathlib import Path

import numpy as np
from jaxtyping import Float, Int, UInt8

from osfcore.errors import CorruptFile, InvalidInput, OsfError
from osfcore.objects.asset import TexturedMesh
from osfcore.objects.mesh_colours import joined, piece_of
from osfcore.objects.texture import clean_texture

MIN_LENGTH_M, MAX_LENGTH_M = 0.005, 1.0
MAX_FACES = 200_000
MESH_SUFFIXES = (".obj", ".glb", ".gltf", ".ply", ".stl", ".off")
_Y_UP_SUFFIXES = (".glb", ".gltf")
_CREASE_RAD = np.deg2rad(50.0)  # edges sharper than this stay sharp: a box must not shade like a pillow
_MIN_THICKNESS = 1e-3  # of the longest side; thinner is a sheet, which no solver can rest on a table


class WrongMeshSize(InvalidInput):
    """A mesh that is too small or too large for a tabletop object, most often because it is in another unit.

    Args:
        extents_m: of its bounding box [m].
        source: what the message calls it.
    """

    def __init__(self, extents_m: Float[np.ndarray, "3"], source: Path | str) -> None:
        self.longest_m = float(extents_m.max())
        hint = "is it in millimetres" if self.longest_m > MAX_LENGTH_M else "is it in another unit"
        size = " x ".join(f"{e:.4g}" for e in extents_m)
        allowed = f"in metres ({hint}?), with the longest side between {MIN_LENGTH_M} and {MAX_LENGTH_M:g}"
        super().__init__(f"size [m] of {source}", size, allowed)


def read_mesh(path: Path, scale: float = 1.0, unpacked: Path | None = None) -> TexturedMesh:
    """Read a mesh file with whatever texture or colours it has.

    Args:
        path: OBJ, GLB or another format that trimesh reads; its images lie beside it or inside.
        scale: metres for one unit of the file. GLB is turned from y up to z up; other formats count as z up.
        unpacked: for what a stranger sent, the folder that holds all that the mesh may name; it must be complete.

    Raises:
        InvalidInput: if there is no such file, its kind is unknown or its size is not that of a tabletop object.
        CorruptFile: if it holds no usable triangles, or names what is not among the unpacked.
    """
    import trimesh

    if path.suffix.lower() not in MESH_SUFFIXES:
        raise InvalidInput("mesh file", path.name, f"one of {', '.join(MESH_SUFFIXES)}")
    if not path.is_file():
        raise InvalidInput("mesh file", path, "a file that exists")
    files = None
    if unpacked is not None:
        from osfcore.objects.mesh_upload import UnpackedFiles

        files = UnpackedFiles(unpacked, path)
    try:
        scene = trimesh.load_scene(path, process=False, resolver=files)
        pieces = [piece_of(g) for g in scene.dump() if isinstance(g, trimesh.Trimesh) and len(g.faces)]
    except OsfError:
        raise
    except MemoryError as error:
        raise CorruptFile(path, "it needs too much memory to be read; simplify the mesh or its texture") from error
    except Exception as error:  # a reader of ten formats raises anything on damaged input
        if files is not None:
            files.check(path)
        raise CorruptFile(path, f"it cannot be read as a mesh ({type(error).__name__})") from error
    if files is not None:
        files.check(path)
    if not pieces:
        raise CorruptFile(path, "it holds no triangles")
    whole = joined(pieces)
    vertices = np.asarray(whole.vertices, float) * scale
    if path.suffix.lower() in _Y_UP_SUFFIXES:
        vertices = vertices @ np.array([[1.0, 0, 0], [0, 0, 1], [0, -1, 0]])
    return textured_mesh(vertices, whole.faces, whole.uv, whole.texture, path, is_clean=whole.is_padded)


def textured_mesh(
    vertices: Float[np.ndarray, "P 3"],
    faces: Int[np.ndarray, "F 3"],
    uv: Float[np.ndarray, "P 2"],
    texture: UInt8[np.ndarray, "h w 3"],
    source: Path | str,
    *,
    is_clean: bool = False,
) -> TexturedMesh:
    """The mesh in the object frame: centred, wound outward, smooth normals, clean texture.

    Args:
        vertices: in any frame with z up [m].
        faces: vertex indices.
        uv: in [0, 1], v upwards.
        texture: RGB.
        source: what the message calls it when something is wrong.
        is_clean: whether the texture can stay as it is.

    Raises:
        CorruptFile: if there are no triangles, numbers are not finite, indices point nowhere or it is flat.
        InvalidInput: if it is under 5 mm or over 1 m long, or has too many triangles.
    """
    vertices, faces, uv = np.asarray(vertices, float), np.asarray(faces, np.int64), np.asarray(uv, float)
    vertices, faces, uv = _check_triangles(vertices, faces, uv, source)
    low, high = vertices.min(axis=0), vertices.max(axis=0)
    _check_size(high - low, source)
    vertices = vertices - (low + high) / 2
    welded, weld = _weld(vertices)
    faces = faces[_has_area(welded, weld[faces])]
    if len(faces) == 0:
        raise CorruptFile(source, "all of its triangles are degenerate")
    faces = _outward(welded, weld, faces)
    texture = np.ascontiguousarray(texture)
    origin, group, faces = _split_at_creases(welded, weld, faces)
    vertices, uv = vertices[origin], uv[origin]
    return TexturedMesh(
        vertices=vertices.astype(np.float32),
        normals=_smooth_normals(vertices, group, faces).astype(np.float32),
        faces=faces.astype(np.int32),
        uv=np.clip(uv, 0, 1).astype(np.float32),
        texture=texture if is_clean else clean_texture(texture, uv, faces),
    )


def _check_triangles(
    vertices: np.ndarray, faces: np.ndarray, uv: np.ndarray, source: Path | str
) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    """The vertices that faces name, if all of them are there and finite."""
    if len(faces) == 0 or len(vertices) == 0:
        raise CorruptFile(source, "it holds no triangles")
    if faces.min() < 0 or faces.max() >= len(vertices):
        raise CorruptFile(source, "its faces name vertices that do not exist")
    vertices, faces, uv = _referenced(vertices, faces, uv)
    if not np.all(np.isfinite(vertices)) or not np.all(np.isfinite(uv)):
        raise CorruptFile(source, "it has coordinates that are not finite")
    if len(faces) > MAX_FACES:
        raise InvalidInput(f"number of triangles of {source}", len(faces), f"at most {MAX_FACES}; simplify the mesh")
    return vertices, faces, uv


def _check_size(extents: Float[np.ndarray, "3"], source: Path | str) -> None:
    longest = float(extents.max())
    if not MIN_LENGTH_M <= longest <= MAX_LENGTH_M:
        raise WrongMeshSize(extents, source)
    if extents.min() < _MIN_THICKNESS * longest:
        raise CorruptFile(source, "it is flat and encloses no volume")


def _referenced(
    vertices: Float[np.ndarray, "P 3"], faces: Int[np.ndarray, "F 3"], uv: Float[np.ndarray, "P 2"]
) -> tuple[Float[np.ndarray, "Q 3"], Int[np.ndarray, "F 3"], Float[np.ndarray, "Q 2"]]:
    """Without the vertices that no face names: they would move the bounding box."""
    used, inverse = np.unique(faces, return_inverse=True)
    return vertices[used], inverse.reshape(faces.shape), uv[used]


def _weld(vertices: Float[np.ndarray, "P 3"]) -> tuple[Float[np.ndarray, "Q 3"], Int[np.ndarray, "P"]]:
    """Distinct positions, and for each vertex the index of its position."""
    grid = np.round(vertices / (1e-6 * np.ptp(vertices, axis=0).max())).astype(np.int64)
    _, first, inverse = np.unique(grid, axis=0, return_index=True, return_inverse=True)
    return vertices[first], inverse.reshape(-1)


def _corners(points: Float[np.ndarray, "Q 3"], faces: Int[np.ndarray, "F 3"]) -> Float[np.ndarray, "F 3"]:
    a, b, c = (points[faces[:, i]] for i in range(3))
    return np.cross(b - a, c - a)


def _has_area(points: Float[np.ndarray, "Q 3"], faces: Int[np.ndarray, "F 3"]) -> np.ndarray:
    distinct = (faces[:, 0] != faces[:, 1]) & (faces[:, 1] != faces[:, 2]) & (faces[:, 2] != faces[:, 0])
    return distinct & (np.linalg.norm(_corners(points, faces), axis=1) > 0)


def _outward(
    points: Float[np.ndarray, "Q 3"], weld: Int[np.ndarray, "P"], faces: Int[np.ndarray, "F 3"]
) -> Int[np.ndarray, "F 3"]:
    """The same faces, each counter-clockwise seen from outside."""
    import trimesh

    mesh = trimesh.Trimesh(points, weld[faces], process=False)
    before = _corners(points, weld[faces])
    if not mesh.is_winding_consistent:
        trimesh.repair.fix_winding(mesh)
    trimesh.repair.fix_inversion(mesh, multibody=mesh.is_watertight and mesh.body_count > 1)
    flipped = np.einsum("ij,ij->i", before, _corners(points, np.asarray(mesh.faces))) < 0
    return np.where(flipped[:, None], faces[:, ::-1], faces)


def _split_at_creases(
    points: Float[np.ndarray, "Q 3"], weld: Int[np.ndarray, "P"], faces: Int[np.ndarray, "F 3"]
) -> tuple[Int[np.ndarray, "R"], Int[np.ndarray, "R"], Int[np.ndarray, "F 3"]]:
    """One vertex per smooth patch that meets there.

    Returns:
        For each new vertex the old one it copies and the group that shares its normal (one position, one patch), and
        the faces in new vertices.
    """
    import trimesh

    mesh = trimesh.Trimesh(points, weld[faces], process=False)
    smooth = mesh.face_adjacency[mesh.face_adjacency_angles < _CREASE_RAD]
    patches = trimesh.graph.connected_component_labels(smooth, node_count=len(faces))
    corners = np.stack([faces.reshape(-1), np.repeat(patches, 3)], axis=1)
    split, inverse = np.unique(corners, axis=0, return_inverse=True)
    shared = np.stack([weld[split[:, 0]], split[:, 1]], axis=1)
    _, group = np.unique(shared, axis=0, return_inverse=True)
    return split[:, 0], group.reshape(-1), inverse.reshape(-1, 3)


def _smooth_normals(
    vertices: Float[np.ndarray, "R 3"], group: Int[np.ndarray, "R"], faces: Int[np.ndarray, "F 3"]
) -> Float[np.ndarray, "R 3"]:
    """Unit normals: those of the faces around each group of vertices, weighted by their angle there."""
    face_normals = _corners(vertices, faces)
    face_normals /= np.linalg.norm(face_normals, axis=1, keepdims=True)
    normals = np.zeros((group.max() + 1, 3))
    for corner in range(3):
        here, after, before = (vertices[faces[:, (corner + k) % 3]] for k in range(3))
        u, w = after - here, before - here
        angle = np.arctan2(np.linalg.norm(np.cross(u, w), axis=1), np.einsum("ij,ij->i", u, w))
        np.add.at(normals, group[faces[:, corner]], angle[:, None] * face_normals)
    length = np.linalg.norm(normals, axis=1, keepdims=True)
    # Opposite faces of a sheet cancel out: any unit vector is as good.
    return np.where(length > 1e-9, normals / np.maximum(length, 1e-9), np.array([0.0, 0.0, 1.0]))[group]
