"""Read image sets in the OSF format, and find what is wrong with them before anything learns from them.

Layout: DIR/{train,test}/anno.json, a list of dicts (`filename`, `RT` 3 x 4 world-to-camera in OpenCV axes, `K` 3 x 3
[px], `light_pos` 3-vector in the world, optionally `resolution`), with 8-bit RGBA PNGs beside it. Further keys and
further splits, such as `val`, are ignored. Lights of any length are directions; the world may have any unit of length.
"""

from __future__ import annotations

import hashlib
import json
import os
from collections.abc import Iterator, Mapping
from dataclasses import dataclass
from pathlib import Path
from typing import Any, Literal

import numpy as np
from jaxtyping import Float, UInt8
from PIL import Image

from osfcore.errors import CorruptFile, InvalidInput, shown
from osfcore.geometry.cameras import MAX_IMAGE_SIDE, MIN_IMAGE_SIDE, Camera
from osfcore.geometry.poses import Pose
from osfcore.io.files import is_file_name, leads_out, reading_png
from osfcore.io.image_file import png_header

MIN_SPLIT = {"train": 8, "test": 1}  # fewer views leave an object unknown; without a test image no metric is honest
MAX_IMAGES = 20_000
MAX_ANNOTATION_BYTES = 64_000_000
MAX_SPLIT_BYTES = 1 << 30  # of decoded images: both splits and the training itself stay below 4 GB
OPAQUE = 128  # alpha from which a pixel counts as the object's
FROM_NERF = (
    "it is of a data set of instant-ngp or nerfstudio, which has camera-to-world matrices with OpenGL axes and no "
    "lights; an image set has train/anno.json and test/anno.json with RT, K and light_pos of each image, where RT is "
    "the inverse of transform_matrix diag(1, -1, -1, 1) without its last row"
)
_RIGID_TOLERANCE = 1e-3
_MAX_NUMBER = 1e9  # in any unit of length a set may have
Split = Literal["train", "test"]


@dataclass(frozen=True, eq=False, slots=True)
class ImageSet:
    """One split of a set, decoded; all its images have one size.

    Attributes:
        cameras: n views, named after split and file, such as "train/0003.png".
        light_directions: unit vectors toward the light.
        rgba: straight alpha, as in the PNGs.
    """

    cameras: tuple[Camera, ...]
    light_directions: Float[np.ndarray, "n 3"]
    rgba: UInt8[np.ndarray, "n h w 4"]

    def digest(self) -> str:
        """Return a hash of pixels, cameras and lights, which differs for any other split."""
        digest = hashlib.blake2b(np.ascontiguousarray(self.rgba).tobytes(), digest_size=16)
        digest.update(repr(self.rgba.shape).encode())
        for camera in self.cameras:
            digest.update(camera.T_world_camera.matrix().tobytes() + camera.intrinsics.tobytes())
        digest.update(np.ascontiguousarray(self.light_directions).tobytes())
        return digest.hexdigest()

    @property
    def is_opaque(self) -> bool:
        """Whether no image has a silhouette, as in images of the bare table."""
        return bool(np.all(self.rgba[..., 3] == 255))


def read_image_set(folder: Path, split: Split) -> ImageSet:
    """Return one split with its pixels. `read_splits` also compares the two.

    Raises:
        CorruptFile: if anything is missing or wrong; the message names the file and what is expected.
    """
    folder = Path(folder)
    cameras, lights, pixels = zip(*_images(folder, split), strict=True)
    rgba = np.stack(pixels)
    opaque = np.all(rgba[..., 3] == 255, axis=(1, 2))
    if opaque.any() and not opaque.all():
        place = folder / (cameras[int(np.argmax(opaque))].name if opaque.sum() * 2 < len(opaque) else split)
        expected = "either all images have a silhouette (an object) or all are opaque (the table)"
        raise CorruptFile(place, f"{opaque.sum()} of {len(opaque)} images are opaque all over; {expected}")
    return ImageSet(cameras, np.array(lights, np.float32), rgba)


def read_splits(folder: Path) -> tuple[ImageSet, ImageSet]:
    """Return the train and the test images of a set; no image is in both.

    Raises:
        CorruptFile: if anything is missing or wrong; the message names the file and what is expected.
    """
    train, test = read_image_set(folder, "train"), read_image_set(folder, "test")
    sizes = [f"{images.rgba.shape[2]} x {images.rgba.shape[1]} px" for images in (train, test)]
    if sizes[0] != sizes[1]:
        raise CorruptFile(folder, f"train images are {sizes[0]} and test images {sizes[1]}; one size is expected")
    if train.is_opaque != test.is_opaque:
        raise CorruptFile(folder, "only one of train and test has transparent pixels; both show an object or the table")
    _refuse_leaks(folder, train, test)
    return train, test


