"""Data sets in BOP's layout: their objects, annotations, results, masks, images and scenes."""

from __future__ import annotations

import csv
import io
import re
from collections import Counter
from collections.abc import Callable, Collection, Mapping, Sequence
from dataclasses import dataclass, field, replace
from itertools import product
from pathlib import Path
from typing import Any

import cv2
import numpy as np
from jaxtyping import Bool, Float
from pydantic import Field, FiniteFloat

from osfcore.errors import CorruptFile, InvalidInput, OsfError, UnknownName, check_ranges, shown
from osfcore.estimation.camera_response import Encoding, linear_from_encoded
from osfcore.geometry.cameras import MAX_IMAGE_SIDE, Camera
from osfcore.geometry.poses import Pose, quaternion_from_matrix, quaternion_to_matrix
from osfcore.geometry.states import EstimatedState, Observation
from osfcore.io.files import read_json
from osfcore.io.json_codec import Entry, Text, Vector3, decode
from osfcore.io.observation_file import MAX_CAMERAS
from osfcore.photo.lens import HALF_PIXEL
from osfcore.photo.pose_loss import TablePrior
from osfcore.photo.poses import table_from_objects
from osfcore.photo.read_photograph import content_of, read_photograph

# The objects of a data set: names, sizes, and where the origin of each model lies.
#
# A data set numbers its objects. Where its models_info.json gives an object a "name", it is called so; else the numbers
# count as those of BOP's YCB-V, 1 (002_master_chef_can) to 21 (061_foam_brick), if the sizes are YCB-V's, too.
#
# Objects here have their origin at the centre of their bounding box. A model of BOP spans min_x to min_x + size_x,
# and so on [mm], so that the centre lies at min + size / 2 in its frame. In BOP's own YCB-V that is zero.


MODELS_INFO = "models_info.json"
_Size = tuple[float, float, float]
_YCBV: tuple[tuple[str, _Size | None], ...] = (  # the box of each object [mm]; None where it was not measured
    ("002_master_chef_can", (102.5, 102.4, 140.2)),
    ("003_cracker_box", (71.8, 164.0, 213.4)),
    ("004_sugar_box", (49.5, 94.2, 176.0)),
    ("005_tomato_soup_can", (67.9, 67.7, 101.9)),
    ("006_mustard_bottle", (97.2, 66.6, 191.3)),
    ("007_tuna_fish_can", (85.6, 85.5, 33.5)),
    ("008_pudding_box", (137.9, 128.8, 38.9)),
    ("009_gelatin_box", (89.4, 101.1, 30.1)),
    ("010_potted_meat_can", (102.1, 60.1, 83.5)),
    ("011_banana", (108.9, 178.4, 36.7)),
    ("019_pitcher_base", (149.1, 144.8, 242.4)),
    ("021_bleach_cleanser", (102.4, 67.7, 250.6)),
    ("024_bowl", (161.5, 161.2, 55.0)),
    ("025_mug", (117.0, 93.1, 81.3)),
    ("035_power_drill", (184.2, 187.5, 57.3)),
    ("036_wood_block", (90.6, 89.9, 206.0)),
    ("037_scissors", None),
    ("040_large_marker", None),
    ("051_large_clamp", None),
    ("052_extra_large_clamp", None),
    ("061_foam_brick", (52.6, 77.9, 51.2)),
)
NAMES: tuple[str, ...] = tuple(name for name, _ in _YCBV)
_MOST_OTHER, _MOST_OTHER_MM = 0.2, 5.0  # by which a side may differ; the wood block's do by 13 mm
NUMBERED = re.compile(r"object -?\d+")  # the name of an object of which only the number is known
_WHOSE = 'obj_id seems to count another data set\'s objects; give each its "name" in models_info.json'


class _ModelJson(Entry):
    name: Text | None = None
    min_x: FiniteFloat
    min_y: FiniteFloat
    min_z: FiniteFloat
    size_x: FiniteFloat = Field(gt=0)
    size_y: FiniteFloat = Field(gt=0)
    size_z: FiniteFloat = Field(gt=0)


