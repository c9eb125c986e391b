"""Compare how methods show scenes under any light, given true poses and light (paper, figure 5).

Each scene of several objects stands under lights from one random side at several elevations above the table and is
shown by every method through the four cameras. All methods are given the same scenes, of objects that all of them
know. Finished scenes are kept in the output folder, method by method: a killed comparison goes on where it was.
"""

from __future__ import annotations

from collections.abc import Iterator, Mapping
from concurrent.futures import Executor
from dataclasses import dataclass, replace
from dataclasses import fields as fields_of
from functools import partial
from typing import Any

import numpy as np
from jaxtyping import UInt8

from osfcore.errors import InvalidInput
from osfcore.experiments.charts import Axis, Chart
from osfcore.experiments.factors import factor_named
from osfcore.experiments.fields import MEASURES, SCENE_QUALITY, compare_scene, figures_of, render_scene, simulate_relit
from osfcore.experiments.harness import EvaluationStep, Piece, TaskCache, TaskResult
from osfcore.experiments.images import (
    FIELD_METHODS,
    TITLES,
    CompareImages,
    checked,
    compare,
    image_charts,
    load_appearance,
    shown_circumstances,
)
from osfcore.experiments.rivals.nerf import with_fitted_brightness
from osfcore.experiments.statistics import mean
from osfcore.fields.field_library import FieldLibrary
from osfcore.geometry.cameras import default_cameras
from osfcore.geometry.light import MIN_LIGHT_ELEVATION_DEG, Light
from osfcore.geometry.poses import fibonacci_sphere
from osfcore.inspection.contact_sheet import image_grid
from osfcore.objects.asset_library import AssetLibrary
from osfcore.random_streams import Stream
from osfcore.render.types import SceneBatch
from osfcore.world.scenes import Conditions
from osfcore.world.tasks import Draw, draw_scene

REPORT_FILE, CHART_FILE, IMAGES_FILE = "relighting.json", "relighting.svg", "relighting_scene.png"
ELEVATIONS_DEG = (5.0, 10.0, 20.0, 30.0, 45.0, 60.0, 75.0, 90.0)
ALL, SKY = "all", "sky"  # the span of all elevations, and that of the whole sky
_SKY_LIGHTS = 16
VERSION = 1  # raised by hand when figures may change


@dataclass(frozen=True, slots=True)
class CompareRelighting(CompareImages):
    """What to compare: scenes by some of `FIELD_METHODS`.

    Attributes:
        elevations_deg: of the lights above the table.
        factor: name of what differs from the usual lamp, table or renderer, such as "objects_shiny"; "" for nothing.
        sky: whether scenes are also shown as they are on average under lights from all over the sky, which is what
            fields without light learn.
    """

    elevations_deg: tuple[float, ...] = ELEVATIONS_DEG
    factor: str = ""
    sky: bool = False


def compare_relighting(
    config: CompareRelighting, fields: FieldLibrary, assets: AssetLibrary, executor: Executor | None = None
) -> Iterator[EvaluationStep[dict[str, Any]]]:
    """Show all scenes by all methods; the chart, images of the first scene and relighting.json go to `config.folder`.

    Args:
        config: what to compare.
        fields: ours, and the table.
        assets: meshes, for the simulator.
        executor: works on scenes side by side, if given.

    Raises:
        UnknownName, MissingAssets: if an object lacks a field or a mesh, or no factor has that name.
        InvalidInput: if a number is out of range, or objects are too few.
        NoRoom: if there is no room for a scene's objects.
        WorkerDied: if a worker process ended.
        CorruptFile, CannotWrite: as files are.
    """
    elevations = tuple(sorted(set(config.elevations_deg)))
    if not elevations or not MIN_LIGHT_ELEVATION_DEG <= elevations[0] <= elevations[-1] <= 90:
        allowed = f"one or more between {MIN_LIGHT_ELEVATION_DEG:g} and 90"
        raise InvalidInput("elevations of the light [deg]", ", ".join(f"{e:g}" for e in elevations) or "none", allowed)
    _conditions(config.factor)  # what cannot be shown is refused before any work
    config = checked(replace(config, elevations_deg=elevations), FIELD_METHODS, fields, assets)
    names = config.names or ()

    def piece(method: str, number: int) -> Piece:
        cell = "-".join(part for part in (f"{config.objects}-{config.seed}", config.factor) if part)
        cache = TaskCache(config.folder / "relighting" / cell / method)
        draw = draw_scene(names, config.objects, config.seed, number, Stream.RELIT_SCENE)
        shown = shown_circumstances(draw, (method,), fields, assets, config.data_dir, config.size)
        given = {"version": VERSION, "elevations_deg": elevations, **shown}
        given |= {"sky": _SKY_LIGHTS} if config.sky else {}
        return Piece(f"{number:04d}", cache, given, partial(show_relit, config, draw, method, fields, assets))

    about = {key: getattr(config, key) for key in ("tasks", "seed", "objects", "size", "factor")}
    spans = {ALL: range(len(elevations)), **{f"{elevation:g}": [n] for n, elevation in enumerate(elevations)}}
    spans |= {SKY: [len(elevations)]} if config.sky else {}
    yield from compare(
        config, piece, executor, files=(REPORT_FILE, CHART_FILE, IMAGES_FILE),
        about={**about, "names": list(names), "elevations_deg": list(elevations)}, measures=MEASURES, spans=spans,
        charts=charts_of, picture=_picture,
    )  # fmt: skip


