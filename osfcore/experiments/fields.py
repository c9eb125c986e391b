"""How good trained fields are: each object alone, and scenes of several on the table; nothing here was trained on.

A figure of an object is the mean over its images; the mean over objects is the mean of those. For scenes, every image
of every scene counts once. Each finished object and scene is kept in the output folder, so that an evaluation can be
killed, resumed and run in pieces.
"""

from __future__ import annotations

import json
from collections.abc import Generator, Iterator, Mapping, Sequence
from contextlib import closing
from dataclasses import asdict, dataclass, replace
from functools import cache
from pathlib import Path
from typing import Any

import numpy as np
from jaxtyping import Bool, Float

from osfcore.errors import CorruptFile, InvalidInput, check_ranges, check_seed
from osfcore.experiments.harness import (
    MAX_TASKS,
    EvaluationStep,
    TaskCache,
    TaskResult,
    chosen_objects,
    file_sha256,
    scene_circumstances,
)
from osfcore.experiments.statistics import mean
from osfcore.fields.field_library import FieldLibrary
from osfcore.fields.kiloosf import KiloOSF, read_field
from osfcore.geometry.cameras import DEFAULT_IMAGE_SIDE, Camera, default_cameras, image_side
from osfcore.geometry.light import Light
from osfcore.geometry.states import MAX_OBJECTS, SceneState
from osfcore.inspection.contact_sheet import Comparison, contact_sheet
from osfcore.io.image_file import to_uint8, write_png
from osfcore.io.image_set import ImageSet, read_image_set
from osfcore.metrics.image_errors import dilated, psnr, ssim
from osfcore.objects.asset_library import AssetLibrary
from osfcore.render.renderer import SceneRenderer
from osfcore.render.types import EXACT, Quality, Renderer, SceneBatch
from osfcore.world.collect_images import MIN_IMAGES, CollectObject, collect_object
from osfcore.world.scenes import Conditions, SceneRequest
from osfcore.world.tabletop import Tabletop
from osfcore.world.tasks import Draw, draw_scene

# How well a field shows its object: unseen views under unseen lights, over black.


VIEW_QUALITY: Quality = EXACT  # one ray a pixel, as in training
_NAME = "object"


@dataclass(frozen=True, eq=False, slots=True)
class ViewFigures:
    """Figures of one image.

    Attributes:
        psnr_full: over the whole image, premultiplied over black [dB].
        psnr_mask: inside the silhouette, dilated by 2 px [dB].
        ssim: over the whole image.
        comparison: true and rendered image.
    """

    psnr_full: float
    psnr_mask: float
    ssim: float
    comparison: Comparison


def compare_views(field: KiloOSF, images: ImageSet) -> Iterator[ViewFigures]:
    """Render each image of a set from its camera under its light, with the object where the set has it."""
    renderer = SceneRenderer({_NAME: field}, None)
    place, turn = np.zeros((1, 1, 3)), np.array([[[1.0, 0.0, 0.0, 0.0]]])
    for camera, light, rgba in zip(images.cameras, images.light_directions, images.rgba, strict=True):
        batch = SceneBatch((_NAME,), place, turn, light[None].astype(float), None)
        rendered = renderer.render(batch, (camera,), quality=VIEW_QUALITY)
        ours = np.clip(rendered.rgb[0, 0], 0, 1)
        truth = rgba[..., :3].astype(np.float32) * rgba[..., 3:] / 255**2
        shown = Comparison(camera.name.rpartition("/")[2], to_uint8(truth), to_uint8(ours))
        inside = dilated(rgba[..., 3] > 0)
        yield ViewFigures(psnr(truth, ours), psnr(truth, ours, inside), ssim(truth, ours), shown)


# How well fields show whole scenes: objects on the table under a harsh light, against the simulator (paper Fig. 5).


