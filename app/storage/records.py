"""Goals, photographs and image sets on disk: ROOT/ID with a JSON of facts and the files that belong to them.

The facts are the records themselves, as dataclasses that the JSON codec reads and writes.
"""

from __future__ import annotations

import contextlib
import io
import json
import shutil
import tempfile
import threading
from collections.abc import Callable, Mapping
from dataclasses import dataclass, replace
from pathlib import Path
from types import MappingProxyType
from typing import Annotated, Any, ClassVar, Generic, Literal, Protocol, TypeVar

import numpy as np
from jaxtyping import Float
from PIL import Image
from pydantic import ConfigDict, Field, GetPydanticSchema
from pydantic_core import core_schema

from osfcore.errors import CorruptFile, NotThere, OsfError, UnknownName, shown
from osfcore.geometry.cameras import Camera
from osfcore.geometry.poses import Pose, unit_quaternion
from osfcore.io.files import folder_at_once, is_file_name, put_in_place, read_json, reading_png, remove_folder
from osfcore.io.json_codec import Entry, Matrix3, Text, Vector3, Vector4, decode, encode
from osfcore.io.scene_file import CameraJson, ObjectJson
from osfcore.photo.found_scene import FoundScene

from ..processes.messages.photo_messages import CameraSource, Mark, Points
from .database import stamp, storing
from .photos import PhotoCrop

Poses = tuple[tuple[str, Pose], ...]
Files = Mapping[str, bytes | None]  # of a record by name; None for one that is not there
_NO_FILES: Files = MappingProxyType({})
_LONGEST_NAME = 255  # bytes of a file's name, on every file system in use


class Kept(Protocol):
    """What every record has; they are dataclasses."""

    __dataclass_fields__: ClassVar[dict[str, Any]]

    @property
    def id(self) -> str:
        """Identifier, the name of its folder."""
        ...

    @property
    def created_at(self) -> str:
        """UTC, ISO 8601."""
        ...

    @property
    def number(self) -> int:
        """Orders the records, whatever the clock says; 0 for those of earlier versions."""
        ...


Record = TypeVar("Record", bound=Kept)


@dataclass(frozen=True, slots=True)
class Damaged:
    """A record that can be deleted, and used for nothing else.

    Attributes:
        id: name of its folder.
        reason: what is wrong with it.
    """

    id: str
    reason: str


