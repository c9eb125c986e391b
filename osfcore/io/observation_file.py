"""Reading and writing of observation folders: images and pusher position at one instant.

Layout: DIR/observation.json beside 8-bit PNGs.

    {"cameras": [as in scene.json], "images": {camera: file}, "objects": [names],
     "masks": {camera: {object: file or null}}, "pusher": {"position": [3]} or null, "time_s": 0}

Images are RGB; linear radiance is value / 255. Masks have a single channel, in which values above 127 show the object.
`masks`, `pusher` and `time_s` may be missing. If there are masks, an object without one is not visible in that view.
An object whose mask is null may be visible, but nobody drew it.
"""

from __future__ import annotations

import os
from collections.abc import Mapping
from pathlib import Path
from typing import Any

import numpy as np
from jaxtyping import Bool, Float32, UInt8
from PIL import Image
from pydantic import Field, FiniteFloat

from osfcore.errors import CorruptFile, InvalidInput, check_known, check_ranges, check_unique, finite_vector, shown
from osfcore.geometry.cameras import Camera
from osfcore.geometry.states import MAX_OBJECTS, Observation
from osfcore.io.files import is_file_name, leads_out, read_json, reading_png, write_json, writing
from osfcore.io.image_file import encode_png, png_header, to_uint8
from osfcore.io.json_codec import Entry, Text, decode
from osfcore.io.scene_file import CameraJson, PointJson, camera_to_json

OBSERVATION_FILE = "observation.json"
MAX_CAMERAS = 32  # keeps a whole observation below a gigabyte
_GREY, _RGB, _RGBA = 0, 2, 6  # colour types of PNG
_MASK_LEVEL = 127


class ObservationJson(Entry):
    """Contents of observation.json."""

    cameras: list[CameraJson]
    images: dict[str, Any]  # `_inside` checks the names of files
    objects: list[Text]
    masks: dict[str, dict[str, Any]] | None = None
    pusher: PointJson | None = None
    time_s: FiniteFloat = Field(0.0, ge=0)


def is_observation(path: Path) -> bool:
    """Return whether a path is a folder with an observation."""
    return (path / OBSERVATION_FILE).exists()


def read_observation(folder: Path) -> Observation:
    """Return the observation in a folder.

    Raises:
        CorruptFile: if anything is missing or wrong; the message names the file and what is expected.
    """
    folder = Path(folder)
    path = folder / OBSERVATION_FILE
    if not path.is_file():
        raise CorruptFile(folder, f"it is no folder with an {OBSERVATION_FILE}")
    return read_json(path, lambda data: _observation(folder, data))


def write_observation(folder: Path, observation: Observation) -> None:
    """Write an observation. The folder counts as an observation only once everything is there.

    Images are not synced here but by the caller that puts the folder in place (see `osfcore.io.files`). Syncing them
    one by one would take longer than rendering them, and many folders only carry images from one process to another.

    Raises:
        InvalidInput: if arrays, cameras and names do not fit each other.
        CannotWrite: if the disk refuses.
    """
    _check(observation)
    folder = Path(folder)
    with writing(folder):
        folder.mkdir(parents=True, exist_ok=True)
        (folder / OBSERVATION_FILE).unlink(missing_ok=True)  # an older one would describe a mixture
        content = _write_images(folder, observation)
    write_json(folder / OBSERVATION_FILE, content)


def _write_images(folder: Path, observation: Observation) -> dict[str, Any]:
    """Write images and masks that are not empty; return the content of observation.json."""
    images, masks = {}, {}
    for view, camera in enumerate(observation.cameras):
        images[camera.name] = f"image_{view}.png"
        (folder / images[camera.name]).write_bytes(encode_png(to_uint8(observation.images[view])))
        if observation.masks is None:
            continue
        files = masks[camera.name] = {}
        for number, (name, mask) in enumerate(zip(observation.names, observation.masks[view], strict=True)):
            if mask.any():
                files[name] = f"mask_{view}_{number}.png"
                (folder / files[name]).write_bytes(encode_png(mask.astype(np.uint8) * 255))
            elif observation.unmasked is not None and observation.unmasked[view, number]:
                files[name] = None
    return {
        "cameras": [camera_to_json(camera) for camera in observation.cameras],
        "images": images,
        "objects": list(observation.names),
        "pusher": None if observation.pusher is None else {"position": observation.pusher.tolist()},
        "time_s": float(observation.time_s),
        **({} if observation.masks is None else {"masks": masks}),
    }


def _check(observation: Observation) -> None:
    _check_listed(observation.cameras, observation.names)
    camera, views, count = observation.cameras[0], len(observation.cameras), len(observation.names)
    shapes: dict[str, tuple[int, ...]] = {"images": (views, camera.height, camera.width, 3)}
    if observation.masks is not None:
        shapes["masks"] = (views, count, camera.height, camera.width)
    if observation.unmasked is not None:
        shapes["unmasked"] = (views, count)
    for name, shape in shapes.items():
        array = getattr(observation, name)
        if array.shape != shape or not np.all(np.isfinite(array)):
            raise InvalidInput(f"shape of the {name}", array.shape, f"{shape}, with finite numbers")
    if observation.pusher is not None:
        finite_vector(observation.pusher, 3, "pusher position [m]")
    if not 0 <= observation.time_s < np.inf:  # also false for NaN
        raise InvalidInput("time_s", observation.time_s, "a finite number of at least 0")


