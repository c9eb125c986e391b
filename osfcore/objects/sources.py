"""Where meshes come from: the package on PyPI, a folder in google_16k layout, a web server with either layout.

A source brings files onto this machine; `fetch` turns them into objects. Everything downloaded lands under a temporary
name in the cache folder and is renamed once it is complete and verified.
"""

from __future__ import annotations

import hashlib
import zipfile
import zlib
from collections.abc import Iterator
from dataclasses import dataclass
from pathlib import Path
from typing import Protocol

from osfcore.errors import CorruptFile, FetchFailed, InvalidInput, UnknownName
from osfcore.io.files import put_in_place
from osfcore.objects.catalogue import CATALOGUE, DEFAULT_NAMES
from osfcore.objects.download import download, pip_download, raising_fetch_failed, temporary_folder, unpack
from osfcore.progress import Progress

_LAYOUTS = ("{name}/google_16k/textured.obj", "{name}/textured.obj")


@dataclass(frozen=True, slots=True)
class MeshFiles:
    """Files of one object on this machine.

    Attributes:
        mesh: .msh, or any format that `read_mesh` reads.
        texture: image that belongs to a .msh; other formats name theirs themselves.
    """

    mesh: Path
    texture: Path | None = None


class Source(Protocol):
    """A place that meshes can be fetched from."""

    @property
    def label(self) -> str:
        """What it is called in messages and in the objects' records."""
        ...

    def names(self) -> tuple[str, ...]:
        """Objects that are fetched when none are named."""
        ...

    def prepare(self) -> Iterator[Progress]:
        """Do what is needed once for all objects; steps count from 0 to their own total.

        Raises:
            FetchFailed: if that is not possible.
        """
        ...

    def files(self, name: str, folder: Path) -> MeshFiles:
        """The files of one object, put into `folder` if they do not lie on this machine already.

        Raises:
            UnknownName: if this source does not have it.
            FetchFailed: if it cannot be downloaded.
            CorruptFile: if an archive is damaged.
        """
        ...


