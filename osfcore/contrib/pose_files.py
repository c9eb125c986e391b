"""Poses that another program found in a photograph, in the camera's frame.

| file          | what it is                                                                  | unit | frame     |
| .csv          | results of BOP: scene_id,im_id,obj_id,score,R,t,time                        | mm   | bop       |
| scene_gt.json | annotations of BOP: cam_R_m2c, cam_t_m2c, obj_id by image                   | mm   | bop       |
| .mat          | results of PoseCNN: rois (column 1 is the class), poses (w, x, y, z, then   | m    | ycb_video |
|               | the position)                                                               |      |           |
| .txt          | FoundationPose's ob_in_cam: a 4 x 4 or 3 x 4 matrix of one object           | m    | bop       |
| .json         | DOPE's and NDDS's: objects with class, location, quaternion_xyzw            | cm   | dope      |
| .json         | happypose's: [{"label", "TWO": [[x, y, z, w], [3]]}]                        | m    | bop       |
| .json         | {"025_mug": {"position": [3], "quaternion": [w, x, y, z]}}, or that by      | m    | bop       |
|               | source, as in photo.json                                                    |      |           |

Objects of BOP, PoseCNN and happypose have YCB-Video's numbers, unless BOP's data set names them.
"""

from __future__ import annotations

import io
import re
from collections.abc import Collection, Iterable, Mapping
from dataclasses import dataclass
from pathlib import Path
from typing import Any, Literal

import numpy as np
from pydantic import Field, FiniteFloat
from scipy.io import loadmat

from osfcore.contrib.bop import (
    MAX_BYTES,
    NAMES,
    NUMBERED,
    BopRow,
    annotated_rows,
    before_camera,
    nearest_rotation,
    object_of,
    only,
    read_objects,
    result_rows,
)
from osfcore.errors import CorruptFile, InvalidInput, OsfError, UnknownName, finite_vector, shown
from osfcore.geometry.poses import Pose, unit_quaternion
from osfcore.io.files import read_json
from osfcore.io.json_codec import Entry, Text, Vector3, Vector4, decode
from osfcore.photo.read_photograph import content_of

# The frames in which other programs give poses of YCB objects.
#
# The first three have the same axes, and differ in where the origin lies:
#
# - "bop": the centre of the mesh's bounding box, as in BOP's YCB-V, and here.
# - "ycb_video": that of the models that came with YCB-Video (Xiang et al. 2018), of PoseCNN and its descendants: up
#   to 3 cm away. BOP's notes on its YCB-V list the shifts.
# - "google_16k": that of the meshes as YCB publishes them, in which the origin lies beside most objects.
# - "dope": the centre of the box, but turned: y points down along the object, as NVIDIA's data sets FAT and NDDS, and
#   networks that were trained with them, have it. fixed_model_transform in NVIDIA's Dataset_Utilities says how.
#
# The bounding boxes of BOP's models and of the google_16k meshes agree along each axis within 0.3 mm, so that their
# axes are the same; but the wood block's is 13 mm wider in BOP, as if turned by about 9 degrees about z. Its poses
# are read as they are, and right as starts only.


ModelFrame = Literal["bop", "ycb_video", "google_16k", "dope"]

