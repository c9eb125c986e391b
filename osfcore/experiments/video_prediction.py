"""Measure futures that are predicted as images: 30 steps of the goal camera's view (paper, section 5.3 and figure 6).

Episodes of random pushes that nothing was trained on, each under a light from anywhere over the table. All methods know
the actions and are given the same episodes, of objects that all of them know. Finished episodes are kept in the output
folder, method by method: a killed comparison goes on where it was.
"""

from __future__ import annotations

from collections.abc import Iterator, Mapping
from concurrent.futures import Executor
from dataclasses import dataclass, replace
from functools import partial
from typing import Any

import numpy as np
from jaxtyping import Float, UInt8

from osfcore.control.estimators import Estimators, SceneModels, load_scene_models
from osfcore.dynamics.rollout import network_path
from osfcore.errors import InvalidInput
from osfcore.experiments.charts import Axis, Chart
from osfcore.experiments.estimation_tasks import episode, first_frame, take_frame
from osfcore.experiments.fields import SCENE_QUALITY
from osfcore.experiments.harness import EvaluationStep, Piece, TaskCache, TaskResult, file_sha256
from osfcore.experiments.images import TITLES, CompareImages, checked, compare, image_charts, shown_circumstances
from osfcore.experiments.rearrangement_runs import Variant, loop_parts
from osfcore.experiments.rivals.fitvid import fitvid_path, read_fitvid
from osfcore.fields.field_library import FieldLibrary
from osfcore.geometry.cameras import Camera, default_cameras, goal_camera
from osfcore.geometry.light import MIN_LIGHT_ELEVATION_DEG
from osfcore.geometry.rollouts import MAX_HORIZON
from osfcore.geometry.states import Observation
from osfcore.inspection.contact_sheet import Comparison, image_grid
from osfcore.io.image_file import to_uint8
from osfcore.metrics.image_errors import psnr, ssim
from osfcore.objects.asset_library import AssetLibrary
from osfcore.paper.dynamics import weights_path
from osfcore.random_streams import Stream, stream_rng
from osfcore.render.types import SceneBatch
from osfcore.world.tasks import Draw, draw_scene, opened

# Episodes of pushes as the goal camera sees them, and how each method predicts them.
#
# Methods:
#     copied  what is seen now stays as it is.
#     ours    poses and light are estimated in one look of four cameras with masks, pushes are predicted by our
#             dynamics, and each step is rendered through our fields.
#     paper   the same as published: estimation, dynamics and fields.
#     nerf    ours with fields that know of no light, so that none is estimated.
#     fitvid  video prediction from two frames of the goal camera, at the look and one action before it.


VIDEO_METHODS = ("copied", "ours", "paper", "nerf", "fitvid")
MEASURES = ("mse", "psnr", "ssim")
_SHOWN_STEPS = (1, 10, 20, 30)


@dataclass(frozen=True, eq=False, slots=True)
class VideoEpisode:
    """T actions that are known in advance, and images of what they do.

    Attributes:
        context: frames of the goal camera, one action before the look and at it.
        between: the action between the two [m/s].
        look: four cameras with masks, for methods that estimate.
        actions: after the look [m/s].
        frames: of the goal camera after each of them, with the pusher.
    """

    context: Float[np.ndarray, "2 h w 3"]
    between: Float[np.ndarray, "3"]
    look: Observation
    actions: Float[np.ndarray, "T 3"]
    frames: Float[np.ndarray, "T h w 3"]


def simulate_video(draw: Draw, library: AssetLibrary, steps: int, size: int) -> VideoEpisode:
    """Simulate pushes that move some object by 5 cm or more, and one action before them.

    Args:
        draw: the scene that it begins with.
        library: meshes of its objects.
        steps: actions that are predicted.
        size: side of the frames [px].

    Raises:
        UnknownName, MissingAssets: if an object has no mesh here.
        NoRoom: if the objects do not fit side by side.
    """
    camera = (goal_camera(size),)
    before = first_frame(draw, library, camera)
    pushes = episode(draw, library, camera, steps=steps + 1)
    with opened(draw, library) as world:
        world.restore(pushes.frames[0].truth)
        look = take_frame(world, default_cameras(), masks=True).observation
    frames = [frame.observation.images[0] for frame in (before, *pushes.frames)]
    return VideoEpisode(np.stack(frames[:2]), pushes.actions[0], look, pushes.actions[1:], np.stack(frames[2:]))


REPORT_FILE, CHART_FILE, IMAGES_FILE = "video.json", "video.svg", "video_episode.png"
HORIZONS = (10, 30)  # steps over which means are reported
VERSION = 1  # raised by hand when figures may change


@dataclass(frozen=True, slots=True)
class CompareVideos(CompareImages):
    """What to compare: episodes by some of `VIDEO_METHODS`; with FitVid among them, frames have its network's side.

    Attributes:
        steps: actions of 0.2 s that are predicted.
    """

    methods: tuple[str, ...] = VIDEO_METHODS
    steps: int = 30


