"""From a source's files to objects in the library: fetch the catalogue's, or add a user's own."""

from __future__ import annotations

import math
from collections.abc import Iterator, Sequence
from concurrent.futures import FIRST_COMPLETED, Executor, Future, wait
from concurrent.futures.process import BrokenProcessPool
from dataclasses import dataclass
from pathlib import Path
from typing import TYPE_CHECKING

from osfcore.errors import CorruptFile, InvalidInput, UnknownName, WorkerDied
from osfcore.objects.asset import ObjectAsset, ObjectInfo, Symmetry, TexturedMesh
from osfcore.objects.asset_library import AssetLibrary, check_name
from osfcore.objects.catalogue import CATALOGUE
from osfcore.objects.download import raising_fetch_failed, temporary_folder
from osfcore.progress import Progress

if TYPE_CHECKING:
    from osfcore.objects.sources import MeshFiles, Source

MAX_MASS_KG = 20.0
MAX_TEXT = 200  # characters of a label or licence


def fetch(
    names: Sequence[str],
    source: Source,
    library: AssetLibrary,
    executor: Executor | None = None,
    *,
    force: bool = False,
) -> Iterator[Progress]:
    """Bring objects of the catalogue from a source into the library.

    Each object is written whole or not at all; those finished before a failure stay.

    Args:
        names: of the catalogue; empty for all that the source offers.
        source: where the meshes are.
        library: where the objects go; those that it has already are left alone.
        executor: does the conversion, mostly convex decomposition, of several objects at once; None for one by one.
        force: fetch also what the library has.

    Yields:
        Steps whose `total` counts the objects and one step of preparation.

    Raises:
        UnknownName: if a name is not in the catalogue or the source does not have it.
        FetchFailed: without network or disk space.
        CorruptFile: if a file of the source is damaged.
    """
    for name in names:
        if name not in CATALOGUE:
            raise UnknownName("object in the catalogue", name, CATALOGUE)
    chosen = list(dict.fromkeys(names or source.names()))
    missing = [name for name in chosen if force or not library.has(name)]
    total = len(chosen) + 1
    here = len(chosen) - len(missing)
    if not missing:
        yield Progress(total, total, f"All {len(chosen)} objects are here already")
        return
    yield Progress(here, total, f"Preparing {source.label}")
    for step in source.prepare():
        yield Progress(here, total, step.note)
    with temporary_folder(library.root, "objects") as folder:
        yield from _converted(missing, source, library, executor, folder, here + 1, total)
    yield Progress(total, total, f"{len(chosen)} objects ready")


def _converted(
    names: list[str],
    source: Source,
    library: AssetLibrary,
    executor: Executor | None,
    folder: Path,
    done: int,
    total: int,
) -> Iterator[Progress]:
    running: dict[Future[None], str] = {}
    objects = total - 1
    try:
        for name in names:
            label = CATALOGUE[name].label.lower()
            note = f"{{}} {label} ({done + len(running)} of {objects})"
            yield Progress(done, total, note.format("Getting"))
            place = folder / name
            with raising_fetch_failed(name, folder):
                place.mkdir()
            files = source.files(name, place)
            yield Progress(done, total, note.format("Converting"))
            if executor is None:
                convert(files, CATALOGUE[name], library, source.label)
                done += 1
                continue
            running[executor.submit(convert, files, CATALOGUE[name], library, source.label)] = label
        while running:
            finished, _ = wait(running, return_when=FIRST_COMPLETED)
            for future in finished:
                label = running.pop(future)
                future.result()
                done += 1
                yield Progress(done, total, f"Converted {label} ({done - 1} of {objects})")
    except BrokenProcessPool as error:  # when a result is taken, or already when the next object is handed over
        raise WorkerDied("converting objects") from error
    finally:
        for future in running:
            future.cancel()
        wait(running)  # those that run already would lose their input with the folder


def convert(files: MeshFiles, info: ObjectInfo, library: AssetLibrary, source: str) -> None:
    """Read one object's files, make its collision parts and resting orientations, and write it.

    Args:
        files: mesh and texture.
        info: the catalogue's facts about the object.
        library: where it goes, over an older one of that name.
        source: where the files came from, for people.

    Raises:
        CorruptFile: if a file is damaged.
        InvalidInput: if the mesh is not of a tabletop object's size, or encloses no volume.
        FetchFailed: if the disk is full.
    """
    library.write(make_asset(_read(files), info), source)


