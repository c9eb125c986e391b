"""Image sets drawn by the project's own renderer from solids made by formula: small, and easy to learn."""

import json
from collections.abc import Callable
from pathlib import Path

import numpy as np
from PIL import Image

from osfcore.fields.kiloosf import KiloOSF
from osfcore.fields.table import TableField
from osfcore.fields.train_kiloosf import Recipe
from osfcore.geometry.cameras import Camera
from osfcore.render.renderer import SceneRenderer
from osfcore.render.types import Quality, SceneBatch
from tests.support.rendered_scenes import UPRIGHT, ball, block, coloured

QUICK = Recipe(coarse_across=16, fine_across=24, cells=2, hidden=8, rays=512)


def painted_block() -> KiloOSF:
    """Red where x < 0, blue elsewhere."""
    paint = np.array([[0.8, 0.3, 0.2], [0.2, 0.4, 0.9]])
    return coloured(block((0.05, 0.04, 0.03), voxel=0.004), lambda x: paint[(x[:, 0] > 0).astype(int)])


def painted_ball() -> KiloOSF:
    return coloured(ball(0.05, voxel=0.004), lambda x: np.where(x[:, 2:] > 0, 0.8, 0.4))


def directions(rng: np.random.Generator, count: int, lowest: float = -1.0) -> np.ndarray:
    """Unit vectors with z >= lowest, uniform by solid angle."""
    z, angle = rng.uniform(lowest, 1, count), rng.uniform(0, 2 * np.pi, count)
    r = np.sqrt(1 - z * z)
    return np.stack([r * np.cos(angle), r * np.sin(angle), z], axis=1)


def write_splits(folder: Path, draw: Callable, sizes: dict[str, int], seed: int = 0) -> Path:
    """A set whose images `draw(rng)` makes: camera, light and RGBA in [0, 1]."""
    rng = np.random.default_rng(seed)
    for split, count in sizes.items():
        (folder / split).mkdir(parents=True)
        entries = []
        for number in range(count):
            camera, light, rgba = draw(rng)
            name = f"{number:04d}.png"
            Image.fromarray(np.round(np.clip(rgba, 0, 1) * 255).astype(np.uint8), "RGBA").save(folder / split / name)
            entries.append(
                {
                    "filename": name,
                    "RT": camera.T_world_camera.inverse().matrix()[:3].tolist(),
                    "K": camera.intrinsics.tolist(),
                    "light_pos": light.tolist(),
                }
            )
        (folder / split / "anno.json").write_text(json.dumps(entries))
    return folder


def write_object_set(
    folder: Path, field: KiloOSF, *, train: int = 24, test: int = 4, size: int = 32, seed: int = 0
) -> Path:
    """Views and lights from all sides."""
    renderer = SceneRenderer({"it": field}, None)

    def draw(rng):
        place, light = directions(rng, 2)
        camera = Camera.look_at("view", 0.3 * place, (0, 0, 0), size=size, fov_y_deg=30)
        batch = SceneBatch(("it",), np.zeros((1, 1, 3)), np.array([[UPRIGHT]]), light[None], None)
        rendered = renderer.render(batch, [camera], quality=Quality(samples_per_side=2), outputs={"rgb", "opacity"})
        alpha = rendered.opacity[0, 0, 0][..., None]
        return camera, light, np.concatenate([rendered.rgb[0, 0] / np.maximum(alpha, 1e-3), alpha], axis=-1)

    return write_splits(folder, draw, {"train": train, "test": test}, seed)


def write_table_set(folder: Path, table: TableField, *, train: int = 24, test: int = 4, size: int = 48) -> Path:
    """The bare table from above, opaque, under lights down to 5 deg."""
    renderer = SceneRenderer({}, table)

    def draw(rng):
        place, light = directions(rng, 1, 0.4)[0], directions(rng, 1, np.sin(np.deg2rad(5)))[0]
        camera = Camera.look_at("view", 1.2 * place, (0, 0, 0), size=size, fov_y_deg=50)
        batch = SceneBatch((), np.zeros((1, 0, 3)), np.zeros((1, 0, 4)), light[None], None)
        rgb = renderer.render(batch, [camera]).rgb[0, 0]
        return camera, light, np.concatenate([rgb, np.ones_like(rgb[..., :1])], axis=-1)

    return write_splits(folder, draw, {"train": train, "test": test})
