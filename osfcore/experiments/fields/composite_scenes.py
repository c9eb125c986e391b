"""How well fields show whole scenes: objects on the table under a harsh light, against the simulator (paper Fig. 5)."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass, replace

import numpy as np
from jaxtyping import Bool, Float

from osfcore.geometry.cameras import Camera
from osfcore.geometry.light import Light
from osfcore.geometry.poses import Pose
from osfcore.geometry.states import SceneState
from osfcore.inspection.contact_sheet import Comparison
from osfcore.io.image_file import to_uint8
from osfcore.metrics.image_errors import psnr, ssim
from osfcore.objects.asset_library import AssetLibrary
from osfcore.render.types import EXACT, Quality, Renderer, SceneBatch
from osfcore.world.imaging.ray_tracer import Picture, RayTracer
from osfcore.world.random_scenes import Draw
from osfcore.world.scene_request import SceneRequest
from osfcore.world.tabletop import Tabletop

SCENE_QUALITY: Quality = replace(EXACT, samples_per_side=2)  # the truth is anti-aliased too
MIN_PIXELS = 20  # of a kind in an image, for its figure to mean anything
_SHADE = 1e-3  # radiance by which shadow differs from lit table


@dataclass(frozen=True, eq=False, slots=True)
class Truth:
    """A scene as the simulator sees it.

    Attributes:
        state: objects and light, no pusher.
        cameras: V views.
        images: with shadows, anti-aliased.
        objects: pixels that show any part of an object.
        shadows: pixels that show table alone, of which any part lies in shadow.
    """

    state: SceneState
    cameras: tuple[Camera, ...]
    images: Float[np.ndarray, "V h w 3"]
    objects: Bool[np.ndarray, "V h w"]
    shadows: Bool[np.ndarray, "V h w"]


@dataclass(frozen=True, eq=False, slots=True)
class SceneFigures:
    """One view of a scene, compared.

    Attributes:
        psnr: over the whole image [dB].
        ssim: over the whole image.
        psnr_object: over pixels that show an object [dB]; None if hardly any does.
        psnr_shadow: over table pixels in shadow [dB]; None if there is hardly any.
        comparison: both images.
    """

    psnr: float
    ssim: float
    psnr_object: float | None
    psnr_shadow: float | None
    comparison: Comparison


def simulate(draw: Draw, library: AssetLibrary, cameras: tuple[Camera, ...]) -> Truth:
    """Let the objects come to rest on the table and take pictures.

    Args:
        draw: the scene.
        library: meshes of its objects.
        cameras: of one image size.

    Raises:
        UnknownName, MissingAssets: if an object has no mesh here.
        NoRoom: if the objects do not fit side by side.
    """
    (truth,) = simulate_relit(draw, (draw.light,), library, cameras)
    return truth


def simulate_relit(
    draw: Draw, lights: Sequence[Light], library: AssetLibrary, cameras: tuple[Camera, ...]
) -> tuple[Truth, ...]:
    """The same arrangement under one light after the other.

    Args:
        draw: the scene, of which its own light plays no part.
        lights: to take pictures under.
        library: meshes of its objects.
        cameras: of one image size.

    Raises:
        UnknownName, MissingAssets: if an object has no mesh here.
        NoRoom: if the objects do not fit side by side.
    """
    world = Tabletop(library, cameras=cameras, request=SceneRequest(names=draw.names, light=draw.light))
    try:
        world.arrange(draw.seed)
        return tuple(_truth(world, light, cameras) for light in lights)
    finally:
        world.close()


def _truth(world: Tabletop, light: Light, cameras: tuple[Camera, ...]) -> Truth:
    world.set_light(light)
    pictures = world.pictures(cameras, with_pusher=False)
    images = np.stack([picture.rgb for picture in pictures])
    return Truth(replace(world.truth(), pusher=None), cameras, images, *_kinds(pictures, light, cameras))


def _kinds(pictures: Sequence[Picture], light: Light, cameras: tuple[Camera, ...]) -> tuple[np.ndarray, np.ndarray]:
    """Pixels with any object, and table pixels that are darker than the empty table."""
    nothing = Pose(np.zeros((0, 3)), np.zeros((0, 4)))
    empty = RayTracer({}).render(SceneState((), nothing, light, None), cameras)
    objects = np.stack([picture.coverage.sum(axis=0) > 0 for picture in pictures])
    darker = [np.any(lit.rgb - picture.rgb > _SHADE, axis=-1) for lit, picture in zip(empty, pictures, strict=True)]
    return objects, np.stack(darker) & ~objects


def render_scene(renderer: Renderer, truth: Truth) -> Float[np.ndarray, "V h w 3"]:
    """A renderer's images of the same scene."""
    rendered = renderer.render(SceneBatch.of(truth.state), truth.cameras, quality=SCENE_QUALITY)
    return np.clip(rendered.rgb[0], 0, 1)


def compare_scene(truth: Truth, ours: Float[np.ndarray, "V h w 3"]) -> tuple[SceneFigures, ...]:
    """Figures of each view."""
    views = zip(truth.cameras, truth.images, ours, truth.objects, truth.shadows, strict=True)
    return tuple(
        SceneFigures(
            psnr(image, mine),
            ssim(image, mine),
            _psnr_over(image, mine, on_object),
            _psnr_over(image, mine, in_shadow),
            Comparison(f"camera {camera.name}", to_uint8(image), to_uint8(mine)),
        )
        for camera, image, mine, on_object, in_shadow in views
    )


def _psnr_over(truth: np.ndarray, ours: np.ndarray, pixels: np.ndarray) -> float | None:
    return psnr(truth, ours, pixels) if pixels.sum() >= MIN_PIXELS else None


def figures_of(scene: Sequence[SceneFigures]) -> dict[str, list[float | None]]:
    """The figures of a scene's views as lists, for JSON."""
    return {
        "psnr": [view.psnr for view in scene],
        "ssim": [view.ssim for view in scene],
        "psnr_object": [view.psnr_object for view in scene],
        "psnr_shadow": [view.psnr_shadow for view in scene],
    }


def mean_of(scenes: Sequence[Mapping[str, Sequence[float | None]]], key: str) -> float | None:
    """Mean over all images of all scenes that have the figure; None if none has."""
    values = [value for scene in scenes for value in scene[key] if value is not None]
    return float(np.mean(values)) if values else None
