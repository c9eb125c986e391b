"""Photographs of tables on disk: DATA_DIR/photos/ID with the file as sent, what is shown of it, masks and facts."""

from __future__ import annotations

import json
from collections.abc import Callable, Mapping
from dataclasses import dataclass, replace
from pathlib import Path
from types import MappingProxyType
from typing import Any

import numpy as np
from jaxtyping import Float

from app.processes.messages.photo_messages import CameraSource, Mark, Points
from app.storage.record_folders import RecordFolders
from osfcore.errors import InvalidInput, OsfError, UnknownName, shown
from osfcore.geometry.cameras import Camera
from osfcore.geometry.poses import Pose, unit_quaternion
from osfcore.io.files import read_json
from osfcore.io.json_codec import Entry, Matrix3, Text, Vector3, Vector4, decode, encode

SENT, STRAIGHT, PICTURE, _FACTS = "sent", "straight.png", "photo.jpg", "photo.json"
_NO_FILES: Mapping[str, bytes | None] = MappingProxyType({})


class TooManyPhotos(OsfError):
    """No more photographs are kept."""

    def __init__(self, limit: int) -> None:
        super().__init__(f"There are {limit} photos already, which is the most; delete one first.")


@dataclass(frozen=True, slots=True)
class MarkedObject:
    """An object that a person has pointed at.

    Attributes:
        name: of the object.
        mark: how.
        outline: of its mask.
        choice: which of the poses that were found a person took, the best being 0; None before that.
    """

    name: str
    mark: Mark
    outline: tuple[Points, ...]
    choice: int | None = None


@dataclass(frozen=True, eq=False, slots=True)
class TablePhoto:
    """A photograph of a table that is kept.

    Attributes:
        id: identifier.
        name: for people.
        created_at: UTC, ISO 8601.
        width: of the picture [px]; all places are pixels of it.
        height: of the picture [px].
        sent_width: of the photo as it was sent [px].
        K: intrinsics [px].
        source: who tells the focal length.
        T_world_camera: pose over the printed board; None if the photo shows none.
        notes: sentences about photo and camera.
        objects: that were marked.
        job: the estimate of what is marked now; None if there is none.
        scene: the table that it became; None if it did not.
        T_table_photo: where the photograph's table frame lies on that table.
    """

    id: str
    name: str
    created_at: str
    width: int
    height: int
    sent_width: int
    K: Float[np.ndarray, "3 3"]
    source: CameraSource
    T_world_camera: Pose | None
    notes: tuple[str, ...]
    objects: tuple[MarkedObject, ...] = ()
    job: str | None = None
    scene: str | None = None
    T_table_photo: Pose | None = None

    def marked(self, name: str) -> MarkedObject:
        """One of the marked objects.

        Raises:
            UnknownName: if it was not marked.
        """
        for entry in self.objects:
            if entry.name == name:
                return entry
        raise UnknownName("object in the photo", name[:80], [entry.name for entry in self.objects])

    def with_object(self, changed: MarkedObject) -> TablePhoto:
        """The same with an object in the place of the one of its name, or behind the others."""
        if any(entry.name == changed.name for entry in self.objects):
            kept = tuple(changed if entry.name == changed.name else entry for entry in self.objects)
        else:
            kept = (*self.objects, changed)
        return replace(self, objects=kept)

    def camera(self, T_world_camera: Pose, longest: int) -> Camera:
        """The camera that took the photo, in another frame and for a smaller picture.

        Args:
            T_world_camera: that maps camera coordinates to the other frame.
            longest: side of the picture [px].
        """
        scale = min(1.0, longest / max(self.width, self.height))
        width, height = max(round(scale * self.width), 1), max(round(scale * self.height), 1)
        per_axis = np.array([[width / self.width], [height / self.height], [1.0]])
        return Camera("photo", T_world_camera, self.K * per_axis, width, height)


class _PoseJson(Entry):
    position: Vector3
    quaternion: Vector4

    @staticmethod
    def of(pose: Pose | None) -> _PoseJson | None:
        if pose is None:
            return None
        return _PoseJson(position=pose.position.tolist(), quaternion=pose.quaternion.tolist())

    def pose(self) -> Pose:
        return Pose(np.array(self.position), unit_quaternion(np.array(self.quaternion), "quaternion"))