SCENE_QUALITY: Quality = replace(EXACT, samples_per_side=2)  # the truth is anti-aliased too
MEASURES = ("psnr", "ssim", "psnr_object", "psnr_shadow")
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
    """Figures of one view of a scene.

    Attributes:
        psnr: over the whole image [dB].
        ssim: over the whole image.
        psnr_object: over pixels that show an object [dB]; None if hardly any does.
        psnr_shadow: over table pixels in shadow [dB]; None if there is hardly any.
        comparison: true and rendered image.
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
    draw: Draw,
    lights: Sequence[Light],
    library: AssetLibrary,
    cameras: tuple[Camera, ...],
    conditions: Conditions | None = None,
) -> tuple[Truth, ...]:
    """Take pictures of the same arrangement under one light after the other.

    Args:
        draw: the scene, of which its own light plays no part.
        lights: to take pictures under.
        library: meshes of its objects.
        cameras: of one image size.
        conditions: of the world; the usual ones if None.

    Raises:
        UnknownName, MissingAssets: if an object has no mesh here.
        NoRoom: if the objects do not fit side by side.
    """
    truths, request = [], SceneRequest(names=draw.names, light=draw.light)
    with closing(Tabletop(library, cameras=cameras, request=request, conditions=conditions)) as world:
        world.arrange(draw.seed)
        for light in lights:
            world.set_light(light)
            pictures = world.pictures(cameras, with_pusher=False)
            empty = world.pictures(cameras, with_pusher=False, with_objects=False)
            objects = np.stack([picture.coverage.sum(axis=0) > 0 for picture in pictures])
            pairs = zip(empty, pictures, strict=True)
            darker = np.stack([np.any(lit.rgb - picture.rgb > _SHADE, axis=-1) for lit, picture in pairs])
            images = np.stack([picture.rgb for picture in pictures])
            truths.append(Truth(replace(world.truth(), pusher=None), cameras, images, objects, darker & ~objects))
    return tuple(truths)


def render_scene(renderer: Renderer, truth: Truth) -> Float[np.ndarray, "V h w 3"]:
    """Return a renderer's images of the same scene."""
    rendered = renderer.render(SceneBatch.of(truth.state), truth.cameras, quality=SCENE_QUALITY)
    return np.clip(rendered.rgb[0], 0, 1)


def compare_scene(truth: Truth, ours: Float[np.ndarray, "V h w 3"]) -> tuple[SceneFigures, ...]:
    """Return the figures of each view."""

    def psnr_over(n: int, pixels: np.ndarray) -> float | None:
        return psnr(truth.images[n], ours[n], pixels) if pixels.sum() >= MIN_PIXELS else None

    return tuple(
        SceneFigures(
            psnr(truth.images[n], ours[n]),
            ssim(truth.images[n], ours[n]),
            psnr_over(n, truth.objects[n]),
            psnr_over(n, truth.shadows[n]),
            Comparison(f"camera {camera.name}", to_uint8(truth.images[n]), to_uint8(ours[n])),
        )
        for n, camera in enumerate(truth.cameras)
    )


def figures_of(scene: Sequence[SceneFigures]) -> dict[str, list[float | None]]:
    """Return each measure of a scene's views as a list, for JSON."""
    return {key: [getattr(view, key) for view in scene] for key in MEASURES}


def mean_of(scenes: Sequence[Mapping[str, Sequence[float | None]]], key: str) -> float | None:
    """Return the mean over all images of all scenes that have the figure; None if none has."""
    return mean(value for scene in scenes for value in scene[key])


# The report.


def field_figures(result: TaskResult, weights: Path) -> dict[str, Any]:
    """Return the figures of one field, with size [MB] and training time [min] of its weights, which are read anew.

    Args:
        result: means over the images of "psnr_full" [dB], "psnr_mask" [dB] and "ssim", and how many "images".
        weights: of the field; "minutes" are None where no metrics lie beside them.
    """
    try:
        minutes = float(json.loads(weights.with_suffix(".json").read_text(encoding="utf-8"))["minutes"])
    except (OSError, ValueError, KeyError, TypeError, OverflowError, RecursionError):
        minutes = None
    return {**result.figures, "file_mb": weights.stat().st_size / 1e6, "minutes": minutes}