def _images(folder: Path, split: Split) -> Iterator[tuple[Camera, Float[np.ndarray, "3"], UInt8[np.ndarray, "h w 4"]]]:
    """Yield view, unit vector toward the light, and pixels of each image of a split."""
    path = folder / split / "anno.json"
    entries = _entries(folder, split, path)
    first_use: dict[Path, int] = {}
    size, first = (0, 0), ""
    for number, entry in enumerate(entries):
        if not isinstance(entry, dict):
            raise CorruptFile(path, f"entry {number} is not an object with filename, RT, K and light_pos")
        image_path = _image_path(folder, path, number, entry)
        if first_use.setdefault(image_path, number) != number:
            earlier = first_use[image_path]
            raise CorruptFile(path, f"entries {earlier} and {number} name the same image {shown(entry['filename'])}")
        rgba = _read_rgba(image_path)
        height, width = rgba.shape[:2]
        _refuse_other_size(path, number, entry, (width, height))
        size, first = (size, first) if number else ((width, height), image_path.name)
        if (width, height) != size:
            expected = f"{size[0]} x {size[1]} px as {first} is"
            raise CorruptFile(image_path, f"it is {width} x {height} px, not {expected}; all images have one size")
        if width * height * 4 * len(entries) > MAX_SPLIT_BYTES:
            limit = f"at most {MAX_SPLIT_BYTES >> 20} MiB are read; take smaller or fewer images"
            raise CorruptFile(path, f"its {len(entries)} images of {width} x {height} px are too many: {limit}")
        if rgba[..., 3].max() < OPAQUE:
            reason = "its mask is empty: it has no opaque pixel, so the object cannot be seen in it"
            raise CorruptFile(image_path, reason)
        yield *_view(path, number, entry, (width, height)), rgba


def _entries(folder: Path, split: Split, path: Path) -> list[Any]:
    try:
        if not path.is_file():
            if (nerf := sorted(folder.glob("transforms*.json"))) and nerf[0].is_file():
                raise CorruptFile(nerf[0], FROM_NERF)
            expected = "an image set holds train/anno.json and test/anno.json"
            raise CorruptFile(folder, f"it has no readable {split}/anno.json; {expected}")
        if path.stat().st_size > MAX_ANNOTATION_BYTES:
            raise CorruptFile(path, f"it is larger than {MAX_ANNOTATION_BYTES // 1_000_000} MB")
        text = path.read_bytes()
    except OSError as error:
        raise CorruptFile(folder, f"it has no readable {split}/anno.json") from error
    try:
        entries = json.loads(text)
    except (ValueError, RecursionError) as error:
        raise CorruptFile(path, "it is not valid JSON") from error
    if not isinstance(entries, list) or not entries:
        raise CorruptFile(path, "it is not a list of images")
    least = MIN_SPLIT[split]
    if not least <= len(entries) <= MAX_IMAGES:
        expected = f"between {least} and {MAX_IMAGES} are expected for {split}"
        raise CorruptFile(path, f"it lists {len(entries)} image{'s' * (len(entries) != 1)}; {expected}")
    return entries


def _image_path(folder: Path, path: Path, number: int, entry: Mapping[str, Any]) -> Path:
    """Return the path of the image of an entry; refuse names that lead out of the set."""
    name = entry.get("filename")
    if not is_file_name(name):
        raise CorruptFile(path, f"entry {number} lacks or garbles filename, the name of its PNG")
    place = f"entry {number} names {shown(repr(name))}"
    if Path(name).is_absolute() or ".." in Path(name).parts:
        raise CorruptFile(path, f"{place}; a file name without '..', relative to anno.json, is expected")
    image = path.parent / name
    if leads_out(folder, image):
        raise CorruptFile(path, f"{place}, a link that leads out of the set; images inside it are expected")
    if not os.path.isfile(image):
        reason = f"there is no readable PNG of that name, but entry {number} of {path.name} asks for it"
        raise CorruptFile(path.parent / shown(name), reason)
    return image


def _read_rgba(path: Path) -> UInt8[np.ndarray, "h w 4"]:
    """Return the pixels of a PNG; its header is checked before anything is decoded."""
    with reading_png(path, "it is no readable PNG: truncated, damaged or of another kind"):
        if header := png_header(path):  # Pillow names no size when it refuses one
            _check_sides(path, header[:2])
        with Image.open(path, formats=["PNG"]) as image:
            _check_sides(path, image.size)
            if image.mode != "RGBA":
                raise CorruptFile(path, f"it is {image.mode} without transparency; 8-bit RGBA is expected")
            return np.array(image, np.uint8)


