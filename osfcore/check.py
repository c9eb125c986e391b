"""Validation of files that people bring, with the reason in words and pictures of what was understood."""

from __future__ import annotations

import json
from collections.abc import Mapping
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import cv2
import numpy as np
from PIL import Image

from osfcore.errors import CorruptFile, InvalidInput
from osfcore.poses import Pose
from osfcore.scene import MAX_IMAGE_SIDE, Camera
from osfcore.scenefile import read_scene

_OVERLAY_IMAGES = 8
_OVERLAY_SIDE = 256


@dataclass(frozen=True, slots=True)
class Report:
    """What a file turned out to be.

    Attributes:
        kind: "scene", "image set" or "push file".
        summary: its contents in words.
        facts: its contents in numbers.
    """

    kind: str
    summary: str
    facts: Mapping[str, Any]


def check_path(path: Path) -> Report:
    """Find out what a file or folder is and whether it is sound.

    Raises:
        CorruptFile: if it is of no known kind or broken; the message says where.
    """
    if path.is_dir():
        return _check_image_set(path)
    if path.suffix.lower() == ".json":
        scene = read_scene(path)
        counts = {"objects": len(scene.state.names), "cameras": len(scene.cameras)}
        return Report("scene", f"{counts['objects']} objects, {counts['cameras']} cameras", counts)
    if path.suffix.lower() in (".h5", ".hdf5"):
        return _check_pushes(path)
    raise CorruptFile(path, "it is neither a .json scene, a .h5 push file nor an image set folder")


def _check_pushes(path: Path) -> Report:
    from osfcore.world.push_file import read_pushes

    episodes = read_pushes(path)
    if not episodes:
        raise CorruptFile(path, "it holds no episodes")
    for number, episode in enumerate(episodes):
        if episode.actions.ndim != 2:
            raise CorruptFile(path, f"actions of episode {number} have shape {episode.actions.shape}, not (T, 3)")
        steps, count = len(episode.actions), len(episode.names)
        shapes = {
            "positions": (steps + 1, count, 3),
            "quaternions": (steps + 1, count, 4),
            "pusher": (steps + 1, 3),
            "actions": (steps, 3),
            "contact": (steps, count),
        }
        for name, shape in shapes.items():
            array = getattr(episode, name)
            if array.dtype.kind not in "bfiu":
                raise CorruptFile(path, f"{name} of episode {number} are not numbers")
            if array.shape != shape:
                raise CorruptFile(path, f"{name} of episode {number} has shape {array.shape}, not {shape}")
            if not np.all(np.isfinite(array)):
                raise CorruptFile(path, f"{name} of episode {number} has values that are not finite")
    facts = {"episodes": len(episodes), "steps": sum(len(e.actions) for e in episodes)}
    return Report("push file", f"{facts['episodes']} episodes, {facts['steps']} steps", facts)


def _check_image_set(folder: Path) -> Report:
    counts = {split: len(read_annotations(folder, split)) for split in ("train", "test")}
    return Report("image set", f"{counts['train']} train and {counts['test']} test images", counts)


@dataclass(frozen=True, eq=False, slots=True)
class AnnotatedImage:
    """One image of an OSF-format set.

    Attributes:
        path: of the PNG.
        camera: its view.
        light_direction: unit vector toward the light; sets whose lights have another length are normalised.
    """

    path: Path
    camera: Camera
    light_direction: np.ndarray


def read_annotations(folder: Path, split: str) -> tuple[AnnotatedImage, ...]:
    """The images of one split of an OSF-format set.

    Raises:
        CorruptFile: if anno.json is missing or wrong, or an image is missing or of another size.
    """
    path = folder / split / "anno.json"
    try:
        entries = json.loads(path.read_text(encoding="utf-8"))
    except OSError as error:
        raise CorruptFile(folder, f"it has no readable {split}/anno.json") from error
    except (ValueError, RecursionError) as error:
        raise CorruptFile(path, "it is not valid JSON") from error
    if not isinstance(entries, list) or not entries:
        raise CorruptFile(path, "it is not a list of images")
    return tuple(_annotated(path, number, entry) for number, entry in enumerate(entries))


