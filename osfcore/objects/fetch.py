"""Objects for the library: meshes from PyPI, a folder or a web server, and a user's own."""

from __future__ import annotations

import hashlib
import math
import zipfile
import zlib
from abc import ABC, abstractmethod
from collections.abc import Iterator, Sequence
from concurrent.futures import FIRST_COMPLETED, Executor, Future, wait
from concurrent.futures.process import BrokenProcessPool
from dataclasses import dataclass
from pathlib import Path
from urllib.parse import urlsplit

from osfcore.errors import CorruptFile, FetchFailed, InvalidInput, UnknownName, WorkerDied, check_known
from osfcore.io.files import put_in_place
from osfcore.objects.asset import ObjectAsset, ObjectInfo, Symmetry, TexturedMesh
from osfcore.objects.asset_library import AssetLibrary, check_name
from osfcore.objects.catalogue import CATALOGUE, DEFAULT_NAMES
from osfcore.objects.download import download, pip_download, raising_fetch_failed, temporary_folder, unpack
from osfcore.progress import Progress

# A source brings files onto this machine; `fetch` turns them into objects. Everything downloaded lands under a
# temporary name in the cache folder and is renamed once it is complete and verified.

YCB_DOWNLOAD = "https://ycb-benchmarks.s3.amazonaws.com/data/google"  # the official archives, of all objects
_LAYOUTS = ("{name}/google_16k/textured.obj", "{name}/textured.obj")


class Source(ABC):
    """A place that meshes can be fetched from.

    Attributes:
        label: name of the source in messages and in the objects' records.
    """

    label: str

    def names(self) -> tuple[str, ...]:
        """Return the objects to fetch if none are named; the default ten if the source cannot list its objects."""
        return DEFAULT_NAMES

    def prepare(self) -> Iterator[Progress]:
        """Do the work that is needed once for all objects; yield steps that count from 0 to their own total.

        Raises:
            FetchFailed: if it fails.
        """
        yield Progress(1, 1, f"Reading {self.label}")

    @abstractmethod
    def mesh(self, name: str, folder: Path) -> Path:
        """Return the mesh file of one object. It is written to `folder` unless it is on this machine already.

        It has a format that `read_mesh` reads, or is a .msh with its texture beside it as .png.

        Raises:
            UnknownName: if this source does not have the object.
            FetchFailed: if it cannot be downloaded.
            CorruptFile: if an archive is damaged.
        """


class WheelSource(Source):
    """Ten YCB objects from the wheel of MyoSuite on PyPI, downloaded with pip, never installed or imported.

    Args:
        cache: folder that keeps the wheel, so that a second fetch needs no network.
    """

    REQUIREMENT = "MyoSuite==2.8.0"
    FILE = "MyoSuite-2.8.0-py3-none-any.whl"
    SHA256 = "e974ae1eacf674d17a72a09153e06a256c795e7f6c5f76d8c4686ca71bab7558"
    BYTES = 85_000_000  # about; only for the progress bar
    FOLDER = "myosuite/simhive/YCB_sim"
    label = f"{REQUIREMENT} from PyPI"

    def __init__(self, cache: Path) -> None:
        self._cache = Path(cache)
        self.wheel = self._cache / self.FILE

    def prepare(self) -> Iterator[Progress]:
        """Download and verify the wheel unless the cache has it.

        Raises:
            FetchFailed: if there is no network, pip or disk space, or the checksum is wrong.
        """
        note = f"Checking {self.label}"
        yield Progress(0, 1, note)
        if not (self.wheel.is_file() and _sha256(self.wheel) == self.SHA256):
            with temporary_folder(self._cache, self.label) as folder:
                for got in pip_download(self.REQUIREMENT, folder):
                    share = f"{got / 1e6:.0f} of {self.BYTES / 1e6:.0f} MB"
                    yield Progress(0, 1, f"Downloading {self.label} ({share})")
                self.adopt(folder / self.FILE)
        yield Progress(1, 1, note)

    def adopt(self, path: Path) -> None:
        """Move a downloaded wheel into the cache if it is the right one.

        Raises:
            FetchFailed: if it is missing or its checksum is not the pinned one.
        """
        if not path.is_file():
            raise FetchFailed(self.label, f"pip did not deliver {self.FILE}")
        digest = _sha256(path)
        if digest != self.SHA256:
            raise FetchFailed(self.label, f"its SHA-256 is {digest} instead of {self.SHA256}")
        with raising_fetch_failed(self.label, self._cache):
            self._cache.mkdir(parents=True, exist_ok=True)
            put_in_place(path, self.wheel)

    def mesh(self, name: str, folder: Path) -> Path:
        """Return the mesh of one object, taken out of the wheel with its texture."""
        check_known(f"object in {self.label}", [name], DEFAULT_NAMES)
        mesh = folder / f"{name}.msh"
        try:
            with raising_fetch_failed(name, folder), zipfile.ZipFile(self.wheel) as wheel:
                mesh.write_bytes(wheel.read(f"{self.FOLDER}/meshes/{name}.msh"))
                mesh.with_suffix(".png").write_bytes(wheel.read(f"{self.FOLDER}/textures/{name}.png"))
        except (zipfile.BadZipFile, zlib.error, KeyError) as error:
            raise CorruptFile(self.wheel, f"it does not hold {name}") from error
        return mesh