@dataclass(frozen=True, eq=False, slots=True)
class BopObject:
    """An object of a data set.

    Attributes:
        name: of the object; "object 22" where nothing says more than its number.
        centre: of its box, in the frame of its model [m].
        size: of its box [m]; None where it is not known.
    """

    name: str
    centre: Float[np.ndarray, "3"] = field(default_factory=lambda: np.zeros(3))
    size: Float[np.ndarray, "3"] | None = None


def models_beside(scene: Path) -> Path | None:
    """Return the folder of the models_info.json that belongs to the folder of a scene; None if there is none.

    A data set holds models, or models_cad and so on, beside the scenes or beside the folder of the split.
    """
    infos = [info for place in scene.absolute().parents[:2] for info in sorted(place.glob(f"models*/{MODELS_INFO}"))]
    return infos[0].parent if infos else None


def read_objects(models: Path | None) -> Mapping[int, BopObject]:
    """Read the objects of a data set, by number.

    Args:
        models: folder with models_info.json; None for BOP's YCB-V, whose models are centred.

    Raises:
        CorruptFile: if the file is missing or broken.
    """
    if models is None:
        return {
            number: BopObject(name, size=None if size is None else 1e-3 * np.array(size))
            for number, (name, size) in enumerate(_YCBV, 1)
        }
    entries = read_json(models / MODELS_INFO, lambda data: decode(dict[str, _ModelJson], data, MODELS_INFO))
    found = {}
    for number, entry in entries.items():
        if number.isdecimal():
            size = 1e-3 * np.array([entry.size_x, entry.size_y, entry.size_z])
            centre = 1e-3 * np.array([entry.min_x, entry.min_y, entry.min_z]) + size / 2
            usual = NAMES[int(number) - 1] if 1 <= int(number) <= len(NAMES) else f"object {number}"
            found[int(number)] = BopObject(entry.name or usual, centre, size)
    return found


def object_of(objects: Mapping[int, BopObject], number: int) -> BopObject:
    """Return the object with a number; one of which only that is known if the data set says nothing of it.

    Raises:
        InvalidInput: with both sizes, if its model has another size than the object of YCB-V that it would be.
    """
    found = objects.get(number, BopObject(f"object {number}"))
    ours = dict(_YCBV).get(found.name)
    if ours is not None and found.size is not None:
        size = 1e3 * found.size
        if np.any(np.abs(size - ours) > _MOST_OTHER_MM + _MOST_OTHER * np.array(ours)):
            allowed = f"{_sides(ours)}, as {found.name} is; {_WHOSE}"
            raise InvalidInput(f"size of object {number} in {MODELS_INFO} [mm]", _sides(size), allowed)
    return found


def _sides(size: Sequence[float] | np.ndarray) -> str:
    return " x ".join(f"{side:.3g}" for side in size)


# Annotations and results: poses of objects in images, numbered.
#
# scene_gt.json  {"IMAGE": [{"obj_id", "cam_R_m2c", "cam_t_m2c"}]}, mm
# .csv           scene_id,im_id,obj_id,score,R,t,time, mm


MAX_BYTES = 100_000_000
HEADER = "scene_id,im_id,obj_id,score,R,t,time"
SCENE_CAMERA, SCENE_GT = "scene_camera.json", "scene_gt.json"
_MOST_SKEW = 0.02  # of R R^T from the identity
_NEAR_M, _FAR_M = 0.02, 20.0  # where objects can be before a camera, and a table's frame


class _BopJson(Entry):
    rotation: list[float] = Field(alias="cam_R_m2c")
    position: list[float] = Field(alias="cam_t_m2c")
    obj_id: int