def _annotated(path: Path, number: int, entry: Any) -> AnnotatedImage:  # noqa: ANN401
    where = f"entry {number}"
    try:
        RT = np.array(entry["RT"], float).reshape(3, 4)
        K = np.array(entry["K"], float).reshape(3, 3)
        light = np.array(entry["light_pos"], float).reshape(3)
        image = path.parent / str(entry["filename"])
    except (KeyError, TypeError, ValueError, OverflowError) as error:
        raise CorruptFile(path, f"{where} lacks or garbles one of filename, RT, K, light_pos") from error
    rotation = RT[:, :3]
    if not np.allclose(rotation @ rotation.T, np.eye(3), atol=1e-3) or np.linalg.det(rotation) < 0:
        raise CorruptFile(path, f"RT of {where} does not start with a rotation")
    length = np.linalg.norm(light)
    if not np.isfinite(length) or length < 1e-9:
        raise CorruptFile(path, f"light_pos of {where} has no direction")
    width, height = _rgba_size(image)
    T_camera_world = Pose.from_matrix(np.vstack([RT, [0, 0, 0, 1]]))
    try:
        camera = Camera(image.stem, T_camera_world.inverse(), K, width, height)
    except InvalidInput as error:
        raise CorruptFile(path, str(error).rstrip(".")) from error
    return AnnotatedImage(image, camera, light / length)


def _rgba_size(path: Path) -> tuple[int, int]:
    """Width and height [px], read from the header before anything is decoded."""
    try:
        with Image.open(path, formats=["PNG"]) as image:
            if max(image.size) > MAX_IMAGE_SIDE:
                raise CorruptFile(path, f"it is {image.width} x {image.height} px; at most {MAX_IMAGE_SIDE} are read")
            if image.mode != "RGBA":
                raise CorruptFile(path, "it has no transparency; images of this format are RGBA")
            image.load()
            return image.size
    except (OSError, SyntaxError, Image.DecompressionBombError) as error:
        raise CorruptFile(path, "there is no readable PNG") from error


def draw_overlay(folder: Path, out: Path) -> None:
    """Draw the world's axes (x red, y green, z blue) and the light (yellow) into some images of a set, as one PNG.

    Raises:
        CorruptFile: if the folder is not an image set.
        InvalidInput: if the PNG cannot be written.
    """
    images = read_annotations(folder, "test")
    chosen = [images[i] for i in np.linspace(0, len(images) - 1, min(_OVERLAY_IMAGES, len(images))).astype(int)]
    half = (len(chosen) + 1) // 2
    tiles = [_overlay(image) for image in chosen]
    tiles += [np.zeros_like(tiles[0])] * (2 * half - len(tiles))
    sheet = np.vstack([np.hstack(tiles[:half]), np.hstack(tiles[half:])])
    try:
        is_written = cv2.imwrite(str(out), sheet)
    except cv2.error:
        is_written = False
    if not is_written:
        raise InvalidInput("overlay file", out, "a writable path that ends in .png")


def _overlay(image: AnnotatedImage) -> np.ndarray:
    bgra = np.asarray(cv2.imread(str(image.path), cv2.IMREAD_UNCHANGED))
    alpha = bgra[..., 3:].astype(float) / 255
    bgr = (bgra[..., :3] * alpha + 96 * (1 - alpha)).astype(np.uint8)
    bgr = cv2.resize(bgr, (_OVERLAY_SIDE, _OVERLAY_SIDE), interpolation=cv2.INTER_AREA)
    camera = image.camera.resized(_OVERLAY_SIDE, _OVERLAY_SIDE)
    length = 0.25 * float(np.linalg.norm(camera.T_world_camera.position))
    ends = length * np.stack([*np.eye(3), image.light_direction])
    colours = ((0, 0, 255), (0, 255, 0), (255, 0, 0), (0, 255, 255))
    (start,) = np.round(camera.project(np.zeros((1, 3)))).astype(int)
    for end, colour in zip(np.round(camera.project(ends)).astype(int), colours, strict=True):
        cv2.arrowedLine(bgr, start.tolist(), end.tolist(), colour, 2, cv2.LINE_AA, tipLength=0.15)
    return bgr