def compare_videos(
    config: CompareVideos, fields: FieldLibrary, assets: AssetLibrary, executor: Executor | None = None
) -> Iterator[EvaluationStep[dict[str, Any]]]:
    """Predict all episodes by all methods; the chart, images of the first episode and video.json go to `config.folder`.

    Args:
        config: what to compare.
        fields: ours, and the table.
        assets: meshes, for the simulator.
        executor: works on episodes side by side, if given.

    Raises:
        UnknownName, MissingAssets: if an object lacks a field or a mesh.
        InvalidInput: if a number is out of range, or objects are too few.
        NoRoom: if there is no room for a scene's objects.
        WorkerDied: if a worker process ended.
        CorruptFile, CannotWrite: as files are.
    """
    config = checked(config, VIDEO_METHODS, fields, assets, ("predicted steps", config.steps, 1, MAX_HORIZON))
    if "fitvid" in config.methods:
        config = replace(config, size=read_fitvid(fitvid_path(config.data_dir)).settings.side)
    names = config.names or ()
    ours = network_path(config.data_dir)
    paths = {"ours": ours, "nerf": ours, "paper": weights_path(config.data_dir)}
    if "fitvid" in config.methods:
        paths["fitvid"] = fitvid_path(config.data_dir)
    networks = {method: [file_sha256(paths[method])] for method in config.methods if method in paths}

    def piece(method: str, number: int) -> Piece:
        cache = TaskCache(config.folder / "video" / f"{config.objects}-{config.seed}" / method)
        draw = draw_scene(names, config.objects, config.seed, number, Stream.VIDEO_SCENE, MIN_LIGHT_ELEVATION_DEG)
        given = {
            "steps": config.steps,
            "networks": networks.get(method, []),
            "version": VERSION,
            # Shapes come from our fields in any case.
            **shown_circumstances(draw, ("ours", method), fields, assets, config.data_dir, config.size),
        }
        work = partial(measure_video, config, fields, assets, number, draw, method)
        return Piece(f"{number:04d}", cache, given, work)

    about = {key: getattr(config, key) for key in ("tasks", "seed", "objects", "steps", "size")}
    yield from compare(
        config, piece, executor, files=(REPORT_FILE, CHART_FILE, IMAGES_FILE), about={**about, "names": list(names)},
        measures=MEASURES,
        spans={str(horizon): range(horizon) for horizon in sorted({min(h, config.steps) for h in HORIZONS})},
        charts=charts_of, picture=_picture,
    )  # fmt: skip


def charts_of(report: Mapping[str, Any]) -> list[Chart]:
    """Draw PSNR and SSIM by predicted step from a report of `compare_videos`."""
    steps = report["steps"]
    return image_charts(report, Axis("predicted steps of 0.2 s", 0, steps), range(1, steps + 1))


def measure_video(
    config: CompareVideos, fields: FieldLibrary, assets: AssetLibrary, number: int, draw: Draw, method: str
) -> TaskResult:
    """Measure an episode as a method predicts it.

    Args:
        config: with the number of steps and the size of the frames.
        fields: ours, and the table.
        assets: meshes for the simulator.
        number: of the episode.
        draw: the scene that it begins with.
        method: one of `VIDEO_METHODS`.

    Returns:
        For each measure a figure for each step; comparisons after 1, 10, 20 and 30 actions.

    Raises:
        NoRoom: if the objects do not fit side by side.
        UnknownName, CorruptFile: as fields and networks are.
    """
    video = simulate_video(draw, assets, config.steps, config.size)
    match method:
        case "copied":
            predicted = np.broadcast_to(video.context[1], video.frames.shape)
        case "fitvid":
            network = read_fitvid(fitvid_path(config.data_dir))
            assert video.look.pusher is not None  # for the type checker: a robot knows its hand
            predicted = network.predict(video.context, video.actions[None], video.look.pusher, between=video.between)[0]
        case "ours" | "paper" | "nerf":
            models = load_scene_models(video.look.names, fields, assets, config.data_dir)
            parts = loop_parts(Variant(method), models, fields, config.data_dir)
            rng = stream_rng(config.seed, Stream.VIDEO_ESTIMATE, number)
            camera = goal_camera(config.size)
            predicted = predict_through_fields(video, parts.models, parts.estimators, camera, rng)
        case _:
            raise InvalidInput("method", repr(method), f"one of {', '.join(VIDEO_METHODS)}")
    pairs = list(zip(video.frames, predicted, strict=True))
    figures = {
        "mse": [float(np.mean((true.astype(float) - image) ** 2)) for true, image in pairs],
        "psnr": [psnr(true, image) for true, image in pairs],
        "ssim": [ssim(true, image) for true, image in pairs],
    }
    steps = [step for step in _SHOWN_STEPS if step <= config.steps]
    shown = [Comparison(f"step {step}", *(to_uint8(image) for image in pairs[step - 1])) for step in steps]
    return TaskResult(figures, tuple(shown))


def predict_through_fields(
    video: VideoEpisode, models: SceneModels, estimators: Estimators, camera: Camera, rng: np.random.Generator
) -> Float[np.ndarray, "T h w 3"]:
    """Estimate what is seen, roll it out, render each step.

    Args:
        video: of which the look and the actions play a part.
        models: fields and dynamics.
        estimators: of poses and light.
        camera: that sees the prediction.
        rng: of the estimate.
    """
    *_, last = estimators.first_frame(models.appearance, video.look, rng)
    assert last.estimate is not None  # for the type checker: the last step has the estimate
    state = last.estimate.state
    future = models.dynamics.rollout(state, video.actions[None])
    lights = np.tile(state.light.direction, (len(video.actions), 1))
    poses = future.positions[0, 1:], future.quaternions[0, 1:]
    batch = SceneBatch(future.names, *poses, lights, future.pusher[0, 1:])
    rendered = models.appearance.together.render(batch, (camera,), quality=SCENE_QUALITY)
    return np.clip(rendered.rgb[:, 0], 0, 1)


def _picture(results: Mapping[str, TaskResult]) -> UInt8[np.ndarray, "H W 3"]:
    """Draw an episode: a row for the truth and for each method; some of the steps."""
    first = next(iter(results.values())).shown
    rows = {"simulator": [one.truth for one in first]}
    rows |= {TITLES[method]: [one.ours for one in result.shown] for method, result in results.items()}
    return image_grid(rows, [one.label for one in first])