@dataclass(frozen=True, eq=False, slots=True)
class BopRow:
    """One pose of a table.

    Attributes:
        scene: its number; 0 in a scene_gt.json.
        image: number of the image.
        object: that it is of.
        score: the larger, the surer.
        pose: `T_camera_object` to the centre of its box; None for one that lies behind the camera.
    """

    scene: int
    image: int
    object: BopObject
    score: float
    pose: Pose | None


def result_rows(path: Path) -> list[BopRow]:
    """Read results of BOP (.csv), of YCB-V's objects.

    Raises:
        CorruptFile: if the file is broken.
    """
    text = content_of(path, shown(path), MAX_BYTES).decode("utf-8-sig", errors="replace").replace("\0", "?")
    try:
        lines = [line for line in csv.reader(io.StringIO(text)) if line]
    except csv.Error:
        raise CorruptFile(shown(path), "it is no table of values with commas between them") from None
    if lines and lines[0][0].strip() == "scene_id":
        lines = lines[1:]
    if not lines:
        raise CorruptFile(shown(path), "it holds no poses")
    rows, objects = [], read_objects(None)
    for number, line in enumerate(lines, 1):
        try:
            scene, image, obj = (int(value) for value in line[:3])
            rotation, shift = (np.array(line[k].split(), float) for k in (4, 5))
            found = object_of(objects, obj)
            rows.append(BopRow(scene, image, found, float(line[3]), _pose(rotation, shift, found)))
        except OsfError as error:
            raise CorruptFile(shown(path), f"pose {number}: {str(error).rstrip('.')}") from None
        except (ValueError, IndexError):
            expected = f"{HEADER} with 9 numbers for R and 3 for t, separated by spaces"
            raise CorruptFile(shown(path), f"pose {number} is not {expected}") from None
    return rows


def result_images(path: Path) -> dict[tuple[int, int], list[str]]:
    """Read the objects by scene and image from results of BOP (.csv).

    Raises:
        CorruptFile: if the file is broken.
    """
    found: dict[tuple[int, int], list[str]] = {}
    for row in result_rows(path):
        found.setdefault((row.scene, row.image), []).append(row.object.name)
    return found


def annotated_rows(path: Path, image: int | None = None, models: Path | None = None) -> list[BopRow]:
    """Read a scene_gt.json; rows of one image are in the order by which BOP numbers its masks.

    Args:
        path: of the file, in the folder of the scene.
        image: whose rows are wanted; None for all.
        models: folder with models_info.json; None for that of the data set, or YCB-V if it has none.

    Raises:
        CorruptFile: if it is no scene_gt.json, or its objects have other sizes than those that their numbers stand for.
    """
    objects = read_objects(models or models_beside(path.parent))

    def parse(data: object) -> list[BopRow]:
        rows = []
        for number, entries in decode(dict[str, list[_BopJson]], data, "scene_gt").items():
            if number.isdecimal() and image in (None, int(number)):
                for entry in entries:
                    found = object_of(objects, entry.obj_id)
                    pose = _pose(np.array(entry.rotation), np.array(entry.position), found)
                    rows.append(BopRow(0, int(number), found, 0.0, pose))
        return rows

    return read_json(path, parse)


def _pose(rotation: np.ndarray, shift_mm: np.ndarray, of: BopObject) -> Pose | None:
    """Return the pose of a rotation matrix, row by row, and a position in mm; None if that is behind the camera."""
    if rotation.shape != (9,) or shift_mm.shape != (3,):
        given = f"{rotation.size} and {shift_mm.size} numbers"
        raise InvalidInput("pose", given, "9 for the rotation and 3 for the position")
    quaternion = nearest_rotation(rotation.reshape(3, 3), "rotation")
    if shift_mm[2] <= 0:  # BlenderProc annotates what is out of view, too
        return None
    pose = Pose(before_camera(1e-3 * shift_mm, "mm"), quaternion)
    return Pose(pose.apply(of.centre), quaternion)


