"""Folders with photographs and what is known of them.

A photographed scene is a folder with photo.json:

    {"image": file, "encoding": "sRGB" or "linear", "K": 3 x 3 [px], pixel centres at +0.5,
     "masks": {object: file}, in which more than 127 is the object,
     "depth": file, 16 bit, and "depth_unit_m"; may be missing,
     "poses_camera_object": {source: {object: {"position": [3], "quaternion": [w, x, y, z]}}}}

The source "ground_truth" is the truth; without one, "posecnn_refined_with_depth" stands for it. A folder of lamps
holds folders chrome, gray and others, each with NAME.mask.png and linear images NAME.K.png; those with the same K
show the same lamp. Its direction is that of the highlight on the chrome ball.
"""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass
from pathlib import Path

import cv2
import numpy as np
from jaxtyping import Bool, Float
from pydantic import Field, FiniteFloat

from osfcore.errors import CorruptFile
from osfcore.estimation.photometry.camera_response import linear_from_encoded
from osfcore.geometry.poses import Pose, unit_quaternion
from osfcore.io.files import read_json
from osfcore.io.json_codec import Entry, Matrix3, Text, Vector3, Vector4, decode
from osfcore.photo.photograph import Photograph

PHOTO_FILE = "photo.json"
GROUND_TRUTH, REFINED = "ground_truth", "posecnn_refined_with_depth"
_MIRROR, _MASK_LEVEL = "chrome", 127
_HIGHLIGHT, _SATURATED = 0.9, 0.985  # of the brightest pixel; of full scale
_SEEN = 0.2  # least cosine to the view of a sphere's pixels


class _PoseJson(Entry):
    position: Vector3
    quaternion: Vector4


class _PhotoJson(Entry):
    image: Text
    encoding: Text = "sRGB"
    K: Matrix3
    masks: dict[Text, Text]
    depth: Text | None = None
    depth_unit_m: FiniteFloat = Field(1e-3, gt=0)
    poses_camera_object: dict[Text, dict[Text, _PoseJson]] = Field(default_factory=dict)


@dataclass(frozen=True, eq=False, slots=True)
class PhotoFolder:
    """One photographed scene.

    Attributes:
        name: of the folder.
        encoded: the photograph as it is.
        photo: linear; the world is the camera's frame.
        depth: measured, along the camera's z axis [m]; 0 where nothing was measured. None without one.
        poses: `T_camera_object` by source and object.
    """

    name: str
    encoded: np.ndarray
    photo: Photograph
    depth: Float[np.ndarray, "h w"] | None
    poses: Mapping[str, Mapping[str, Pose]]

    @property
    def reference(self) -> Mapping[str, Pose]:
        """Poses that stand for the truth; empty if there are none."""
        return self.poses.get(GROUND_TRUTH) or self.poses.get(REFINED) or {}

    def table_points(self) -> Float[np.ndarray, "P 3"]:
        """Measured points around the objects, in the camera's frame [m]."""
        assert self.depth is not None
        objects = np.any(list(self.photo.masks.values()), axis=0).astype(np.uint8)
        around, margin = (cv2.dilate(objects, np.ones((side, side), np.uint8)) > 0 for side in (81, 13))
        rows, columns = np.nonzero(around & ~margin & (self.depth > 0))
        pixels = np.stack([columns + 0.5, rows + 0.5, np.ones(len(rows))], axis=1)
        return pixels @ np.linalg.inv(self.photo.intrinsics).T * self.depth[rows, columns, None]


@dataclass(frozen=True, eq=False, slots=True)
class LampSubject:
    """One thing under several lamps.

    Attributes:
        name: of the thing.
        images: linear.
        mask: its pixels.
        directions: unit vectors toward the lamps, in the camera's frame.
    """

    name: str
    images: Float[np.ndarray, "K h w 3"]
    mask: Bool[np.ndarray, "h w"]
    directions: Float[np.ndarray, "K 3"]


def scene_folders(data: Path) -> tuple[Path, ...]:
    """Folders of photographed scenes in a folder, or the folder itself, in order of name."""
    return tuple(sorted(path.parent for path in (*data.glob(PHOTO_FILE), *data.glob(f"*/{PHOTO_FILE}"))))


