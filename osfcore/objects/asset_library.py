"""A library of objects on disk, with one folder for each object.

A folder holds `object.json` (facts, format version, checksums), `arrays.npz` (mesh, collision parts, resting
orientations), `texture.png`, and `viewer.glb`, a light copy for 3D views in browsers. Folders are written atomically: a
kill or a full disk leaves either the old object or none.
"""

from __future__ import annotations

import contextlib
import functools
import hashlib
import io
import json
import re
import zlib
from collections.abc import Iterator
from dataclasses import asdict, dataclass
from pathlib import Path
from typing import Any

import cv2
import numpy as np
from jaxtyping import Float

from osfcore.errors import CorruptFile, InvalidInput, MissingAssets, OsfError, UnknownName
from osfcore.io.files import replace_folder, scratch_folder, sync, writing
from osfcore.io.image_file import encode_png
from osfcore.io.json_codec import decode
from osfcore.objects.asset import ObjectAsset, ObjectGeometry, ObjectInfo, RestingPoses, TexturedMesh, viewer_glb
from osfcore.objects.catalogue import CATALOGUE
from osfcore.objects.download import raising_fetch_failed

FORMAT_VERSION = 1
_FACTS, _ARRAYS, _TEXTURE, _VIEWER = "object.json", "arrays.npz", "texture.png", "viewer.glb"
_TEMPORARY_PREFIX = ".writing-"
_NAME = re.compile(r"(?=[\w.-]*[\d_])[\w.-]*\w")  # a whole word with a digit or an underscore
_WRONG_CHECKSUM = "its checksum does not fit; fetch or add it again with --force"
_TEMPORARY_LIFE_S = 600  # far longer than one write takes; older ones were left by a killed process


