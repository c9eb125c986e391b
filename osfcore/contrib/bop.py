"""Data sets in BOP's layout, and masks and poses of other programs."""

from __future__ import annotations

import csv
import io
import re
from collections.abc import Callable, Collection, Mapping, Sequence
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Any, Literal

import cv2
import numpy as np
from jaxtyping import Bool, Float
from pydantic import Field, FiniteFloat
from scipy.io import loadmat

from osfcore.errors import CorruptFile, InvalidInput, OsfError, UnknownName, check_ranges, shown
from osfcore.estimation.camera_response import Encoding, linear_from_encoded
from osfcore.geometry.cameras import MAX_IMAGE_SIDE, Camera
from osfcore.geometry.poses import Pose, quaternion_from_matrix, quaternion_to_matrix, unit_quaternion
from osfcore.geometry.states import EstimatedState, Observation
from osfcore.io.files import read_json
from osfcore.io.json_codec import Entry, Text, Vector3, Vector4, decode
from osfcore.io.observation_file import MAX_CAMERAS
from osfcore.photo.pose_loss import TablePrior
from osfcore.photo.poses import table_from_objects
from osfcore.photo.read_photograph import content_of, read_photograph

# The numbers of YCB-Video's objects, and the frames in which other programs give poses of YCB objects.
#
# Three frames of one object are in use; they have the same axes, and differ in where the origin lies:
#
# - "bop": the centre of the mesh's bounding box, as in BOP's YCB-V, and here.
# - "ycb_video": that of the models that came with YCB-Video (Xiang et al. 2018), of PoseCNN and its descendants: up
#   to 3 cm away. BOP's notes on its YCB-V list the shifts.
# - "google_16k": that of the meshes as YCB publishes them, in which the origin lies beside most objects.
#
# The bounding boxes of BOP's models and of the google_16k meshes agree along each axis within 0.3 mm, so that their
# axes are the same; but the wood block's is 13 mm wider in BOP, as if turned by about 9 degrees about z. Its poses
# are read as they are, and right as starts only.


ModelFrame = Literal["bop", "ycb_video", "google_16k"]

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
NAMES: tuple[str, ...] = tuple(name for name, _, _ in _ROWS)
_SHIFTS_MM: dict[str, dict[str, _Shift]] = {
    "ycb_video": {name: shift for name, shift, _ in _ROWS},
    "google_16k": {name: shift for name, _, shift in _ROWS if shift is not None}
    | {
        "013_apple": (0.86, -3.78, 35.55),
        "016_pear": (-33.32, 17.99, 32.65),
        "022_windex_bottle": (18.29, 11.93, 134.25),
    },
}


def name_of(number: int) -> str:
    """Return the object with a number, from 1 (002_master_chef_can) to 21 (061_foam_brick), of BOP's YCB-V and PoseCNN.

    Raises:
        InvalidInput: if there is none.
    """
    if not 1 <= number <= len(NAMES):
        raise InvalidInput("number of the object", number, f"1 to {len(NAMES)}, as in YCB-Video")
    return NAMES[number - 1]


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
    shifts = _SHIFTS_MM[frame]
    if name not in shifts:
        raise UnknownName(f"object of known origin in the frame {frame}", name, shifts)
    return Pose(pose.apply(1e-3 * np.array(shifts[name])), pose.quaternion)


# models_info.json of BOP: where the origin of each model lies.
#
# Objects here have their origin at the centre of their bounding box. A model of BOP spans min_x to min_x + size_x,
# and so on [mm], so that the centre lies at min + size / 2 in its frame. In BOP's own YCB-V that is zero.


MODELS_INFO = "models_info.json"


class _ModelJson(Entry):
    min_x: FiniteFloat
    min_y: FiniteFloat
    min_z: FiniteFloat
    size_x: FiniteFloat = Field(gt=0)
    size_y: FiniteFloat = Field(gt=0)
    size_z: FiniteFloat = Field(gt=0)


def read_centres(models: Path | None) -> Mapping[str, Float[np.ndarray, "3"]]:
    """Read where the box's centre lies in each model's frame, by name of the object [m].

    Args:
        models: folder with models_info.json; None for BOP's YCB-V, whose models are centred.

    Raises:
        CorruptFile: if the file is missing or broken.
    """
    if models is None:
        return dict.fromkeys(NAMES, np.zeros(3))
    entries = read_json(models / MODELS_INFO, lambda data: decode(dict[str, _ModelJson], data, MODELS_INFO))
    known = {str(number): name for number, name in enumerate(NAMES, 1)}
    return {
        known[number]: 1e-3 * np.array([e.min_x + e.size_x / 2, e.min_y + e.size_y / 2, e.min_z + e.size_z / 2])
        for number, e in entries.items()
        if number in known
    }