def fields_report(objects: Mapping[str, Mapping[str, Any]], scenes: Sequence[TaskResult]) -> dict[str, Any]:
    """Return all figures as plain numbers.

    Args:
        objects: figures of each field, by the name of its object.
        scenes: whose images are all counted once; the figures of scenes are None without any.
    """
    rows = list(objects.values())
    figures = [scene.figures for scene in scenes]
    return {
        **{f"{key}_mean": float(np.mean([row[key] for row in rows])) for key in ("psnr_full", "psnr_mask", "ssim")},
        **{f"scene_{key}_mean": mean_of(figures, key) for key in ("psnr", "psnr_object", "psnr_shadow")},
        "max_file_mb": max(row["file_mb"] for row in rows),
        "objects": dict(objects),
        "scenes": len(scenes),
    }


# The evaluation.


FORMAT = 1  # of the kept results; rises when figures come to mean something else
SET_SEED = 760_000  # image sets with this seed and the next ones are for evaluation: never train on them
_DIGEST_CHARACTERS = 12  # of an object's digest in the name of its set
_SHOWN = 8  # images of an object on its sheet
_Steps = Generator[EvaluationStep, None, TaskResult]


@dataclass(frozen=True, slots=True)
class EvaluateFields:
    """Evaluate fields against the simulator.

    Attributes:
        out: folder for results; those of an earlier run of the same fields are taken over.
        names: which objects, at least one, or None for all that have a field and a mesh.
        tasks: number of scenes, each with its own objects, arrangement and harsh light.
        objects: in each scene.
        seed: of views, lights and scenes.
        size: side of the images [px].
    """

    out: Path
    names: tuple[str, ...] | None = None
    tasks: int = 20
    objects: int = 3
    seed: int = 0
    size: int = DEFAULT_IMAGE_SIDE


@dataclass(frozen=True, slots=True)
class EvaluateSet:
    """Evaluate one field on the test images of a set in the OSF format.

    Attributes:
        data: folder with test/anno.json.
        weights: field to evaluate; its metrics lie beside it as .json.
        out: folder for results.
    """

    data: Path
    weights: Path
    out: Path


def evaluate_fields(config: EvaluateFields, fields: FieldLibrary, assets: AssetLibrary) -> Iterator[EvaluationStep]:
    """Measure every object, then scenes of them; contact sheets go to objects.png, scenes.png and folders beside them.

    Args:
        config: what to measure.
        fields: of the objects and the table.
        assets: meshes, for the simulator.

    Raises:
        UnknownName, MissingAssets: if an object lacks a field or a mesh.
        InvalidInput: if a number is out of range.
        CorruptFile, CannotWrite: as files are.
    """
    limits = ("number of scenes", config.tasks, 0, MAX_TASKS), ("objects in a scene", config.objects, 1, MAX_OBJECTS)
    check_ranges(*limits)
    check_seed(config.seed)
    image_side(config.size)
    if config.names == ():
        raise InvalidInput("number of names", 0, "1 or more, or --names left out for all")
    names = chosen_objects(config.names, fields, assets)
    tasks = config.tasks if len(names) >= config.objects else 0  # too few objects make no scene
    total = len(names) + tasks
    objects: dict[str, TaskResult] = {}
    for name in names:
        objects[name] = yield from _object_alone(config, name, fields, assets, (len(objects), total))
    shown = [replace(result.shown[0], label=name) for name, result in objects.items()]
    write_png(config.out / "objects.png", contact_sheet(shown))
    figures = {name: field_figures(result, fields.info(name).path) for name, result in objects.items()}
    scenes: list[TaskResult] = []
    load, results = cache(fields.load), TaskCache(config.out / "scenes")
    for number in range(tasks):
        yield EvaluationStep(len(names) + number, total, f"Scenes ({number + 1} of {tasks})")
        draw = draw_scene(names, config.objects, config.seed, number)
        circumstances = {
            "format": FORMAT,
            **scene_circumstances(draw, fields, assets),
            "size": config.size,
            "quality": asdict(SCENE_QUALITY),
        }
        result = results.read(f"{number:04d}", circumstances)
        if result is None:
            truth = simulate(draw, assets, default_cameras(config.size))
            renderer = SceneRenderer({one: load(one) for one in draw.names}, fields.load_table())
            views = compare_scene(truth, render_scene(renderer, truth))
            result = TaskResult(figures_of(views), tuple(view.comparison for view in views))
            write_png(results.folder / f"{number:04d}.png", contact_sheet(result.shown))
            results.write(f"{number:04d}", circumstances, result)
        scenes.append(result)
    if scenes:  # one view of each: the next camera every time
        shown = [replace(scene.shown[i % len(scene.shown)], label=f"scene {i}") for i, scene in enumerate(scenes)]
        write_png(config.out / "scenes.png", contact_sheet(shown))
    yield EvaluationStep(total, total, "Everything is measured", fields_report(figures, scenes))


