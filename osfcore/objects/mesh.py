"""Textured meshes: read from files of strangers, brought into the object frame and checked; orientations at rest.

`read_mesh` reads what people bring, for page, REST and command line alike: glTF by `gltf`, OBJ by `obj`, the rest by
trimesh. `named_files` finds what a mesh names, and `surface` makes one texture of all colours.
"""

from __future__ import annotations

import io
import re
import shutil
import tempfile
from collections.abc import Mapping
from dataclasses import replace
from pathlib import Path, PurePath
from typing import TYPE_CHECKING, Any

import cv2
import numpy as np
from jaxtyping import Float, Int, UInt8, UInt16
from trimesh.visual.color import to_float

from osfcore.errors import CorruptFile, InvalidInput, OsfError
from osfcore.geometry.poses import quaternion_from_matrix
from osfcore.io.archives import ArchiveKind, check_zip, unpack
from osfcore.objects.asset import RestingPoses, TexturedMesh
from osfcore.objects.gltf import read_gltf
from osfcore.objects.named_files import NamedFiles
from osfcore.objects.obj import GREY, read_obj
from osfcore.objects.surface import Surface, TexturedPiece, joined, key_of, pieces_of

if TYPE_CHECKING:
    import trimesh


# A mesh that a stranger sends: one file, or a zip with a mesh and the files that it names. Nothing in it is trusted.


MAX_UNPACKED_BYTES = 1 << 30
MAX_FILES = 1000
_GLB_MAGIC, _ZIP_MAGIC = b"glTF", b"PK"
_RANKS = ((".obj", ".glb", ".gltf"), (".ply",), (".stl", ".off"))  # scans come with copies that have fewer colours
MESH_SUFFIXES = tuple(suffix for rank in _RANKS for suffix in rank)
_EXPECTED = "a GLB, PLY or STL, or a zip of an OBJ with its MTL and texture"
_ZIP = ".zip"


def check_upload(file: Path, name: str) -> str:
    """Return the format of an upload as the end of a file name, such as ".glb" or ".zip"; this takes milliseconds.

    Args:
        file: GLB and zip are known by their first bytes.
        name: what its owner calls it; all other formats are known by its end.

    Raises:
        CorruptFile: if it is of no format of meshes, or the zip is damaged.
    """
    with file.open("rb") as source:
        magic = source.read(4)
    if magic == _GLB_MAGIC:
        return ".glb"
    if magic.startswith(_ZIP_MAGIC):
        check_zip(file, MAX_FILES)
        return _ZIP
    suffix = PurePath(name).suffix.lower()
    if suffix == ".glb" or suffix not in MESH_SUFFIXES:
        raise CorruptFile(file, f"it is no mesh that can be read; send {_EXPECTED}")
    return suffix


def unpack_mesh(file: Path, out: Path, name: str) -> Path:
    """Unpack the mesh of an upload, with the files that it names beside it.

    Args:
        file: one mesh, or a zip.
        out: folder to write; must not exist.
        name: what its owner calls it.

    Returns:
        The mesh in `out`.

    Raises:
        CorruptFile: if it is neither, or the zip holds no mesh or several, is damaged, a bomb, or leads elsewhere.
        CannotWrite: if the disk is full.
    """
    suffix = check_upload(file, name)
    if suffix != _ZIP:
        out.mkdir()
        return shutil.copyfile(file, out / f"the uploaded mesh{suffix}")  # as messages call it
    paths = [p for p in check_zip(file, MAX_FILES) if p.name[:1] != "." and p.parts[0] != "__MACOSX"]
    ranked = ([p for p in paths if p.suffix.lower() in suffixes] for suffixes in _RANKS)
    meshes = next(filter(None, ranked), [])
    if not meshes:
        raise CorruptFile(file, f"it holds no mesh; send {_EXPECTED}")
    if len(meshes) > 1:
        raise CorruptFile(file, f"it holds {len(meshes)} meshes, {meshes[0]} and {meshes[1]} among them; send one")
    kind = ArchiveKind("mesh", meshes[0], (), _EXPECTED)
    return unpack(file, out, kind, MAX_UNPACKED_BYTES, MAX_FILES) / meshes[0]