# Poses that another program found in a photograph, in the camera's frame.
#
# | file          | what it is                                                                  | unit | frame     |
# | .csv          | results of BOP: scene_id,im_id,obj_id,score,R,t,time                        | mm   | bop       |
# | scene_gt.json | annotations of BOP: cam_R_m2c, cam_t_m2c, obj_id by image                   | mm   | bop       |
# | .mat          | results of PoseCNN: rois (column 1 is the class), poses (w, x, y, z, then   | m    | ycb_video |
# |               | the position)                                                               |      |           |
# | .json         | {"025_mug": {"position": [3], "quaternion": [w, x, y, z]}}, or that by      | m    | bop       |
# |               | source, as in photo.json                                                    |      |           |
#
# Objects of BOP and PoseCNN have YCB-Video's numbers.


MAX_BYTES = 100_000_000
HEADER = "scene_id,im_id,obj_id,score,R,t,time"
SCENE_CAMERA, SCENE_GT = "scene_camera.json", "scene_gt.json"
_MOST_SKEW = 0.02  # of R R^T from the identity
_NEAR_M, _FAR_M = 0.02, 20.0  # where objects can be before a camera, and a table's frame
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
    """Read `T_camera_object` by name, to the centre of the object's box; of several poses the one with the best score.

    Args:
        path: of the file, in one of the forms above.
        choice: which of its poses.

    Raises:
        CorruptFile: if it is none of these, or a pose in it makes no sense.
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
    """Read the objects of an image from a scene_gt.json, in the order by which BOP numbers its masks.

    Raises:
        CorruptFile: if it is no scene_gt.json.
        InvalidInput: if it lacks the image.
    """
    return tuple(row.name for row in _image_rows(path, image))


def result_images(path: Path) -> dict[tuple[int, int], list[str]]:
    """Read the objects by scene and image from results of BOP (.csv).

    Raises:
        CorruptFile: if the file is broken.
    """
    found: dict[tuple[int, int], list[str]] = {}
    for row in _csv_rows(path):
        found.setdefault((row.scene, row.image), []).append(row.name)
    return found


def _of_image(rows: list[_Row], choice: PoseChoice) -> dict[str, Pose]:
    scene = _only("scene of the poses", choice.scene, {row.scene for row in rows})
    rows = [row for row in rows if row.scene == scene]
    image = _only("image of the poses", choice.image, {row.image for row in rows})
    chosen = sorted((row for row in rows if row.image == image), key=lambda row: row.score)
    return {row.name: row.pose for row in chosen}  # the best comes last


def _only(what: str, asked: int | str | None, there: set[int] | set[str]) -> Any:  # noqa: ANN401
    """Return what is asked for, or the only one there is."""
    if asked is None and len(there) == 1:
        return next(iter(there))
    if asked not in there:
        some = shown(", ".join(str(one) for one in sorted(there)))
        raise InvalidInput(what, "missing" if asked is None else asked, f"one of {some or 'none'}")
    return asked


def _csv_rows(path: Path) -> list[_Row]:
    text = content_of(path, shown(path), MAX_BYTES).decode("utf-8-sig", errors="replace").replace("\0", "?")
    try:
        lines = [line for line in csv.reader(io.StringIO(text)) if line]
    except csv.Error:
        raise CorruptFile(shown(path), "it is no table of values with commas between them") from None
    if lines and lines[0][0].strip() == "scene_id":
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
            expected = f"{HEADER} with 9 numbers for R and 3 for t, separated by spaces"
            raise CorruptFile(shown(path), f"pose {number} is not {expected}") from None
    return rows


def _gt_rows(data: object) -> list[_Row]:
    """Return the rows of a scene_gt.json; those of one image in its order."""
    by_image = decode(dict[str, list[_BopJson]], data, "scene_gt")
    return [
        _Row(0, int(image), name_of(entry.obj_id), 0.0, _bop_pose(np.array(entry.rotation), np.array(entry.position)))
        for image, entries in by_image.items()
        for entry in entries
    ]


def _image_rows(path: Path, image: int) -> list[_Row]:
    """Read the rows of one image from a scene_gt.json, in its order."""
    return [row for row in read_json(path, _gt_rows) if row.image == image]


def _of_json(path: Path, choice: PoseChoice) -> dict[str, Pose]:
    def parse(data: object) -> dict[str, Pose] | list[_Row]:
        if isinstance(data, dict) and data and all(str(key).isdecimal() for key in data):
            return _gt_rows(data)
        if isinstance(data, dict) and "poses_camera_object" in data:
            by_source = decode(dict[Text, dict[Text, _PoseJson]], data["poses_camera_object"], "poses_camera_object")
            entries: Mapping[str, _PoseJson] = by_source[_only("source of the poses", choice.source, set(by_source))]
        else:
            entries = decode(dict[Text, _PoseJson], data, "poses")
        return {name: _pose(entry.quaternion, entry.position, name) for name, entry in entries.items()}

    found = read_json(path, parse)
    return _of_image(found, PoseChoice(choice.image)) if isinstance(found, list) else found


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
    order = np.argsort(scores[:, 0], kind="stable") if scores.shape[1] else np.arange(len(classes))[::-1]
    found = {}
    for k in order:
        if np.any(poses[k, :4]):  # zeros stand for what was not found
            try:
                name = name_of(int(classes[k]))
                found[name] = _pose(poses[k, :4], poses[k, 4:], name)
            except OsfError as error:
                raise CorruptFile(shown(path), str(error).rstrip(".")) from None
    return found


def _bop_pose(rotation: np.ndarray, shift_mm: np.ndarray) -> Pose:
    """Return the pose of a rotation matrix, row by row, and a position in mm."""
    if rotation.shape != (9,) or shift_mm.shape != (3,):
        given = f"{rotation.size} and {shift_mm.size} numbers"
        raise InvalidInput("pose", given, "9 for the rotation and 3 for the position")
    quaternion = _nearest_rotation(rotation.reshape(3, 3), "rotation")
    return Pose(_before_camera(1e-3 * shift_mm, "mm"), quaternion)


def _nearest_rotation(matrix: Float[np.ndarray, "3 3"], what: str) -> Float[np.ndarray, "4"]:
    """Return the unit quaternion of the rotation next to a matrix, which must be one but for rounding."""
    bounded = np.all(np.abs(matrix) < 1 + _MOST_SKEW)  # false for NaN
    if not bounded or np.abs(matrix @ matrix.T - np.eye(3)).max() > _MOST_SKEW or np.linalg.det(matrix) < 0:
        raise InvalidInput(what, matrix.round(3).tolist(), "a rotation matrix, row by row")
    left, _, right = np.linalg.svd(matrix)
    return quaternion_from_matrix(left @ right)


def _pose(quaternion: Any, position: Any, name: str) -> Pose:  # noqa: ANN401
    quaternion = unit_quaternion(np.array(quaternion, float), f"quaternion of {shown(name)}")
    return Pose(_before_camera(np.array(position, float), "m"), quaternion)


def _before_camera(position: np.ndarray, unit: str) -> np.ndarray:
    if not _NEAR_M <= position[2] <= _FAR_M or not np.all(np.abs(position) <= _FAR_M):
        allowed = f"{_NEAR_M:g} to {_FAR_M:g} m before the camera; it is read as {unit}, z forward"
        raise InvalidInput("position [m]", position.round(6).tolist(), allowed)
    return position


# Poses as the results of BOP: what its toolkit evaluates.
#
#     scene_id,im_id,obj_id,score,R,t,time
#
# R are 9 numbers, row by row, t 3 in mm, separated by spaces: x_camera = R x_model + t in the frame of BOP's model.
# Objects here have their origin at the centre of their bounding box; BOP's models of YCB-V have theirs there, too,
# and where the folder of other models is given, models_info.json says where the centre lies. `time` is that of the
# whole image [s], -1 where it is not known.


UNKNOWN_TIME = -1.0  # [s]
_MOST_SCENE = 999_999


def bop_results(
    estimate: EstimatedState,
    cameras: tuple[Camera, ...],
    scene: int,
    models: Path | None = None,
    seconds: float = UNKNOWN_TIME,
) -> str:
    """Write every object of a state in every image as a CSV.

    The score is 1 / (1 + standard deviation of the position [mm]): 1 for a state that says nothing of it, 0 for one
    without bounds. BOP ranks by it.

    Args:
        estimate: of the scene.
        cameras: of the images; their names are the images' numbers, as `osf import bop` gives them.
        scene: number of the scene.
        models: folder with models_info.json; None for BOP's YCB-V.
        seconds: that the estimation took; the same for all images [s].

    Raises:
        InvalidInput: if a camera's name is no number.
        UnknownName: if an object is not one of YCB-V, or models_info.json lacks it.
        CorruptFile: if models_info.json is missing or broken.
    """
    check_ranges(("number of the scene", scene, 0, _MOST_SCENE), ("time [s]", seconds, UNKNOWN_TIME, np.inf))
    centres = read_centres(models)
    lines = [HEADER]
    for camera in cameras:
        if not camera.name.isdecimal():
            raise InvalidInput("name of a camera", camera.name, "the number of its image in BOP's scene")
        T_camera_world = camera.T_world_camera.inverse()
        for name, std in zip(estimate.state.names, estimate.position_std, strict=True):
            if name not in centres:
                raise UnknownName("object of BOP's YCB-V", name, centres)
            pose = T_camera_world @ estimate.state.pose(name)
            parts = quaternion_to_matrix(pose.quaternion).ravel(), 1e3 * pose.apply(-centres[name])
            R, t = (" ".join(f"{value:.8f}" for value in part) for part in parts)
            score = f"{1 / (1 + 1e3 * std):.6g}"
            lines.append(f"{scene},{int(camera.name)},{NAMES.index(name) + 1},{score},{R},{t},{seconds:g}")
    return "\n".join(lines) + "\n"


# Masks that another program or a person drew: a folder of PNG files, by name of the object or as BOP numbers them.
#
# NAME.png or mask_NAME.png: what is brighter than half of the brightest pixel is the object.
# IMAGE_INDEX.png (000059_000002.png): BOP's mask_visib; INDEX counts the objects of IMAGE in scene_gt.json beside it.


_BOP_NAME = re.compile(r"(\d{6})_(\d{6})\.png")


def read_masks(
    folder: Path, known: Collection[str], sizes: tuple[tuple[int, int], tuple[int, int]], image: int | None = None
) -> dict[str, Bool[np.ndarray, "h w"]]:
    """Read masks by name of the object; files of others are left alone, and so are masks without a pixel.

    Args:
        folder: that holds them.
        known: names of objects that are looked for.
        sizes: width and height of the photo as it was sent, which masks must have, and as it is worked on [px].
        image: number of the image, for masks as BOP numbers them.

    Raises:
        InvalidInput: if the folder holds no mask of a known object, a mask has another size than the photo, or BOP's
            masks lack scene_gt.json or the image's number.
        CorruptFile: if a file is no picture.
    """
    if not folder.is_dir():
        raise InvalidInput("folder of masks", folder, "a folder that exists")
    files = _bop_files(folder, image)
    if not files:
        named = [(name, folder / f"{start}{name}.png") for name in known for start in ("", "mask_")]
        files = {name: path for name, path in named if path.is_file()}
    masks = {name: _read(path, *sizes) for name, path in files.items() if name in known}
    masks = {name: mask for name, mask in masks.items() if mask.any()}
    if not masks:
        raise InvalidInput("number of masks of known objects in the folder", 0, "1 or more, such as 025_mug.png")
    return masks


def _bop_files(folder: Path, image: int | None) -> dict[str, Path]:
    """Return the files that are numbered as BOP does, by object."""
    numbered = [match for path in folder.iterdir() if (match := _BOP_NAME.fullmatch(path.name))]
    if not numbered:
        return {}
    shown = _only("image of the masks", image, {int(match[1]) for match in numbered})
    table = next((place / SCENE_GT for place in (folder, folder.parent) if (place / SCENE_GT).is_file()), None)
    if table is None:
        raise InvalidInput(f"{SCENE_GT} of the masks", "missing", "in the folder above them: it names what they show")
    names = scene_gt_names(table, shown)
    its = {int(match[2]): folder / match[0] for match in numbered if int(match[1]) == shown}
    return {name: its[index] for index, name in enumerate(names) if index in its}


def _read(path: Path, sent: tuple[int, int], kept: tuple[int, int]) -> Bool[np.ndarray, "h w"]:
    try:
        values = cv2.imdecode(np.frombuffer(path.read_bytes(), np.uint8), cv2.IMREAD_GRAYSCALE)
    except (OSError, cv2.error):
        values = None
    if values is None:
        raise CorruptFile(shown(path), "it is no picture")
    size = values.shape[1], values.shape[0]
    if size not in (sent, kept):
        given, wanted = (f"{width} x {height} pixels" for width, height in (size, sent))
        raise InvalidInput(f"size of the mask {shown(path.name)}", given, f"the photo's, {wanted}")
    share = (values > values.max() / 2).astype(np.float32)
    return share > 0 if size == kept else cv2.resize(share, kept, interpolation=cv2.INTER_AREA) > 0.5


# Images of a scene of a BOP data set, each with its camera, masks and annotated poses in the camera's own frame.
#
# FOLDER (its name is the scene's number)
#   scene_camera.json {"IMAGE": {"cam_K": [9], "cam_R_w2c": [9], "cam_t_w2c": [3]}}, mm
#   scene_gt.json {"IMAGE": [{"obj_id", "cam_R_m2c", "cam_t_m2c"}]}, mm
#   rgb/IMAGE.png or .jpg with six digits
#   mask_visib/IMAGE_INDEX.png
#
# What is assumed: objects have the numbers of YCB-V, and each is there once. BOP counts pixels from the centre of
# the first one, which is at (0.5, 0.5) here, so that half a pixel is added to its principal points.


_HALF_PIXEL = np.array([[0, 0, 0.5], [0, 0, 0.5], [0, 0, 0.0]])


class _CameraJson(Entry):
    """One image's camera in scene_camera.json."""

    K: list[FiniteFloat] = Field(alias="cam_K", min_length=9, max_length=9)
    R_w2c: list[FiniteFloat] | None = Field(default=None, alias="cam_R_w2c", min_length=9, max_length=9)
    t_w2c: Vector3 | None = Field(default=None, alias="cam_t_w2c")

    def T_camera_world(self, image: int) -> Pose | None:  # noqa: N802
        """Return the pose of BOP's world in the camera's frame [m]; None where the file lacks it.

        Raises:
            InvalidInput: if it is no rotation, or farther away than any table.
        """
        if self.R_w2c is None or self.t_w2c is None:
            return None
        quaternion = _nearest_rotation(np.array(self.R_w2c).reshape(3, 3), f"cam_R_w2c of image {image}")
        t = 1e-3 * np.array(self.t_w2c)
        if np.linalg.norm(t) > _FAR_M:
            raise InvalidInput(f"cam_t_w2c of image {image} [mm]", self.t_w2c, f"below {1e3 * _FAR_M:g} in length")
        return Pose(t, quaternion)


