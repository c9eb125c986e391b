"""Poses that another program found in a photograph, in the camera's frame.

| file | what it is | positions | frame of the object |
|---|---|---|---|
| .csv | results of BOP: scene_id,im_id,obj_id,score,R,t,time | mm | bop |
| scene_gt.json | annotations of BOP: cam_R_m2c, cam_t_m2c, obj_id by image | mm | bop |
| .mat | results of PoseCNN: rois (column 1 is the class), poses (w, x, y, z, then the position) | m | ycb_video |
| .json | {"025_mug": {"position": [3], "quaternion": [w, x, y, z]}}, or that by source, as in photo.json | m | bop |

Objects of BOP and PoseCNN have YCB-Video's numbers.
"""

from __future__ import annotations

import csv
import io
from collections.abc import Mapping
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np
from pydantic import Field
from scipy.io import loadmat

from osfcore.errors import CorruptFile, InvalidInput, OsfError, shown
from osfcore.geometry.poses import Pose, quaternion_from_matrix, unit_quaternion
from osfcore.io.files import read_json
from osfcore.io.json_codec import Entry, Text, Vector3, Vector4, decode
from osfcore.photo.other_programs.ycb_video import ModelFrame, in_object_frame, name_of

MAX_BYTES = 100_000_000
_COLUMNS = ("scene_id", "im_id", "obj_id", "score", "R", "t")
_NEAR_M, _FAR_M = 0.02, 20.0  # where objects can be before a camera
_QUATERNION = 4
_KINDS = "a .csv of BOP, a scene_gt.json, a .mat of PoseCNN, or a .json with a position and a quaternion of each object"


@dataclass(frozen=True, slots=True)
class PoseChoice:
    """Which of the poses in a file are meant; what is None may be left open only where it is the only one.

    Attributes:
        image: number of the image.
        scene: number of the scene.
        source: in a photo.json, whose poses; in a .mat, the variable that holds them ("poses" by default).
        frame: of the objects; that of the file's kind if None.
    """

    image: int | None = None
    scene: int | None = None
    source: str | None = None
    frame: ModelFrame | None = None


class _PoseJson(Entry):
    position: Vector3
    quaternion: Vector4


class _BopJson(Entry):
    rotation: list[float] = Field(alias="cam_R_m2c")
    position: Vector3 = Field(alias="cam_t_m2c")
    obj_id: int


@dataclass(frozen=True, eq=False, slots=True)
class _Row:
    """One pose of a table."""

    scene: int
    image: int
    name: str
    score: float
    pose: Pose


def read_poses(path: Path, choice: PoseChoice | None = None) -> dict[str, Pose]:
    """`T_camera_object` by name, objects in the frame of their box's centre; of several the one with the best score.

    Args:
        path: of the file, in one of the forms above.
        choice: which of its poses.

    Raises:
        CorruptFile: if it is none of these, or a pose in it is none.
        InvalidInput: if it holds several images, scenes or sources and the choice leaves it open, or lacks the chosen.
        UnknownName: if an object's origin is not known in the frame.
    """
    choice, suffix = choice or PoseChoice(), path.suffix.lower()
    frame: ModelFrame = "bop"
    if suffix == ".csv":
        poses = _of_image(_csv_rows(path), choice)
    elif suffix == ".mat":
        poses, frame = _of_mat(path, choice.source or "poses"), "ycb_video"
    elif suffix == ".json":
        poses = _of_json(path, choice)
    else:
        raise CorruptFile(shown(path), f"poses come in {_KINDS}")
    return {name: in_object_frame(pose, name, choice.frame or frame) for name, pose in poses.items()}


def scene_gt_names(path: Path, image: int) -> tuple[str, ...]:
    """Objects of an image in a scene_gt.json, in the order by which BOP numbers its masks.

    Raises:
        CorruptFile: if it is no scene_gt.json.
        InvalidInput: if it lacks the image.
    """
    return tuple(row.name for row in read_json(path, _gt_rows) if row.image == image)


def result_images(path: Path) -> dict[tuple[int, int], list[str]]:
    """Objects by scene and image in results of BOP (.csv).

    Raises:
        CorruptFile: if the file is none, or a pose in it is none.
    """
    found: dict[tuple[int, int], list[str]] = {}
    for row in _csv_rows(path):
        found.setdefault((row.scene, row.image), []).append(row.name)
    return found


def _of_image(rows: list[_Row], choice: PoseChoice) -> dict[str, Pose]:
    scene = _only("scene", choice.scene, {row.scene for row in rows})
    rows = [row for row in rows if row.scene == scene]
    image = _only("image", choice.image, {row.image for row in rows})
    chosen = sorted((row for row in rows if row.image == image), key=lambda row: row.score)
    return {row.name: row.pose for row in chosen}  # the best comes last


def _only(what: str, asked: int | str | None, there: set[int] | set[str]) -> Any:  # noqa: ANN401
    """What is asked for, or the only one there is."""
    if asked is None and len(there) == 1:
        return next(iter(there))
    if asked not in there:
        some = shown(", ".join(str(one) for one in sorted(there)))
        raise InvalidInput(f"{what} of the poses", "not told" if asked is None else asked, f"one of {some or 'none'}")
    return asked


