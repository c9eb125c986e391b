"""Images of a scene of a BOP data set, each with its camera, masks and annotated poses in the camera's own frame.

FOLDER (its name is the scene's number)
  scene_camera.json       {"IMAGE": {"cam_K": [9], "cam_R_w2c": [9], "cam_t_w2c": [3]}}, mm
  scene_gt.json           {"IMAGE": [{"obj_id", "cam_R_m2c", "cam_t_m2c"}]}, mm
  rgb/IMAGE.png or .jpg   with six digits
  mask_visib/IMAGE_INDEX.png

What is assumed: objects have the numbers of YCB-V, and each is there once. BOP counts pixels from the centre of the
first one, which is at (0.5, 0.5) here, so that half a pixel is added to its principal points.
"""

from __future__ import annotations

from collections.abc import Mapping
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
from osfcore.io.files import read_json
from osfcore.io.json_codec import Entry, Vector3, decode
from osfcore.io.observation_file import MAX_CAMERAS
from osfcore.photo.other_programs.bop_models import read_centres
from osfcore.photo.other_programs.mask_folder import read_masks
from osfcore.photo.other_programs.pose_file import PoseChoice, read_poses, scene_gt_names
from osfcore.photo.read_photograph import read_photograph

SCENE_CAMERA, SCENE_GT = "scene_camera.json", "scene_gt.json"
_MASKS = "mask_visib"
_HALF_PIXEL = np.array([[0, 0, 0.5], [0, 0, 0.5], [0, 0, 0.0]])
_FARTHEST_M = 20.0
_MOST_SKEW = 0.02  # of R R^T from the identity


class _CameraJson(Entry):
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
        T_camera_world: from BOP's world; None where that is not told.
    """

    number: int
    camera: Camera
    picture: Float[np.ndarray, "h w 3"]
    masks: Mapping[str, Bool[np.ndarray, "h w"]]
    poses: Mapping[str, Pose]
    T_camera_world: Pose | None


def is_bop_scene(path: Path) -> bool:
    """Whether a path is a folder with BOP's files in it."""
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
    choice = choice or BopChoice()
    entries, centres = _read_cameras(folder), read_centres(choice.models)
    return tuple(
        _image(folder, number, entries[number], _annotated(folder, number, centres), choice.encoding)
        for number in _chosen(choice.images, tuple(entries))
    )


def _read_cameras(folder: Path) -> dict[int, _CameraJson]:
    """Cameras by number of the image."""

    def parse(data: object) -> dict[int, _CameraJson]:
        entries = decode(dict[str, _CameraJson], data, SCENE_CAMERA)
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


def _image(folder: Path, number: int, entry: _CameraJson, poses: Mapping[str, Pose], encoding: Encoding) -> BopImage:
    """An image with what belongs to it, reduced to the largest size of cameras."""
    raw = read_photograph(_picture_of(folder, number), encoding=encoding)
    width, height = raw.sent_size
    scale = min(1.0, MAX_IMAGE_SIDE / max(width, height))
    size = round(width * scale), round(height * scale)
    K = np.diag([size[0] / width, size[1] / height, 1.0]) @ entry.intrinsics()
    masks: Mapping[str, np.ndarray] = {}
    try:
        camera, T_camera_world = Camera(str(number), Pose.identity(), K, *size), entry.T_camera_world(number)
        if poses:
            masks = read_masks(folder / _MASKS, poses, (raw.sent_size, size), number)
    except CorruptFile:
        raise
    except OsfError as error:
        raise CorruptFile(folder, f"image {number}: {str(error).rstrip('.')}") from None
    picture = linear_from_encoded(raw.encoded.astype(np.float32) / np.iinfo(raw.encoded.dtype).max, encoding)
    if raw.encoded.shape[1::-1] != size:
        picture = cv2.resize(picture, size, interpolation=cv2.INTER_AREA)
    return BopImage(number, camera, np.clip(picture, 0, 1), masks, poses, T_camera_world)


def _picture_of(folder: Path, image: int) -> Path:
    for suffix in (".png", ".jpg"):
        path = folder / "rgb" / f"{image:06d}{suffix}"
        if path.is_file():
            return path
    raise CorruptFile(folder / "rgb" / f"{image:06d}.png", "there is no such picture, nor a .jpg")