_Shift = tuple[float, float, float]
# Name, from YCB-Video's origin to the box's centre, and from google_16k's (None where that was not measured) [mm]
_ROWS: tuple[tuple[str, _Shift, _Shift | None], ...] = (
    ("002_master_chef_can", (-1.3360, 0.5000, -3.5105), (-17.05, -9.76, 69.90)),
    ("003_cracker_box", (-0.5575, -1.7005, -4.8050), (-12.88, -14.14, 103.48)),
    ("004_sugar_box", (0.9520, -1.4670, -4.3645), (-7.47, -16.71, 88.04)),
    ("005_tomato_soup_can", (0.0240, 1.5270, -8.4035), (-9.17, 84.02, 51.01)),
    ("006_mustard_bottle", (-1.2995, -2.4870, 11.8290), (-15.34, -23.50, 92.50)),
    ("007_tuna_fish_can", (0.1565, -0.1150, -4.2625), (-26.05, -22.13, 13.55)),
    ("008_pudding_box", (-1.1645, 4.2015, -3.1190), (0.50, 19.12, 18.95)),
    ("009_gelatin_box", (-1.4460, 0.5915, -3.6085), (-22.77, -8.24, 14.49)),
    ("010_potted_meat_can", (-2.4195, -0.3075, -8.0715), (-32.78, -26.55, 38.58)),
    ("011_banana", (18.6730, -12.1915, 1.4635), (11.48, -7.34, 17.96)),
    ("019_pitcher_base", (-5.3370, -5.8855, -25.6115), (-5.83, 40.05, 118.37)),
    ("021_bleach_cleanser", (-4.9290, 2.4800, 13.2920), (-21.66, 11.71, 124.84)),
    ("024_bowl", (0.2270, -0.7950, 2.9675), (-14.84, -43.69, 26.97)),
    ("025_mug", (8.4675, 0.6995, 1.6145), (-8.86, 17.34, 40.12)),
    ("035_power_drill", (-9.0710, -20.9360, 2.1190), (-45.96, 10.59, 25.47)),
    ("036_wood_block", (-1.4265, 2.5305, -17.1890), (23.71, -10.91, 102.94)),
    ("037_scissors", (-7.0535, 28.1320, -0.0420), None),
    ("040_large_marker", (-0.0460, 2.1040, -0.3500), None),
    ("051_large_clamp", (-10.5180, 1.9640, 0.4745), None),
    ("052_extra_large_clamp", (0.3950, 10.4130, -0.1620), None),
    ("061_foam_brick", (0.0805, -0.0805, 8.2435), (-18.26, 17.20, 25.25)),
)
_SHIFTS_MM: dict[str, dict[str, _Shift]] = {
    "ycb_video": {name: shift for name, shift, _ in _ROWS},
    "google_16k": {name: shift for name, _, shift in _ROWS if shift is not None}
    | {
        "013_apple": (0.86, -3.78, 35.55),
        "016_pear": (-33.32, 17.99, 32.65),
        "022_windex_bottle": (18.29, 11.93, 134.25),
    },
}
# From DOPE's frame to ours: unit quaternion (w, x, y, z), and where the centre of our box lies [mm]
_TURNS: dict[str, tuple[tuple[float, float, float, float], _Shift]] = {
    "002_master_chef_can": ((0.68301, 0.68301, -0.18301, 0.18301), (0.02, 0.0, -0.07)),
    "003_cracker_box": ((0.5, 0.5, -0.5, 0.5), (0.0, -0.01, 0.0)),
    "004_sugar_box": ((0.49577, 0.48659, -0.49547, 0.52149), (0.43, -0.36, 0.12)),
    "005_tomato_soup_can": ((0.70559, 0.70559, 0.04625, -0.04625), (0.08, 0.0, 0.05)),
    "006_mustard_bottle": ((0.69291, 0.69291, -0.14097, 0.14097), (-0.01, 0.0, -0.49)),
    "007_tuna_fish_can": ((0.70711, 0.70711, 0.0, 0.0), (0.0, 0.0, 0.0)),
    "008_pudding_box": ((0.24178, -0.01481, -0.01163, 0.97015), (0.05, 0.06, 0.78)),
    "009_gelatin_box": ((0.7826, -0.00272, -0.00341, 0.62251), (-0.13, -0.04, -0.03)),
    "010_potted_meat_can": ((0.70686, 0.70686, 0.01851, -0.01851), (-0.06, 0.0, -0.03)),
    "011_banana": ((0.35223, 0.44041, -0.62699, 0.53745), (3.59, -4.95, 14.49)),
    "019_pitcher_base": ((0.65562, 0.65562, 0.26489, -0.26489), (-0.7, 0.0, -1.25)),
    "021_bleach_cleanser": ((0.0, 0.0, 0.70711, -0.70711), (0.0, 0.0, 0.0)),
    "024_bowl": ((0.5, 0.5, -0.5, 0.5), (0.0, 0.0, 0.0)),
    "025_mug": ((0.70686, 0.70686, -0.01851, 0.01851), (0.01, 0.0, 0.78)),
    "035_power_drill": ((0.01324, -0.99972, -0.0085, 0.01756), (-1.25, 0.48, -1.13)),
    "036_wood_block": ((0.44259, 0.43777, -0.55146, 0.5553), (-0.17, -0.39, 0.15)),
    "061_foam_brick": ((0.5, 0.5, -0.5, 0.5), (0.0, 0.0, 0.0)),
}


_DOPE = {  # what the networks that its authors published call objects
    "cracker": "003_cracker_box", "gelatin": "009_gelatin_box", "meat": "010_potted_meat_can",
    "mustard": "006_mustard_bottle", "soup": "005_tomato_soup_can", "sugar": "004_sugar_box",
}  # fmt: skip