def only(what: str, asked: int | str | None, there: set[int] | set[str]) -> Any:  # noqa: ANN401
    """Return what is asked for, or the only one there is."""
    if asked is None and len(there) == 1:
        return next(iter(there))
    if asked not in there:
        some = shown(", ".join(str(one) for one in sorted(there)))
        raise InvalidInput(what, "missing" if asked is None else asked, f"one of {some or 'none'}")
    return asked


def nearest_rotation(matrix: Float[np.ndarray, "3 3"], what: str) -> Float[np.ndarray, "4"]:
    """Return the unit quaternion of the rotation next to a matrix, which must be one but for rounding.

    Raises:
        InvalidInput: if it is none.
    """
    bounded = np.all(np.abs(matrix) < 1 + _MOST_SKEW)  # false for NaN
    if not bounded or np.abs(matrix @ matrix.T - np.eye(3)).max() > _MOST_SKEW or np.linalg.det(matrix) < 0:
        raise InvalidInput(what, matrix.round(3).tolist(), "a rotation matrix, row by row")
    left, _, right = np.linalg.svd(matrix)
    return quaternion_from_matrix(left @ right)


def before_camera(position: Float[np.ndarray, "3"], unit: str) -> Float[np.ndarray, "3"]:
    """Return a position before a camera [m] after checking it; `unit` is that of the file.

    Raises:
        InvalidInput: if it is behind the camera, or out of reach.
    """
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
        UnknownName: if an object is not one of the data set.
        CorruptFile: if models_info.json is missing or broken.
    """
    check_ranges(("number of the scene", scene, 0, _MOST_SCENE), ("time [s]", seconds, UNKNOWN_TIME, np.inf))
    objects = {found.name: (number, found.centre) for number, found in read_objects(models).items()}
    lines = [HEADER]
    for camera in cameras:
        if not camera.name.isdecimal():
            raise InvalidInput("name of a camera", camera.name, "the number of its image in BOP's scene")
        T_camera_world = camera.T_world_camera.inverse()
        for name, std in zip(estimate.state.names, estimate.position_std, strict=True):
            if name not in objects:
                raise UnknownName("object of the data set", name, objects)
            (number, centre), pose = objects[name], T_camera_world @ estimate.state.pose(name)
            parts = quaternion_to_matrix(pose.quaternion).ravel(), 1e3 * pose.apply(-centre)
            R, t = (" ".join(f"{value:.8f}" for value in part) for part in parts)
            score = f"{1 / (1 + 1e3 * std):.6g}"
            lines.append(f"{scene},{int(camera.name)},{number},{score},{R},{t},{seconds:g}")
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
    if files is None:
        named = [(name, folder / f"{start}{name}.png") for name in known for start in ("", "mask_")]
        files = {name: path for name, path in named if path.is_file()}
    masks = {name: _read(path, *sizes) for name, path in files.items() if name in known}
    masks = {name: mask for name, mask in masks.items() if mask.any()}
    if not masks:
        raise InvalidInput("number of masks of known objects in the folder", 0, "1 or more, such as 025_mug.png")
    return masks


def _bop_files(folder: Path, image: int | None) -> dict[str, Path] | None:
    """Return the files that are numbered as BOP does, by object; None if there are none."""
    numbered = [match for path in folder.iterdir() if (match := _BOP_NAME.fullmatch(path.name))]
    if not numbered:
        return None
    shown = only("image of the masks", image, {int(match[1]) for match in numbered})
    table = next((place / SCENE_GT for place in (folder, folder.parent) if (place / SCENE_GT).is_file()), None)
    if table is None:
        raise InvalidInput(f"{SCENE_GT} of the masks", "missing", "in the folder above them: it names what they show")
    return _mask_files(folder, shown, [row.object.name for row in annotated_rows(table, shown)])


def _mask_files(folder: Path, image: int, names: Sequence[str]) -> dict[str, Path]:
    """Return the files of an image's masks by object, given these in their order; of none that is there twice."""
    files = {name: folder / f"{image:06d}_{index:06d}.png" for index, name in enumerate(names)}
    return {name: path for name, path in files.items() if names.count(name) == 1 and path.is_file()}


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
# BOP counts pixels from the centre of the first one, which is at (0.5, 0.5) here, so that half a pixel is added to its
# principal points.