def _pose(entry: _PoseJson | None) -> Pose | None:
    return None if entry is None else entry.pose()


class _PhotoJson(Entry):
    """What photo.json holds."""

    id: Text
    name: Text
    created_at: Text
    width: int
    height: int
    sent_width: int
    K: Matrix3
    source: CameraSource
    T_world_camera: _PoseJson | None
    notes: list[Text]
    objects: list[dict[str, Any]]
    job: Text | None
    scene: Text | None
    T_table_photo: _PoseJson | None


class TablePhotoStore(RecordFolders[TablePhoto]):
    """The photographs of one data directory. Any thread may call.

    Args:
        root: the folder, DATA_DIR/photos; made when the first photo comes.
        max_photos: kept at once.
    """

    def __init__(self, root: Path, max_photos: int) -> None:
        super().__init__(root, "photo", _FACTS, _read, max_photos, TooManyPhotos)

    def picture(self, photo: str) -> Path:
        """What is shown of a photograph that exists."""
        return self._root / photo / PICTURE

    def sent(self, photo: str) -> Path:
        """The file as it was sent."""
        return self._root / photo / SENT

    def straight(self, photo: str) -> Path:
        """All bits of a photograph whose lens bends straight lines, free of that; there may be none."""
        return self._root / photo / STRAIGHT

    def mask(self, photo: str, name: str) -> Path:
        """The mask of an object that was marked."""
        return self._root / photo / mask_file(name)

    def keep(self, record: TablePhoto, sent: bytes, picture: bytes, straight: bytes | None = None) -> None:
        """Keep a new photograph.

        Args:
            record: its facts.
            sent: the file.
            picture: what is shown.
            straight: without the lens's distortion, if it shows any.

        Raises:
            TooManyPhotos: if there are too many.
            CannotStore: if the disk is full.
        """
        self._keep(record.id, {SENT: sent, STRAIGHT: straight, PICTURE: picture, _FACTS: _facts(record)})

    def change(
        self, photo: str, changed: Callable[[TablePhoto], TablePhoto], files: Mapping[str, bytes | None] = _NO_FILES
    ) -> TablePhoto:
        """Give a photograph other facts, made of the latest ones, and other files; None removes one.

        Raises:
            UnknownName: if there is none, or as `changed`.
            CannotStore: if the disk is full.
        """
        with self._lock:
            record = changed(self.get(photo))
            self._replace(photo, {**files, _FACTS: _facts(record)})
        return record


def mask_file(name: str) -> str:
    """The file with an object's mask."""
    return f"mask_{name}.png"


def _facts(record: TablePhoto) -> bytes:
    entry = _PhotoJson(
        id=record.id,
        name=record.name,
        created_at=record.created_at,
        width=record.width,
        height=record.height,
        sent_width=record.sent_width,
        K=record.K.tolist(),
        source=record.source,
        T_world_camera=_PoseJson.of(record.T_world_camera),
        notes=list(record.notes),
        objects=[encode(each) for each in record.objects],
        job=record.job,
        scene=record.scene,
        T_table_photo=_PoseJson.of(record.T_table_photo),
    )
    return (json.dumps(encode(entry), indent=1) + "\n").encode()


def _read(path: Path) -> TablePhoto:
    def parse(data: object) -> TablePhoto:
        entry = decode(_PhotoJson, data, "photo")
        if entry.id != path.parent.name:
            raise InvalidInput("id", shown(entry.id), "the name of its folder")
        return TablePhoto(
            entry.id,
            entry.name,
            entry.created_at,
            entry.width,
            entry.height,
            entry.sent_width,
            np.array(entry.K),
            entry.source,
            _pose(entry.T_world_camera),
            tuple(entry.notes),
            tuple(decode(MarkedObject, each, "object") for each in entry.objects),
            entry.job,
            entry.scene,
            _pose(entry.T_table_photo),
        )

    return read_json(path, parse)