@dataclass(frozen=True, slots=True)
class BopChoice:
    """Which images of a scene are read, and how.

    Attributes:
        images: their numbers; None for all, spread evenly if there are more than an observation holds.
        encoding: of the pictures.
        models: folder with models_info.json; None for BOP's YCB-V.
    """

    images: tuple[int, ...] | None = None
    encoding: Encoding = "srgb"
    models: Path | None = None


@dataclass(frozen=True, eq=False, slots=True)
class BopImage:
    """One image of a scene.

    Attributes:
        number: of the image, and the name of its camera.
        camera: in its own frame: `T_world_camera` is the identity.
        picture: linear RGB in [0, 1].
        masks: visible pixels, of objects that have some.
        poses: annotated, `T_camera_object` to the centre of the box.
        T_camera_world: from BOP's world; None where that is unknown.
    """

    number: int
    camera: Camera
    picture: Float[np.ndarray, "h w 3"]
    masks: Mapping[str, Bool[np.ndarray, "h w"]]
    poses: Mapping[str, Pose]
    T_camera_world: Pose | None


def is_bop_scene(path: Path) -> bool:
    """Return whether a path is a folder with BOP's files in it."""
    return (path / SCENE_CAMERA).is_file() or (path / SCENE_GT).is_file()


def read_images(folder: Path, choice: BopChoice | None = None) -> tuple[BopImage, ...]:
    """Read images of a scene.

    Args:
        folder: of the scene.
        choice: which.

    Raises:
        CorruptFile: if a file is missing or broken, or a mask has another size than its picture.
        InvalidInput: if an image is chosen that is not there, or an object is there several times.
    """

    def parse(data: object) -> dict[int, _CameraJson]:
        entries = decode(dict[str, _CameraJson], data, SCENE_CAMERA)
        if not entries or not all(number.isdecimal() for number in entries):
            raise InvalidInput("images", shown(list(entries)), "numbered, at least one")
        return {int(number): entry for number, entry in entries.items()}

    choice = choice or BopChoice()
    entries, centres = read_json(folder / SCENE_CAMERA, parse), read_centres(choice.models)
    numbers = _chosen(choice.images, tuple(entries))
    return tuple(_image(folder, n, entries[n], _annotated(folder, n, centres), choice.encoding) for n in numbers)