_MASKS = "mask_visib"


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
        quaternion = nearest_rotation(np.array(self.R_w2c).reshape(3, 3), f"cam_R_w2c of image {image}")
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
        models: folder with models_info.json; None for that of the data set, or YCB-V if it has none.
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
        poses: annotated, `T_camera_object` to the centre of the box; of objects that are there once.
        T_camera_world: from BOP's world; None where that is unknown.
        sizes: of the boxes of these objects [m], where they are known.
        unmasked: objects with a pose but without a file of their mask.
        twice: objects that are annotated several times, of which nobody could tell one from the other.
    """

    number: int
    camera: Camera
    picture: Float[np.ndarray, "h w 3"]
    masks: Mapping[str, Bool[np.ndarray, "h w"]]
    poses: Mapping[str, Pose]
    T_camera_world: Pose | None
    sizes: Mapping[str, Float[np.ndarray, "3"]]
    unmasked: tuple[str, ...]
    twice: tuple[str, ...]


def is_bop_scene(path: Path) -> bool:
    """Return whether a path is a folder with BOP's files in it."""
    return (path / SCENE_CAMERA).is_file() or (path / SCENE_GT).is_file()


def read_images(folder: Path, choice: BopChoice | None = None) -> tuple[BopImage, ...]:
    """Read images of a scene.

    Args:
        folder: of the scene.
        choice: which.

    Raises:
        CorruptFile: if a file is missing or broken, a mask has another size than its picture, or objects have other
            sizes than those that their numbers stand for.
        InvalidInput: if an image is chosen that is not there.
    """

    def parse(data: object) -> dict[int, _CameraJson]:
        entries = decode(dict[str, _CameraJson], data, SCENE_CAMERA)
        if not entries or not all(number.isdecimal() for number in entries):
            raise InvalidInput("images", shown(list(entries)), "numbered, at least one")
        return {int(number): entry for number, entry in entries.items()}

    choice = choice or BopChoice()
    entries = read_json(folder / SCENE_CAMERA, parse)
    return tuple(_image(folder, n, entries[n], choice) for n in _chosen(choice.images, tuple(entries)))


def _chosen(asked: tuple[int, ...] | None, there: tuple[int, ...]) -> tuple[int, ...]:
    if asked is None:
        spread = np.linspace(0, len(there) - 1, min(len(there), MAX_CAMERAS)).round().astype(int)
        return tuple(there[number] for number in spread)
    if missing := [image for image in asked if image not in there]:
        raise InvalidInput("image", missing[0], f"one of {shown(', '.join(map(str, there)))}")
    if not 1 <= len(set(asked)) == len(asked) <= MAX_CAMERAS:
        raise InvalidInput("images", asked, f"1 to {MAX_CAMERAS}, all different")
    return asked