class RecordFolders(Generic[Record]):
    """The records of one folder. Any thread may call.

    Args:
        root: the folder; made when the first record comes.
        kind: of the records, a dataclass that the JSON codec takes.
        what: a record is, in sentences.
        facts: name of the JSON file.
        picture: the file without which a record is damaged, a PNG or JPEG.
        most: records kept at once.
        too_many: the error that says so.
    """

    def __init__(
        self,
        root: Path,
        kind: type[Record],
        what: str,
        facts: str,
        picture: str,
        most: int,
        too_many: Callable[[int], OsfError],
    ) -> None:
        self._root, self._kind, self._what, self._facts, self._picture = root, kind, what, facts, picture
        self._most, self._too_many = most, too_many
        self._lock = threading.RLock()
        self._known: dict[Path, tuple[object, Record | Damaged]] = {}  # with what the files were when they were read

    def start(self) -> None:
        """Remove what an earlier service left half done."""
        for folder in self._root.glob(".*"):
            shutil.rmtree(folder, ignore_errors=True)

    def all(self) -> tuple[Record, ...]:
        """Return the records that can be used, newest first."""
        return tuple(record for record in self._found() if not isinstance(record, Damaged))

    def damaged(self) -> tuple[Damaged, ...]:
        """Return the records that cannot be used."""
        return tuple(record for record in self._found() if isinstance(record, Damaged))

    def get(self, name: str) -> Record:
        """Return one record.

        Raises:
            UnknownName: if there is none.
            CorruptFile: if it is damaged.
        """
        record = self._read(self._folder(name))
        if isinstance(record, Damaged):
            raise CorruptFile(f"This {self._what}", f"{record.reason}; delete it")
        return record

    def remove(self, name: str) -> None:
        """Delete a record, damaged or not.

        Raises:
            UnknownName: if there is none.
            CannotStore: if that is not allowed.
        """
        with self._lock, storing(Path(self._root.name)):
            remove_folder(self._folder(name))

    def check_room(self) -> None:
        """Refuse a new record, damaged ones counted, if there are too many."""
        if len(self._found()) >= self._most:
            raise self._too_many(self._most)

    def _keep(self, record: Record, files: Files, made: Path | None = None) -> Record:
        """Put a new record in place, whole or not at all, and return it with its number.

        Args:
            record: its facts.
            files: of it, by name.
            made: a folder beside its place with more files, which becomes the record's; None for none.
        """
        with self._lock, storing(Path(self._root.name)):  # others may come in at the same time
            self.check_room()
            latest = max((each.number for each in self._found() if not isinstance(each, Damaged)), default=0)
            record = replace(record, number=latest + 1)
            if made is None:
                with folder_at_once(self._root / record.id) as folder:
                    self._write(folder, record, files)
            else:
                self._write(made, record, files)
                put_in_place(made, self._root / record.id)
        return record

    def _replace(self, record: Record, files: Files) -> None:
        """Give a record that exists other files and facts, the facts last; files that are None are removed."""
        with self._lock, storing(Path(self._root.name)):
            place = self._folder(record.id)
            with tempfile.TemporaryDirectory(prefix=".", dir=self._root) as folder:
                self._write(Path(folder), record, files)  # all of it before anything changes
                for file in (*files, self._facts):
                    if files.get(file, b"") is None:
                        (place / file).unlink(missing_ok=True)
                    else:
                        put_in_place(Path(folder, file), place / file)

    def _write(self, folder: Path, record: Record, files: Files) -> None:
        for name, data in files.items():
            if data is not None:
                (folder / name).write_bytes(data)
        (folder / self._facts).write_bytes((json.dumps(encode(record), indent=1) + "\n").encode())

    def _folder(self, name: str) -> Path:
        is_plain = is_file_name(name) and Path(name).name == name and not name.startswith(".")
        is_plain = is_plain and len(name.encode()) <= _LONGEST_NAME
        if not is_plain or not (self._root / name).is_dir():
            raise NotThere(self._what)
        return self._root / name

    def _found(self) -> list[Record | Damaged]:
        """Return all records, newest first, and then those that are damaged."""
        sound: list[Record] = []
        damaged: list[Record | Damaged] = []
        folders = sorted(folder for folder in self._root.glob("[!.]*") if folder.is_dir())
        for folder in folders:
            with contextlib.suppress(NotThere):  # another caller has just deleted it
                record = self._read(folder)
                damaged.append(record) if isinstance(record, Damaged) else sound.append(record)
        self._known = {folder: known for folder, known in self._known.items() if folder in folders}
        return sorted(sound, key=lambda record: (record.number, record.created_at, record.id), reverse=True) + damaged

    def _read(self, folder: Path) -> Record | Damaged:
        """Return what is in a folder, which is read again when its files are other ones.

        Raises:
            UnknownName: if it is not there any more.
        """
        facts, picture = folder / self._facts, folder / self._picture
        stamps = tuple(stamp(path) for path in (folder, facts, picture))
        before, record = self._known.get(folder, (None, None))
        if record is not None and before == stamps:
            return record
        try:
            record = read_json(facts, lambda data: decode(self._kind, data, self._what))
            if record.id != folder.name:
                raise CorruptFile(facts, "it is that of another one")
            _check_picture(picture)
        except CorruptFile as error:
            if not folder.is_dir():
                raise NotThere(self._what) from None
            record = Damaged(folder.name, f"{Path(error.path).name}: {error.reason}")
        self._known[folder] = stamps, record
        return record


def _check_picture(path: Path) -> None:
    """Refuse a PNG of which the checksums, or a JPEG of which the end is missing.

    Raises:
        CorruptFile: if so, or if it is neither.
    """
    with reading_png(path, "it is not whole"):
        data = path.read_bytes()
        with Image.open(io.BytesIO(data), formats=("PNG", "JPEG")) as image:
            image.verify()
        if image.format == "JPEG" and not data.endswith(b"\xff\xd9"):
            raise CorruptFile(path, "it is not whole")


# How values of the core stand in the facts


def _stored_as(entry: object, of: Callable[[Any], object], value: Callable[[Any], object]) -> GetPydanticSchema:
    """Store a value in the form of an entry of JSON.

    Args:
        entry: type of the entry.
        of: makes one of a value.
        value: makes the value of one; raises an OsfError if it makes no sense.
    """
    return GetPydanticSchema(
        lambda _, schema_of: core_schema.no_info_after_validator_function(
            value, schema_of(entry), serialization=core_schema.plain_serializer_function_ser_schema(of)
        )
    )


