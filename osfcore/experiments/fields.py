"""How good trained fields are: each object alone, and scenes of several on the table; nothing here was trained on.

A figure of an object is the mean over its images; the mean over objects is the mean of those. For scenes, every image
of every scene counts once. Each finished object and scene is kept in the output folder, so that an evaluation can be
killed, resumed and run in pieces.
"""

from __future__ import annotations

import json
from collections.abc import Generator, Iterator, Mapping, Sequence
from dataclasses import asdict, dataclass, replace
from pathlib import Path
from typing import Any, TypeVar

import numpy as np
from jaxtyping import Bool, Float

from osfcore.errors import CorruptFile, InvalidInput, MissingAssets, check_ranges, check_seed
from osfcore.experiments.harness import TaskCache, TaskResult, file_sha256, table_sha256
from osfcore.fields.field_library import FieldLibrary
from osfcore.fields.kiloosf import KiloOSF, read_field
from osfcore.geometry.cameras import DEFAULT_IMAGE_SIDE, Camera, default_cameras, image_side
from osfcore.geometry.light import Light
from osfcore.geometry.poses import Pose
from osfcore.geometry.states import MAX_OBJECTS, SceneState
from osfcore.inspection.contact_sheet import Comparison, contact_sheet
from osfcore.io.image_file import to_uint8, write_png
from osfcore.io.image_set import ImageSet, read_image_set
from osfcore.metrics.image_errors import dilated, psnr, ssim
from osfcore.objects.asset_library import AssetLibrary
from osfcore.render.renderer import SceneRenderer
from osfcore.render.types import EXACT, Quality, Renderer, SceneBatch
from osfcore.world.collect_images import MIN_IMAGES, CollectObject, collect_object
from osfcore.world.imaging import Picture, RayTracer
from osfcore.world.scenes import SceneRequest
from osfcore.world.tabletop import Tabletop
from osfcore.world.tasks import Draw, draw_scene

# What an evaluation of fields reports.


@dataclass(frozen=True, slots=True)
class FieldFigures:
    """One field on unseen views under unseen lights; means over the images.

    Attributes:
        psnr_full: over whole images, over black [dB].
        psnr_mask: inside the silhouettes, dilated by 2 px [dB].
        ssim: over whole images.
        images: how many.
        file_mb: size of the weights [MB].
        minutes: training time, or None if that is not known.
    """

    psnr_full: float
    psnr_mask: float
    ssim: float
    images: int
    file_mb: float
    minutes: float | None


@dataclass(frozen=True, eq=False, slots=True)
class FieldsReport:
    """What was measured.

    Attributes:
        objects: by name.
        scene_psnr: mean over all images of all scenes, whole images [dB]; None without scenes.
        scene_psnr_object: the same over pixels that show an object.
        scene_psnr_shadow: the same over table pixels in shadow.
        scenes: how many.
    """

    objects: Mapping[str, FieldFigures]
    scene_psnr: float | None = None
    scene_psnr_object: float | None = None
    scene_psnr_shadow: float | None = None
    scenes: int = 0

    def to_json(self) -> dict[str, Any]:
        """The report as plain numbers, with means over the objects."""
        figures = list(self.objects.values())
        return {
            "psnr_full_mean": float(np.mean([f.psnr_full for f in figures])),
            "psnr_mask_mean": float(np.mean([f.psnr_mask for f in figures])),
            "ssim_mean": float(np.mean([f.ssim for f in figures])),
            "scene_psnr_mean": self.scene_psnr,
            "scene_psnr_object_mean": self.scene_psnr_object,
            "scene_psnr_shadow_mean": self.scene_psnr_shadow,
            "max_file_mb": max(f.file_mb for f in figures),
            "objects": {name: asdict(f) for name, f in self.objects.items()},
            "scenes": self.scenes,
        }


def field_figures(result: TaskResult, weights: Path) -> FieldFigures:
    """Figures with size and training time, which are read anew each time."""
    try:
        minutes = float(json.loads(weights.with_suffix(".json").read_text())["minutes"])
    except (
        OSError,
        ValueError,
        KeyError,
        TypeError,
        OverflowError,
        RecursionError,
    ):  # weights may come without metrics
        minutes = None
    return FieldFigures(**result.figures, file_mb=weights.stat().st_size / 1e6, minutes=minutes)


