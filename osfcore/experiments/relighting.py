"""How well fields show scenes under any light: true poses, true light, against the simulator (paper, figure 5).

Each scene of several objects stands under lights from one random side at several elevations above the table and is
shown by every method through the four cameras. All methods are given the same scenes, of objects that all of them
know. Finished scenes are kept in the output folder, method by method: a killed comparison goes on where it was.
"""

from __future__ import annotations

from collections.abc import Iterator, Mapping, Sequence
from concurrent.futures import Executor
from dataclasses import asdict, dataclass, replace
from functools import partial
from pathlib import Path
from typing import Any

import numpy as np
from jaxtyping import UInt8

from osfcore.errors import InvalidInput, check_ranges, check_seed
from osfcore.experiments.charts import Axis
from osfcore.experiments.fields import SCENE_QUALITY, compare_scene, figures_of, mean_of, render_scene, simulate_relit
from osfcore.experiments.harness import EvaluationStep, Piece, TaskCache, TaskResult, file_sha256, table_sha256
from osfcore.experiments.images import (
    FIELD_METHODS,
    TITLES,
    check_methods,
    common_names,
    field_path,
    load_appearance,
    measured,
    summary,
    tables_of,
    write_comparison,
)
from osfcore.fields.field_library import FieldLibrary
from osfcore.geometry.cameras import DEFAULT_IMAGE_SIDE, default_cameras, image_side
from osfcore.geometry.light import MIN_LIGHT_ELEVATION_DEG, Light
from osfcore.inspection.contact_sheet import image_grid
from osfcore.io.image_file import write_png
from osfcore.objects.asset_library import AssetLibrary
from osfcore.random_streams import Stream
from osfcore.world.tasks import Draw, draw_scene

# One scene under lights of several elevations, as a method shows it, against the simulator.


MEASURES = ("psnr", "ssim", "psnr_object", "psnr_shadow")