def _csv_rows(path: Path) -> list[_Row]:
    text = _content(path).decode("utf-8-sig", errors="replace").replace("\0", "?")
    try:
        lines = [line for line in csv.reader(io.StringIO(text)) if line]
    except csv.Error:
        raise CorruptFile(shown(path), "it is no table of values with commas between them") from None
    if lines and lines[0][0].strip() == _COLUMNS[0]:
        lines = lines[1:]
    if not lines:
        raise CorruptFile(shown(path), "it holds no poses")
    rows = []
    for number, line in enumerate(lines, 1):
        try:
            scene, image, obj = (int(value) for value in line[:3])
            rotation, shift = (np.array(line[k].split(), float) for k in (4, 5))
            rows.append(_Row(scene, image, name_of(obj), float(line[3]), _bop_pose(rotation, shift)))
        except OsfError as error:
            raise CorruptFile(shown(path), f"pose {number}: {str(error).rstrip('.')}") from None
        except (ValueError, IndexError):
            expected = f"{','.join(_COLUMNS)},time with 9 numbers for R and 3 for t"
            raise CorruptFile(shown(path), f"pose {number} is not {expected}, separated by spaces") from None
    return rows


def _gt_rows(data: object) -> list[_Row]:
    """Rows of a scene_gt.json; those of one image in its order."""
    by_image = decode(dict[str, list[_BopJson]], data, "scene_gt")
    return [
        _Row(0, int(image), name_of(entry.obj_id), 0.0, _bop_pose(np.array(entry.rotation), np.array(entry.position)))
        for image, entries in by_image.items()
        for entry in entries
    ]


def _of_json(path: Path, choice: PoseChoice) -> dict[str, Pose]:
    def parse(data: object) -> dict[str, Pose] | list[_Row]:
        if isinstance(data, dict) and data and all(str(key).isdecimal() for key in data):
            return _gt_rows(data)
        if isinstance(data, dict) and "poses_camera_object" in data:
            by_source = decode(dict[Text, dict[Text, _PoseJson]], data["poses_camera_object"], "poses_camera_object")
            entries: Mapping[str, _PoseJson] = by_source[_only("source", choice.source, set(by_source))]
        else:
            entries = decode(dict[Text, _PoseJson], data, "poses")
        return {name: _pose(entry.quaternion, entry.position, name) for name, entry in entries.items()}

    found = read_json(path, parse)
    return _of_image(found, PoseChoice(choice.image)) if isinstance(found, list) else found


def _of_mat(path: Path, variable: str) -> dict[str, Pose]:
    content = _content(path)
    try:
        data = loadmat(io.BytesIO(content))
        classes, poses = np.atleast_2d(data["rois"])[:, 1].astype(int), np.atleast_2d(data[variable]).astype(float)
        scores = np.atleast_2d(data["rois"])[:, 6:].astype(float)
    except KeyError as error:
        raise CorruptFile(shown(path), f"it has no variable {error}, as results of PoseCNN have") from None
    except Exception:  # readers of MATLAB's files raise whatever they stumble over
        raise CorruptFile(shown(path), "it is no file of MATLAB with results of PoseCNN") from None
    if poses.shape != (len(classes), 7):
        raise CorruptFile(shown(path), f"its {variable} are not 7 numbers for each of its {len(classes)} rois")
    order = np.argsort(scores[:, 0], kind="stable") if scores.shape[1] else np.arange(len(classes))[::-1]
    seen = [k for k in order if np.any(poses[k, :_QUATERNION])]  # zeros stand for what was not found
    return dict(_named(path, int(classes[k]), poses[k]) for k in seen)


def _named(path: Path, number: int, values: np.ndarray) -> tuple[str, Pose]:
    try:
        name = name_of(number)
        return name, _pose(values[:_QUATERNION], values[_QUATERNION:], name)
    except OsfError as error:
        raise CorruptFile(shown(path), str(error).rstrip(".")) from None


def _bop_pose(rotation: np.ndarray, shift_mm: np.ndarray) -> Pose:
    """The pose of a rotation matrix, row by row, and a position in mm."""
    if rotation.shape != (9,) or shift_mm.shape != (3,):
        raise InvalidInput(
            "pose", f"{rotation.size} and {shift_mm.size} numbers", "9 for the rotation and 3 for the position"
        )
    matrix = rotation.reshape(3, 3)
    bounded = np.all(np.abs(matrix) < 1 + _MOST_SKEW)  # false for NaN
    if not bounded or np.abs(matrix @ matrix.T - np.eye(3)).max() > _MOST_SKEW or np.linalg.det(matrix) < 0:
        raise InvalidInput("rotation", matrix.round(3).tolist(), "a rotation matrix, row by row")
    left, _, right = np.linalg.svd(matrix)
    return Pose(_before_camera(1e-3 * shift_mm, "mm"), quaternion_from_matrix(left @ right))


def _pose(quaternion: Any, position: Any, name: str) -> Pose:  # noqa: ANN401
    quaternion = unit_quaternion(np.array(quaternion, float), f"quaternion of {shown(name)}")
    return Pose(_before_camera(np.array(position, float), "m"), quaternion)


def _before_camera(position: np.ndarray, unit: str) -> np.ndarray:
    if not _NEAR_M <= position[2] <= _FAR_M or not np.all(np.abs(position) <= _FAR_M):
        allowed = f"{_NEAR_M:g} to {_FAR_M:g} m before the camera; it is read as {unit}, z forward"
        raise InvalidInput("position [m]", position.round(6).tolist(), allowed)
    return position


def _content(path: Path) -> bytes:
    try:
        if path.stat().st_size > MAX_BYTES:
            raise CorruptFile(shown(path), f"it is larger than {MAX_BYTES // 1_000_000} MB")
        return path.read_bytes()
    except OSError as error:
        raise CorruptFile(shown(path), error.strerror or str(error)) from error
