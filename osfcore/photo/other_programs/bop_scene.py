"""A scene of a BOP data set as an observation: images, cameras and masks, and the annotated poses beside it.

FOLDER (its name is the scene's number)
  scene_camera.json       {"IMAGE": {"cam_K": [9], "cam_R_w2c": [9], "cam_t_w2c": [3]}}, mm
  scene_gt.json           {"IMAGE": [{"obj_id", "cam_R_m2c", "cam_t_m2c"}]}, mm
  rgb/IMAGE.png or .jpg   with six digits
  mask_visib/IMAGE_INDEX.png

What is assumed: objects have the numbers of YCB-V, and each is there once. BOP counts pixels from the centre of the
first one, which is at (0.5, 0.5) here, so that half a pixel is added to its principal points. BOP's world can be any
frame: it counts as the table's (z up, table at z = 0) only if the objects lie on it, and else can be replaced by the
table that they tell.
"""

from __future__ import annotations

from collections.abc import Callable, Mapping
from dataclasses import dataclass
from pathlib import Path

import cv2
import numpy as np
from jaxtyping import Bool, Float
from pydantic import Field, FiniteFloat

from osfcore.errors import CorruptFile, InvalidInput, OsfError, shown
from osfcore.estimation.photometry.camera_response import Encoding, linear_from_encoded
from osfcore.geometry.cameras import MAX_IMAGE_SIDE, Camera
from osfcore.geometry.poses import Pose, quaternion_from_matrix
from osfcore.geometry.states import Observation
from osfcore.io.files import read_json
from osfcore.io.json_codec import Entry, Vector3, decode
from osfcore.io.observation_file import MAX_CAMERAS
from osfcore.photo.other_programs.bop_models import read_centres
from osfcore.photo.other_programs.mask_folder import read_masks
from osfcore.photo.other_programs.pose_file import PoseChoice, read_poses, scene_gt_names
from osfcore.photo.poses.table_from_objects import table_from_objects
from osfcore.photo.poses.table_prior import TablePrior
from osfcore.photo.read_photograph import read_photograph

SCENE_CAMERA, SCENE_GT, MASKS = "scene_camera.json", "scene_gt.json", "mask_visib"
_HALF_PIXEL = np.array([[0, 0, 0.5], [0, 0, 0.5], [0, 0, 0.0]])
_FARTHEST_M = 20.0
_HIGHEST_M, _DEEPEST_M, _WIDEST_M = 1.0, 0.05, 1.5  # where objects on a table can be
_MOST_SKEW = 0.02
_HOW = "'osf import bop --table objects' finds the table by how the objects lie"


class BopCamera(Entry):
    """One image's camera in scene_camera.json."""

    K: list[FiniteFloat] = Field(alias="cam_K", min_length=9, max_length=9)
    R_w2c: list[FiniteFloat] | None = Field(default=None, alias="cam_R_w2c", min_length=9, max_length=9)
    t_w2c: Vector3 | None = Field(default=None, alias="cam_t_w2c")

    def intrinsics(self) -> Float[np.ndarray, "3 3"]:
        """K for pixel centres at +0.5 [px]."""
        return np.array(self.K).reshape(3, 3) + _HALF_PIXEL

    def T_camera_world(self, image: int) -> Pose | None:  # noqa: N802
        """From BOP's world to the camera [m]; None where the file does not tell.

        Raises:
            InvalidInput: if it is no rotation, or farther away than any table.
        """
        if self.R_w2c is None or self.t_w2c is None:
            return None
        R, t = np.array(self.R_w2c).reshape(3, 3), 1e-3 * np.array(self.t_w2c)
        if np.abs(R @ R.T - np.eye(3)).max() > _MOST_SKEW or np.linalg.det(R) < 0:
            raise InvalidInput(f"cam_R_w2c of image {image}", R.round(3).tolist(), "a rotation matrix, row by row")
        if np.linalg.norm(t) > _FARTHEST_M:
            raise InvalidInput(f"cam_t_w2c of image {image} [mm]", self.t_w2c, f"below {1e3 * _FARTHEST_M:g} in length")
        left, _, right = np.linalg.svd(R)
        return Pose(t, quaternion_from_matrix(left @ right))