def evaluate_set(config: EvaluateSet) -> Iterator[EvaluationStep]:
    """Measure one field on the test images of a set; the contact sheet goes to objects.png.

    Raises:
        CorruptFile: if the set or the weights are not sound.
        CannotWrite: if the disk refuses.
    """
    name = config.data.resolve().name
    result = yield from _measured(name, config.weights, config.data, (0, 1))
    write_png(config.out / "objects.png", contact_sheet(result.shown))
    report = fields_report({name: field_figures(result, config.weights)}, ())
    yield EvaluationStep(1, 1, "Everything is measured", report)


def _object_alone(
    config: EvaluateFields, name: str, fields: FieldLibrary, assets: AssetLibrary, at: tuple[int, int]
) -> _Steps:
    """Measure one object on a fresh set of images; `at` says how many parts of how many are done."""
    results = TaskCache(config.out / "objects")
    weights = fields.info(name).path
    asset = assets.digest(name)
    data = config.out / "sets" / f"{name}-{asset[:_DIGEST_CHARACTERS]}-{config.size}px-{config.seed}"
    circumstances = {
        "format": FORMAT,
        "weights": file_sha256(weights),
        "asset": asset,
        "set": data.name,
        "quality": asdict(VIEW_QUALITY),
    }
    if (kept := results.read(name, circumstances)) is not None:
        return kept
    if not (data / "test" / "anno.json").is_file():  # sets appear whole
        for step in collect_object(CollectObject(name, data, MIN_IMAGES, config.size, SET_SEED + config.seed), assets):
            yield EvaluationStep(*at, f"{name} (taking picture {step.done} of {step.total})")
    result = yield from _measured(name, weights, data, at)
    write_png(config.out / "objects" / f"{name}.png", contact_sheet(result.shown))
    results.write(name, circumstances, result)
    return result


def _measured(name: str, weights: Path, data: Path, at: tuple[int, int]) -> _Steps:
    """Measure a field on the test images of a set."""
    field, images = read_field(weights), read_image_set(data, "test")
    if images.is_opaque:
        raise CorruptFile(data, "its images are opaque all over; an object before a transparent background is expected")
    count = len(images.cameras)
    views = []
    for view in compare_views(field, images):
        views.append(view)
        yield EvaluationStep(*at, f"{name} (image {len(views)} of {count})")
    figures = {key: float(np.mean([getattr(v, key) for v in views])) for key in ("psnr_full", "psnr_mask", "ssim")}
    chosen = np.unique(np.linspace(0, count - 1, _SHOWN).astype(int)).tolist()
    return TaskResult({**figures, "images": count}, tuple(views[i].comparison for i in chosen))