def _chosen(asked: tuple[int, ...] | None, there: tuple[int, ...]) -> tuple[int, ...]:
    if asked is None:
        spread = np.linspace(0, len(there) - 1, min(len(there), MAX_CAMERAS)).round().astype(int)
        return tuple(there[number] for number in spread)
    if missing := [image for image in asked if image not in there]:
        raise InvalidInput("image", missing[0], f"one of {shown(', '.join(map(str, there)))}")
    if not 1 <= len(set(asked)) == len(asked) <= MAX_CAMERAS:
        raise InvalidInput("images", asked, f"1 to {MAX_CAMERAS}, all different")
    return asked


def _annotated(folder: Path, image: int, centres: Mapping[str, np.ndarray]) -> dict[str, Pose]:
    """Read `T_camera_object` of the objects in an image, in the frame of their boxes' centres."""
    poses: dict[str, Pose] = {}
    for row in _image_rows(folder / SCENE_GT, image):
        if row.name in poses:
            raise InvalidInput(f"objects of image {image}", f"{row.name} several times", "each there once")
        if row.name not in centres:
            raise InvalidInput(f"model of {row.name}", "missing", "in models_info.json")
        poses[row.name] = Pose(row.pose.apply(centres[row.name]), row.pose.quaternion)
    return poses