def charts_of(report: Mapping[str, Any]) -> list[Chart]:
    """Draw PSNR and SSIM by elevation of the light from a report of `compare_relighting`."""
    return image_charts(report, Axis("light above the table [deg]", 0, 90), report["elevations_deg"])


def show_relit(
    config: CompareRelighting, draw: Draw, method: str, fields: FieldLibrary, assets: AssetLibrary
) -> TaskResult:
    """Show a scene by a method that is given its true poses and light, and compare it with the simulator.

    Args:
        config: size of the images, elevations of the lights, and where fields of other methods may be.
        draw: the scene; its light has the azimuth of all lights.
        method: one of `FIELD_METHODS`.
        fields: ours, and the table.
        assets: meshes for the simulator.

    Returns:
        For each measure its means over the four cameras, one for each elevation and one for the sky if asked for;
        comparisons of the first camera under the lowest, the middle and the highest light.

    Raises:
        NoRoom: if the objects do not fit side by side.
        UnknownName, CorruptFile: as fields are.
    """
    azimuth = float(np.arctan2(draw.light.direction[1], draw.light.direction[0]))
    lights = [Light.from_angles(azimuth, np.deg2rad(elevation)) for elevation in config.elevations_deg]
    lowest = np.sin(np.deg2rad(MIN_LIGHT_ELEVATION_DEG))
    sky = [Light(one) for one in fibonacci_sphere(2 * _SKY_LIGHTS) if one[2] > lowest] if config.sky else []
    cameras, conditions = default_cameras(config.size), _conditions(config.factor)
    truths = list(simulate_relit(draw, [*lights, *sky], assets, cameras, conditions))
    renderer = load_appearance(method, draw.names, fields, config.data_dir).together
    images = [render_scene(renderer, truth) for truth in truths]
    if sky:
        rest, nowhere = slice(len(lights), None), np.zeros_like(truths[0].shadows)
        average = np.mean([truth.images for truth in truths[rest]], axis=0)
        truths[rest] = [replace(truths[-1], images=average, shadows=nowhere)]
        images[rest] = [np.mean(images[rest], axis=0)]
    if method == "nerf_fitted":
        whole = renderer.render(SceneBatch.of(truths[0].state), cameras, quality=SCENE_QUALITY, outputs={"opacity"})
        assert whole.opacity is not None  # it was asked for
        pairs = zip(images, truths, strict=True)
        images = [with_fitted_brightness(shown, whole.opacity[0], truth.images) for shown, truth in pairs]
    scenes = [compare_scene(truth, shown) for truth, shown in zip(truths, images, strict=True)]
    figures = [figures_of(scene) for scene in scenes]
    return TaskResult(
        {key: [mean(one[key]) for one in figures] for key in MEASURES},
        tuple(
            replace(scenes[n][0].comparison, label=f"{config.elevations_deg[n]:g} deg")
            for n in sorted({0, len(lights) // 2, len(lights) - 1})
        ),
    )


def _conditions(factor: str) -> Conditions | None:
    """Return the conditions of a factor, None for none.

    Raises:
        UnknownName: if there is none of that name.
        InvalidInput: if it differs in more than its conditions, of which nothing would be seen here.
    """
    if not factor:
        return None
    found = factor_named(factor)
    if any(getattr(found, entry.name) != entry.default for entry in fields_of(found) if entry.name != "conditions"):
        raise InvalidInput("factor", factor, "one that changes lamp, table or renderer alone, such as objects_shiny")
    return found.conditions


def _picture(results: Mapping[str, TaskResult]) -> UInt8[np.ndarray, "H W 3"]:
    """Draw a scene: a row for each light; the truth, then the methods."""
    lit = zip(*(result.shown for result in results.values()), strict=True)
    rows = {shown[0].label: [shown[0].truth, *(one.ours for one in shown)] for shown in lit}
    return image_grid(rows, ("simulator", *(TITLES[method] for method in results)))