@dataclass(frozen=True, slots=True)
class BopChoice:
    """What of a scene is meant.

    Attributes:
        images: their numbers; None for all, spread evenly if there are more than an observation holds.
        names: of the objects; None for all that are annotated.
        encoding: of the pictures.
        models: folder with models_info.json; None for BOP's YCB-V.
    """

    images: tuple[int, ...] | None = None
    names: tuple[str, ...] | None = None
    encoding: Encoding = "srgb"
    models: Path | None = None


@dataclass(frozen=True, eq=False, slots=True)
class BopScene:
    """A scene as it is understood.

    Attributes:
        observation: cameras bear the numbers of their images.
        poses: `T_world_object` by name, as the first chosen image that shows the object annotates it.
    """

    observation: Observation
    poses: Mapping[str, Pose]


def is_bop_scene(path: Path) -> bool:
    """Whether a path is a folder with BOP's files in it."""
    return (path / SCENE_CAMERA).is_file() or (path / SCENE_GT).is_file()


def read_bop_scene(
    folder: Path, choice: BopChoice | None = None, table_prior: Callable[[str], TablePrior] | None = None
) -> BopScene:
    """Read a scene.

    Args:
        folder: of the scene.
        choice: what of it.
        table_prior: how an object can lie, to find the table by how the objects do; None to take BOP's world for it.

    Raises:
        CorruptFile: if a file is missing or broken.
        InvalidInput: if images or objects are chosen that are not there, the cameras' places are not told, or BOP's
            world is not the table's frame.
    """
    choice = choice or BopChoice()
    entries = read_cameras(folder)
    images = _chosen(choice.images, tuple(entries))
    centres = read_centres(choice.models)
    placed = {image: entries[image].T_camera_world(image) for image in images}
    annotated = {image: _annotated(folder, image, centres) for image in images}
    names = _names(choice.names, annotated)
    if table_prior is None:
        cameras_in_world = _in_bop_world(placed)
    else:
        cameras_in_world = _over_found_table(placed, annotated[images[0]], table_prior)
    poses = {
        name: next(cameras_in_world[i] @ annotated[i][name] for i in images if name in annotated[i]) for name in names
    }
    if table_prior is None:
        _check_over_table(cameras_in_world, poses)
    views = [_view(folder, image, entries[image], cameras_in_world[image], names, choice.encoding) for image in images]
    if len({camera.width / camera.height for camera, _, _ in views}) > 1:
        raise InvalidInput("sizes of the images", "not the same", "the same; choose images of one camera")
    cameras, pictures, masks = zip(*views, strict=True)
    return BopScene(Observation(cameras, np.stack(pictures), names, np.stack(masks), None, 0.0), poses)


def read_cameras(folder: Path) -> dict[int, BopCamera]:
    """Cameras by number of the image.

    Raises:
        CorruptFile: if there is no scene_camera.json, or it lacks a K.
    """

    def parse(data: object) -> dict[int, BopCamera]:
        entries = decode(dict[str, BopCamera], data, SCENE_CAMERA)
        if not entries or not all(number.isdecimal() for number in entries):
            raise InvalidInput("images", shown(list(entries)), "numbered, at least one")
        return {int(number): entry for number, entry in entries.items()}

    return read_json(folder / SCENE_CAMERA, parse)


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
    """`T_camera_object` of the objects in an image, in the frame of their boxes' centres."""
    names = scene_gt_names(folder / SCENE_GT, image)
    if repeated := [name for name in names if names.count(name) > 1]:
        raise InvalidInput(f"objects of image {image}", f"{repeated[0]} several times", "each there once")
    if not names:
        return {}
    poses = read_poses(folder / SCENE_GT, PoseChoice(image))
    if unknown := [name for name in names if name not in centres]:
        raise InvalidInput(f"model of {unknown[0]}", "missing", "in models_info.json")
    return {name: Pose(poses[name].apply(centres[name]), poses[name].quaternion) for name in names}


def _names(asked: tuple[str, ...] | None, annotated: Mapping[int, Mapping[str, Pose]]) -> tuple[str, ...]:
    there = tuple(sorted({name for poses in annotated.values() for name in poses}))
    if asked is None:
        return there
    if missing := [name for name in asked if name not in there]:
        raise InvalidInput("object", missing[0], f"one that scene_gt.json has: {', '.join(there) or 'none'}")
    return asked