class _PoseJson(Entry):
    position: Vector3
    quaternion: Vector4

    @staticmethod
    def of(pose: Pose) -> _PoseJson:
        return _PoseJson(position=pose.position.tolist(), quaternion=pose.quaternion.tolist())

    def pose(self) -> Pose:
        return Pose(np.array(self.position), unit_quaternion(np.array(self.quaternion), "quaternion"))


def _poses(entries: list[ObjectJson]) -> Poses:
    poses = tuple((entry.name, entry.pose()) for entry in entries)
    for name, pose in poses:
        unit_quaternion(pose.quaternion, f"quaternion of {shown(name)}")
    return poses


_CameraFact = Annotated[Camera, _stored_as(CameraJson, CameraJson.of, CameraJson.camera)]
_PoseFact = Annotated[Pose, _stored_as(_PoseJson, _PoseJson.of, _PoseJson.pose)]
_MatrixFact = Annotated[Float[np.ndarray, "3 3"], _stored_as(Matrix3, np.ndarray.tolist, np.array)]
_PosesFact = Annotated[
    Poses, _stored_as(list[ObjectJson], lambda poses: [ObjectJson.of(name, pose) for name, pose in poses], _poses)
]


# Goals: DATA_DIR/goals/ID with `goal.png`, `goal.json`, and the photo it was cut out of, if it was.

Source = Literal["upload", "composed", "drawn", "photo"]
IMAGE, PHOTO = "goal.png", "photo.jpg"


class TooManyGoals(OsfError):
    """No more goals are kept."""

    def __init__(self, limit: int) -> None:
        super().__init__(f"There are {limit} goals already, which is the most; delete one first.")


@dataclass(frozen=True, slots=True)
class PhotoRecord:
    """The photo that a goal image was cut out of.

    Attributes:
        width: as it was sent [px].
        height: as it was sent [px].
        crop: what was cut out.
    """

    width: int
    height: int
    crop: PhotoCrop


@dataclass(frozen=True, eq=False, slots=True)
class GoalRecord:
    """A goal image that is kept.

    Attributes:
        id: identifier.
        name: for people.
        created_at: UTC, ISO 8601.
        source: an uploaded goal image, a layout by hand, a random one, or one that was found in a photograph.
        scene: that it was made from; None for an upload.
        camera: that took the image.
        poses: of the objects in it, where they are known; "objects" in the file.
        example: that it belongs to; None if it is anybody's own.
        photo: that it was cut out of; None if it was made here, or by an earlier version.
        number: orders the goals; the store gives it.
    """

    __pydantic_config__: ClassVar[ConfigDict] = ConfigDict(serialize_by_alias=True)

    id: Text
    name: Text
    created_at: Text
    source: Source
    scene: Text | None
    camera: _CameraFact
    poses: Annotated[_PosesFact | None, Field(alias="objects")]
    example: Text | None = None
    photo: PhotoRecord | None = None
    number: int = 0


class GoalStore(RecordFolders[GoalRecord]):
    """The goals of one data directory. Any thread may call.

    Args:
        root: the folder, DATA_DIR/goals; made when the first goal comes.
        max_goals: kept at once.
    """

    def __init__(self, root: Path, max_goals: int) -> None:
        super().__init__(root, GoalRecord, "goal", "goal.json", IMAGE, max_goals, TooManyGoals)

    def image(self, goal: str) -> Path:
        """Return where the image of a goal that exists is."""
        return self._root / goal / IMAGE

    def photo(self, goal: str) -> Path:
        """Return where the photo is that a goal that exists was cut out of; it may have none."""
        return self._root / goal / PHOTO

    def keep(self, record: GoalRecord, png: bytes, photo: bytes | None = None) -> None:
        """Keep a new goal, and the photo that it was cut out of.

        Raises:
            TooManyGoals: if there are too many.
            CannotStore: if the disk is full.
        """
        self._keep(record, {IMAGE: png, PHOTO: photo})

    def replace(self, record: GoalRecord, png: bytes) -> None:
        """Give a goal another image, and other facts.

        Raises:
            UnknownName: if there is none.
            CannotStore: if the disk is full.
        """
        self._replace(record, {IMAGE: png})


