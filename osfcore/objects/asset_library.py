"""Objects on disk: one folder each, written whole or not at all.

A folder holds `object.json` (facts, format version, checksums), `arrays.npz` (mesh, collision parts, resting
orientations), `texture.png`, and `viewer.glb`, a light copy for 3D views in browsers. It is written under another name
beside its place, synced, and renamed, so that a kill or a full disk leaves either the old object or none.
"""

from __future__ import annotations

import contextlib
import errno
import hashlib
import io
import json
import os
import re
import shutil
import tempfile
import zlib
from collections.abc import Iterator
from dataclasses import asdict
from pathlib import Path
from typing import Any

import numpy as np
from jaxtyping import Float

from osfcore.errors import CannotWrite, CorruptFile, InvalidInput, MissingAssets, OsfError, UnknownName
from osfcore.io.files import sync, sync_tree
from osfcore.io.image_file import encode_png
from osfcore.io.json_codec import decode
from osfcore.objects.asset import ObjectAsset, ObjectGeometry, ObjectInfo, RestingPoses, TexturedMesh
from osfcore.objects.catalogue import CATALOGUE
from osfcore.objects.download import raising_fetch_failed, remove_old

FORMAT_VERSION = 1
_FACTS, _ARRAYS, _TEXTURE, _VIEWER = "object.json", "arrays.npz", "texture.png", "viewer.glb"
_TEMPORARY_PREFIX = ".writing-"
_NAME = re.compile(r"(?=[\w.-]*[\d_])[\w.-]*\w")  # a whole word that no other word looks like
_TEMPORARY_LIFE_S = 600  # far longer than one write takes; older ones were left by a killed process