def _in_bop_world(placed: Mapping[int, Pose | None]) -> dict[int, Pose]:
    """`T_world_camera` by image."""
    poses: dict[int, Pose] = {}
    for image, pose in placed.items():
        if pose is None:
            raise InvalidInput(f"cam_R_w2c and cam_t_w2c of image {image}", "missing", f"given; {_HOW}")
        poses[image] = pose.inverse()
    return poses


def _over_found_table(
    placed: Mapping[int, Pose | None], annotated: Mapping[str, Pose], table_prior: Callable[[str], TablePrior]
) -> dict[int, Pose]:
    """`T_world_camera` over the table on which the objects of the first image lie."""
    found = table_from_objects([table_prior(name) for name in annotated], list(annotated.values()))
    if found is None:
        raise InvalidInput("table under the objects", "not to be found", "one that two or more objects stand on")
    first = next(iter(placed))
    if len(placed) == 1:
        return {first: found.T_world_camera}
    in_bop = _in_bop_world(placed)
    return {image: found.T_world_camera @ in_bop[first].inverse() @ pose for image, pose in in_bop.items()}


def _check_over_table(cameras: Mapping[int, Pose], poses: Mapping[str, Pose]) -> None:
    """Cameras above z = 0, objects near it; a world that is one of the cameras fails."""
    for image, camera in cameras.items():
        if not camera.position[2] > _DEEPEST_M:
            allowed = f"above a table at z = 0; {SCENE_CAMERA} seems to mean another world or unit than mm: {_HOW}"
            raise InvalidInput(
                f"height of image {image}'s camera in BOP's world [m]", f"{camera.position[2]:.3f}", allowed
            )
    for name, pose in poses.items():
        x, y, z = pose.position
        if not -_DEEPEST_M <= z <= _HIGHEST_M or max(abs(x), abs(y)) > _WIDEST_M:
            place = f"({x:.2f}, {y:.2f}, {z:.2f})"
            allowed = f"on a table at z = 0; {SCENE_CAMERA} seems to mean another world or unit than mm: {_HOW}"
            raise InvalidInput(f"place of {name} in BOP's world [m]", place, allowed)


def _view(
    folder: Path, image: int, entry: BopCamera, pose: Pose, names: tuple[str, ...], encoding: Encoding
) -> tuple[Camera, Float[np.ndarray, "h w 3"], Bool[np.ndarray, "N h w"]]:
    """Camera, picture and masks of an image, reduced to the largest size of cameras."""
    raw = read_photograph(picture_of(folder, image), encoding=encoding)
    width, height = raw.sent_size
    scale = min(1.0, MAX_IMAGE_SIDE / max(width, height))
    size = round(width * scale), round(height * scale)
    K = np.diag([size[0] / width, size[1] / height, 1.0]) @ entry.intrinsics()
    try:
        camera = Camera(str(image), pose, K, *size)
    except InvalidInput as error:
        raise CorruptFile(folder / SCENE_CAMERA, str(error).rstrip(".")) from None
    values = raw.encoded.astype(np.float32) / np.iinfo(raw.encoded.dtype).max
    picture = linear_from_encoded(values, encoding)
    if raw.encoded.shape[1::-1] != size:
        picture = cv2.resize(picture, size, interpolation=cv2.INTER_AREA)
    found: Mapping[str, np.ndarray] = {}
    if any(name in names for name in scene_gt_names(folder / SCENE_GT, image)):
        try:
            found = read_masks(folder / MASKS, names, (raw.sent_size, size), image)
        except CorruptFile:
            raise
        except OsfError as error:
            raise CorruptFile(folder / MASKS, str(error).rstrip(".")) from None
    hidden = np.zeros(size[::-1], bool)
    masks = np.stack([found.get(name, hidden) for name in names])
    return camera, np.clip(picture, 0, 1), masks


def picture_of(folder: Path, image: int) -> Path:
    """The file of an image.

    Raises:
        CorruptFile: if there is none.
    """
    for suffix in (".png", ".jpg"):
        path = folder / "rgb" / f"{image:06d}{suffix}"
        if path.is_file():
            return path
    raise CorruptFile(folder / "rgb" / f"{image:06d}.png", "there is no such picture, nor a .jpg")