class FolderSource(Source):
    """A folder in the layout of the YCB downloads: NAME/google_16k/textured.obj, or NAME/textured.obj.

    Args:
        folder: the folder that holds the objects' folders.

    Raises:
        InvalidInput: if there is no such folder.
    """

    def __init__(self, folder: Path) -> None:
        self._folder = Path(folder).expanduser()
        if not self._folder.is_dir():
            raise InvalidInput("source", folder, "'pypi', 'ycb', a folder that exists or an http(s) address")
        self.label = str(self._folder.resolve())

    def names(self) -> tuple[str, ...]:
        """Return the catalogue's objects that the folder holds.

        Raises:
            InvalidInput: if it holds none.
        """
        available = tuple(name for name in CATALOGUE if _mesh_in(self._folder, name))
        if not available:
            allowed = "a folder with NAME/google_16k/textured.obj in it, NAME such as 006_mustard_bottle"
            raise InvalidInput("source", self._folder, allowed)
        return available

    def mesh(self, name: str, folder: Path) -> Path:
        """Return the mesh file in its folder."""
        del folder  # nothing has to be copied
        path = _mesh_in(self._folder, name)
        if path is None:
            raise UnknownName(f"object in {self._folder}", name, (n for n in CATALOGUE if _mesh_in(self._folder, n)))
        return path


def _mesh_in(folder: Path, name: str) -> Path | None:
    """Return an object's mesh in a folder of either layout."""
    paths = (folder / layout.format(name=name) for layout in _LAYOUTS)
    return next((path for path in paths if path.is_file()), None)


class UrlSource(Source):
    """A web address with the official archives (NAME_google_16k.tgz) or with the folder layout of `FolderSource`.

    Args:
        base: http or https address of the folder.
        cache: folder in which archives are kept.

    Raises:
        InvalidInput: if it is not an http(s) address.
    """

    def __init__(self, base: str, cache: Path) -> None:
        try:
            parts = urlsplit(base)
            is_address = parts.scheme in ("http", "https") and bool(parts.hostname) and base.isascii()
        except ValueError:  # half an IPv6 address
            is_address = False
        if not is_address:
            raise InvalidInput("source", repr(base), "an address that starts with http:// or https://")
        self.label = self._base = base.rstrip("/")
        self._cache = Path(cache) / "archives" / hashlib.sha256(self._base.encode()).hexdigest()[:16]

    def mesh(self, name: str, folder: Path) -> Path:
        """Return the mesh of one object, from its archive or from single files, whichever the server has."""
        archive = self._archive(name)
        if archive is not None:
            try:
                unpack(archive, folder)
            except CorruptFile:
                archive.unlink(missing_ok=True)  # the next try asks the server again
                raise
            path = _mesh_in(folder, name)
            if path is None:
                archive.unlink(missing_ok=True)
                raise CorruptFile(archive.name, f"it holds no {name}/google_16k/textured.obj")
            return path
        for layout in _LAYOUTS:
            address = f"{self._base}/{layout.format(name=name)}"
            if download(address, folder / "textured.obj"):
                base = address.rsplit("/", 1)[0]
                for library in _named(folder / "textured.obj", "mtllib"):
                    if download(f"{base}/{library}", folder / library):
                        for image in _named(folder / library, "map_Kd"):
                            download(f"{base}/{image}", folder / image)
                return folder / "textured.obj"
        raise FetchFailed(name, f"{self._base} has neither {name}_google_16k.tgz nor {_LAYOUTS[0].format(name=name)}")

    def _archive(self, name: str) -> Path | None:
        path = self._cache / f"{name}_google_16k.tgz"
        if path.is_file():
            return path
        for address in (f"{self._base}/{path.name}", f"{self._base}/{name}/{path.name}"):
            with temporary_folder(self._cache, name) as folder:
                if download(address, folder / path.name):
                    with raising_fetch_failed(address, self._cache):
                        put_in_place(folder / path.name, path)
                    return path
        return None