@dataclass(frozen=True)
class AssetLibrary:
    """A library of objects in one folder: meshes, textures, collision shapes, and resting orientations.

    `osf assets fetch` fills it. Several processes may read and write at once; readers see complete objects only.

    Attributes:
        root: the folder, usually DATA_DIR/objects. The first write creates it.

    Example:
        >>> assets.size_m("006_mustard_bottle").round(2)  # along x, y and z of the object frame [m]
        array([0.1 , 0.07, 0.19])
    """

    root: Path

    def __post_init__(self) -> None:
        object.__setattr__(self, "root", Path(self.root))  # a string is a path, too

    def names(self) -> tuple[str, ...]:
        """Return the names of all objects that can be loaded, sorted."""
        return tuple(name for name in self._folders() if self.has(name))

    def damaged(self) -> dict[str, str]:
        """Return the damaged objects: for each name, why the object cannot be loaded."""
        found = {}
        for name in self._folders():
            try:
                self.check(name)
            except CorruptFile as error:
                found[name] = error.reason
            except OsfError:
                found[name] = f"{_FACTS} is missing"
        return found

    def has(self, name: str) -> bool:
        """Return whether an object of this name can be loaded."""
        try:
            self.check(name)
        except OsfError:
            return False
        return True

    def check(self, name: str) -> None:
        """Check by the checksums of its files that an object can be loaded. Each file is read only once.

        Raises:
            MissingAssets: if the object is in the catalogue but not on this machine.
            UnknownName: if there is no such object.
            CorruptFile: if its files are damaged.
        """
        with self._reading(name) as facts:
            decode(ObjectInfo, facts["info"], "info")
            for file in (_ARRAYS, _TEXTURE, _VIEWER):
                path = self.root / name / file
                state = path.stat()
                if _crc32(path, state.st_ino, state.st_size, state.st_mtime_ns) != facts["crc32"][file]:
                    raise CorruptFile(path, _WRONG_CHECKSUM)

    def info(self, name: str) -> ObjectInfo:
        """Return facts about an object of the catalogue, fetched or not, or about one that a user added.

        Raises:
            UnknownName: if there is no such object.
            CorruptFile: if a user's object is damaged.
        """
        if name in CATALOGUE:
            return CATALOGUE[name]
        with self._reading(name) as facts:
            return decode(ObjectInfo, facts["info"], "info")

    def label(self, name: str) -> str:
        """Return the label of an object for people, or its name if it has no label."""
        try:
            return self.info(name).label
        except OsfError:  # removed meanwhile, or damaged
            return name

    def in_words(self, sentence: str) -> str:
        """Return a sentence in which labels replace the names of objects."""
        return _NAME.sub(lambda word: self.label(word[0]), sentence)

    def source(self, name: str) -> str:
        """Return the source of an object on this machine, as it was given to `write`."""
        return str(self._known_facts(name).get("source", ""))

    def size_m(self, name: str) -> Float[np.ndarray, "3"]:
        """Return the sides of an object's bounding box in the object frame [m], without loading the mesh.

        Raises:
            MissingAssets: if the object is in the catalogue but not on this machine.
            UnknownName: if there is no such object.
            CorruptFile: if its files are damaged.
        """
        with self._reading(name) as facts:
            return np.array(facts["size_m"], float).reshape(3)

    def load(self, name: str) -> ObjectAsset:
        """Return an object with its mesh, texture, collision parts and resting orientations.

        Raises:
            MissingAssets: if the object is in the catalogue but not on this machine.
            UnknownName: if there is no such object.
            CorruptFile: if its files are damaged.
        """
        with self._reading(name) as facts:
            arrays = self._arrays(name, facts)
            png = np.frombuffer(self._checked(name, _TEXTURE, facts), np.uint8)
            texture = cv2.imdecode(png, cv2.IMREAD_COLOR_RGB)
            if texture is None:
                raise CorruptFile(self.root / name / _TEXTURE, "it is not an image")
            mesh = TexturedMesh(arrays["vertices"], arrays["normals"], arrays["faces"], arrays["uv"], texture)
            resting = RestingPoses(arrays["resting_quaternions"], arrays["resting_probabilities"])
            return ObjectAsset(self.info(name), mesh, _parts(arrays), resting)

    def load_geometry(self, name: str) -> ObjectGeometry:
        """Return the mesh and collision parts of an object without its texture. This is much faster than `load`.

        Raises:
            MissingAssets: if the object is in the catalogue but not on this machine.
            UnknownName: if there is no such object.
            CorruptFile: if its files are damaged.
        """
        with self._reading(name) as facts:
            arrays = self._arrays(name, facts)
            return ObjectGeometry(arrays["vertices"], arrays["faces"], _parts(arrays))

    def digest(self, name: str) -> str:
        """Return a hash of an object's contents, without loading it.

        Raises:
            MissingAssets: if the object is in the catalogue but not on this machine.
            UnknownName: if there is no such object.
            CorruptFile: if its files are damaged.
        """
        with self._reading(name) as facts:
            checks = [facts["crc32"][file] for file in (_ARRAYS, _TEXTURE)]
        return hashlib.sha256(json.dumps([checks, asdict(self.info(name))]).encode()).hexdigest()

    def viewer_glb(self, name: str) -> bytes:
        """Return the object as binary glTF with a small JPEG texture, in the object frame (z up) [m].

        Raises:
            MissingAssets: if the object is in the catalogue but not on this machine.
            UnknownName: if there is no such object.
            CorruptFile: if its files are damaged.
        """
        with self._reading(name) as facts:
            return self._checked(name, _VIEWER, facts)

    def write(self, asset: ObjectAsset, source: str) -> None:
        """Write an object. It replaces an older one of the same name.

        Args:
            asset: the object.
            source: where it came from, for people.

        Raises:
            FetchFailed: if the disk is full or the folder cannot be written. Nothing is then changed.
        """
        mesh = asset.mesh
        files = {_ARRAYS: _array_bytes(asset), _TEXTURE: encode_png(mesh.texture), _VIEWER: viewer_glb(mesh)}
        facts = {
            "format_version": FORMAT_VERSION,
            "info": asdict(asset.info),
            "size_m": [round(float(s), 6) for s in asset.size_m],
            "source": source,
            "crc32": {name: zlib.crc32(data) for name, data in files.items()},
        }
        files[_FACTS] = (json.dumps(facts, indent=1) + "\n").encode()
        with raising_fetch_failed(asset.info.name, self.root), self._scratch() as scratch:
            folder = scratch / "new"
            folder.mkdir()
            folder.chmod(0o755)  # another user may serve what this one fetched
            for name, data in files.items():
                (folder / name).write_bytes(data)
            replace_folder(folder, self.root / asset.info.name)

    def remove(self, name: str) -> None:
        """Delete an object that a user added, even if it is damaged.

        Raises:
            UnknownName: if there is no such object.
            InvalidInput: if the object belongs to the catalogue.
            CannotWrite: if the folder cannot be changed.
        """
        if name not in self._folders():
            raise UnknownName("object", name, {*CATALOGUE, *self.names()})
        if name in CATALOGUE:
            raise InvalidInput("object to delete", name, "one that you added; those of the catalogue stay")
        with writing(self.root):
            with self._scratch() as trash:
                (self.root / name).rename(trash / "old")
            sync(self.root)

    def _folders(self) -> tuple[str, ...]:
        """Return the names of all objects, damaged or not, sorted."""
        if not self.root.is_dir():
            return ()
        return tuple(sorted(entry.name for entry in self.root.iterdir() if _is_plain(entry.name) and entry.is_dir()))

    def _known_facts(self, name: str) -> dict[str, Any]:
        path = self.root / name / _FACTS
        try:
            if not _is_plain(name):
                raise FileNotFoundError(name)
            facts = {"format_version": 0, **json.loads(path.read_text(encoding="utf-8"))}
        except (ValueError, TypeError) as error:
            raise CorruptFile(path, "it is not valid JSON") from error
        except OSError:
            if name in CATALOGUE:
                raise MissingAssets([name]) from None
            written = (other for other in self._folders() if (self.root / other / _FACTS).is_file())
            raise UnknownName("object", name, {*CATALOGUE, *written}) from None
        if facts["format_version"] != FORMAT_VERSION:
            reason = "another version of this program wrote it; fetch or add the object again with --force"
            raise CorruptFile(self.root / name, reason)
        return facts

    def _arrays(self, name: str, facts: dict[str, Any]) -> dict[str, np.ndarray]:
        with np.load(io.BytesIO(self._checked(name, _ARRAYS, facts)), allow_pickle=False) as stored:
            return {key: stored[key] for key in stored.files}

    def _checked(self, name: str, file: str, facts: dict[str, Any]) -> bytes:
        data = (self.root / name / file).read_bytes()
        if zlib.crc32(data) != facts["crc32"][file]:
            raise CorruptFile(self.root / name / file, _WRONG_CHECKSUM)
        return data

    @contextlib.contextmanager
    def _reading(self, name: str) -> Iterator[dict[str, Any]]:
        """Yield the facts of an object; turn errors from damaged contents into `CorruptFile`."""
        facts = self._known_facts(name)
        try:
            yield facts
        except CorruptFile:
            raise
        except (OSError, KeyError, TypeError, ValueError) as error:
            reason = "its files are damaged; fetch or add it again with --force"
            raise CorruptFile(self.root / name, reason) from error

    def _scratch(self) -> contextlib.AbstractContextManager[Path]:
        return scratch_folder(self.root, _TEMPORARY_PREFIX, _TEMPORARY_LIFE_S)