class WheelSource:
    """Ten YCB objects from the wheel of MyoSuite on PyPI, downloaded with pip, never installed or imported.

    Args:
        cache: folder in which the wheel is kept, so that a second fetch needs no network.
    """

    REQUIREMENT = "MyoSuite==2.8.0"
    FILE = "MyoSuite-2.8.0-py3-none-any.whl"
    SHA256 = "e974ae1eacf674d17a72a09153e06a256c795e7f6c5f76d8c4686ca71bab7558"
    BYTES = 85_000_000  # about; only for the progress bar
    FOLDER = "myosuite/simhive/YCB_sim"

    def __init__(self, cache: Path) -> None:
        self._cache = Path(cache)

    @property
    def label(self) -> str:
        """The package and where it is from."""
        return f"{self.REQUIREMENT} from PyPI"

    @property
    def wheel(self) -> Path:
        """Where the wheel lies in the cache."""
        return self._cache / self.FILE

    def names(self) -> tuple[str, ...]:
        """The ten objects of the wheel."""
        return DEFAULT_NAMES

    def prepare(self) -> Iterator[Progress]:
        """Download and verify the wheel unless the cache has it.

        Raises:
            FetchFailed: without network, pip or disk space, or if the checksum is wrong.
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

    def files(self, name: str, folder: Path) -> MeshFiles:
        """Mesh and texture of one object, taken out of the wheel."""
        if name not in DEFAULT_NAMES:
            raise UnknownName(f"object in {self.label}", name, DEFAULT_NAMES)
        mesh, texture = folder / f"{name}.msh", folder / f"{name}.png"
        try:
            with raising_fetch_failed(name, folder), zipfile.ZipFile(self.wheel) as wheel:
                mesh.write_bytes(wheel.read(f"{self.FOLDER}/meshes/{name}.msh"))
                texture.write_bytes(wheel.read(f"{self.FOLDER}/textures/{name}.png"))
        except (zipfile.BadZipFile, zlib.error, KeyError) as error:
            raise CorruptFile(self.wheel, f"it does not hold {name}") from error
        return MeshFiles(mesh, texture)


class FolderSource:
    """A folder in the layout of the YCB downloads: NAME/google_16k/textured.obj, or NAME/textured.obj.

    Args:
        folder: the folder that holds the objects' folders.

    Raises:
        InvalidInput: if there is no such folder.
    """

    def __init__(self, folder: Path) -> None:
        self._folder = Path(folder).expanduser()
        if not self._folder.is_dir():
            raise InvalidInput("source", folder, "'pypi', a folder that exists or an http(s) address")

    @property
    def label(self) -> str:
        """The folder."""
        return str(self._folder.resolve())

    def names(self) -> tuple[str, ...]:
        """The catalogue's objects that the folder holds.

        Raises:
            InvalidInput: if it holds none.
        """
        available = tuple(name for name in CATALOGUE if self._find(name))
        if not available:
            allowed = "a folder with NAME/google_16k/textured.obj in it, NAME such as 006_mustard_bottle"
            raise InvalidInput("source", self._folder, allowed)
        return available

    def prepare(self) -> Iterator[Progress]:
        """Nothing is needed."""
        yield Progress(1, 1, f"Reading {self._folder}")

    def files(self, name: str, folder: Path) -> MeshFiles:
        """The mesh where it lies."""
        del folder  # nothing has to be copied
        path = self._find(name)
        if path is None:
            raise UnknownName(f"object in {self._folder}", name, (n for n in CATALOGUE if self._find(n)))
        return MeshFiles(path)

    def _find(self, name: str) -> Path | None:
        paths = (self._folder / layout.format(name=name) for layout in _LAYOUTS)
        return next((path for path in paths if path.is_file()), None)


class UrlSource:
    """A web address with the official archives (NAME_google_16k.tgz) or with the folder layout of `FolderSource`.

    Args:
        base: http or https address of the folder.
        cache: archives are kept in a folder of this one.

    Raises:
        InvalidInput: if it is not an http(s) address.
    """

    def __init__(self, base: str, cache: Path) -> None:
        from urllib.parse import urlsplit

        try:
            parts = urlsplit(base)
            is_address = parts.scheme in ("http", "https") and bool(parts.hostname) and base.isascii()
        except ValueError:  # half an IPv6 address
            is_address = False
        if not is_address:
            raise InvalidInput("source", repr(base), "an address that starts with http:// or https://")
        self._base = base.rstrip("/")
        self._cache = Path(cache) / "archives" / hashlib.sha256(self._base.encode()).hexdigest()[:16]

    @property
    def label(self) -> str:
        """The address."""
        return self._base

    def names(self) -> tuple[str, ...]:
        """The default ten: a web server does not tell what it has."""
        return DEFAULT_NAMES

    def prepare(self) -> Iterator[Progress]:
        """Nothing is needed."""
        yield Progress(1, 1, f"Reading {self._base}")

    def files(self, name: str, folder: Path) -> MeshFiles:
        """The mesh of one object, from its archive or from single files, whichever the server has."""
        archive = self._archive(name)
        if archive is not None:
            try:
                unpack(archive, folder)
            except CorruptFile:
                archive.unlink(missing_ok=True)  # the next try asks the server again
                raise
            path = next((p for lay in _LAYOUTS if (p := folder / lay.format(name=name)).is_file()), None)
            if path is None:
                archive.unlink(missing_ok=True)
                raise CorruptFile(archive.name, f"it holds no {name}/google_16k/textured.obj")
            return MeshFiles(path)
        for layout in _LAYOUTS:
            address = f"{self._base}/{layout.format(name=name)}"
            if download(address, folder / "textured.obj"):
                self._companions(address.rsplit("/", 1)[0], folder)
                return MeshFiles(folder / "textured.obj")
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

    def _companions(self, address: str, folder: Path) -> None:
        """The material file that an OBJ names, and the images that the material names."""
        for library in _named(folder / "textured.obj", "mtllib"):
            if download(f"{address}/{library}", folder / library):
                for image in _named(folder / library, "map_Kd"):
                    download(f"{address}/{image}", folder / image)


def _named(path: Path, key: str) -> tuple[str, ...]:
    """File names after `key` in an OBJ or MTL file; names that would leave the folder are left out."""
    with path.open(encoding="utf-8", errors="replace") as lines:
        names = {line.split(maxsplit=1)[1].strip() for line in lines if line.startswith(f"{key} ") and line.split()[1:]}
    return tuple(sorted(name for name in names if Path(name).name == name))


def source_from(text: str, cache: Path) -> Source:
    """The source that a user names: "pypi", an http(s) address or a folder.

    Raises:
        InvalidInput: if it is none of these.
    """
    if text == "pypi":
        return WheelSource(cache)
    if "://" in text:
        return UrlSource(text, cache)
    return FolderSource(Path(text))


def _sha256(path: Path) -> str:
    with path.open("rb") as file:
        return hashlib.file_digest(file, "sha256").hexdigest()