def _observation(folder: Path, data: object) -> Observation:
    entry = decode(ObservationJson, data, "observation")
    cameras, names, files = tuple(c.camera() for c in entry.cameras), tuple(entry.objects), entry.images
    _check_listed(cameras, names)
    check_known("camera", files, {camera.name for camera in cameras})
    if missing := [camera.name for camera in cameras if camera.name not in files]:
        raise InvalidInput(f"image of camera {shown(missing[0])}", "missing", "given")
    taken = [str(files[camera.name]) for camera in cameras]
    if len(set(taken)) != len(taken):
        raise InvalidInput("files of the images", ", ".join(taken), "all different")
    images = np.stack([_read_image(folder, files[camera.name], camera) for camera in cameras])
    masks, unmasked = None, None
    if entry.masks is not None:
        masks = _read_masks(folder, entry.masks, cameras, names)
        drawn = [{name: file is not None for name, file in entry.masks.get(c.name, {}).items()} for c in cameras]
        undrawn = np.array([[not its.get(name, True) for name in names] for its in drawn])
        unmasked = undrawn if undrawn.any() else None
    pusher = None if entry.pusher is None else np.array(entry.pusher.position)
    return Observation(cameras, images, names, masks, pusher, entry.time_s, unmasked)


def _check_listed(cameras: tuple[Camera, ...], names: tuple[str, ...]) -> None:
    check_ranges(("number of cameras", len(cameras), 1, MAX_CAMERAS))
    check_unique("names of the cameras", [camera.name for camera in cameras], "all different")
    sizes = [f"{camera.width} x {camera.height}" for camera in cameras]
    if len(set(sizes)) != 1:
        raise InvalidInput("sizes of the cameras [px]", ", ".join(sizes), "the same")
    check_ranges(("number of objects", len(names), 1, MAX_OBJECTS))
    if not all(names):
        raise InvalidInput("objects", list(names), "a list of names")
    check_unique("list of objects", names)


def _read_image(folder: Path, file: object, camera: Camera) -> Float32[np.ndarray, "h w 3"]:
    path = _inside(folder, file, f"image of camera {shown(camera.name)}")
    pixels = _read_png(path, camera, {_RGB: (8,), _RGBA: (8,)}, "8-bit RGB")
    if pixels.shape[2:] == (4,) and pixels[..., 3].min() < 255:
        raise CorruptFile(path, "it is partly transparent; 8-bit RGB is expected")
    return pixels[..., :3].astype(np.float32) / 255


def _read_masks(
    folder: Path, by_camera: Mapping[str, Mapping[str, Any]], cameras: tuple[Camera, ...], names: tuple[str, ...]
) -> Bool[np.ndarray, "V N h w"]:
    check_known("camera", by_camera, {camera.name for camera in cameras})
    masks = np.zeros((len(cameras), len(names), cameras[0].height, cameras[0].width), bool)
    for view, camera in enumerate(cameras):
        files = by_camera.get(camera.name, {})
        check_known("object", files, names)
        for name, file in files.items():
            if file is None:
                continue
            path = _inside(folder, file, f"mask of {shown(name)} for camera {shown(camera.name)}")
            pixels = _read_png(path, camera, {_GREY: (1, 8)}, "8-bit grey, a single channel without transparency,")
            masks[view, names.index(name)] = pixels > _MASK_LEVEL
    return masks


def _inside(folder: Path, file: object, what: str) -> Path:
    """Return the path of a file that observation.json names; refuse names that lead out of the folder."""
    allowed = "a file name without '..', relative to the folder"
    if not is_file_name(file) or Path(file).is_absolute() or ".." in Path(file).parts or "\\" in file:
        raise InvalidInput(what, shown(repr(file)), allowed)
    path = folder / file
    if leads_out(folder, path):
        raise InvalidInput(what, shown(repr(file)), "inside the folder, not a link that leads out of it")
    if not os.path.isfile(path):
        raise CorruptFile(folder / shown(file), f"there is no such file, but {OBSERVATION_FILE} names it as {what}")
    return path


def _read_png(
    path: Path, camera: Camera, kinds: Mapping[int, tuple[int, ...]], expected: str
) -> UInt8[np.ndarray, "h w *c"]:
    """Return the pixels of a PNG; its header is checked before anything is decoded.

    Pillow alone would turn 16 bits into 8, and return a palette's indices, without an error.
    """
    with reading_png(path, "it is no readable PNG: truncated or damaged"):
        header = png_header(path)
        if header is None:
            raise CorruptFile(path, "it is no PNG")
        width, height, depth, colour = header
        if (width, height) != (camera.width, camera.height):
            wanted = f"{camera.width} x {camera.height} px as camera {shown(camera.name)}"
            raise CorruptFile(path, f"it is {width} x {height} px; {wanted} is expected")
        if depth not in kinds.get(colour, ()):
            raise CorruptFile(path, f"it has {depth} bits and colour type {colour} of PNG; {expected} is expected")
        with Image.open(path, formats=["PNG"]) as image:
            return np.array(image.convert("L") if colour == _GREY else image, np.uint8)
