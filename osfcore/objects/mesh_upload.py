"""A mesh that a stranger sends: one GLB, or a zip with a mesh and the files that it names. Nothing in it is trusted."""

from __future__ import annotations

import zipfile
from pathlib import Path, PurePosixPath

from trimesh.resolvers import Resolver

from osfcore.errors import CorruptFile, shown
from osfcore.io.archives import ArchiveKind, check_zip, unpack

MAX_UNPACKED_BYTES = 1 << 30
MAX_FILES = 1000
_GLB_MAGIC, _ZIP_MAGIC = b"glTF", b"PK"
_SUFFIXES = (".obj", ".glb", ".gltf", ".ply")
_EXPECTED = "a GLB, or a zip of an OBJ with its MTL and texture"


def check_upload(file: Path) -> None:
    """Refuse at once what is neither a GLB nor a zip; this takes milliseconds.

    Raises:
        CorruptFile: if it is neither.
    """
    with file.open("rb") as source:
        magic = source.read(4)
    if magic == _GLB_MAGIC:
        return
    if not magic.startswith(_ZIP_MAGIC):
        raise CorruptFile(file, f"it is neither a GLB nor a zip; send {_EXPECTED}")
    check_zip(file, MAX_FILES)


def unpack_mesh(file: Path, out: Path) -> Path:
    """The mesh of an upload, with what it names beside it.

    Args:
        file: a GLB or a zip, whatever it is called.
        out: folder to write; must not exist.

    Returns:
        The mesh in `out`.

    Raises:
        CorruptFile: if it is neither, or the zip holds no mesh or several, is damaged, a bomb, or leads elsewhere.
        CannotWrite: if the disk is full.
    """
    check_upload(file)
    with file.open("rb") as source:
        is_glb = source.read(4) == _GLB_MAGIC
    if is_glb:
        out.mkdir()
        mesh = out / "mesh.glb"
        file.rename(mesh)
        return mesh
    inside = _mesh_in(file)
    kind = ArchiveKind("mesh", inside, (), _EXPECTED)
    return unpack(file, out, kind, MAX_UNPACKED_BYTES, MAX_FILES) / inside


def _mesh_in(archive: Path) -> PurePosixPath:
    with zipfile.ZipFile(archive) as file:
        paths = [PurePosixPath(name.replace("\\", "/")) for name in file.namelist()]
    meshes = [p for p in paths if p.suffix.lower() in _SUFFIXES and not p.name.startswith(".")]
    meshes = [p for p in meshes if p.parts[0] != "__MACOSX"]
    if not meshes:
        raise CorruptFile(archive, f"it holds no mesh; send {_EXPECTED}")
    if len(meshes) > 1:
        raise CorruptFile(archive, f"it holds {len(meshes)} meshes, {meshes[0]} and {meshes[1]} among them; send one")
    return meshes[0]


class UnpackedFiles(Resolver):
    """What a mesh may name: files under one folder, by their path from the mesh or, failing that, by their name alone.

    Args:
        root: the folder.
        mesh: where the mesh lies in it.
    """

    def __init__(self, root: Path, mesh: Path) -> None:
        self._root, self._folder = root.resolve(), mesh.resolve().parent
        self.missing: list[str] = []

    def get(self, key: str) -> bytes:
        """The contents of a file.

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
        """Nothing is written beside a stranger's mesh.

        Raises:
            PermissionError: always.
        """
        del data
        raise PermissionError(name)

    def keys(self) -> list[str]:
        """The names of all files."""
        return sorted(str(path.relative_to(self._root)) for path in self._root.rglob("*") if path.is_file())

    def namespaced(self, namespace: str) -> UnpackedFiles:
        """The same files, seen from a folder among them."""
        return UnpackedFiles(self._root, self._folder / namespace / "mesh")

    def check(self, mesh: Path) -> None:
        """Tell of what was asked for in vain.

        Raises:
            CorruptFile: if there is something.
        """
        if self.missing:
            missing = ", ".join(dict.fromkeys(self.missing))
            raise CorruptFile(mesh, f"it names {missing}, which did not come with it; put the mesh and it into one zip")
