"""Goal images on disk: DATA_DIR/goals/ID with `goal.png`, `goal.json`, and the photo it was cut out of, if it was."""

from __future__ import annotations

import json
from dataclasses import asdict, dataclass
from pathlib import Path
from typing import Any, Literal

from pydantic import FiniteFloat

from app.storage.photo_crop import PhotoCrop
from app.storage.record_folders import RecordFolders
from osfcore.errors import InvalidInput, OsfError, shown
from osfcore.geometry.cameras import Camera
from osfcore.geometry.poses import Pose, unit_quaternion
from osfcore.io.files import read_json
from osfcore.io.json_codec import Entry, Text, decode, encode
from osfcore.io.scene_file import CameraJson, ObjectJson, camera_to_json

Source = Literal["upload", "composed", "drawn", "photo"]
Poses = tuple[tuple[str, Pose], ...]
IMAGE, PHOTO, _FACTS = "goal.png", "photo.jpg", "goal.json"


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


class GoalStore(RecordFolders[GoalRecord]):
    """The goals of one data directory. Any thread may call.

    Args:
        root: the folder, DATA_DIR/goals; made when the first goal comes.
        max_goals: kept at once.
    """

    def __init__(self, root: Path, max_goals: int) -> None:
        super().__init__(root, "goal", _FACTS, _read, max_goals, TooManyGoals)

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
        self._keep(record.id, {IMAGE: png, PHOTO: photo, _FACTS: _facts(record)})

    def replace(self, record: GoalRecord, png: bytes) -> None:
        """Give a goal another image, and other facts.

        Raises:
            UnknownName: if there is none.
            CannotStore: if the disk is full.
        """
        self._replace(record.id, {IMAGE: png, _FACTS: _facts(record)})


def poses_to_json(poses: Poses) -> list[dict[str, Any]]:
    """Poses as in scene.json."""
    return [encode(ObjectJson.of(name, pose)) for name, pose in poses]


def _facts(record: GoalRecord) -> bytes:
    return (json.dumps(_to_json(record), indent=1) + "\n").encode()


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
