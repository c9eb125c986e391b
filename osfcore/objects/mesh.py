"""Textured meshes: read from files of strangers, brought into the object frame and checked; orientations at rest."""

from __future__ import annotations

import zipfile
from dataclasses import dataclass
from pathlib import Path, PurePosixPath
from typing import TYPE_CHECKING, Any

import cv2
import numpy as np
from jaxtyping import Float, Int, UInt8
from trimesh.resolvers import Resolver

from osfcore.errors import CorruptFile, InvalidInput, OsfError, shown
from osfcore.geometry.poses import quaternion_from_matrix
from osfcore.io.archives import ArchiveKind, check_zip, unpack
from osfcore.objects.asset import RestingPoses, TexturedMesh

if TYPE_CHECKING:
    import trimesh


# Colours of loaded meshes as one texture: images, colour factors, vertex or face colours, several materials.


MAX_IMAGE_PIXELS = 8192 * 8192
_MAX_TILES = 4  # how often a texture may repeat along one side
PLAIN_SIDE = 4  # texels a side of the texture of a body of one colour
_CELL = 4  # texels a side of the cell that one face's vertex colours get
_GREY = (178, 178, 178)


@dataclass(frozen=True, eq=False, slots=True)
class TexturedPiece:
    """Triangles with one texture.

    Attributes:
        vertices: in the file's units.
        faces: vertex indices.
        uv: in [0, 1], v upwards.
        texture: RGB, first row at v = 1.
        is_padded: whether texels around the faces' own continue their colours already.
    """

    vertices: Float[np.ndarray, "P 3"]
    faces: Int[np.ndarray, "F 3"]
    uv: Float[np.ndarray, "P 2"]
    texture: UInt8[np.ndarray, "h w 3"]
    is_padded: bool = False


def piece_of(mesh: trimesh.Trimesh) -> TexturedPiece:
    """Return one loaded mesh with its image, its vertex or face colours, or a grey.

    Raises:
        InvalidInput: if the image has over 67 million pixels or repeats too often.
    """
    visual: Any = mesh.visual  # trimesh's kinds of visuals share no base with these attributes
    vertices, faces = np.asarray(mesh.vertices, float), np.asarray(mesh.faces, np.int64)
    uv = getattr(visual, "uv", None)
    if visual.kind == "texture":
        material = visual.material
        image = getattr(material, "image", None) or getattr(material, "baseColorTexture", None)
        factor = getattr(material, "baseColorFactor", None)
        if image is not None and uv is not None and len(uv) == len(vertices):
            if image.width * image.height > MAX_IMAGE_PIXELS:
                raise InvalidInput("texture size [px]", f"{image.width} x {image.height}", "at most 8192 x 8192")
            texture = np.asarray(image.convert("RGB"))
            if factor is not None:
                texture = np.round(texture * _rgb(factor)).astype(np.uint8)
            return _unrepeated(TexturedPiece(vertices, faces, np.asarray(uv, float), texture))
        colour = _rgb(material.main_color) * 255
    elif visual.kind in ("vertex", "face"):
        by_face = np.repeat(np.asarray(visual.face_colors)[:, None], 3, axis=1) if visual.kind == "face" else None
        colours = np.asarray(visual.vertex_colors)[faces] if by_face is None else by_face
        return _baked(vertices, faces, colours[..., :3].astype(float))
    else:
        colour = np.array(_GREY)
    texture = np.broadcast_to(np.round(colour).astype(np.uint8), (PLAIN_SIDE, PLAIN_SIDE, 3)).copy()
    return TexturedPiece(vertices, faces, np.full((len(vertices), 2), 0.5), texture)


def _rgb(colour: object) -> Float[np.ndarray, "3"]:
    """Return the first three channels in [0, 1], from bytes or fractions."""
    array = np.asarray(colour)
    return np.clip(array[:3] / 255.0 if array.dtype.kind in "ui" else array[:3].astype(float), 0, 1)