def _check_sides(path: Path, size: tuple[int, int]) -> None:
    if not MIN_IMAGE_SIDE <= min(size) <= max(size) <= MAX_IMAGE_SIDE:
        expected = f"sides from {MIN_IMAGE_SIDE} to {MAX_IMAGE_SIDE} px are read"
        raise CorruptFile(path, f"it is {size[0]} x {size[1]} px; {expected}")


def _refuse_other_size(path: Path, number: int, entry: Mapping[str, Any], size: tuple[int, int]) -> None:
    """Compare an image with its `resolution`: absent, a side of a square [px], or width and height [px]."""
    value = entry.get("resolution")
    if value is None:
        return
    sides = value if isinstance(value, list) else [value, value]
    if len(sides) != 2 or not all(isinstance(s, int | float) and not isinstance(s, bool) for s in sides):
        raise CorruptFile(path, f"resolution of entry {number} is not one side or [width, height] in pixels")
    if tuple(sides) != size:
        claimed = shown(f"{sides[0]} x {sides[1]}")
        reason = f"it is {size[0]} x {size[1]} px, but resolution of entry {number} says {claimed}"
        raise CorruptFile(path.parent / shown(entry["filename"]), reason)


def _view(
    path: Path, number: int, entry: Mapping[str, Any], size: tuple[int, int]
) -> tuple[Camera, Float[np.ndarray, "3"]]:
    where = f"entry {number} ({shown(entry['filename'])})"
    RT = _numbers(path, where, entry, "RT", (3, 4))
    K = _numbers(path, where, entry, "K", (3, 3))
    light = _numbers(path, where, entry, "light_pos", (3,))
    rotation = RT[:, :3]
    is_rigid = np.allclose(rotation @ rotation.T, np.eye(3), atol=_RIGID_TOLERANCE)
    if not is_rigid or np.linalg.det(rotation) < 0:
        expected = "expected is world-to-camera [R | t] in OpenCV axes"
        raise CorruptFile(path, f"RT of {where} does not start with a rotation; {expected}")
    length = np.linalg.norm(light)
    if not 1e-9 < length < np.inf:
        raise CorruptFile(path, f"light_pos of {where} has no direction; a vector toward the light is expected")
    T_camera_world = Pose.from_matrix(np.vstack([RT, [0, 0, 0, 1]]))
    try:
        camera = Camera(f"{path.parent.name}/{entry['filename']}", T_camera_world.inverse(), K, *size)
    except InvalidInput as error:
        raise CorruptFile(path, str(error).rstrip(".")) from error
    return camera, light / length


def _numbers(path: Path, where: str, entry: Mapping[str, Any], key: str, shape: tuple[int, ...]) -> np.ndarray:
    expected = f"{' x '.join(map(str, shape))} finite numbers below {_MAX_NUMBER:.0e} are expected"
    try:
        array = np.array(entry[key], float).reshape(shape)
    except (KeyError, TypeError, ValueError, OverflowError) as error:
        raise CorruptFile(path, f"{where} lacks or garbles {key}; {expected}") from error
    if not np.all(np.abs(array) < _MAX_NUMBER):  # also for NaN
        raise CorruptFile(path, f"{key} of {where} has values that are not finite or too large; {expected}")
    return array


def _refuse_leaks(folder: Path, train: ImageSet, test: ImageSet) -> None:
    """Refuse a test image that is also a training one: a figure measured on it would mean nothing.

    Pixels are compared, so a copy that was encoded anew is found, too. Two pictures of the bare table from one place
    can be equal under different lights; there the view and the light must agree as well.
    """
    seen = {_key(train, i): camera.name for i, camera in enumerate(train.cameras)}
    twins = [(c.name, seen[key]) for i, c in enumerate(test.cameras) if (key := _key(test, i)) in seen]
    if twins:
        expected = "no test image may be a training image, or what is measured on it is a lie"
        count = f"{len(twins)} of {len(test.cameras)} test images are also training images"
        raise CorruptFile(folder, f"{count}: {twins[0][0]} is {twins[0][1]}; {expected}")


def _key(images: ImageSet, index: int) -> bytes:
    digest = hashlib.blake2b(images.rgba[index].tobytes())
    if images.is_opaque:
        T_world_camera = images.cameras[index].T_world_camera.matrix()
        values = np.append(T_world_camera, images.light_directions[index])
        digest.update(np.round(1e5 * values).astype(np.int64).tobytes())
    return digest.digest()
