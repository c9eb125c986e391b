"""Estimates of first frames as they run: where objects and light are after each step (paper, figures 2 and 3).

Ours and the published estimation are given the same frames. The picture shows one frame as each sees it at five
moments, through a camera that the estimate has and from far away, with a green cube where the light is taken to be and
a white frame where it is.
"""

from __future__ import annotations

from collections.abc import Iterator, Mapping, Sequence
from concurrent.futures import Executor
from dataclasses import asdict, dataclass, field
from functools import partial
from itertools import product
from typing import Any

import cv2
import numpy as np
from jaxtyping import UInt8

from osfcore.estimation.first_frame import FirstFrameConfig, estimate_first
from osfcore.estimation.objective import ObjectModels
from osfcore.estimation.steps import UNPLACED_BELOW_M, EstimateStep
from osfcore.experiments.charts import Axis, Chart, Curve, write_charts
from osfcore.experiments.estimation_tasks import Frame, take_frame
from osfcore.experiments.harness import EvaluationStep, Piece, TaskCache, TaskResult, finished
from osfcore.experiments.images import TITLES, CompareImages, checked, load_appearance, shown_circumstances
from osfcore.experiments.statistics import median, rounded
from osfcore.fields.field_library import FieldLibrary
from osfcore.geometry.cameras import Camera, default_cameras
from osfcore.geometry.light import Light
from osfcore.geometry.states import SceneState
from osfcore.inspection.contact_sheet import Comparison, image_grid
from osfcore.io.files import write_json
from osfcore.io.image_file import to_uint8, write_png
from osfcore.metrics.pose_errors import pose_error
from osfcore.objects.asset import Symmetry
from osfcore.objects.asset_library import AssetLibrary
from osfcore.paper.estimation import PaperEstimationConfig
from osfcore.paper.estimation import estimate_first as estimate_as_published
from osfcore.random_streams import Stream, stream_rng
from osfcore.render.types import SceneBatch
from osfcore.world.tasks import draw_scene, opened

METHODS = ("ours", "paper")
REPORT_FILE, CHART_FILE, IMAGES_FILE = "unrolled.json", "unrolled.svg", "unrolled_scene.png"
VERSION = 1  # raised by hand when figures may change
MOMENTS = ("first step", "light overhead", "light moves", "halfway", "end")
_KEYS = {"mm": "mean position error [mm]", "deg": "mean rotation error [deg]", "light_deg": "error of the light [deg]"}
_FAR_EYE, _FAR_TARGET = (1.7, -1.7, 1.5), (0.0, 0.0, 0.35)
_CUBE_M, _GREEN, _WHITE = 0.14, (40, 160, 60), (255, 255, 255)


@dataclass(frozen=True, slots=True)
class UnrollEstimates(CompareImages):
    """What to compare: estimates by some of `METHODS`.

    Attributes:
        published: effort of the published one.
    """

    published: PaperEstimationConfig = field(default_factory=PaperEstimationConfig)


def unrolled_estimates(
    config: UnrollEstimates, fields: FieldLibrary, assets: AssetLibrary, executor: Executor | None = None
) -> Iterator[EvaluationStep[dict[str, Any]]]:
    """Estimate frames by all methods; the charts, images of the first frame and unrolled.json go to `config.folder`.

    Args:
        config: what to compare.
        fields: ours, and the table.
        assets: meshes, for the simulator.
        executor: works on frames side by side, if given.

    Raises:
        UnknownName, MissingAssets: if an object lacks a field or a mesh.
        InvalidInput: if a number is out of range, or objects are too few.
        NoRoom: if there is no room for a scene's objects.
        WorkerDied: if a worker process ended.
        CorruptFile, CannotWrite: as files are.
    """
    config = checked(config, METHODS, fields, assets)

    def piece(method: str, number: int) -> Piece:
        cache = TaskCache(config.folder / "unrolled" / f"{config.objects}-{config.seed}" / method)
        draw = draw_scene(config.names or (), config.objects, config.seed, number, Stream.UNROLLED_SCENE)
        effort = FirstFrameConfig() if method == "ours" else config.published
        shown = shown_circumstances(draw, (method,), fields, assets, config.data_dir, config.size)
        given = {"version": VERSION, "effort": asdict(effort), **shown}
        return Piece(f"{number:04d}", cache, given, partial(_estimated, config, method, number, fields, assets))

    pieces = [piece(method, number) for method in config.methods for number in range(config.tasks)]
    left = iter((yield from finished(pieces, executor, "estimates")))
    results = {method: [next(left) for _ in range(config.tasks)] for method in config.methods}
    report: dict[str, Any] = {key: getattr(config, key) for key in ("tasks", "seed", "objects", "size")}
    report["names"] = list(config.names or ())
    report["methods"] = {method: summary([one.figures for one in part]) for method, part in results.items()}
    write_charts(config.folder / CHART_FILE, charts_of(report))
    write_json(config.folder / REPORT_FILE, report)
    write_png(config.folder / IMAGES_FILE, _picture({method: part[0] for method, part in results.items()}))
    yield EvaluationStep(len(pieces), len(pieces), "Everything is measured", report)


def charts_of(report: Mapping[str, Any]) -> list[Chart]:
    """Draw each error along the estimate, a curve for each method, from a report of `unrolled_estimates`."""
    charts = []
    for key, label in _KEYS.items():
        rows = {method: figures["along"][key] for method, figures in report["methods"].items()}
        curves = [Curve(TITLES[m], np.linspace(0, 100, len(row)), np.array(row, float)) for m, row in rows.items()]
        charts.append(Chart("", Axis("share of all steps [%]", 0, 100), Axis(label, 0), curves))
    return charts