def _unrepeated(piece: TexturedPiece) -> TexturedPiece:
    """Bring texture coordinates into [0, 1], and tile the texture where a face spans several copies of it."""
    if not np.all(np.isfinite(piece.uv)) or (piece.uv.min() >= 0 and piece.uv.max() <= 1):
        return piece
    corners = piece.uv[piece.faces]
    corners = corners - np.floor(corners.min(axis=1, keepdims=True) + 1e-6)
    tiles = np.maximum(np.ceil(corners.max(axis=(0, 1)) - 1e-6), 1).astype(int)
    if tiles.max() > _MAX_TILES:
        raise InvalidInput("repetitions of the texture within one triangle", int(tiles.max()), f"at most {_MAX_TILES}")
    texture = np.tile(piece.texture, (tiles[1], tiles[0], 1))
    faces = np.arange(3 * len(piece.faces)).reshape(-1, 3)
    return TexturedPiece(piece.vertices[piece.faces].reshape(-1, 3), faces, (corners / tiles).reshape(-1, 2), texture)


def _baked(
    vertices: Float[np.ndarray, "P 3"], faces: Int[np.ndarray, "F 3"], colours: Float[np.ndarray, "F 3 3"]
) -> TexturedPiece:
    """Make a texture with a small square for each face, in which bilinear sampling gives the corners' colours."""
    across = int(np.ceil(np.sqrt(len(faces))))
    down = -(-len(faces) // across)
    index = np.arange(len(faces))
    origin = np.stack([index % across, index // across], axis=1) * _CELL
    # Corners lie on texel centres (0, 0), (2, 0), (0, 2) of the cell; the rest of the cell continues the same plane.
    y, x = np.meshgrid(np.arange(_CELL) / 2, np.arange(_CELL) / 2, indexing="ij")
    a, b, c = colours[:, 0], colours[:, 1], colours[:, 2]
    cells = a[:, None, None] + x[..., None] * (b - a)[:, None, None] + y[..., None] * (c - a)[:, None, None]
    padded = np.zeros((across * down, _CELL, _CELL, 3))
    padded[: len(faces)] = cells
    rows = padded.reshape(down, across, _CELL, _CELL, 3).transpose(0, 2, 1, 3, 4)
    texture = np.clip(np.round(rows.reshape(down * _CELL, across * _CELL, 3)), 0, 255).astype(np.uint8)
    pixel = origin[:, None] + np.array([[0.5, 0.5], [2.5, 0.5], [0.5, 2.5]])
    uv = pixel / (np.array([across, down]) * _CELL)
    uv[..., 1] = 1 - uv[..., 1]
    flat = np.arange(3 * len(faces)).reshape(-1, 3)
    return TexturedPiece(vertices[faces].reshape(-1, 3), flat, uv.reshape(-1, 2), texture, is_padded=True)


def joined(pieces: list[TexturedPiece]) -> TexturedPiece:
    """Join pieces into one, their textures (equal ones once) stacked into one image."""
    if len(pieces) == 1:
        return pieces[0]
    images = {_key(p.texture): p.texture for p in pieces}
    width = max(image.shape[1] for image in images.values())
    tops, rows, top = {}, [], 0
    for key, image in images.items():
        height = max(round(image.shape[0] * width / image.shape[1]), 1)
        rows.append(cv2.resize(image, (width, height), interpolation=cv2.INTER_LINEAR))
        tops[key] = (top, height)
        top += height
    if width * top > MAX_IMAGE_PIXELS:
        raise InvalidInput("size of all textures together [px]", f"{width} x {top}", "at most 8192 x 8192")
    uvs, faces, offset = [], [], 0
    for piece in pieces:
        start, height = tops[_key(piece.texture)]
        below = (1 - piece.uv[:, 1]) * height + start
        uvs.append(np.stack([piece.uv[:, 0], 1 - below / top], axis=1))
        faces.append(piece.faces + offset)
        offset += len(piece.vertices)
    vertices = np.concatenate([p.vertices for p in pieces])
    return TexturedPiece(vertices, np.concatenate(faces), np.concatenate(uvs), np.concatenate(rows))


def _key(texture: UInt8[np.ndarray, "h w 3"]) -> tuple[tuple[int, ...], bytes]:
    return texture.shape, texture.tobytes()


# A mesh that a stranger sends: one GLB, or a zip with a mesh and the files that it names. Nothing in it is trusted.


MAX_UNPACKED_BYTES = 1 << 30
MAX_FILES = 1000
_GLB_MAGIC, _ZIP_MAGIC = b"glTF", b"PK"
_SUFFIXES = (".obj", ".glb", ".gltf", ".ply")
_EXPECTED = "a GLB, or a zip of an OBJ with its MTL and texture"


def check_upload(file: Path) -> bool:
    """Return whether an upload is a GLB, not a zip, and refuse what is neither; this takes milliseconds.

    Raises:
        CorruptFile: if it is neither.
    """
    with file.open("rb") as source:
        magic = source.read(4)
    if magic == _GLB_MAGIC:
        return True
    if not magic.startswith(_ZIP_MAGIC):
        raise CorruptFile(file, f"it is neither a GLB nor a zip; send {_EXPECTED}")
    check_zip(file, MAX_FILES)
    return False


def unpack_mesh(file: Path, out: Path) -> Path:
    """Unpack the mesh of an upload, with the files that it names beside it.

    Args:
        file: a GLB or a zip, whatever it is called.
        out: folder to write; must not exist.

    Returns:
        The mesh in `out`.

    Raises:
        CorruptFile: if it is neither, or the zip holds no mesh or several, is damaged, a bomb, or leads elsewhere.
        CannotWrite: if the disk is full.
    """
    if check_upload(file):
        out.mkdir()
        return file.rename(out / "mesh.glb")
    with zipfile.ZipFile(file) as archive:
        paths = [PurePosixPath(name.replace("\\", "/")) for name in archive.namelist()]
    meshes = [p for p in paths if p.suffix.lower() in _SUFFIXES and p.name[0] != "." and p.parts[0] != "__MACOSX"]
    if not meshes:
        raise CorruptFile(file, f"it holds no mesh; send {_EXPECTED}")
    if len(meshes) > 1:
        raise CorruptFile(file, f"it holds {len(meshes)} meshes, {meshes[0]} and {meshes[1]} among them; send one")
    kind = ArchiveKind("mesh", meshes[0], (), _EXPECTED)
    return unpack(file, out, kind, MAX_UNPACKED_BYTES, MAX_FILES) / meshes[0]


class UnpackedFiles(Resolver):
    """The files that a mesh may name: those of one folder, by their path from the mesh or else by their name alone.

    Args:
        root: the folder.
        mesh: where the mesh lies in it.
    """

    def __init__(self, root: Path, mesh: Path) -> None:
        self._root, self._folder = root.resolve(), mesh.resolve().parent
        self.missing: list[str] = []

    def get(self, key: str) -> bytes:
        """Return the contents of a file.

        Raises:
            FileNotFoundError: if it is not among the unpacked; it is then in `missing`, too.
        """
        plain = key.strip().replace("\\", "/")
        direct = (self._folder / plain).resolve()
        if direct.is_relative_to(self._root) and direct.is_file():
            return direct.read_bytes()
        wanted = PurePosixPath(plain).name
        for path in sorted(self._root.rglob("*")):  # modellers write paths of their own machine
            if path.is_file() and path.name.lower() == wanted.lower():
                return path.read_bytes()
        self.missing.append(shown(wanted))
        raise FileNotFoundError(wanted)

    def write(self, name: str, data: object) -> None:
        """Refuse to write beside a stranger's mesh.

        Raises:
            PermissionError: always.
        """
        del data
        raise PermissionError(name)

    def keys(self) -> list[str]:
        """The names of all files."""
        return sorted(str(path.relative_to(self._root)) for path in self._root.rglob("*") if path.is_file())

    def namespaced(self, namespace: str) -> UnpackedFiles:
        """Return the same files, seen from a folder among them."""
        return UnpackedFiles(self._root, self._folder / namespace / "mesh")

    def check(self, mesh: Path) -> None:
        """Refuse a mesh that names files which did not come with it.

        Raises:
            CorruptFile: if there is one.
        """
        if self.missing:
            missing = ", ".join(dict.fromkeys(self.missing))
            raise CorruptFile(mesh, f"it names {missing}, which did not come with it; put the mesh and it into one zip")


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
    covered = coverage(uv, faces, width, height)
    if not covered.any():
        return texture
    weight = _without_rim(covered, _RIM_TEXELS if max(height, width) > max_side else 1).astype(np.float32)
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
MESH_SUFFIXES = (".obj", ".glb", ".gltf", ".ply", ".stl", ".off")
_Y_UP_SUFFIXES = (".glb", ".gltf")
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
    files = None if unpacked is None else UnpackedFiles(unpacked, path)
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
    if len(faces) > MAX_FACES:
        raise InvalidInput(f"number of triangles of {source}", len(faces), f"at most {MAX_FACES}; simplify the mesh")
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
