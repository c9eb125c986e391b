"""Photographs made of fields: posed, lit, exposed, white-balanced and stored as a camera would."""

import json
from dataclasses import dataclass
from pathlib import Path

import numpy as np

from osfcore.estimation.camera_response import linear_from_encoded, srgb_of_linear
from osfcore.geometry.cameras import Camera
from osfcore.geometry.poses import Pose, quaternion_exp
from osfcore.io.image_file import to_uint8, write_png
from osfcore.photo.photograph import Photograph
from osfcore.render.renderer import SceneRenderer
from osfcore.render.types import SceneBatch

NAME = "009_gelatin_box"
INTRINSICS = np.array([[600.0, 0, 150], [0, 600, 130], [0, 0, 1]])


@dataclass(frozen=True, eq=False)
class Taken:
    """A photograph and the truth."""

    photo: Photograph
    encoded: np.ndarray
    pose: Pose
    light: np.ndarray
    depth: np.ndarray


def take(fields, name=NAME, turn=(2.2, 0.5, -0.3), light=(0.5, -0.7, -0.6), gain=(0.62, 0.7, 0.8)) -> Taken:
    pose = Pose(np.array([0.01, -0.015, 0.62]), quaternion_exp(np.array(turn)))
    light = np.array(light) / np.linalg.norm(light)
    camera = Camera("photo", Pose.identity(), INTRINSICS, 300, 260)
    batch = SceneBatch((name,), pose.position[None, None], pose.quaternion[None, None], light[None], None)
    drawn = SceneRenderer(fields, None).render(batch, [camera], outputs={"rgb", "masks", "depth"})
    mask = drawn.masks[0, 0, 0]
    background = np.random.default_rng(0).uniform(0.1, 0.3, (260, 300, 3))
    radiance = np.where(mask[..., None], drawn.rgb[0, 0], background) * np.array(gain)
    encoded = to_uint8(srgb_of_linear(radiance))
    image = linear_from_encoded(encoded / 255.0, "srgb").astype(np.float32)
    photo = Photograph(image, np.all(encoded < 251, axis=-1), INTRINSICS, Pose.identity(), False, {name: mask})
    return Taken(photo, encoded, pose, light, drawn.depth[0, 0])


def write_photo(folder: Path, taken: Taken, name=NAME, **more) -> None:
    """Write photo.json with its picture, mask and true pose, and whatever else it shall hold."""
    write_png(folder / "photo.png", taken.encoded)
    write_png(folder / "mask.png", 255 * taken.photo.masks[name].astype(np.uint8))
    pose = {"position": taken.pose.position.tolist(), "quaternion": taken.pose.quaternion.tolist()}
    known = {
        "image": "photo.png", "encoding": "sRGB", "K": INTRINSICS.tolist(), "masks": {name: "mask.png"},
        "poses_camera_object": {"ground_truth": {name: pose}},
    }  # fmt: skip
    (folder / "photo.json").write_text(json.dumps(known | more))
