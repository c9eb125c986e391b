"""Small image sets in the OSF format, drawn without any renderer: a Lambert ellipsoid beside the origin."""

import json
from pathlib import Path

import cv2
import numpy as np

from osfcore.geometry.cameras import Camera

CENTRE = np.array([0.2, -0.1, 0.1])
HALF = np.array([0.5, 0.3, 0.2])


def ellipsoid(camera: Camera, light: np.ndarray) -> np.ndarray:
    """RGBA of one view, 8 bit."""
    size = camera.width
    v, u = np.mgrid[:size, :size] + 0.5
    d = camera.ray_directions(np.stack([u, v], axis=-1)) / HALF
    o = (camera.T_world_camera.position - CENTRE) / HALF
    a, b, c = (d * d).sum(-1), d @ o, o @ o - 1
    hit = b * b > a * c
    t = (-b - np.sqrt(np.maximum(b * b - a * c, 0))) / a
    normal = (o + t[..., None] * d) / HALF
    normal /= np.linalg.norm(normal, axis=-1, keepdims=True)
    shade = 0.25 + 0.75 * np.maximum(normal @ light, 0)
    rgb = 255 * shade[..., None] * (0.8, 0.5, 0.3)
    return np.where(hit[..., None], np.concatenate([rgb, np.full_like(rgb[..., :1], 255)], -1), 0).astype(np.uint8)


def write_set(folder: Path, train: int = 12, test: int = 4, size: int = 32, seed: int = 0) -> Path:
    """A set as public ones are: cameras at 2.5, upper half only, lights at 15, extra keys, a copy of test named val."""
    rng = np.random.default_rng(seed)
    for split, count in (("train", train), ("test", test), ("val", test)):
        (folder / split).mkdir(parents=True)
        entries = []
        for number in range(count):
            view, light = rng.normal(size=(2, 3))
            view[2] = abs(view[2]) + 0.1
            light /= np.linalg.norm(light)
            camera = Camera.look_at("view", 2.5 * view / np.linalg.norm(view), (0, 0, 0), size=size, fov_y_deg=39.6)
            rgba = ellipsoid(camera, light)
            cv2.imwrite(str(folder / split / f"r_{number}.png"), cv2.cvtColor(rgba, cv2.COLOR_RGBA2BGRA))
            entries.append(
                {
                    "objects": {},
                    "resolution": size,
                    "light_rgb": None,
                    "RT": camera.T_world_camera.inverse().matrix()[:3].tolist(),
                    "light_pos": (15 * light).tolist(),
                    "K": camera.intrinsics.tolist(),
                    "filename": f"r_{number}.png",
                }
            )
        (folder / split / "anno.json").write_text(json.dumps(entries))
    return folder


def edit(folder: Path, change, split: str = "train", number: int | None = 3) -> None:
    """Change one entry of a split's anno.json in place, or all of them."""
    path = folder / split / "anno.json"
    entries = json.loads(path.read_text())
    for entry in entries if number is None else [entries[number]]:
        change(entry)
    path.write_text(json.dumps(entries))


def turn_cameras(folder: Path, turn, splits=("train", "test"), number: int | None = None) -> None:
    """Replace RT (3 x 4) by what `turn` makes of it."""
    for split in splits:
        edit(folder, lambda e: e.update(RT=np.asarray(turn(np.array(e["RT"]))).tolist()), split, number)