# Textures without traces of their background: reduced by a coverage-weighted filter, filled around the charts.
#
# Scanned textures show their charts on black. A plain filter or mip map would pull that black into the charts'
# rims; here only texels that a face covers count, and all others continue the colours of their neighbours.


MAX_TEXTURE_SIDE = 2048
_SUBPIXEL_BITS = 4
_RIM_TEXELS = 2  # JPEG mixes the background into this many texels of a chart's rim


def coverage(
    uv: Float[np.ndarray, "P 2"], faces: Int[np.ndarray, "F 3"], width: int, height: int
) -> UInt8[np.ndarray, "height width"]:
    """Return 1 for each texel that a face touches, else 0; first row at v = 1.

    Args:
        uv: texture coordinates of the vertices, v upwards; what lies outside [0, 1] is cut off.
        faces: vertex indices.
        width: of the texture [texels].
        height: of the texture [texels].
    """
    mask = np.zeros((height, width), np.uint8)
    pixels = np.stack([uv[:, 0] * width, (1 - uv[:, 1]) * height], axis=1) - 0.5
    corners = np.round(pixels * 2**_SUBPIXEL_BITS).astype(np.int32)[faces]
    for triangle in corners:
        cv2.fillConvexPoly(mask, triangle, 1, lineType=cv2.LINE_8, shift=_SUBPIXEL_BITS)
    return mask


def _pinned(
    uv: Float[np.ndarray, "P 2"], faces: Int[np.ndarray, "F 3"], width: int, height: int
) -> UInt8[np.ndarray, "height width"]:
    """Return 1 for each texel that bilinear sampling mixes for a face that is smaller than a texel.

    Such faces take one colour of a palette, whose texels must not be taken for the rim of a chart.
    """
    mask = np.zeros((height, width), np.uint8)
    corners = (np.stack([uv[:, 0] * width, (1 - uv[:, 1]) * height], axis=1) - 0.5)[faces]
    x, y = np.floor(corners[np.ptp(corners, axis=1).max(axis=1) < 1].reshape(-1, 2)).astype(int).T
    for right, below in ((0, 0), (0, 1), (1, 0), (1, 1)):
        mask[np.clip(y + below, 0, height - 1), np.clip(x + right, 0, width - 1)] = 1
    return mask