# Photographs of tables: DATA_DIR/photos/ID with `photo.json`, the file as sent, what is shown of it, and masks.

SENT, STRAIGHT, PICTURE = "sent", "straight.png", "photo.jpg"


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
        doubt: a sentence if the mask does not fill the box; "" if it does.
    """

    name: str
    mark: Mark
    outline: tuple[Points, ...]
    choice: int | None = None
    doubt: str = ""


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
        source: where the focal length comes from.
        T_world_camera: pose over the printed board; None if the photo shows none.
        notes: sentences about photo and camera.
        objects: that were marked.
        job: the estimate of what is marked now; None if there is none.
        scene: the table that it became; None if it did not.
        T_table_photo: where the photograph's table frame lies on that table.
        number: orders the photographs; the store gives it.
        board: that was looked for, as `board_of` reads it; "" for the one to print.
    """

    id: Text
    name: Text
    created_at: Text
    width: int
    height: int
    sent_width: int
    K: _MatrixFact
    source: CameraSource
    T_world_camera: _PoseFact | None
    notes: tuple[Text, ...]
    objects: tuple[MarkedObject, ...] = ()
    job: Text | None = None
    scene: Text | None = None
    T_table_photo: _PoseFact | None = None
    number: int = 0
    board: Text = ""

    def marked(self, name: str) -> MarkedObject:
        """Return one of the marked objects.

        Raises:
            UnknownName: if it was not marked.
        """
        for entry in self.objects:
            if entry.name == name:
                return entry
        raise UnknownName("object in the photo", name[:80], [entry.name for entry in self.objects])

    def with_object(self, changed: MarkedObject) -> TablePhoto:
        """Return the same photograph with an object in the place of the one of its name, or behind the others."""
        if any(entry.name == changed.name for entry in self.objects):
            kept = tuple(changed if entry.name == changed.name else entry for entry in self.objects)
        else:
            kept = (*self.objects, changed)
        return replace(self, objects=kept)

    def as_found(self, found: FoundScene) -> TablePhoto:
        """Return it with the focal length that its objects show, if that was unknown."""
        K = np.array(found.camera.K)
        return self if self.source != "assumed" or np.allclose(K, self.K) else replace(self, K=K, source="objects")

    def camera(self, T_world_camera: Pose, longest: int) -> Camera:
        """Return the camera that took the photo, in another frame and for a smaller picture.

        Args:
            T_world_camera: that maps camera coordinates to the other frame.
            longest: side of the picture [px].
        """
        scale = min(1.0, longest / max(self.width, self.height))
        width, height = max(round(scale * self.width), 1), max(round(scale * self.height), 1)
        per_axis = np.array([[width / self.width], [height / self.height], [1.0]])
        return Camera("photo", T_world_camera, self.K * per_axis, width, height)


class TablePhotoStore(RecordFolders[TablePhoto]):
    """The photographs of one data directory. Any thread may call.

    Args:
        root: the folder, DATA_DIR/photos; made when the first photo comes.
        max_photos: kept at once.
    """

    def __init__(self, root: Path, max_photos: int) -> None:
        super().__init__(root, TablePhoto, "photo", "photo.json", PICTURE, max_photos, TooManyPhotos)

    def picture(self, photo: str) -> Path:
        """Return where what is shown is of a photograph that exists."""
        return self._root / photo / PICTURE

    def sent(self, photo: str) -> Path:
        """Return where the file as it was sent is."""
        return self._root / photo / SENT

    def straight(self, photo: str) -> Path:
        """Return where all bits of a photograph are without the distortion of its lens; there may be none."""
        return self._root / photo / STRAIGHT

    def mask(self, photo: str, name: str) -> Path:
        """Return where the mask is of an object that was marked."""
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
        self._keep(record, {SENT: sent, STRAIGHT: straight, PICTURE: picture})

    def change(self, photo: str, changed: Callable[[TablePhoto], TablePhoto], files: Files = _NO_FILES) -> TablePhoto:
        """Give a photograph other facts, made of the latest ones, and other files; None removes one.

        Raises:
            UnknownName: if there is none, or as `changed`.
            CannotStore: if the disk is full.
        """
        with self._lock:
            record = changed(self.get(photo))
            self._replace(record, files)
        return record


def mask_file(name: str) -> str:
    """Return the name of the file with an object's mask."""
    return f"mask_{name}.png"