def lamp_folders(data: Path) -> tuple[Path, ...]:
    """Folders with a chrome ball under several lamps, likewise."""
    return tuple(sorted(path.parents[1] for path in data.glob(f"**/{_MIRROR}/{_MIRROR}.mask.png")))


def read_scene(folder: Path) -> PhotoFolder:
    """Read a photographed scene.

    Raises:
        CorruptFile: if a file is missing or not what it should be.
    """
    known = read_json(folder / PHOTO_FILE, lambda data: decode(_PhotoJson, data, PHOTO_FILE))
    image = _read(folder / known.image)[..., 2::-1]
    masks = {name: _read(folder / file, cv2.IMREAD_GRAYSCALE) > _MASK_LEVEL for name, file in known.masks.items()}
    values = (image / np.float32(np.iinfo(image.dtype).max)).astype(np.float32)
    linear = linear_from_encoded(values, "linear" if known.encoding == "linear" else "srgb").astype(np.float32)
    exposed = np.all(values < _SATURATED, axis=-1)
    photo = Photograph(linear, exposed, np.array(known.K), Pose.identity(), False, masks)
    depth = None if known.depth is None else _read(folder / known.depth, cv2.IMREAD_UNCHANGED) * known.depth_unit_m
    poses = {
        source: {name: Pose(np.array(p.position), unit_quaternion(np.array(p.quaternion))) for name, p in its.items()}
        for source, its in known.poses_camera_object.items()
    }
    return PhotoFolder(folder.name, image, photo, depth, poses)


def read_lamps(folder: Path) -> tuple[LampSubject, ...]:
    """All things of a folder of lamps but the chrome ball.

    Raises:
        CorruptFile: as files are.
    """
    mirror, mask = _images(folder / _MIRROR)
    normals, _ = sphere_normals(mask)
    directions = {}
    for number, image in mirror.items():
        shine = image.mean(axis=-1) * mask
        normal = normals[shine > _HIGHLIGHT * shine.max()].mean(axis=0)
        normal /= np.linalg.norm(normal)
        view = np.array([0.0, 0.0, -1.0])
        directions[number] = 2 * (normal @ view) * normal - view
    subjects = []
    for path in sorted(p for p in folder.iterdir() if p.is_dir() and p.name != _MIRROR):
        images, mask = _images(path)
        both = sorted(images.keys() & directions.keys(), key=lambda number: (len(number), number))
        lamps = np.array([directions[number] for number in both])
        subjects.append(LampSubject(path.name, np.stack([images[number] for number in both]), mask, lamps))
    return tuple(subjects)


def sphere_normals(mask: Bool[np.ndarray, "h w"]) -> tuple[Float[np.ndarray, "h w 3"], Bool[np.ndarray, "h w"]]:
    """Normals of a sphere that a distant camera sees, in its frame, and pixels that are not seen at a grazing angle."""
    rows, columns = np.nonzero(mask)
    centre = np.array([columns.min() + columns.max() + 1, rows.min() + rows.max() + 1]) / 2
    radius = (np.ptp(rows) + np.ptp(columns) + 2) / 4
    y, x = np.mgrid[: mask.shape[0], : mask.shape[1]] + 0.5
    x, y = (x - centre[0]) / radius, (y - centre[1]) / radius
    z = np.sqrt(np.maximum(1 - x * x - y * y, 0))
    return np.stack([x, y, -z], axis=-1), mask & (z > _SEEN)


def _images(folder: Path) -> tuple[dict[str, np.ndarray], np.ndarray]:
    mask = _read(folder / f"{folder.name}.mask.png", cv2.IMREAD_GRAYSCALE) > _MASK_LEVEL
    images = {}
    for path in sorted(folder.glob(f"{folder.name}.*.png")):
        if (number := path.name.split(".")[-2]) != "mask":
            image = _read(path)[..., 2::-1]
            images[number] = image / float(np.iinfo(image.dtype).max)
    return images, mask


def _read(path: Path, flags: int = cv2.IMREAD_UNCHANGED) -> np.ndarray:
    image = cv2.imread(str(path), flags)
    if image is None:
        raise CorruptFile(path, "it is missing, or no image")
    return image