def _image(folder: Path, number: int, entry: _CameraJson, choice: BopChoice) -> BopImage:
    """Read an image with what belongs to it, reduced to the largest size of cameras."""
    rows, encoding = annotated_rows(folder / SCENE_GT, number, choice.models), choice.encoding
    names = [row.object.name for row in rows]
    poses = {row.object.name: row.pose for row in rows if row.pose is not None and names.count(row.object.name) == 1}
    sizes = {row.object.name: row.object.size for row in rows if row.object.size is not None}
    png, jpg = (folder / "rgb" / f"{number:06d}{suffix}" for suffix in (".png", ".jpg"))
    picture_file = next((path for path in (png, jpg) if path.is_file()), None)
    if picture_file is None:
        raise CorruptFile(png, "there is no such picture, nor a .jpg")
    raw = read_photograph(picture_file, encoding=encoding)
    width, height = raw.sent_size
    scale = min(1.0, MAX_IMAGE_SIDE / max(width, height))
    size = round(width * scale), round(height * scale)
    K = np.diag([size[0] / width, size[1] / height, 1.0]) @ (np.array(entry.K).reshape(3, 3) + HALF_PIXEL)
    files = _mask_files(folder / _MASKS, number, names)
    try:
        camera, T_camera_world = Camera(str(number), Pose.identity(), K, *size), entry.T_camera_world(number)
        masks = {name: _read(path, raw.sent_size, size) for name, path in files.items() if name in poses}
    except CorruptFile:
        raise
    except OsfError as error:
        raise CorruptFile(folder, f"image {number}: {str(error).rstrip('.')}") from None
    picture = linear_from_encoded(raw.encoded.astype(np.float32) / np.iinfo(raw.encoded.dtype).max, encoding)
    if raw.encoded.shape[1::-1] != size:
        picture = cv2.resize(picture, size, interpolation=cv2.INTER_AREA)
    masks, picture = {name: mask for name, mask in masks.items() if mask.any()}, np.clip(picture, 0, 1)
    unmasked = tuple(name for name in poses if name not in files)
    twice = tuple(name for name, count in Counter(names).items() if count > 1)
    return BopImage(number, camera, picture, masks, poses, T_camera_world, sizes, unmasked, twice)


# What speaks against a scene as a whole, and what is missing in it.


_SHARE = 0.5  # of the objects that must lie where their masks are, and be as large as these
_LEAST_PIXELS = 20  # of a mask that counts
_LARGER, _SMALLER = 1.15, 0.55  # most and least of what the box extends to; a ball reaches 0.58 of its own


def check_scene(images: Sequence[BopImage]) -> None:
    """Refuse a scene whose annotations are of other images, or of other objects.

    Most objects' centres must project into the boxes of their visible pixels, grown by the boxes' own sizes to all
    sides. Most masks must be about as large as the boxes of the objects that their numbers stand for.

    Raises:
        InvalidInput: naming the first that does not fit.
    """
    known = [(image, name) for image in images for name in image.masks]
    wrong = [(image, name) for image, name in known if not _fits(image, name)]
    if len(wrong) > _SHARE * len(known):
        image, name = wrong[0]
        u, v = image.camera.project(image.poses[name].position)
        what = f"place of {name} in image {image.number} by cam_K and cam_t_m2c [px]"
        allowed = "where its mask is; cam_K may be of another image size, or the masks of another image"
        raise InvalidInput(what, f"({u:.0f}, {v:.0f})", allowed)
    extents: dict[str, list[tuple[float, float, BopImage]]] = {}
    for image, name in known:
        if name in image.sizes and image.masks[name].sum() >= _LEAST_PIXELS:
            extents.setdefault(name, []).append((*_extents(image, name), image))
    shares = {name: [seen / expected for seen, expected, _ in its] for name, its in extents.items()}
    other = [name for name, its in shares.items() if np.median(its) > _LARGER or max(its) < _SMALLER]
    if len(other) > _SHARE * len(shares):
        seen, expected, image = max(extents[other[0]], key=lambda each: each[0] / each[1])
        what = f"extent of the mask of {other[0]} in image {image.number} [px]"
        box = f"a box of {_sides(1e3 * image.sizes[other[0]])} mm"
        raise InvalidInput(what, f"{seen:.0f}", f"about {expected:.0f}, as of {box}; {_WHOSE}")


def _fits(image: BopImage, name: str) -> bool:
    rows, columns = np.nonzero(image.masks[name])
    if len(rows) < _LEAST_PIXELS:
        return True
    low, high = np.array([columns.min(), rows.min()]), np.array([columns.max(), rows.max()]) + 1
    place = image.camera.project(image.poses[name].position)
    return bool(np.all((place > 2 * low - high) & (place < 2 * high - low)))


