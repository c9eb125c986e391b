"""Goal images on disk: DATA_DIR/goals/ID with `goal.png`, `goal.json`, and the photo it was cut out of, if it was."""

from __future__ import annotations

import contextlib
import json
import shutil
import threading
import uuid
from dataclasses import asdict, dataclass
from pathlib import Path
from typing import Any, Literal

from pydantic import FiniteFloat

from app.storage.durable import put_in_place
from app.storage.photo_crop import PhotoCrop
from app.storage.schema import CannotStore
from osfcore.errors import CorruptFile, InvalidInput, OsfError, UnknownName, shown
from osfcore.geometry.cameras import Camera
from osfcore.geometry.poses import Pose, unit_quaternion
from osfcore.io.files import read_json
from osfcore.io.json_codec import Entry, Text, decode, encode
from osfcore.io.scene_file import CameraJson, ObjectJson, camera_to_json

Source = Literal["upload", "composed", "drawn", "photo"]
Poses = tuple[tuple[str, Pose], ...]
IMAGE, PHOTO, _FACTS = "goal.png", "photo.jpg", "goal.json"
_TEMPORARY_PREFIX = ".new-"


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
        poses: of the objects in it, where they are known.
        example: that it belongs to; None if it is anybody's own.
        photo: that it was cut out of; None if it was made here, or by an earlier version.
    """

    id: str
    name: str
    created_at: str
    source: Source
    scene: str | None
    camera: Camera
    poses: Poses | None
    example: str | None = None
    photo: PhotoRecord | None = None


class CropJson(Entry):
    """What of a photo became the goal image, in its pixels and degrees."""

    left: FiniteFloat
    top: FiniteFloat
    width: FiniteFloat
    turn_deg: FiniteFloat


class PhotoJson(Entry):
    """The photo in goal.json."""

    width: int
    height: int
    crop: CropJson


class GoalJson(Entry):
    """What goal.json holds."""

    id: Text
    name: Text
    created_at: Text
    source: Source
    scene: Text | None
    camera: CameraJson
    objects: list[ObjectJson] | None
    example: Text | None = None
    photo: PhotoJson | None = None


class GoalStore:
    """The goals of one data directory. Any thread may call.

    Args:
        root: the folder, DATA_DIR/goals; made when the first goal comes.
        max_goals: kept at once.
    """

    def __init__(self, root: Path, max_goals: int) -> None:
        self._root = root
        self._max_goals = max_goals
        self._lock = threading.Lock()

    def start(self) -> None:
        """Remove what an earlier service left half done."""
        for folder in self._root.glob(f"{_TEMPORARY_PREFIX}*"):
            shutil.rmtree(folder, ignore_errors=True)

    def all(self) -> tuple[GoalRecord, ...]:
        """All goals, newest first."""
        records = []
        for path in self._root.glob(f"[!.]*/{_FACTS}"):
            with contextlib.suppress(CorruptFile, OSError):  # a damaged one must not hide the others
                records.append(_read(path))
        return tuple(sorted(records, key=lambda record: (record.created_at, record.id), reverse=True))

    def get(self, goal: str) -> GoalRecord:
        """One goal.

        Raises:
            UnknownName: if there is none.
        """
        records = self.all()
        for record in records:
            if record.id == goal:
                return record
        raise UnknownName("goal", goal[:80], [record.id for record in records][:5])

    def image(self, goal: str) -> Path:
        """The image of a goal that exists."""
        return self._root / goal / IMAGE

    def photo(self, goal: str) -> Path:
        """The photo that a goal that exists was cut out of; it may have none."""
        return self._root / goal / PHOTO

    def keep(self, record: GoalRecord, png: bytes, photo: bytes | None = None) -> None:
        """Keep a new goal, and the photo that it was cut out of.

        Raises:
            TooManyGoals: if there are too many.
            CannotStore: if the disk is full.
        """
        folder = self._root / f"{_TEMPORARY_PREFIX}{uuid.uuid4().hex[:12]}"
        try:
            with self._lock:  # others may come in at the same time
                if len(self.all()) >= self._max_goals:
                    raise TooManyGoals(self._max_goals)
                self._write(folder, record, png, photo)
                put_in_place(folder, self._root / record.id)
        except OSError as error:
            raise CannotStore(Path(self._root.name), error.strerror or str(error)) from error
        finally:
            shutil.rmtree(folder, ignore_errors=True)

    def replace(self, record: GoalRecord, png: bytes) -> None:
        """Give a goal another image, and other facts.

        Raises:
            UnknownName: if there is none.
            CannotStore: if the disk is full.
        """
        folder = self._root / f"{_TEMPORARY_PREFIX}{uuid.uuid4().hex[:12]}"
        try:
            with self._lock:
                self.get(record.id)
                self._write(folder, record, png, None)
                for name in (IMAGE, _FACTS):  # the photo stays
                    (folder / name).replace(self._root / record.id / name)
        except OSError as error:
            raise CannotStore(Path(self._root.name), error.strerror or str(error)) from error
        finally:
            shutil.rmtree(folder, ignore_errors=True)

    @staticmethod
    def _write(folder: Path, record: GoalRecord, png: bytes, photo: bytes | None) -> None:
        folder.mkdir(parents=True)
        (folder / IMAGE).write_bytes(png)
        if photo is not None:
            (folder / PHOTO).write_bytes(photo)
        (folder / _FACTS).write_text(json.dumps(_to_json(record), indent=1) + "\n", encoding="utf-8")

    def remove(self, goal: str) -> None:
        """Delete a goal; episodes that had it keep their own copy.

        Raises:
            UnknownName: if there is none.
            CannotStore: if that is not allowed.
        """
        self.get(goal)
        trash = self._root / f"{_TEMPORARY_PREFIX}{uuid.uuid4().hex[:12]}"
        try:
            (self._root / goal).rename(trash)
        except OSError as error:
            raise CannotStore(Path(self._root.name), error.strerror or str(error)) from error
        shutil.rmtree(trash, ignore_errors=True)


def poses_to_json(poses: Poses) -> list[dict[str, Any]]:
    """Poses as in scene.json."""
    return [encode(ObjectJson.of(name, pose)) for name, pose in poses]


def _to_json(record: GoalRecord) -> dict[str, Any]:
    facts = {key: getattr(record, key) for key in ("id", "name", "created_at", "source", "scene", "example")}
    objects = None if record.poses is None else poses_to_json(record.poses)
    photo = None if record.photo is None else asdict(record.photo)
    return {**facts, "camera": camera_to_json(record.camera), "objects": objects, "photo": photo}


def _read(path: Path) -> GoalRecord:
    def parse(data: object) -> GoalRecord:
        entry = decode(GoalJson, data, "goal")
        if entry.id != path.parent.name:
            raise InvalidInput("id", shown(entry.id), "the name of its folder")
        poses = None if entry.objects is None else tuple((placed.name, placed.pose()) for placed in entry.objects)
        for name, pose in poses or ():
            unit_quaternion(pose.quaternion, f"quaternion of {shown(name)}")
        facts = entry.model_dump(exclude={"camera", "objects", "photo"})
        photo = None
        if entry.photo is not None:
            photo = PhotoRecord(entry.photo.width, entry.photo.height, PhotoCrop(**entry.photo.crop.model_dump()))
        return GoalRecord(**facts, camera=entry.camera.camera(), poses=poses, photo=photo)

    return read_json(path, parse)