def make_asset(mesh: TexturedMesh, info: ObjectInfo) -> ObjectAsset:
    """The mesh with its collision parts and resting orientations.

    Raises:
        InvalidInput: if the mesh encloses no volume.
    """
    from osfcore.geometry.convex_parts import convex_parts
    from osfcore.objects.stable_poses import resting_poses

    parts = convex_parts(mesh.vertices, mesh.faces)
    return ObjectAsset(info, mesh, parts, resting_poses(parts))


@dataclass(frozen=True, slots=True)
class NewObject:
    """What a user says of an object to add.

    Attributes:
        name: what scenes call it; not one of the catalogue's.
        mass_kg: in (0, 20] [kg].
        label: name for a person; from `name` if empty.
        scale: metres for one unit of the file.
        licence: of the mesh.
    """

    name: str
    mass_kg: float
    label: str = ""
    scale: float = 1.0
    licence: str = "unknown"

    @property
    def info(self) -> ObjectInfo:
        """As the library keeps it."""
        text = self.label or self.name.replace("_", " ").replace("-", " ").capitalize()
        symmetry = Symmetry("none", reason="not examined")
        return ObjectInfo(self.name, text, float(self.mass_kg), symmetry, self.licence, "added by the user")

    def check(self) -> None:
        """Refuse what no object may be.

        Raises:
            InvalidInput: if the name is malformed or the catalogue's, or a value is out of range.
        """
        check_name(self.name)
        if self.name in CATALOGUE:
            raise InvalidInput("object name", repr(self.name), "different from the names of the catalogue")
        if not (math.isfinite(self.mass_kg) and 0 < self.mass_kg <= MAX_MASS_KG):
            raise InvalidInput("mass [kg]", self.mass_kg, f"above 0 and at most {MAX_MASS_KG:g}")
        if not (math.isfinite(self.scale) and self.scale > 0):
            raise InvalidInput("scale", self.scale, "above 0")
        for what, text in (("label", self.label), ("licence", self.licence)):
            if not text.isprintable() or len(text) > MAX_TEXT:  # unprintable: surrogates of broken encodings too
                raise InvalidInput(what, ascii(text)[:40], f"printable text of at most {MAX_TEXT} characters")


def add_object(mesh_path: Path, new: NewObject, library: AssetLibrary, *, force: bool = False) -> ObjectAsset:
    """Put a user's own textured mesh into the library.

    Args:
        mesh_path: OBJ, GLB or another format of `read_mesh`.
        new: what is said of it.
        library: where it goes.
        force: replace an object of that name.

    Raises:
        InvalidInput: if the name is malformed or taken, or mass, scale or size are out of range.
        CorruptFile: if the mesh is unusable.
        FetchFailed: if the disk is full.
    """
    new.check()
    if not force and (library.root / new.name).exists():
        raise InvalidInput(
            "object name", repr(new.name), "one that is not taken yet (or use --force to replace that object)"
        )
    from osfcore.objects.mesh import read_mesh

    asset = make_asset(read_mesh(Path(mesh_path), new.scale), new.info)
    library.write(asset, str(mesh_path))
    return asset


def _read(files: MeshFiles) -> TexturedMesh:
    from osfcore.objects.mesh import read_mesh, textured_mesh
    from osfcore.objects.mesh_colours import PLAIN_SIDE
    from osfcore.objects.msh import read_msh

    if files.mesh.suffix != ".msh":
        mesh = read_mesh(files.mesh)
        if max(mesh.texture.shape) <= PLAIN_SIDE:
            raise CorruptFile(files.mesh, "the image of its texture is missing")
        return mesh
    import cv2

    raw = read_msh(files.mesh)
    image = cv2.imread(str(files.texture)) if files.texture else None
    if image is None:
        raise CorruptFile(files.texture or files.mesh, "its texture cannot be read")
    return textured_mesh(raw.vertices, raw.faces, raw.uv, image[..., ::-1], files.mesh)