@functools.lru_cache(maxsize=1024)
def _crc32(path: Path, inode: int, size: int, mtime_ns: int) -> int:
    """Return the checksum of a file. The other arguments tell versions of the file apart."""
    del inode, size, mtime_ns
    return zlib.crc32(path.read_bytes())


def _parts(arrays: dict[str, np.ndarray]) -> tuple[Float[np.ndarray, "_ 3"], ...]:
    return tuple(np.split(arrays["parts"], np.cumsum(arrays["part_sizes"])[:-1]))


def _is_plain(name: str) -> bool:
    """Return whether a name is a plain folder name, which cannot lead out of the library."""
    return re.fullmatch(r"[A-Za-z0-9][A-Za-z0-9_.-]{0,99}", name) is not None


def check_name(name: str) -> str:
    """Check that a user's object may have this name, and return the name.

    Raises:
        InvalidInput: if it is not 1 to 64 lower-case letters, digits, "_" and "-", the first a letter or digit.
    """
    if not re.fullmatch(r"[a-z0-9][a-z0-9_-]{0,63}", name):
        allowed = "1 to 64 lower-case letters, digits, '_' or '-', starting with a letter or digit"
        raise InvalidInput("object name", repr(name[:80]), allowed)
    return name


def _array_bytes(asset: ObjectAsset) -> bytes:
    mesh, buffer = asset.mesh, io.BytesIO()
    np.savez(
        buffer,
        vertices=mesh.vertices.astype(np.float32),
        normals=mesh.normals.astype(np.float32),
        faces=mesh.faces.astype(np.int32),
        uv=mesh.uv.astype(np.float32),
        parts=np.concatenate(asset.parts).astype(np.float32),
        part_sizes=np.array([len(part) for part in asset.parts], np.int32),
        resting_quaternions=asset.resting.quaternions.astype(float),
        resting_probabilities=asset.resting.probabilities.astype(float),
    )
    return buffer.getvalue()