class AssetLibrary:
    """The objects in one folder.

    Several processes may read and write at once: readers see whole objects only.

    Args:
        root: the folder, usually DATA_DIR/objects; made at the first write.
    """

    def __init__(self, root: Path) -> None:
        self.root = Path(root)

    def __eq__(self, other: object) -> bool:
        """Whether both look into the same folder."""
        return isinstance(other, AssetLibrary) and self.root == other.root

    def __hash__(self) -> int:
        """By the folder."""
        return hash(self.root)

    def names(self) -> tuple[str, ...]:
        """Names of all objects that can be loaded, sorted."""
        if not self.root.is_dir():
            return ()
        return tuple(sorted(entry.name for entry in self.root.iterdir() if self.has(entry.name)))

    def has(self, name: str) -> bool:
        """Whether an object of this name has been written (by a version that this one can read)."""
        try:
            return _is_plain(name) and self._facts(name)["format_version"] == FORMAT_VERSION
        except (OSError, CorruptFile):
            return False

    def info(self, name: str) -> ObjectInfo:
        """Facts of an object of the catalogue, fetched or not, or of one that a user added.

        Raises:
            UnknownName: if it is neither.
            CorruptFile: if a user's object is damaged.
        """
        if name in CATALOGUE:
            return CATALOGUE[name]
        facts = self._known_facts(name)
        with self._as_corrupt(name):
            return decode(ObjectInfo, facts["info"], "info")

    def label(self, name: str) -> str:
        """What people call an object; its name where nothing else is known."""
        try:
            return self.info(name).label
        except OsfError:  # removed meanwhile, or damaged
            return name

    def in_words(self, sentence: str) -> str:
        """A sentence with what people call the objects in place of their names."""
        return _NAME.sub(lambda word: self.label(word[0]), sentence)

    def source(self, name: str) -> str:
        """Where an object on this machine came from, as told to `write`."""
        return str(self._known_facts(name).get("source", ""))

    def size_m(self, name: str) -> Float[np.ndarray, "3"]:
        """Extents of the bounding box in the object frame [m], without loading the mesh.

        Raises:
            MissingAssets: if the object is in the catalogue but not on this machine.
            UnknownName: if there is no such object.
            CorruptFile: if its files are damaged.
        """
        facts = self._known_facts(name)
        with self._as_corrupt(name):
            return np.array(facts["size_m"], float).reshape(3)

    def load(self, name: str) -> ObjectAsset:
        """An object with its mesh, texture, collision parts and resting orientations.

        Raises:
            MissingAssets: if the object is in the catalogue but not on this machine.
            UnknownName: if there is no such object.
            CorruptFile: if its files are damaged.
        """
        import cv2

        facts = self._known_facts(name)
        with self._as_corrupt(name):
            arrays = self._arrays(name, facts)
            png = np.frombuffer(self._checked(name, _TEXTURE, facts), np.uint8)
            texture = cv2.imdecode(png, cv2.IMREAD_COLOR_RGB)
            if texture is None:
                raise CorruptFile(self.root / name / _TEXTURE, "it is not an image")
            mesh = TexturedMesh(arrays["vertices"], arrays["normals"], arrays["faces"], arrays["uv"], texture)
            resting = RestingPoses(arrays["resting_quaternions"], arrays["resting_probabilities"])
            return ObjectAsset(self.info(name), mesh, _parts(arrays), resting)

    def load_geometry(self, name: str) -> ObjectGeometry:
        """An object's shape alone, without decoding its texture, which takes most of the time of `load`.

        Raises:
            MissingAssets: if the object is in the catalogue but not on this machine.
            UnknownName: if there is no such object.
            CorruptFile: if its files are damaged.
        """
        facts = self._known_facts(name)
        with self._as_corrupt(name):
            arrays = self._arrays(name, facts)
            return ObjectGeometry(arrays["vertices"], arrays["faces"], _parts(arrays))

    def digest(self, name: str) -> str:
        """Tells an object from any other and from any earlier one of its name, without loading it.

        Raises:
            MissingAssets: if the object is in the catalogue but not on this machine.
            UnknownName: if there is no such object.
            CorruptFile: if its files are damaged.
        """
        facts = self._known_facts(name)
        with self._as_corrupt(name):
            checks = [facts["crc32"][file] for file in (_ARRAYS, _TEXTURE)]
        return hashlib.sha256(json.dumps([checks, asdict(self.info(name))]).encode()).hexdigest()

    def viewer_glb(self, name: str) -> bytes:
        """The object as binary glTF with a small JPEG texture, in the object frame (z up) [m].

        Raises:
            MissingAssets: if the object is in the catalogue but not on this machine.
            UnknownName: if there is no such object.
            CorruptFile: if its files are damaged.
        """
        facts = self._known_facts(name)
        with self._as_corrupt(name):
            return self._checked(name, _VIEWER, facts)

    def write(self, asset: ObjectAsset, source: str) -> None:
        """Put an object in place, in one piece, over an older one of the same name if there is one.

        Args:
            asset: what to write.
            source: where it came from, for people.

        Raises:
            FetchFailed: if the disk is full or the folder cannot be written; nothing is changed.
        """
        from osfcore.objects.asset import viewer_glb

        glb = viewer_glb(asset.mesh)
        with raising_fetch_failed(asset.info.name, self.root):
            self.root.mkdir(parents=True, exist_ok=True)
            remove_old(self.root, _TEMPORARY_PREFIX, _TEMPORARY_LIFE_S)
            with self._temporary(asset.info.name) as folder:
                _write_arrays(folder / _ARRAYS, asset)
                (folder / _TEXTURE).write_bytes(encode_png(asset.mesh.texture))
                (folder / _VIEWER).write_bytes(glb)
                checks = {f: zlib.crc32((folder / f).read_bytes()) for f in (_ARRAYS, _TEXTURE, _VIEWER)}
                facts = {
                    "format_version": FORMAT_VERSION,
                    "info": asdict(asset.info),
                    "size_m": [round(float(s), 6) for s in asset.size_m],
                    "source": source,
                    "crc32": checks,
                }
                (folder / _FACTS).write_text(json.dumps(facts, indent=1) + "\n", encoding="utf-8")
                sync_tree(folder)
                self._put(folder, self.root / asset.info.name)

    def remove(self, name: str) -> None:
        """Delete an object that a user added.

        Raises:
            UnknownName: if there is no such object.
            InvalidInput: if it is the catalogue's.
            CannotWrite: if that is not allowed.
        """
        self._known_facts(name)
        if name in CATALOGUE:
            raise InvalidInput("object to delete", name, "one that was added here; the catalogue's stay")
        try:
            with self._temporary(name) as trash:
                os.rename(self.root / name, trash / "old")
            sync(self.root)
        except OSError as error:
            raise CannotWrite(self.root, error.strerror or str(error)) from error

    def _facts(self, name: str) -> dict[str, Any]:
        path = self.root / name / _FACTS
        try:
            facts = json.loads(path.read_text(encoding="utf-8"))
            return {"format_version": 0, **facts}
        except (ValueError, TypeError) as error:
            raise CorruptFile(path, "it is not valid JSON") from error

    def _known_facts(self, name: str) -> dict[str, Any]:
        try:
            if not _is_plain(name):
                raise FileNotFoundError(name)
            facts = self._facts(name)
        except OSError:
            if name in CATALOGUE:
                raise MissingAssets([name]) from None
            raise UnknownName("object", name, {*CATALOGUE, *self.names()}) from None
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
            raise CorruptFile(self.root / name / file, "its checksum does not fit; fetch or add it again with --force")
        return data

    @contextlib.contextmanager
    def _as_corrupt(self, name: str) -> Iterator[None]:
        """Tell damaged contents as what they are."""
        try:
            yield
        except CorruptFile:
            raise
        except (OSError, KeyError, TypeError, ValueError) as error:
            reason = "its files are damaged; fetch or add it again with --force"
            raise CorruptFile(self.root / name, reason) from error

    @contextlib.contextmanager
    def _temporary(self, name: str) -> Iterator[Path]:
        folder = Path(tempfile.mkdtemp(prefix=f"{_TEMPORARY_PREFIX}{name}-", dir=self.root))
        try:
            yield folder
        finally:
            shutil.rmtree(folder, ignore_errors=True)

    def _put(self, folder: Path, place: Path) -> None:
        folder.chmod(0o755)  # mkdtemp makes it private, but another user may serve what this one fetched
        while not _renamed(folder, place):  # another process may put the same object there at any moment
            with self._temporary(place.name) as trash, contextlib.suppress(FileNotFoundError):
                os.rename(place, trash / "old")
        sync(self.root)