def _extents(image: BopImage, name: str) -> tuple[float, float]:
    """Return the diagonals of an upright rectangle around a mask, and around the object's box in the image [px]."""
    rows, columns = np.nonzero(image.masks[name])
    corners = np.array(list(product((-0.5, 0.5), repeat=3))) * image.sizes[name]
    points = image.poses[name].apply(corners)
    points[:, 2] = np.maximum(points[:, 2], _NEAR_M)
    pixels = np.clip(image.camera.project(points), 0, (image.camera.width, image.camera.height))
    return float(np.hypot(np.ptp(rows) + 1, np.ptp(columns) + 1)), float(np.hypot(*np.ptp(pixels, axis=0)))


def missing_parts(folder: Path, images: Sequence[BopImage]) -> tuple[str, ...]:
    """Return sentences about what images of a scene lack, or show several times, and about those without a camera."""
    cameras, annotated = (read_json(folder / name, _image_numbers) for name in (SCENE_CAMERA, SCENE_GT))
    found = {f"without a camera in {SCENE_CAMERA}": [str(n) for n in sorted(annotated - cameras)]}
    for image in images:
        parts = [] if image.poses or image.twice else ["without annotation of an object"]
        parts += [f"with {name}, whose name nothing says" for name in image.poses if NUMBERED.fullmatch(name)]
        parts += [f"without the file of the mask of {name}" for name in image.unmasked]
        for part in (*parts, *(f"with {name} several times" for name in image.twice)):
            found.setdefault(part, []).append(str(image.number))
    return tuple(
        f"Image{'s' * (len(numbers) > 1)} {shown(', '.join(numbers), 200)}: {part}."
        for part, numbers in found.items()
        if numbers
    )


def _image_numbers(data: object) -> set[int]:
    return {int(key) for key in data if str(key).isdecimal()} if isinstance(data, dict) else set()


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
        left_out: why other objects that are annotated in these images are not there, by name.
        notes: sentences about what the images lack.
    """

    observation: Observation
    poses: Mapping[str, Pose]
    left_out: Mapping[str, str]
    notes: tuple[str, ...]


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
        names: of the objects; None for all that are annotated, each once, and known.
        table_prior: how a known object can lie, to find the table by how they do; None to take BOP's world for it.
        known: objects that can be estimated; None for all.

    Raises:
        CorruptFile: if a file is missing or broken.
        InvalidInput: if images or objects are chosen that are not there, or not once; nothing is annotated or masked;
            the cameras' places are missing; BOP's world is not the table's frame; or annotations and masks do not fit.
    """
    every = read_images(folder, choice)
    images = tuple(image for image in every if image.poses)
    if not any(image.masks for image in images):
        allowed = f"in {SCENE_GT} and {_MASKS}, of one object at least; BOP's toolkit makes masks with calc_gt_masks.py"
        raise InvalidInput("poses and masks of the objects", "missing", allowed)
    check_scene(images)
    left_out = {name: "there several times" for image in every for name in image.twice}
    there = tuple(sorted({name for image in images for name in image.poses} - left_out.keys()))
    if names is None:
        names = tuple(name for name in there if known is None or name in known)
        left_out |= {name: "without a field" for name in there if name not in names}
    else:
        if missing := [name for name in names if name not in there]:
            given = left_out.get(missing[0], f"not in {SCENE_GT}")
            raise InvalidInput(f"object {missing[0]}", given, f"one of {', '.join(there) or 'none'}")
        left_out |= {name: "not asked for" for name in there if name not in names}
    if not names:
        reasons = "; ".join(f"{name}: {why}" for name, why in left_out.items())
        raise InvalidInput("number of objects", f"0 ({reasons})", "1 or more that are there once and have a field")
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
    unmasked = np.array([[name in image.unmasked for name in names] for image in images])
    observation = Observation(placed, pictures, names, masks, None, 0.0, unmasked if unmasked.any() else None)
    return BopScene(observation, poses, left_out, missing_parts(folder, every))


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