def _image(folder: Path, number: int, entry: _CameraJson, poses: Mapping[str, Pose], encoding: Encoding) -> BopImage:
    """Read an image with what belongs to it, reduced to the largest size of cameras."""
    png, jpg = (folder / "rgb" / f"{number:06d}{suffix}" for suffix in (".png", ".jpg"))
    picture_file = next((path for path in (png, jpg) if path.is_file()), None)
    if picture_file is None:
        raise CorruptFile(png, "there is no such picture, nor a .jpg")
    raw = read_photograph(picture_file, encoding=encoding)
    width, height = raw.sent_size
    scale = min(1.0, MAX_IMAGE_SIDE / max(width, height))
    size = round(width * scale), round(height * scale)
    K = np.diag([size[0] / width, size[1] / height, 1.0]) @ (np.array(entry.K).reshape(3, 3) + _HALF_PIXEL)
    masks: Mapping[str, np.ndarray] = {}
    try:
        camera, T_camera_world = Camera(str(number), Pose.identity(), K, *size), entry.T_camera_world(number)
        if poses:
            masks = read_masks(folder / "mask_visib", poses, (raw.sent_size, size), number)
    except CorruptFile:
        raise
    except OsfError as error:
        raise CorruptFile(folder, f"image {number}: {str(error).rstrip('.')}") from None
    picture = linear_from_encoded(raw.encoded.astype(np.float32) / np.iinfo(raw.encoded.dtype).max, encoding)
    if raw.encoded.shape[1::-1] != size:
        picture = cv2.resize(picture, size, interpolation=cv2.INTER_AREA)
    return BopImage(number, camera, np.clip(picture, 0, 1), masks, poses, T_camera_world)