def _renamed(folder: Path, place: Path) -> bool:
    """Give a folder its name, unless something with contents has that name."""
    try:
        os.rename(folder, place)
    except OSError as error:
        if error.errno not in (errno.ENOTEMPTY, errno.EEXIST, errno.ENOTDIR):
            raise
        return False
    return True


def _parts(arrays: dict[str, np.ndarray]) -> tuple[Float[np.ndarray, "_ 3"], ...]:
    return tuple(np.split(arrays["parts"], np.cumsum(arrays["part_sizes"])[:-1]))


def _is_plain(name: str) -> bool:
    """Whether a name can be that of a folder in the library, and of nothing elsewhere."""
    return re.fullmatch(r"[A-Za-z0-9][A-Za-z0-9_.-]{0,99}", name) is not None


def check_name(name: str) -> str:
    """A name that a user's object may have.

    Raises:
        InvalidInput: if it is not 1 to 64 lower-case letters, digits, "_" and "-", the first a letter or digit.
    """
    if not re.fullmatch(r"[a-z0-9][a-z0-9_-]{0,63}", name):
        allowed = "1 to 64 lower-case letters, digits, '_' or '-', starting with a letter or digit"
        raise InvalidInput("object name", repr(name[:80]), allowed)
    return name


def _write_arrays(path: Path, asset: ObjectAsset) -> None:
    mesh = asset.mesh
    with path.open("wb") as file:
        np.savez(
            file,
            vertices=mesh.vertices.astype(np.float32),
            normals=mesh.normals.astype(np.float32),
            faces=mesh.faces.astype(np.int32),
            uv=mesh.uv.astype(np.float32),
            parts=np.concatenate(asset.parts).astype(np.float32),
            part_sizes=np.array([len(part) for part in asset.parts], np.int32),
            resting_quaternions=asset.resting.quaternions.astype(float),
            resting_probabilities=asset.resting.probabilities.astype(float),
        )