def _named(path: Path, key: str) -> tuple[str, ...]:
    """Return the file names after `key` in an OBJ or MTL file, without those that would leave the folder."""
    with path.open(encoding="utf-8", errors="replace") as lines:
        names = {line.split(maxsplit=1)[1].strip() for line in lines if line.startswith(f"{key} ") and line.split()[1:]}
    return tuple(sorted(name for name in names if Path(name).name == name))


def source_from(text: str, cache: Path) -> Source:
    """Return the source that a user names: "pypi", "ycb" for the official download, an http(s) address or a folder.

    Raises:
        InvalidInput: if it is none of these.
    """
    if text == "pypi":
        return WheelSource(cache)
    if text == "ycb":
        return UrlSource(YCB_DOWNLOAD, cache)
    if "://" in text:
        return UrlSource(text, cache)
    return FolderSource(Path(text))


def _sha256(path: Path) -> str:
    with path.open("rb") as file:
        return hashlib.file_digest(file, "sha256").hexdigest()


MAX_MASS_KG = 20.0
_LEAST_GUESS_KG, _HULL_DENSITY = 0.001, 500.0  # the median of the twenty YCB objects here [kg/m^3 of the convex hull]
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

    Each object is written atomically. Objects that were finished before a failure stay.

    Args:
        names: names of the catalogue; empty for all that the source offers.
        source: source of the meshes.
        library: library to write to. Objects that it has already are skipped.
        executor: pool that converts several objects at once, which is mostly convex decomposition; None to convert one
            after the other.
        force: whether to fetch objects again that the library has.

    Yields:
        Steps whose `total` counts the objects and one step of preparation.

    Raises:
        UnknownName: if a name is not in the catalogue or the source does not have it.
        FetchFailed: if there is no network or disk space.
        CorruptFile: if a file of the source is damaged.
    """
    check_known("object in the catalogue", names, CATALOGUE)
    chosen = list(dict.fromkeys(names or source.names()))
    missing = [name for name in chosen if force or not library.has(name)]
    objects, total = len(chosen), len(chosen) + 1
    done = objects - len(missing)
    if not missing:
        yield Progress(total, total, f"All {objects} objects are here already")
        return
    yield Progress(done, total, f"Preparing {source.label}")
    for step in source.prepare():
        yield Progress(done, total, step.note)
    done += 1
    running: dict[Future[None], str] = {}
    with temporary_folder(library.root, "objects") as folder:
        try:
            for name in missing:
                label = CATALOGUE[name].label.lower()
                note = f"{{}} {label} ({done + len(running)} of {objects})"
                yield Progress(done, total, note.format("Getting"))
                with raising_fetch_failed(name, folder):
                    (folder / name).mkdir()
                path = source.mesh(name, folder / name)
                yield Progress(done, total, note.format("Converting"))
                if executor is None:
                    convert(path, CATALOGUE[name], library, source.label)
                    done += 1
                else:
                    running[executor.submit(convert, path, CATALOGUE[name], library, source.label)] = label
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
    yield Progress(total, total, f"{objects} objects ready")


def convert(path: Path, info: ObjectInfo, library: AssetLibrary, source: str) -> None:
    """Read one object's mesh, make its collision parts and resting orientations, and write it.

    Args:
        path: path of the mesh, as `Source.mesh` returns it.
        info: the catalogue's facts about the object.
        library: library to write to. An older object of that name is replaced.
        source: where the mesh came from, for people.

    Raises:
        CorruptFile: if a file is damaged.
        InvalidInput: if the mesh is not as large as a tabletop object, or encloses no volume.
        FetchFailed: if the disk is full.
    """
    from osfcore.objects.mesh import read_mesh, read_msh
    from osfcore.objects.surface import PLAIN_SIDE

    mesh = read_msh(path) if path.suffix == ".msh" else read_mesh(path)
    if max(mesh.texture.shape) <= PLAIN_SIDE:
        raise CorruptFile(path, "the image of its texture is missing")
    library.write(make_asset(mesh, info), source)


def make_asset(mesh: TexturedMesh, info: ObjectInfo) -> ObjectAsset:
    """Return the mesh with its collision parts and resting orientations.

    Raises:
        InvalidInput: if the mesh encloses no volume.
    """
    from osfcore.geometry.convex_parts import convex_parts
    from osfcore.objects.mesh import resting_poses

    parts = convex_parts(mesh.vertices, mesh.faces)
    return ObjectAsset(info, mesh, parts, resting_poses(parts))


def guessed_mass(mesh: TexturedMesh) -> float:
    """Guess the mass of an object of unknown material from its convex hull, to two digits [kg].

    The guess is within a factor of 2.8 for seventeen of twenty YCB objects. It lies between 1 g and 20 kg, and is 1 g
    without a volume.
    """
    from scipy.spatial import ConvexHull, QhullError

    try:
        guess = _HULL_DENSITY * float(ConvexHull(mesh.vertices).volume)
    except QhullError:
        guess = 0.0
    return float(f"{min(max(guess, _LEAST_GUESS_KG), MAX_MASS_KG):.2g}")


@dataclass(frozen=True, slots=True)
class NewObject:
    """Facts about a user's object to add.

    Attributes:
        name: name in scenes, which must not be in the catalogue.
        mass_kg: mass, in (0, 20] [kg]; None to guess it from the volume.
        label: name for people; made from `name` if empty.
        scale: metres for one unit of the file.
        licence: licence of the mesh.
    """

    name: str
    mass_kg: float | None
    label: str = ""
    scale: float = 1.0
    licence: str = "unknown"

    def info(self, mesh: TexturedMesh) -> ObjectInfo:
        """Return the facts about an object with this mesh that the library stores."""
        mass_kg = guessed_mass(mesh) if self.mass_kg is None else float(self.mass_kg)
        text = self.label or self.name.replace("_", " ").replace("-", " ").capitalize()
        symmetry = Symmetry("none", reason="not examined")
        return ObjectInfo(self.name, text, mass_kg, symmetry, self.licence, "added by the user")

    def check(self) -> None:
        """Check the values.

        Raises:
            InvalidInput: if the name is malformed or in the catalogue, or a value is out of range.
        """
        check_name(self.name)
        if self.name in CATALOGUE:
            raise InvalidInput("object name", repr(self.name), "different from the names of the catalogue")
        if self.mass_kg is not None and not 0 < self.mass_kg <= MAX_MASS_KG:
            raise InvalidInput("mass [kg]", self.mass_kg, f"above 0 and at most {MAX_MASS_KG:g}")
        if not 0 < self.scale < math.inf:
            raise InvalidInput("scale", self.scale, "above 0")
        for what, text in (("label", self.label), ("licence", self.licence)):
            if not text.isprintable() or len(text) > MAX_TEXT:  # unprintable: surrogates of broken encodings too
                raise InvalidInput(what, ascii(text)[:40], f"printable text of at most {MAX_TEXT} characters")


def add_object(mesh_path: Path, new: NewObject, library: AssetLibrary, *, force: bool = False) -> ObjectAsset:
    """Add a user's textured mesh to the library.

    Args:
        mesh_path: file in a format of `read_mesh`.
        new: name, mass and other facts.
        library: library to write to.
        force: whether to replace an object of that name.

    Raises:
        InvalidInput: if the name is malformed or taken, or mass, scale or size are out of range.
        CorruptFile: if the mesh cannot be used.
        FetchFailed: if the disk is full.
    """
    new.check()
    if not force and (library.root / new.name).exists():
        allowed = "one that is not taken yet (or use --force to replace that object)"
        raise InvalidInput("object name", repr(new.name), allowed)
    from osfcore.objects.mesh import read_mesh

    mesh = read_mesh(Path(mesh_path), new.scale)
    asset = make_asset(mesh, new.info(mesh))
    library.write(asset, str(mesh_path))
    return asset