# A scene of a BOP data set as an observation over a table, and the annotated poses beside it.
#
# BOP's world can be any frame: it counts as the table's (z up, table at z = 0) only if cameras are above it and
# objects near it, and else can be replaced by the table on which the objects lie.


_HIGHEST_M, _DEEPEST_M, _WIDEST_M = 1.0, 0.05, 1.5  # where objects on a table can be
_HOW_TO_FIND = "'osf import bop --table objects' finds the table by how the objects lie"


@dataclass(frozen=True, eq=False, slots=True)
class BopScene:
    """A scene over a table.

    Attributes:
        observation: cameras bear the numbers of their images.
        poses: `T_world_object` by name, as the first chosen image that shows the object annotates it.
        left_out: other objects that are annotated in these images.
    """

    observation: Observation
    poses: Mapping[str, Pose]
    left_out: tuple[str, ...]


def read_bop_scene(
    folder: Path,
    choice: BopChoice | None = None,
    names: tuple[str, ...] | None = None,
    table_prior: Callable[[str], TablePrior] | None = None,
    known: Collection[str] | None = None,
) -> BopScene:
    """Read a scene.

    Args:
        folder: of the scene.
        choice: which images, and how they are read.
        names: of the objects; None for all that are annotated and known.
        table_prior: how a known object can lie, to find the table by how they do; None to take BOP's world for it.
        known: objects that can be estimated; None for all.

    Raises:
        CorruptFile: if a file is missing or broken.
        InvalidInput: if images or objects are chosen that are not there, the cameras' places are missing, or BOP's
            world is not the table's frame.
    """
    images = read_images(folder, choice)
    there = tuple(sorted({name for image in images for name in image.poses}))
    if names is None:
        names = tuple(name for name in there if known is None or name in known)
    elif missing := [name for name in names if name not in there]:
        raise InvalidInput("object", missing[0], f"one that scene_gt.json has: {', '.join(there) or 'none'}")
    cameras = _in_bop_world(images) if table_prior is None else _over_found_table(images, table_prior, known)
    poses = {
        name: next(c @ i.poses[name] for c, i in zip(cameras, images, strict=True) if name in i.poses) for name in names
    }
    if table_prior is None:
        _check_over_table(images, cameras, poses)
    if len({image.picture.shape for image in images}) > 1:
        raise InvalidInput("sizes of the images", "not the same", "the same; choose images of one camera")
    hidden = np.zeros(images[0].picture.shape[:2], bool)
    placed = tuple(replace(image.camera, T_world_camera=pose) for image, pose in zip(images, cameras, strict=True))
    pictures = np.stack([image.picture for image in images])
    masks = np.stack([[image.masks.get(name, hidden) for name in names] for image in images])
    observation = Observation(placed, pictures, names, masks, None, 0.0)
    return BopScene(observation, poses, tuple(name for name in there if name not in names))