def in_object_frame(pose: Pose, name: str, frame: ModelFrame) -> Pose:
    """Return `T_camera_object`, in the frame of the box's centre, of a pose in one of the other frames.

    Args:
        pose: from the model's frame to the camera's.
        name: of the object.
        frame: of the model.

    Raises:
        UnknownName: if it is not known where the box's centre lies in that frame.
    """
    if frame == "bop":  # whatever the object
        return pose
    known = _TURNS if frame == "dope" else _SHIFTS_MM[frame]
    if name not in known:
        raise UnknownName(f"object of known origin in the frame {frame}", name, known)
    quaternion, shift = _TURNS[name] if frame == "dope" else ((1.0, 0.0, 0.0, 0.0), _SHIFTS_MM[frame][name])
    return pose @ Pose(1e-3 * np.array(shift), unit_quaternion(np.array(quaternion), "turn"))


# The files.


_KINDS = (
    "a .csv of BOP, a scene_gt.json, a .mat of PoseCNN, a .txt of FoundationPose, or a .json of DOPE, of happypose or "
    "with a position and a quaternion of each object"
)


@dataclass(frozen=True, slots=True)
class PoseChoice:
    """Which of the poses in a file are meant; what is None may be left open only where it is the only one.

    Attributes:
        image: number of the image.
        scene: number of the scene.
        source: in a photo.json, whose poses; in a .mat, the variable that holds them ("poses" by default).
        frame: of the objects; that of the file's kind if None.
        names: of the objects in the photo, where a file does not say whose a pose is.
    """

    image: int | None = None
    scene: int | None = None
    source: str | None = None
    frame: ModelFrame | None = None
    names: tuple[str, ...] = ()


class _PoseJson(Entry):
    position: Vector3
    quaternion: Vector4


class _DopeJson(Entry):
    name: Text = Field(alias="class")
    location: Vector3
    quaternion_xyzw: Vector4


class _HappyposeJson(Entry):
    label: Text
    TWO: list[list[FiniteFloat]] = Field(min_length=2, max_length=2)


def read_poses(path: Path, choice: PoseChoice | None = None) -> dict[str, Pose]:
    """Read `T_camera_object` by name, to the centre of the object's box; of several poses the one with the best score.

    Of an object that is there several times without scores, none is returned. Objects of which only a number is known
    are called "object 22".

    Args:
        path: of the file, in one of the forms above.
        choice: which of its poses.

    Raises:
        CorruptFile: if it is none of these, or a pose in it makes no sense.
        InvalidInput: if it holds several images, scenes or sources and the choice leaves it open, or lacks the chosen;
            or if nothing says whose the pose of a .txt is.
        UnknownName: if an object's origin is not known in the frame.
    """
    choice, suffix = choice or PoseChoice(), path.suffix.lower()
    frame: ModelFrame = "bop"
    if suffix == ".csv":
        poses = _of_image(result_rows(path), choice)
    elif suffix == ".mat":
        poses, frame = _of_mat(path, choice.source or "poses"), "ycb_video"
    elif suffix == ".json":
        poses = _of_json(path, choice)
    elif suffix == ".txt":
        poses = _of_txt(path, choice.names)
    else:
        raise CorruptFile(shown(path), f"poses come in {_KINDS}")
    frame = choice.frame or frame
    if frame != "bop":  # nobody knows where the origin of an object without a name is
        poses = {name: pose for name, pose in poses.items() if not NUMBERED.fullmatch(name)}
    return {name: in_object_frame(pose, name, frame) for name, pose in poses.items()}


def _of_image(rows: list[BopRow], choice: PoseChoice) -> dict[str, Pose]:
    scene = only("scene of the poses", choice.scene, {row.scene for row in rows})
    rows = [row for row in rows if row.scene == scene]
    image = only("image of the poses", choice.image, {row.image for row in rows})
    chosen = sorted((row for row in rows if row.image == image), key=lambda row: row.score)
    return _unambiguous((row.object.name, row.score, row.pose) for row in chosen if row.pose is not None)


def _unambiguous(found: Iterable[tuple[str, float, Pose]]) -> dict[str, Pose]:
    """Return the pose of each object with the best score, where that is one pose."""
    best: dict[str, tuple[float, Pose | None]] = {}
    for name, score, pose in found:
        if name not in best or score > best[name][0]:
            best[name] = score, pose
        elif score == best[name][0]:
            best[name] = score, None
    return {name: pose for name, (_, pose) in best.items() if pose is not None}