def _fill(image: Float[np.ndarray, "h w 3"], weight: Float[np.ndarray, "h w"]) -> Float[np.ndarray, "h w 3"]:
    """Give texels of no weight the smoothly interpolated colour of those that have some, by push-pull."""
    height, width = weight.shape
    if weight.all() or (height == 1 and width == 1):
        return image
    size = ((width + 1) // 2, (height + 1) // 2)
    coarse_weight = cv2.resize(weight, size, interpolation=cv2.INTER_AREA)
    coarse = cv2.resize(image * weight[..., None], size, interpolation=cv2.INTER_AREA)
    coarse /= np.maximum(coarse_weight, 1e-12)[..., None]
    coarse = _fill(coarse, (coarse_weight > 0).astype(np.float32))
    smooth = cv2.resize(coarse, (width, height), interpolation=cv2.INTER_LINEAR)
    return np.where(weight[..., None] > 0, image, smooth)


def _without_rim(covered: UInt8[np.ndarray, "h w"], texels: int) -> UInt8[np.ndarray, "h w"]:
    """Return the charts without their rims, into which the background is mixed; charts of rim alone stay."""
    inner = cv2.erode(covered, np.ones((2 * texels + 1, 2 * texels + 1), np.uint8), borderValue=1)
    near = cv2.dilate(inner, np.ones((4 * texels + 3, 4 * texels + 3), np.uint8))
    return np.maximum(inner, covered & (1 - near))


def clean_texture(
    texture: UInt8[np.ndarray, "h w 3"],
    uv: Float[np.ndarray, "P 2"],
    faces: Int[np.ndarray, "F 3"],
    max_side: int = MAX_TEXTURE_SIDE,
) -> UInt8[np.ndarray, "h2 w2 3"]:
    """Return the texture, reduced if need be, with everything outside the charts filled from their rims.

    A covered texel of the result is the mean of the covered texels beneath it. A texture of which no face covers
    anything comes back as it is.

    Args:
        texture: RGB.
        uv: texture coordinates of the vertices, v upwards.
        faces: vertex indices.
        max_side: longest side of the result [texels].
    """
    height, width = texture.shape[:2]
    covered, pinned = coverage(uv, faces, width, height), _pinned(uv, faces, width, height)
    if not covered.any():
        return texture
    inner = _without_rim(covered | pinned, _RIM_TEXELS if max(height, width) > max_side else 1)
    weight = (inner | pinned).astype(np.float32)
    image = texture.astype(np.float32)
    scale = max_side / max(height, width)
    if scale < 1:
        target = (max(round(width * scale), 1), max(round(height * scale), 1))
        reduced = cv2.resize(image * weight[..., None], target, interpolation=cv2.INTER_AREA)
        weight = cv2.resize(weight, target, interpolation=cv2.INTER_AREA)
        image = reduced / np.maximum(weight, 1e-12)[..., None]
    return np.clip(np.round(_fill(image, weight)), 0, 255).astype(np.uint8)


# MuJoCo's binary mesh format: four int32 counts (vertices, normals, texture coordinates, faces), then
# float32 vertices, normals and texture coordinates, then int32 faces. Its v runs downwards; it is turned to run upwards
# as in OBJ.


_HEADER_BYTES = 16
_MAX_COUNT = 10_000_000


def read_msh(path: Path) -> TexturedMesh:
    """Read a MuJoCo .msh file [m] that has one texture coordinate a vertex, with its texture beside it as .png.

    Raises:
        CorruptFile: if the counts do not fit the length of the file or each other, or the texture cannot be read.
        InvalidInput: as `textured_mesh`.
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
    image = cv2.imread(str(path.with_suffix(".png")))
    if image is None:
        raise CorruptFile(path.with_suffix(".png"), "its texture cannot be read")
    return textured_mesh(floats[: 3 * vertices].reshape(-1, 3), indices, uv, image[..., ::-1], path)


# Orientations in which an object comes to rest on a plane.


MIN_PROBABILITY = 0.03
MAX_POSES = 12
_SAME_DOWN_RAD = 0.35  # the facets of a rolling can lie closer together than this


def resting_poses(parts: tuple[Float[np.ndarray, "_ 3"], ...]) -> RestingPoses:
    """Return the orientations at rest on a plane of a body of uniform density made of convex parts.

    Poses that differ by a turn about the vertical, or by less than 20 degrees in what points down, count as one; those
    that a random drop hardly ever ends in are left out.

    Raises:
        InvalidInput: if the parts span no volume.
    """
    import trimesh

    hulls = [trimesh.convex.convex_hull(part) for part in parts]
    volumes = np.array([hull.volume for hull in hulls])
    if not volumes.sum() > 0:
        raise InvalidInput("collision parts", "without volume", "solid bodies")
    centre = volumes @ np.array([hull.center_mass for hull in hulls]) / volumes.sum()
    whole = trimesh.convex.convex_hull(np.concatenate(parts))
    transforms, probabilities = trimesh.poses.compute_stable_poses(whole, center_mass=centre)
    downs = -transforms[:, 2, :3]
    order = np.lexsort((*np.round(downs.T, 6), -np.round(probabilities, 6)))
    kept: list[int] = []
    sums: list[float] = []
    for i in order:
        near = [k for k, j in enumerate(kept) if downs[i] @ downs[j] > np.cos(_SAME_DOWN_RAD)]
        if near:
            sums[near[0]] += float(probabilities[i])
        else:
            kept.append(int(i))
            sums.append(float(probabilities[i]))
    total = np.array(sums)
    likeliest = np.argsort(-total, kind="stable")[:MAX_POSES]
    likeliest = likeliest[total[likeliest] >= min(MIN_PROBABILITY, total.max())]
    chosen = total[likeliest]
    return RestingPoses(quaternion_from_matrix(transforms[kept, :3, :3][likeliest]), chosen / chosen.sum())


# Whatever a file holds (a scan, a modelled GLB with several materials, vertex colours only) becomes one `TexturedMesh`:
# centred, wound outward, with smooth normals across texture seams and one clean texture.


MIN_LENGTH_M, MAX_LENGTH_M = 0.005, 1.0
MAX_FACES = 200_000
_GLTF_SUFFIXES = (".glb", ".gltf")
_CREASE_RAD = np.deg2rad(50.0)  # edges sharper than this stay sharp: a box must not shade like a pillow
_MIN_THICKNESS = 1e-3  # of the longest side; thinner is a sheet, which no solver can rest on a table


class WrongMeshSize(InvalidInput):
    """A mesh that is too small or too large for a tabletop object, most often because it is in another unit.

    Args:
        extents_m: of its bounding box [m].
        source: its name in the message.
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
        path: of one of the formats `MESH_SUFFIXES`, or a zip that holds one with all that it names.
        scale: metres for one unit of the file. glTF is turned from y up to z up; other formats count as z up.
        unpacked: for what a stranger sent, the folder that holds all that the mesh may name.

    Raises:
        InvalidInput: if there is no such file, its kind is unknown or its size is not that of a tabletop object.
        CorruptFile: if it holds no usable triangles, or names what is not there.
    """
    suffix = path.suffix.lower()
    if suffix not in (*MESH_SUFFIXES, ".zip"):
        raise InvalidInput("mesh file", path.name, f"one of {', '.join(MESH_SUFFIXES)}, or a .zip of one")
    if not path.is_file():
        raise InvalidInput("mesh file", path, "a file that exists")
    if suffix == ".zip":
        with tempfile.TemporaryDirectory() as folder:
            out = Path(folder) / "unpacked"
            return read_mesh(unpack_mesh(path, out, path.name), scale, out)
    files = NamedFiles(path, unpacked)
    try:
        with np.errstate(invalid="ignore", over="ignore"):  # what is not finite is refused below
            surfaces = [s for s in _surfaces(path, files) if len(s.faces)]
        files.check()
        if not surfaces:
            raise CorruptFile(files.source, "it holds no triangles")
        for what, rows in ((name, getattr(s, name)) for s in surfaces for name in ("vertices", "colours")):
            if not np.all(np.isfinite(rows)):
                raise CorruptFile(files.source, f"it has {what} that are not finite numbers; export it again")
        _check_count(sum(len(s.faces) for s in surfaces), files.source)  # before they fill a texture
        whole = _whole(surfaces, files.source)
    except OsfError:
        raise
    except MemoryError as error:
        reason = "it needs too much memory to be read; simplify the mesh or its texture"
        raise CorruptFile(files.source, reason) from error
    except Exception as error:  # readers of six formats raise anything on damaged input
        files.check()
        reason = "it is damaged, or not as its format wants it; open it in Blender or MeshLab and export it again"
        raise CorruptFile(files.source, reason) from error
    vertices = whole.vertices * scale
    if suffix in _GLTF_SUFFIXES:
        vertices = vertices @ np.array([[1.0, 0, 0], [0, 0, 1], [0, -1, 0]])
    return textured_mesh(vertices, whole.faces, whole.uv, whole.texture, files.source, is_clean=True)


def _whole(surfaces: list[Surface], source: str) -> TexturedPiece:
    """Join surfaces; each image is cleaned before by all the faces that show it, so that none bleeds into another."""
    pieces = pieces_of(surfaces)
    shown: dict[object, list[TexturedPiece]] = {}
    for piece in pieces:
        if not np.all(np.isfinite(piece.uv)):
            raise CorruptFile(source, "it has coordinates that are not finite")
        if not piece.is_padded:
            shown.setdefault(key_of(piece.texture), []).append(piece)
    clean = {}
    for key, group in shown.items():
        faces = np.concatenate([p.uv[p.faces] for p in group])
        corners = np.arange(3 * len(faces)).reshape(-1, 3)
        clean[key] = clean_texture(group[0].texture, faces.reshape(-1, 2), corners)
    whole = joined([p if p.is_padded else replace(p, texture=clean[key_of(p.texture)], is_padded=True) for p in pieces])
    scale = MAX_TEXTURE_SIDE / max(whole.texture.shape)
    if scale >= 1:
        return whole
    return replace(whole, texture=cv2.resize(whole.texture, None, fx=scale, fy=scale, interpolation=cv2.INTER_AREA))


def _surfaces(path: Path, files: NamedFiles) -> list[Surface]:
    """Read a mesh file in its own frame and units."""
    suffix = path.suffix.lower()
    if suffix in _GLTF_SUFFIXES:
        return read_gltf(path, files)
    if suffix == ".obj":
        return read_obj(path, files, MAX_FACES)
    if suffix == ".ply":
        return _read_ply(_with_line_feeds(path.read_bytes()), files)
    import trimesh

    data = path.read_bytes()
    scene = trimesh.load_scene(io.BytesIO(data), file_type=suffix[1:], process=False)
    return [_surface(mesh, data[:80]) for mesh in scene.dump() if isinstance(mesh, trimesh.Trimesh)]


# PLY by trimesh, but for colours: it knows them by one name, takes fractions and bytes alone, and mixes up those of
# polygons with those of their triangles.

_PLY_COLOURS = (("red", "green", "blue"), ("diffuse_red", "diffuse_green", "diffuse_blue"), ("r", "g", "b"))
_PLY_CORNERS = ("vertex_indices", "vertex_index")


def _read_ply(data: bytes, files: NamedFiles) -> list[Surface]:
    """Return what a PLY shows: its image, else colours of vertices, else those of faces, else grey."""
    from trimesh.exchange.ply import load_ply
    from trimesh.geometry import triangulate_quads

    image = _ply_image(data, files)
    read: Any = load_ply(io.BytesIO(data), skip_materials=True, fix_texture=image is not None)
    if read.get("faces") is None:
        return []
    vertices, faces = np.asarray(read["vertices"], float), triangulate_quads(read["faces"])
    uv = getattr(read.get("visual"), "uv", None)
    if image is not None and uv is not None and len(uv) == len(vertices):
        return [Surface(vertices, faces, np.ones((len(faces), 3, 3)), np.asarray(uv, float), image)]
    elements = read["metadata"]["_ply_raw"]
    by_vertex, by_face = (_ply_colours(elements[name]) for name in ("vertex", "face"))
    if by_vertex is not None:
        return [Surface(vertices, faces, by_vertex[faces])]
    if by_face is None:
        return [Surface(vertices, faces, np.full((len(faces), 3, 3), GREY))]
    polygons = elements["face"]["data"]
    corners = next(polygons[name] for name in _PLY_CORNERS if name in elements["face"]["properties"])
    counts = [len(row) for row in (corners["f1"] if corners.dtype.names else corners)]
    numbers = triangulate_quads([[number] * count for number, count in enumerate(counts)])  # of the triangles' polygons
    return [Surface(vertices, faces, np.repeat(by_face[numbers[:, :1]], 3, axis=1))]


def _ply_colours(element: Mapping[str, Any]) -> Float[np.ndarray, "P 3"] | None:
    """Return the colours of an element of a PLY as fractions; None if it has none."""
    names = next((names for names in _PLY_COLOURS if set(names) <= element["properties"].keys()), None)
    if names is None:
        return None
    colours = np.column_stack([np.ravel(element["data"][name]) for name in names])
    most = np.nanmax(colours)
    if colours.dtype.kind == "f":
        return colours / (255.0 if most > 1 else 1.0)
    return colours / (255.0 if most <= 255 else 65535.0)


def _with_line_feeds(ply: bytes) -> bytes:
    """Return a PLY whose lines end in carriage returns alone with the line ends that trimesh reads."""
    head, mark, body = ply.partition(b"end_header\r")
    if not mark or body.startswith(b"\n"):
        return ply
    is_text = b"format ascii" in head
    return (head + mark).replace(b"\r", b"\n") + (body.replace(b"\r", b"\n") if is_text else body)


def _ply_image(ply: bytes, files: NamedFiles) -> UInt8[np.ndarray, "h w 3"] | None:
    """Return the image that a PLY names in a comment, as MeshLab writes it."""
    header = ply[: ply.find(b"end_header")].decode("utf-8", errors="replace")
    names = re.findall(r"(?im)^comment\s+TextureFile\s+(.*\S)", header)
    if len(names) > 1:
        raise CorruptFile(files.source, f"it has {len(names)} textures, which are read of OBJ and glTF only")
    return files.image(names[0]) if names else None


def _surface(mesh: trimesh.Trimesh, head: bytes) -> Surface:
    """Return what trimesh read with its colours, else grey.

    Args:
        mesh: as trimesh has it.
        head: the first 80 bytes of the file, where STL notes how its colours are meant.
    """
    vertices, faces = np.asarray(mesh.vertices, float), np.asarray(mesh.faces, np.int64)
    visual: Any = mesh.visual  # trimesh's kinds of visuals share no base with these attributes
    by_vertex = visual.vertex_colors if visual.kind == "vertex" else mesh.vertex_attributes.get("color")
    by_face = visual.face_colors if visual.kind == "face" else mesh.face_attributes.get("color")
    if by_vertex is not None and len(by_vertex) == len(vertices):
        colours = to_float(by_vertex)[faces, :3]
    elif by_face is not None:
        colours = np.repeat(to_float(by_face)[:, None, :3], 3, axis=1)
    elif "stl" in mesh.face_attributes:
        colours = np.repeat(_stl_colours(mesh.face_attributes["stl"], head)[:, None], 3, axis=1)
    else:
        colours = np.full((len(faces), 3, 3), GREY)
    return Surface(vertices, faces, colours)


def _stl_colours(attributes: UInt16[np.ndarray, "F"], head: bytes) -> Float[np.ndarray, "F 3"]:
    """Return the colours of faces in the spare 16 bits of a binary STL, grey where there is none.

    Five bits a colour. Magics notes COLOR= and a colour for the faces whose highest bit is set, and begins with red;
    others (VisCAM, SolidView, MeshLab) begin with blue, and set the highest bit where there is a colour.
    """
    levels = (attributes[:, None].astype(int) >> np.array([0, 5, 10]) & 31) / 31
    is_high = (attributes >> 15 == 1)[:, None]
    of_magics = re.search(rb"COLOR=(...)", head, re.DOTALL)
    if of_magics:
        return np.where(is_high, np.frombuffer(of_magics[1], np.uint8) / 255, levels)
    return np.where(is_high, levels[:, ::-1], GREY)


def textured_mesh(
    vertices: Float[np.ndarray, "P 3"],
    faces: Int[np.ndarray, "F 3"],
    uv: Float[np.ndarray, "P 2"],
    texture: UInt8[np.ndarray, "h w 3"],
    source: Path | str,
    *,
    is_clean: bool = False,
) -> TexturedMesh:
    """Return the mesh in the object frame: centred, wound outward, with smooth normals and a clean texture.

    Args:
        vertices: in any frame with z up [m].
        faces: vertex indices.
        uv: in [0, 1], v upwards.
        texture: RGB.
        source: its name in messages.
        is_clean: whether the texture can stay as it is.

    Raises:
        CorruptFile: if there are no triangles, numbers are not finite, indices point nowhere or it is flat.
        InvalidInput: if it is under 5 mm or over 1 m long, or has too many triangles.
    """
    vertices, faces, uv = np.asarray(vertices, float), np.asarray(faces, np.int64), np.asarray(uv, float)
    if len(faces) == 0 or len(vertices) == 0:
        raise CorruptFile(source, "it holds no triangles")
    if faces.min() < 0 or faces.max() >= len(vertices):
        raise CorruptFile(source, "its faces name vertices that do not exist")
    used, inverse = np.unique(faces, return_inverse=True)  # others would move the bounding box
    vertices, faces, uv = vertices[used], inverse.reshape(faces.shape), uv[used]
    if not np.all(np.isfinite(vertices)) or not np.all(np.isfinite(uv)):
        raise CorruptFile(source, "it has coordinates that are not finite")
    _check_count(len(faces), source)
    low, high = vertices.min(axis=0), vertices.max(axis=0)
    longest = float((high - low).max())
    if not MIN_LENGTH_M <= longest <= MAX_LENGTH_M:
        raise WrongMeshSize(high - low, source)
    if (high - low).min() < _MIN_THICKNESS * longest:
        raise CorruptFile(source, "it is flat and encloses no volume")
    vertices = vertices - (low + high) / 2
    welded, weld = _weld(vertices)
    a, b, c = weld[faces].T
    faces = faces[(a != b) & (b != c) & (c != a) & (np.linalg.norm(_normals(welded, weld[faces]), axis=1) > 0)]
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


def _check_count(faces: int, source: Path | str) -> None:
    if faces > MAX_FACES:
        raise InvalidInput(f"number of triangles of {source}", faces, f"at most {MAX_FACES}; simplify the mesh")


def _weld(vertices: Float[np.ndarray, "P 3"]) -> tuple[Float[np.ndarray, "Q 3"], Int[np.ndarray, "P"]]:
    """Return the distinct positions, and for each vertex the index of its position."""
    grid = np.round(vertices / (1e-6 * np.ptp(vertices, axis=0).max())).astype(np.int64)
    _, first, inverse = np.unique(grid, axis=0, return_index=True, return_inverse=True)
    return vertices[first], inverse.reshape(-1)


def _normals(points: Float[np.ndarray, "Q 3"], faces: Int[np.ndarray, "F 3"]) -> Float[np.ndarray, "F 3"]:
    """Return the normals of faces, as long as twice their areas."""
    a, b, c = (points[faces[:, i]] for i in range(3))
    return np.cross(b - a, c - a)


def _outward(
    points: Float[np.ndarray, "Q 3"], weld: Int[np.ndarray, "P"], faces: Int[np.ndarray, "F 3"]
) -> Int[np.ndarray, "F 3"]:
    """Return the same faces, each counter-clockwise seen from outside."""
    import trimesh

    mesh = trimesh.Trimesh(points, weld[faces], process=False)
    before = _normals(points, weld[faces])
    if not mesh.is_winding_consistent:
        trimesh.repair.fix_winding(mesh)
    trimesh.repair.fix_inversion(mesh, multibody=mesh.is_watertight and mesh.body_count > 1)
    flipped = np.einsum("ij,ij->i", before, _normals(points, np.asarray(mesh.faces))) < 0
    return np.where(flipped[:, None], faces[:, ::-1], faces)


def _split_at_creases(
    points: Float[np.ndarray, "Q 3"], weld: Int[np.ndarray, "P"], faces: Int[np.ndarray, "F 3"]
) -> tuple[Int[np.ndarray, "R"], Int[np.ndarray, "R"], Int[np.ndarray, "F 3"]]:
    """Split vertices at sharp edges: one for each smooth patch that meets there.

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
    """Return unit normals: means over the faces around each group of vertices, weighted by their angle there."""
    face_normals = _normals(vertices, faces)
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