def _estimated(
    config: UnrollEstimates, method: str, number: int, fields: FieldLibrary, assets: AssetLibrary
) -> TaskResult:
    draw = draw_scene(config.names or (), config.objects, config.seed, number, Stream.UNROLLED_SCENE)
    with opened(draw, assets) as world:
        frame = take_frame(world, default_cameras(config.size), masks=True, with_pusher=False)
    models = load_appearance(method, draw.names, fields, config.data_dir)
    rng = stream_rng(config.seed, Stream.UNROLLED_SCENE, number, 1)
    if method == "ours":
        steps = list(estimate_first(models, frame.observation, rng, FirstFrameConfig()))
    else:
        steps = list(estimate_as_published(models, frame.observation, rng, config.published))
    symmetries = {name: assets.info(name).symmetry for name in draw.names}
    figures = {key: rounded(row, 4) for key, row in errors_along(steps, frame.truth, symmetries).items()}
    moments = moments_of(steps)
    return TaskResult({**figures, "moments": moments}, _shown(models, frame, [steps[n].state for n in moments]))


def errors_along(
    steps: Sequence[EstimateStep], truth: SceneState, symmetries: Mapping[str, Symmetry]
) -> dict[str, list[float | None]]:
    """Return the errors after each step: "mm" and "deg", means over the objects, and "light_deg".

    Args:
        steps: of an estimate.
        truth: poses and light.
        symmetries: of the objects, by name.

    Returns:
        None for the poses as long as an object was not looked at yet.
    """
    rows: dict[str, list[float | None]] = {key: [] for key in _KEYS}
    for step in steps:
        state = step.state
        pairs = [pose_error(symmetries[name], state.pose(name), truth.pose(name)) for name in truth.names]
        is_placed = state.poses.position[:, 2].min() > UNPLACED_BELOW_M
        for key, values in zip(("mm", "deg"), zip(*pairs, strict=True), strict=True):
            rows[key].append(float(np.mean(values)) if is_placed else None)
        rows["light_deg"].append(float(np.rad2deg(state.light.angle_to(truth.light))))
    return rows


def moments_of(steps: Sequence[EstimateStep]) -> list[int]:
    """Return the steps that are shown: `MOMENTS`, of which the third is the first one with another light."""
    last, held = len(steps) - 1, steps[0].state.light
    lit = next((n for n, step in enumerate(steps) if step.state.light.angle_to(held) > 0), last)
    return [0, max(lit - 1, 0), lit, (lit + last) // 2, last]


def summary(figures: Sequence[Mapping[str, Any]]) -> dict[str, Any]:
    """Return medians over frames of each error: at each of the "moments", and "along" a hundredth of all steps each."""
    moments, along = {}, {}
    for key in _KEYS:
        at = [[one[key][n] for n in one["moments"]] for one in figures]
        moments[key] = [rounded(median(column), 4) for column in zip(*at, strict=True)]
        spread = [[one[key][round(share * (len(one[key]) - 1))] for share in np.linspace(0, 1, 101)] for one in figures]
        along[key] = [rounded(median(column), 4) for column in zip(*spread, strict=True)]
    return {"frames": len(figures), "moments": moments, "along": along}


def _shown(models: ObjectModels, frame: Frame, states: Sequence[SceneState]) -> tuple[Comparison, ...]:
    """Return a comparison for each state: the frame from near and far, and what the state looks like."""
    near = frame.observation.cameras[0]
    far = Camera.look_at("far", _FAR_EYE, _FAR_TARGET, size=near.width)
    pictures = list[UInt8[np.ndarray, "h w 3"]]()
    for state in states:
        close, distant = map(to_uint8, models.together.render(SceneBatch.of(state), (near, far)).rgb[0])
        pictures.append(np.hstack([close, _with_lights(distant, far, state.light, frame.truth.light)]))
    seen = np.hstack([to_uint8(frame.observation.images[0]), np.full_like(pictures[0][:, near.width :], 255)])
    return tuple(Comparison(name, seen, picture) for name, picture in zip(MOMENTS, pictures, strict=True))


def _with_lights(
    image: UInt8[np.ndarray, "h w 3"], camera: Camera, light: Light, truth: Light
) -> UInt8[np.ndarray, "h w 3"]:
    """Draw a cube where the light is taken to be, and a frame where it is."""
    corners = np.array(list(product((-1, 1), repeat=3))) * _CUBE_M / 2
    drawn = image.copy()
    found, true = (
        cv2.convexHull(camera.project(one.position + corners).round().astype(np.int32)) for one in (light, truth)
    )
    cv2.fillConvexPoly(drawn, found, _GREEN, cv2.LINE_AA)
    cv2.polylines(drawn, [true], True, _WHITE, 1, cv2.LINE_AA)
    return drawn


def _picture(results: Mapping[str, TaskResult]) -> UInt8[np.ndarray, "H W 3"]:
    """Draw a frame: two rows for each method, near and far; what is seen, then what is believed at each moment."""
    rows: dict[str, list[UInt8[np.ndarray, "h w 3"]]] = {}
    for method, result in results.items():
        for side, name in enumerate(("near", "far")):
            pairs = [result.shown[0].truth, *(one.ours for one in result.shown)]
            rows[f"{TITLES[method]}, {name}"] = [np.hsplit(pair, 2)[side] for pair in pairs]
    return image_grid(rows, ("seen", *MOMENTS))