# How well a field shows its object: unseen views under unseen lights, over black.


VIEW_QUALITY: Quality = EXACT  # one ray a pixel, as in training
_NAME = "object"


@dataclass(frozen=True, eq=False, slots=True)
class ViewFigures:
    """One image, compared.

    Attributes:
        psnr_full: over the whole image, premultiplied over black [dB].
        psnr_mask: inside the silhouette, dilated by 2 px [dB].
        ssim: over the whole image.
        comparison: both images.
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


FORMAT = 1  # of the kept results; rises when figures come to mean something else
SET_SEED = 760_000  # image sets with this seed and the next ones are for evaluation: never train on them
MAX_TASKS = 10_000
MAX_SEED = 1_000_000
_DIGEST_CHARACTERS = 12  # of an object's digest in the name of its set
_SHOWN = 8  # images of an object on its sheet
_ResultT = TypeVar("_ResultT")
_Notes = Generator[str, None, _ResultT]  # work that tells what it is doing, and returns its result


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


@dataclass(frozen=True, eq=False, slots=True)
class EvaluationStep:
    """How far an evaluation is.

    Attributes:
        done: objects and scenes finished.
        total: objects and scenes in all.
        note: what is being done.
        report: with the last step only.
    """

    done: int
    total: int
    note: str
    report: FieldsReport | None = None


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
    names = _checked(config, fields, assets)
    tasks = config.tasks if len(names) >= config.objects else 0  # too few objects make no scene
    total = len(names) + tasks
    objects: dict[str, TaskResult] = {}
    for name in names:
        objects[name] = yield from _told(_object_alone(config, name, fields, assets), len(objects), total)
    _write_sheet(config.out / "objects.png", [_titled(result, 0, name) for name, result in objects.items()])
    figures = {name: field_figures(result, fields.info(name).path) for name, result in objects.items()}
    scenes: list[TaskResult] = []
    run = _Scenes(config, names, fields, assets)
    for number in range(tasks):
        yield EvaluationStep(len(names) + number, total, f"Scenes ({number + 1} of {tasks})")
        scenes.append(run.result(number))
    if scenes:  # one view of each: the next camera every time
        shown = [_titled(scene, i % len(scene.shown), f"scene {i}") for i, scene in enumerate(scenes)]
        _write_sheet(config.out / "scenes.png", shown)
    means = (mean_of([scene.figures for scene in scenes], key) for key in ("psnr", "psnr_object", "psnr_shadow"))
    yield EvaluationStep(total, total, "Everything is measured", FieldsReport(figures, *means, scenes=tasks))


def evaluate_set(config: EvaluateSet) -> Iterator[EvaluationStep]:
    """Measure one field on the test images of a set; the contact sheet goes to objects.png.

    Raises:
        CorruptFile: if the set or the weights are not sound.
        CannotWrite: if the disk refuses.
    """
    name = config.data.resolve().name
    result = yield from _told(_measured(name, config.weights, config.data), 0, 1)
    _write_sheet(config.out / "objects.png", result.shown)
    report = FieldsReport({name: field_figures(result, config.weights)})
    yield EvaluationStep(1, 1, "Everything is measured", report)


def measurable(fields: FieldLibrary, assets: AssetLibrary) -> tuple[str, ...]:
    """The objects with both a field and a mesh.

    Raises:
        InvalidInput: if there is no field at all.
        MissingAssets: if there are fields, but no mesh for any.
    """
    known = fields.names()
    if not known:
        raise InvalidInput("number of trained fields", 0, "1 or more: train one with 'osf train field'")
    names = tuple(name for name in known if assets.has(name))
    if not names:
        raise MissingAssets(known)
    return names


def _checked(config: EvaluateFields, fields: FieldLibrary, assets: AssetLibrary) -> tuple[str, ...]:
    """The objects to measure, after everything asked for was found possible."""
    check_ranges(
        ("number of scenes", config.tasks, 0, MAX_TASKS), ("objects in a scene", config.objects, 1, MAX_OBJECTS)
    )  # fmt: skip
    check_seed(config.seed)
    image_side(config.size)
    if config.names is None:
        return measurable(fields, assets)
    if not config.names:
        raise InvalidInput("number of names", 0, "1 or more, or --names left out for all")
    for name in config.names:
        fields.info(name)  # raises UnknownName
        if not assets.has(name):
            assets.info(name)
            raise MissingAssets([name])
    return tuple(dict.fromkeys(config.names))


def _object_alone(config: EvaluateFields, name: str, fields: FieldLibrary, assets: AssetLibrary) -> _Notes[TaskResult]:
    """One object on a fresh set of images."""
    cache = TaskCache(config.out / "objects")
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
    kept = cache.read(name, circumstances)
    if kept is not None:
        return kept
    if not (data / "test" / "anno.json").is_file():  # sets appear whole
        for step in collect_object(CollectObject(name, data, MIN_IMAGES, config.size, SET_SEED + config.seed), assets):
            yield f"{name} (taking picture {step.done} of {step.total})"
    result = yield from _measured(name, weights, data)
    _write_sheet(config.out / "objects" / f"{name}.png", result.shown)
    cache.write(name, circumstances, result)
    return result


def _measured(name: str, weights: Path, data: Path) -> _Notes[TaskResult]:
    """A field on the test images of a set."""
    field, images = read_field(weights), read_image_set(data, "test")
    if images.is_opaque:
        raise CorruptFile(data, "its images are opaque all over; an object before a transparent background is expected")
    count = len(images.cameras)
    views = []
    for view in compare_views(field, images):
        views.append(view)
        yield f"{name} (image {len(views)} of {count})"
    figures = {key: float(np.mean([getattr(v, key) for v in views])) for key in ("psnr_full", "psnr_mask", "ssim")}
    chosen = np.unique(np.linspace(0, count - 1, _SHOWN).astype(int)).tolist()
    return TaskResult({**figures, "images": count}, tuple(views[i].comparison for i in chosen))


class _Scenes:
    """Composite scenes, one after another."""

    def __init__(
        self, config: EvaluateFields, names: tuple[str, ...], fields: FieldLibrary, assets: AssetLibrary
    ) -> None:
        self._config, self._names, self._fields, self._assets = config, names, fields, assets
        self._cache = TaskCache(config.out / "scenes")
        self._hashes: dict[str, str] = {}
        self._loaded: dict[str, KiloOSF] = {}

    def result(self, number: int) -> TaskResult:
        """Figures and images of one scene, measured or taken over."""
        config, table = self._config, self._fields.load_table()
        draw = draw_scene(self._names, config.objects, config.seed, number)
        circumstances = {
            "format": FORMAT,
            "weights": {name: self._hash(name) for name in draw.names},
            "assets": {name: self._assets.digest(name) for name in draw.names},
            "table": table_sha256(table),
            "arrangement": draw.seed,
            "light": draw.light.direction.tolist(),
            "size": config.size,
            "quality": asdict(SCENE_QUALITY),
        }
        name = f"{number:04d}"
        kept = self._cache.read(name, circumstances)
        if kept is not None:
            return kept
        truth = simulate(draw, self._assets, default_cameras(config.size))
        renderer = SceneRenderer({object_name: self._load(object_name) for object_name in draw.names}, table)
        views = compare_scene(truth, render_scene(renderer, truth))
        result = TaskResult(figures_of(views), tuple(view.comparison for view in views))
        _write_sheet(config.out / "scenes" / f"{name}.png", result.shown)
        self._cache.write(name, circumstances, result)
        return result

    def _hash(self, name: str) -> str:
        if name not in self._hashes:
            self._hashes[name] = file_sha256(self._fields.info(name).path)
        return self._hashes[name]

    def _load(self, name: str) -> KiloOSF:
        if name not in self._loaded:
            self._loaded[name] = self._fields.load(name)
        return self._loaded[name]


def _told(notes: _Notes[_ResultT], done: int, total: int) -> Generator[EvaluationStep, None, _ResultT]:
    """The notes as steps."""
    while True:
        try:
            yield EvaluationStep(done, total, next(notes))
        except StopIteration as stop:
            return stop.value


def _titled(result: TaskResult, number: int, label: str) -> Comparison:
    return replace(result.shown[number], label=label)


def _write_sheet(path: Path, shown: Sequence[Comparison]) -> None:
    write_png(path, contact_sheet(shown))
