"""Check files that people bring, and draw how they were understood."""

from __future__ import annotations

import contextlib
import os
import tempfile
from collections.abc import Iterator, Mapping
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import cv2
import numpy as np
from jaxtyping import UInt8

from osfcore.contrib.bop import BopImage, check_scene, is_bop_scene, missing_parts, read_images, result_images
from osfcore.errors import CorruptFile, InvalidInput, OsfError, shown
from osfcore.fields.kiloosf import FORMAT as FIELD_FORMAT
from osfcore.fields.kiloosf import read_field, tensor_format
from osfcore.fields.table import TABLE_FORMAT, read_table
from osfcore.fields.visual_hull import carve, silhouette_box
from osfcore.inspection.overlays import (
    AXIS_COLOURS,
    draw_line,
    draw_mask,
    draw_text,
    object_colour,
    observation_sheet,
    overlay_sheet,
    tiled,
)
from osfcore.io.archives import unpack_set
from osfcore.io.files import read_json
from osfcore.io.image_file import to_uint8, write_png
from osfcore.io.image_set import FROM_NERF, read_image_set, read_splits
from osfcore.io.observation_file import OBSERVATION_FILE, is_observation, read_observation
from osfcore.io.output_paths import check_place
from osfcore.io.scene_file import actions_from_json, estimated_from_json, is_estimated, scene_from_json

_AXIS_M = 0.05
_MOST_TILES, _SIDE = 8, 384