@dataclass(frozen=True, eq=False, slots=True)
class RelitScenes:
    """Measures single scenes; can be sent to other processes.

    Attributes:
        fields: ours, and the table.
        assets: meshes for the simulator.
        data_dir: where fields of other methods may be.
        elevations_deg: of the lights above the table.
        size: side of the images [px].
    """

    fields: FieldLibrary
    assets: AssetLibrary
    data_dir: Path
    elevations_deg: tuple[float, ...]
    size: int

    def measure(self, draw: Draw, method: str) -> TaskResult:
        """A scene shown by a method that is told its true poses and light.

        Args:
            draw: the scene; its light tells the azimuth of all lights.
            method: one of `osfcore.experiments.images.FIELD_METHODS`.

        Returns:
            For each measure its means over the four cameras, one for each elevation; comparisons of the first camera
            under the lowest, the middle and the highest light.

        Raises:
            NoRoom: if the objects do not fit side by side.
            UnknownName, CorruptFile: as fields are.
        """
        azimuth = float(np.arctan2(draw.light.direction[1], draw.light.direction[0]))
        lights = [Light.from_angles(azimuth, np.deg2rad(elevation)) for elevation in self.elevations_deg]
        truths = simulate_relit(draw, lights, self.assets, default_cameras(self.size))
        renderer = load_appearance(method, draw.names, self.fields, self.data_dir).together
        scenes = [compare_scene(truth, render_scene(renderer, truth)) for truth in truths]
        figures = [figures_of(scene) for scene in scenes]
        return TaskResult(
            {key: [mean_of([one], key) for one in figures] for key in MEASURES},
            tuple(
                replace(scenes[n][0].comparison, label=f"{self.elevations_deg[n]:g} deg")
                for n in sorted({0, len(scenes) // 2, len(scenes) - 1})
            ),
        )


REPORT_FILE, CHART_FILE, IMAGES_FILE = "relighting.json", "relighting.png", "relighting_scene.png"
ELEVATIONS_DEG = (5.0, 10.0, 20.0, 30.0, 45.0, 60.0, 75.0, 90.0)
ALL = "all"  # the span of all elevations
MAX_TASKS = 10_000
VERSION = 1  # raised by hand when figures may change


@dataclass(frozen=True, slots=True)
class CompareRelighting:
    """What to compare.

    Attributes:
        folder: for results, pictures and relighting.json.
        data_dir: where fields trained on this machine are.
        names: objects to draw from; all with a mesh and a field of every method if None.
        tasks: number of scenes.
        seed: of the scenes.
        methods: some of `FIELD_METHODS`.
        objects: in each scene.
        elevations_deg: of the lights above the table.
        size: side of the images [px].
    """

    folder: Path
    data_dir: Path
    names: tuple[str, ...] | None = None
    tasks: int = 20
    seed: int = 0
    methods: tuple[str, ...] = FIELD_METHODS
    objects: int = 3
    elevations_deg: tuple[float, ...] = ELEVATIONS_DEG
    size: int = DEFAULT_IMAGE_SIDE


def compare_relighting(
    config: CompareRelighting, fields: FieldLibrary, assets: AssetLibrary, executor: Executor | None = None
) -> Iterator[EvaluationStep]:
    """Show all scenes by all methods; the chart, images of the first scene and relighting.json go to `config.folder`.

    Args:
        config: what to compare.
        fields: ours, and the table.
        assets: meshes, for the simulator.
        executor: works on scenes side by side, if given.

    Raises:
        UnknownName, MissingAssets: if an object lacks a field or a mesh.
        InvalidInput: if a number is out of range, or objects are too few.
        NoRoom: if there is no room for a scene's objects.
        WorkerDied: if a worker process ended.
        CorruptFile, CannotWrite: as files are.
    """
    config = _checked(config, fields, assets)
    pieces = {method: _pieces(config, method, fields, assets) for method in config.methods}
    results = yield from measured(pieces, executor)
    tables = tables_of(results, MEASURES)
    spans = {ALL: range(len(config.elevations_deg))}
    spans |= {f"{elevation:g}": [n] for n, elevation in enumerate(config.elevations_deg)}
    about = {key: getattr(config, key) for key in ("tasks", "seed", "objects", "size")}
    drawn_from = {"names": list(config.names or ()), "elevations_deg": list(config.elevations_deg)}
    report = {**about, **drawn_from, **summary(tables, spans)}
    x = Axis("light above the table [deg]", 0, 90)
    files = config.folder / REPORT_FILE, config.folder / CHART_FILE
    write_comparison(files, report, tables, x, config.elevations_deg)
    write_png(config.folder / IMAGES_FILE, _first_scene(results))
    total = config.tasks * len(config.methods)
    yield EvaluationStep(total, total, "Everything is measured", report)


def _checked(config: CompareRelighting, fields: FieldLibrary, assets: AssetLibrary) -> CompareRelighting:
    """The same with methods, names and elevations in order."""
    check_ranges(("number of tasks", config.tasks, 1, MAX_TASKS))
    check_seed(config.seed)
    image_side(config.size)
    elevations = tuple(sorted(set(config.elevations_deg)))
    if not elevations or not MIN_LIGHT_ELEVATION_DEG <= elevations[0] <= elevations[-1] <= 90:
        allowed = f"one or more between {MIN_LIGHT_ELEVATION_DEG:g} and 90"
        raise InvalidInput("elevations of the light [deg]", ", ".join(f"{e:g}" for e in elevations) or "none", allowed)
    methods = check_methods(config.methods, FIELD_METHODS)
    names = common_names(methods, config.names, fields, assets, config.data_dir, config.objects)
    return replace(config, methods=methods, names=names, elevations_deg=elevations)


def _pieces(config: CompareRelighting, method: str, fields: FieldLibrary, assets: AssetLibrary) -> list[Piece]:
    scenes = RelitScenes(fields, assets, config.data_dir, config.elevations_deg, config.size)
    given = {
        "elevations_deg": config.elevations_deg,
        "size": config.size,
        "quality": asdict(SCENE_QUALITY),
        "table": table_sha256(fields.load_table()),
        "version": VERSION,
    }
    cache = TaskCache(config.folder / "relighting" / f"{config.objects}-{config.seed}" / method)

    def piece(number: int) -> Piece:
        draw = draw_scene(config.names or (), config.objects, config.seed, number, Stream.RELIT_SCENE)
        own = _circumstances(draw, method, fields, assets, config.data_dir)
        return Piece(f"{number:04d}", cache, {**given, **own}, partial(scenes.measure, draw, method))

    return [piece(number) for number in range(config.tasks)]


def _circumstances(
    draw: Draw, method: str, fields: FieldLibrary, assets: AssetLibrary, data_dir: Path
) -> dict[str, Any]:
    """What a scene is, and by which fields it is shown."""
    paths = {name: field_path(method, name, fields, data_dir) for name in draw.names}
    return {
        "objects": {name: [assets.digest(name), file_sha256(path)] for name, path in paths.items()},
        "arrangement": draw.seed,
        "light": draw.light.direction.tolist(),
    }


def _first_scene(results: Mapping[str, Sequence[TaskResult]]) -> UInt8[np.ndarray, "H W 3"]:
    """The first scene: a row for each light; the truth, then the methods."""
    shown = [part[0].shown for part in results.values()]
    rows = {lights[0].label: [lights[0].truth, *(one.ours for one in lights)] for lights in zip(*shown, strict=True)}
    return image_grid(rows, ("simulator", *(TITLES[method] for method in results)))