def _in_bop_world(images: Sequence[BopImage]) -> list[Pose]:
    """Return `T_world_camera` of each image."""
    poses: list[Pose] = []
    for image in images:
        if image.T_camera_world is None:
            raise InvalidInput(f"cam_R_w2c and cam_t_w2c of image {image.number}", "missing", f"given; {_HOW_TO_FIND}")
        poses.append(image.T_camera_world.inverse())
    return poses


def _over_found_table(
    images: Sequence[BopImage], table_prior: Callable[[str], TablePrior], known: Collection[str] | None
) -> list[Pose]:
    """Return `T_world_camera` of each image over the table on which the objects of the first one lie."""
    lost = [image.number for image in images if image.T_camera_world is None]
    if lost and len(images) > 1:
        what = f"cam_R_w2c and cam_t_w2c of image {lost[0]}"
        raise InvalidInput(what, "missing", "given for several images; choose one with --images")
    annotated = {name: pose for name, pose in images[0].poses.items() if known is None or name in known}
    found = table_from_objects([table_prior(name) for name in annotated], list(annotated.values()))
    if found is None:
        raise InvalidInput("table under the objects", "not to be found", "one that two or more objects stand on")
    if len(images) == 1:
        return [found.T_world_camera]
    in_bop = _in_bop_world(images)
    return [found.T_world_camera @ in_bop[0].inverse() @ pose for pose in in_bop]


def _check_over_table(images: Sequence[BopImage], cameras: Sequence[Pose], poses: Mapping[str, Pose]) -> None:
    """Refuse cameras below z = 0 and objects far from it, as in a world that is one of the cameras."""
    why = f"{SCENE_CAMERA} seems to mean another world or unit than mm: {_HOW_TO_FIND}"
    for image, camera in zip(images, cameras, strict=True):
        height = camera.position[2]
        if not height > _DEEPEST_M:
            what = f"height of image {image.number}'s camera in BOP's world [m]"
            raise InvalidInput(what, f"{height:.3f}", f"above a table at z = 0; {why}")
    for name, pose in poses.items():
        x, y, z = pose.position
        if not -_DEEPEST_M <= z <= _HIGHEST_M or max(abs(x), abs(y)) > _WIDEST_M:
            place = f"({x:.2f}, {y:.2f}, {z:.2f})"
            raise InvalidInput(f"place of {name} in BOP's world [m]", place, f"on a table at z = 0; {why}")