def _of_json(path: Path, choice: PoseChoice) -> dict[str, Pose]:
    def parse(data: object) -> dict[str, Pose] | None:
        if isinstance(data, dict) and data and all(str(key).isdecimal() for key in data):
            return None  # of BOP
        if isinstance(data, list):
            return _of_happypose(decode(list[_HappyposeJson], data, "poses"), choice.names)
        if isinstance(data, dict) and isinstance(data.get("objects"), list):
            return _of_dope(decode(list[_DopeJson], data["objects"], "objects"), choice)
        if isinstance(data, dict) and "poses_camera_object" in data:
            by_source = decode(dict[Text, dict[Text, _PoseJson]], data["poses_camera_object"], "poses_camera_object")
            entries: Mapping[str, _PoseJson] = by_source[only("source of the poses", choice.source, set(by_source))]
        else:
            entries = decode(dict[Text, _PoseJson], data, "poses")
        return {name: _pose(entry.quaternion, entry.position, name) for name, entry in entries.items()}

    found = read_json(path, parse)
    return _of_image(annotated_rows(path), PoseChoice(choice.image)) if found is None else found


def _of_dope(entries: list[_DopeJson], choice: PoseChoice) -> dict[str, Pose]:
    """Return poses of DOPE, in whose frame an object lies that DOPE's authors trained; others are taken as centred."""
    found = []
    for entry in entries:
        name, (x, y, z, w) = _known_as(entry.name, choice.names), entry.quaternion_xyzw
        pose = _pose((w, x, y, z), np.array(entry.location) / 100, name, "cm")
        turned = choice.frame is None and name in _TURNS
        found.append((name, 0.0, in_object_frame(pose, name, "dope") if turned else pose))
    return _unambiguous(found)


def _of_happypose(entries: list[_HappyposeJson], names: tuple[str, ...]) -> dict[str, Pose]:
    found = []
    for entry in entries:
        x, y, z, w = finite_vector(entry.TWO[0], 4, f"quaternion of {shown(entry.label)}")
        position = finite_vector(entry.TWO[1], 3, f"position of {shown(entry.label)}")
        number = re.fullmatch(r"(?:.*-)?obj_(\d{6})", entry.label)
        name = object_of(read_objects(None), int(number[1])).name if number else _known_as(entry.label, names)
        found.append((name, 0.0, _pose((w, x, y, z), position, name)))
    return _unambiguous(found)


def _known_as(label: str, names: Collection[str]) -> str:
    """Return our name of another program's class, such as "003_cracker_box_16k"; the class itself if there is none."""
    if label in _DOPE:
        return _DOPE[label]
    plain = _plain(label.removesuffix("_16k"))
    alike = (name for name in (*names, *NAMES) if plain in (_plain(name), _plain(name).lstrip("0123456789")))
    return next(alike, label)


def _plain(name: str) -> str:
    return re.sub(r"[^a-z0-9]", "", name.lower())


def _of_txt(path: Path, names: tuple[str, ...]) -> dict[str, Pose]:
    """Return the pose of a .txt, of the object that file or folder is named after, or that alone is in the photo."""
    text = content_of(path, shown(path), MAX_BYTES).decode("utf-8", errors="replace")
    try:
        numbers = np.array(re.sub(r"[\[\],;]", " ", text).split(), float)
    except ValueError:
        numbers = np.zeros(0)
    if numbers.size == 12:
        numbers = np.append(numbers, (0, 0, 0, 1))
    if numbers.size != 16 or not np.array_equal(numbers[12:], (0, 0, 0, 1)):
        raise CorruptFile(shown(path), "it is no 4 x 4 matrix with the last row 0 0 0 1, nor its first three rows")
    named = [name for name in (path.stem, *reversed(path.absolute().parent.parts)) if name in names]
    if not named and len(names) != 1:
        allowed = f"the only one with a box or mask, or the name of {path.name} or of a folder above it"
        raise InvalidInput("object of the pose", "unknown", allowed)
    matrix = numbers.reshape(4, 4)
    try:
        quaternion = nearest_rotation(matrix[:3, :3], "rotation")
        return {(named or names)[0]: Pose(before_camera(matrix[:3, 3], "m"), quaternion)}
    except OsfError as error:
        raise CorruptFile(shown(path), str(error).rstrip(".")) from None


def _of_mat(path: Path, variable: str) -> dict[str, Pose]:
    content = content_of(path, shown(path), MAX_BYTES)
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
    objects = read_objects(None)
    order = np.argsort(scores[:, 0], kind="stable") if scores.shape[1] else np.arange(len(classes))[::-1]
    found = {}
    for k in order:
        if np.any(poses[k, :4]):  # zeros stand for what was not found
            try:
                name = object_of(objects, int(classes[k])).name
                found[name] = _pose(poses[k, :4], poses[k, 4:], name)
            except OsfError as error:
                raise CorruptFile(shown(path), str(error).rstrip(".")) from None
    return found


def _pose(quaternion: Any, position: Any, name: str, unit: str = "m") -> Pose:  # noqa: ANN401
    quaternion = unit_quaternion(np.array(quaternion, float), f"quaternion of {shown(name)}")
    return Pose(before_camera(np.array(position, float), unit), quaternion)