def _tile(image: BopImage) -> UInt8[np.ndarray, "h w 3"]:
    """Draw the outlines of masks, and 5 cm axes of each annotated object, into an image, BGR."""
    bgr = cv2.resize(to_uint8(image.picture[..., ::-1]), (_SIDE, _SIDE * 3 // 4), interpolation=cv2.INTER_AREA)
    camera = image.camera.resized(bgr.shape[1], bgr.shape[0])
    for number, (name, pose) in enumerate(image.poses.items()):
        if name in image.masks:
            draw_mask(bgr, image.masks[name], name, object_colour(number))
        for axis, colour in zip(np.eye(3), AXIS_COLOURS, strict=True):
            draw_line(bgr, camera, pose.position, pose.apply(_AXIS_M * axis), colour, 2)
    draw_text(bgr, f"image {image.number}", (6, 16), (255, 255, 255))
    return bgr


_REASON_CHARACTERS = 500


@dataclass(frozen=True, slots=True)
class Report:
    """The kind and the contents of a file.

    Attributes:
        kind: "scene", "state", "observation", "scene of BOP", "results file of BOP", "image set", "push file",
            "actions", "field" or "dynamics".
        summary: its contents in words.
        facts: its contents in numbers.
    """

    kind: str
    summary: str
    facts: Mapping[str, Any]


def check_path(path: Path) -> Report:
    """Return the kind and the contents of a file or folder that is sound.

    Raises:
        CorruptFile: if it is of no known kind or broken; the message says where.
    """
    if is_observation(path):
        return _check_observation(path)
    if is_bop_scene(path):
        return _check_bop(path)
    if path.is_dir() or path.suffix.lower() == ".zip":
        with _unpacked(path) as folder:
            return _check_image_set(folder)
    if path.suffix.lower() == ".json":
        if path.name == OBSERVATION_FILE:
            raise CorruptFile(path, "it is one file of an observation; check the folder that holds it")
        return read_json(path, _any_json)
    others = {".h5": _check_pushes, ".hdf5": _check_pushes, ".safetensors": _check_field, ".csv": _check_results}
    if check := others.get(path.suffix.lower()):
        return check(path)
    raise CorruptFile(
        path,
        "it is neither a .json scene, state or actions, a .h5 push file, a .safetensors field or network, a .csv of "
        "BOP's results, nor the folder of an observation, image set or scene of BOP",
    )


def _any_json(data: object) -> Report:
    if isinstance(data, dict) and isinstance(data.get("frames"), list):
        raise OsfError(FROM_NERF)
    if isinstance(data, dict) and "actions" in data and "objects" not in data:
        count, steps = actions_from_json(data).shape[:2]
        return Report("actions", f"{count} sequences of {steps} actions", {"sequences": count, "steps": steps})
    if not is_estimated(data):
        scene = scene_from_json(data)
        counts = {"objects": len(scene.state.names), "cameras": len(scene.cameras)}
        return Report("scene", f"{counts['objects']} objects, {counts['cameras']} cameras", counts)
    estimate = estimated_from_json(data)
    count = len(estimate.state.names)
    facts = {"objects": count, "trusted": estimate.trusted, "reason": estimate.reason}
    trust = "trusted" if estimate.trusted else f"not trusted: {shown(estimate.reason, _REASON_CHARACTERS)}"
    return Report("state", f"{count} objects, {trust}", facts)


def _check_observation(folder: Path) -> Report:
    observation = read_observation(folder)
    height, width = observation.images.shape[1:3]
    facts = {"cameras": len(observation.cameras), "objects": len(observation.names), "width": width, "height": height}
    facts["masks"] = 0 if observation.masks is None else int(observation.masks.any(axis=(2, 3)).sum())
    views = f"{facts['cameras']} view{'s' * (facts['cameras'] != 1)} of {width} x {height} px"
    return Report("observation", f"{views}, {facts['objects']} objects, {facts['masks']} masks", facts)


def _check_bop(folder: Path) -> Report:
    images = read_images(folder)
    try:
        check_scene(images)
    except InvalidInput as error:
        raise CorruptFile(folder, str(error).rstrip(".")) from None
    names = {name for image in images for name in image.poses}
    facts: dict[str, Any] = {"images": len(images), "objects": len(names)}
    facts |= {"masks": sum(len(image.masks) for image in images), "notes": missing_parts(folder, images)}
    facts["cameras in a world"] = sum(image.T_camera_world is not None for image in images)
    world = "cameras in one world" if facts["cameras in a world"] == len(images) else "cameras without a common world"
    summary = f"{facts['images']} images of {facts['objects']} objects, {facts['masks']} masks, {world}"
    return Report("scene of BOP", summary, facts)


def _check_results(path: Path) -> Report:
    images = result_images(path)
    facts = {"poses": sum(map(len, images.values())), "images": len(images)}
    facts |= {"scenes": len({scene for scene, _ in images}), "objects": len(set().union(*images.values()))}
    summary = f"{facts['poses']} poses of {facts['objects']} objects in {facts['images']} images"
    return Report("results file of BOP", summary, facts)


def _check_field(path: Path) -> Report:
    kind = tensor_format(path)
    if kind == TABLE_FORMAT:
        table = read_table(path)
        return Report("field", "the table", {"half_side": table.half_side})
    if kind is not None and kind != FIELD_FORMAT:
        from osfcore.dynamics.graph import FORMAT, read_network

        if kind == FORMAT:
            network = read_network(path)
            facts = {"hidden": network.hidden, "steps": network.steps}
            return Report("dynamics", f"a network of pushes, {network.hidden} wide, {network.steps} rounds", facts)
    field = read_field(path)
    size = " x ".join(f"{side:.3g}" for side in field.extent[1] - field.extent[0])
    facts = {"corners": len(field.rows) - 1, "networks": len(field.networks)}
    summary = f"an object of {size}, {facts['corners']} voxel corners, {facts['networks']} networks"
    return Report("field", summary, facts)


def _check_pushes(path: Path) -> Report:
    from osfcore.io.push_file import read_sound_pushes

    episodes = read_sound_pushes(path)
    facts = {"episodes": len(episodes), "steps": sum(len(e.actions) for e in episodes)}
    return Report("push file", f"{facts['episodes']} episodes, {facts['steps']} steps", facts)


def _check_image_set(folder: Path) -> Report:
    train, test = read_splits(folder)
    facts = {"train": len(train.cameras), "test": len(test.cameras)}
    what = "the bare table"
    if not train.is_opaque:
        box = silhouette_box(train, test, where=folder)
        what = "an object of " + " x ".join(f"{side:.3g}" for side in box[1] - box[0])
    return Report("image set", f"{facts['train']} train and {facts['test']} test images of {what}", facts)


@contextlib.contextmanager
def _unpacked(path: Path) -> Iterator[Path]:
    """Give the folder of an image set, unpacked for as long as this is open if it is a zip."""
    if path.is_dir() or path.suffix.lower() != ".zip":
        yield path
        return
    with tempfile.TemporaryDirectory(prefix="osf-check-") as place:
        try:
            yield unpack_set(path, Path(place) / path.stem)
        except CorruptFile as error:
            if str(error).startswith(str(path)):
                raise
            inside = str(error).replace(f"{place}{os.sep}", "").rstrip(".")
            raise CorruptFile(path, inside) from error


def draw_overlay(path: Path, out: Path) -> None:
    """Draw how a set or an observation was understood into its images, as one PNG.

    For some images of a set that is the world's axes (x red, y green, z blue), the direction of the light (yellow) and
    the box that holds every silhouette (magenta). Where cameras and silhouettes contradict each other there is no such
    box; one of about the object's size is drawn where most cameras look, and lies beside the silhouettes. For an
    observation see `observation_sheet`; a scene of BOP has a tile for each of its first eight images.

    Args:
        path: folder of an observation or scene of BOP, or folder or zip of an image set; it may be a set in which
            `check_path` found contradicting silhouettes.
        out: PNG to write.

    Raises:
        CorruptFile: if it is neither.
        InvalidInput: if the PNG would have another suffix.
        CannotWrite: if it cannot be written.
    """
    check_overlay_place(out)
    if is_observation(path):
        sheet = observation_sheet(read_observation(path))
    elif is_bop_scene(path):
        sheet = tiled([_tile(image) for image in read_images(path)[:_MOST_TILES]])
    else:
        with _unpacked(path) as folder:
            sets = (read_image_set(folder, "train"), read_image_set(folder, "test"))
        has_box = not any(images.is_opaque for images in sets)
        sheet = overlay_sheet(sets, carve(*sets).box if has_box else None)
    write_png(out, sheet[..., ::-1])


def check_overlay_place(out: Path) -> None:
    """Refuse a place for an overlay that cannot take it.

    Raises:
        InvalidInput: if it has another suffix than .png.
        CannotWrite: if it cannot be written.
    """
    if out.suffix.lower() != ".png":
        raise InvalidInput("overlay file", out, "a path that ends in .png")
    check_place(out)
