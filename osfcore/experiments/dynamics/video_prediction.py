"""How well futures are predicted as images: 30 steps of the goal camera's view (paper, section 5.3 and figure 6).

Episodes of random pushes that nothing was trained on, each under a light from anywhere over the table. All methods know
the actions and are given the same episodes, of objects that all of them know; `video_episodes` tells what each of them
sees. Finished episodes are kept in the output folder, method by method: a killed comparison goes on where it was.
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

from osfcore.dynamics.push_models import network_path
from osfcore.errors import InvalidInput, check_ranges, check_seed
from osfcore.experiments.charts import Axis
from osfcore.experiments.dynamics.video_episodes import MEASURES, VIDEO_METHODS, VideoEpisodes
from osfcore.experiments.fields.composite_scenes import SCENE_QUALITY
from osfcore.experiments.image_figures import measured, summary, tables_of, write_comparison
from osfcore.experiments.image_methods import TITLES, check_methods, common_names, field_path
from osfcore.experiments.pieces import EvaluationStep, Piece
from osfcore.experiments.rivals.fitvid.weights import fitvid_path, read_fitvid
from osfcore.experiments.task_cache import TaskCache, TaskResult, file_sha256, table_sha256
from osfcore.fields.field_library import FieldLibrary
from osfcore.geometry.cameras import DEFAULT_IMAGE_SIDE, image_side
from osfcore.geometry.light import MIN_LIGHT_ELEVATION_DEG
from osfcore.geometry.rollouts import MAX_HORIZON
from osfcore.inspection.contact_sheet import image_grid
from osfcore.io.image_file import write_png
from osfcore.objects.asset_library import AssetLibrary
from osfcore.paper.dynamics.weights import weights_path
from osfcore.random_streams import Stream
from osfcore.world.random_scenes import Draw, draw_scene

REPORT_FILE, CHART_FILE, IMAGES_FILE = "video.json", "video.png", "video_episode.png"
HORIZONS = (10, 30)  # steps over which means are told
MAX_TASKS = 10_000
VERSION = 1  # raised by hand when figures may change


@dataclass(frozen=True, slots=True)
class CompareVideos:
    """What to compare.

    Attributes:
        folder: for results, pictures and video.json.
        data_dir: where fields and networks trained on this machine are.
        names: objects to draw from; all with a mesh and a field of every method if None.
        tasks: number of episodes.
        seed: of the episodes.
        methods: some of `VIDEO_METHODS`.
        objects: in each scene.
        steps: actions of 0.2 s that are predicted.
        size: side of the frames [px]; that of FitVid's network.
    """

    folder: Path
    data_dir: Path
    names: tuple[str, ...] | None = None
    tasks: int = 20
    seed: int = 0
    methods: tuple[str, ...] = VIDEO_METHODS
    objects: int = 3
    steps: int = 30
    size: int = DEFAULT_IMAGE_SIDE


def compare_videos(
    config: CompareVideos, fields: FieldLibrary, assets: AssetLibrary, executor: Executor | None = None
) -> Iterator[EvaluationStep]:
    """Predict all episodes by all methods; the chart, images of the first episode and video.json go to `config.folder`.

    Args:
        config: what to compare.
        fields: ours, and the table.
        assets: meshes, for the simulator.
        executor: works on episodes side by side, if given.

    Raises:
        UnknownName, MissingAssets: if an object lacks a field or a mesh.
        InvalidInput: if a number is out of range, objects are too few, or FitVid's network has another image size.
        NoRoom: if there is no room for a scene's objects.
        WorkerDied: if a worker process ended.
        CorruptFile, CannotWrite: as files are.
    """
    config = _checked(config, fields, assets)
    pieces = {method: _pieces(config, method, fields, assets) for method in config.methods}
    results = yield from measured(pieces, executor)
    tables = tables_of(results, MEASURES)
    spans = {str(horizon): range(horizon) for horizon in sorted({min(h, config.steps) for h in HORIZONS})}
    about = {key: getattr(config, key) for key in ("tasks", "seed", "objects", "steps", "size")}
    report = {**about, "names": list(config.names or ()), **summary(tables, spans)}
    x, places = Axis("predicted steps of 0.2 s", 0, config.steps), range(1, config.steps + 1)
    files = config.folder / REPORT_FILE, config.folder / CHART_FILE
    write_comparison(files, report, tables, x, places)
    write_png(config.folder / IMAGES_FILE, _first_episode(results))
    total = config.tasks * len(config.methods)
    yield EvaluationStep(total, total, "Everything is measured", report)


def _checked(config: CompareVideos, fields: FieldLibrary, assets: AssetLibrary) -> CompareVideos:
    """The same with methods and names in order."""
    check_ranges(("number of tasks", config.tasks, 1, MAX_TASKS), ("predicted steps", config.steps, 1, MAX_HORIZON))
    check_seed(config.seed)
    image_side(config.size)
    methods = check_methods(config.methods, VIDEO_METHODS)
    names = common_names(methods, config.names, fields, assets, config.data_dir, config.objects)
    if "fitvid" in methods:
        side = read_fitvid(fitvid_path(config.data_dir)).settings.side
        if side != config.size:
            raise InvalidInput("image size [px]", config.size, f"{side}, as FitVid's network has")
    return replace(config, methods=methods, names=names)


def _pieces(config: CompareVideos, method: str, fields: FieldLibrary, assets: AssetLibrary) -> list[Piece]:
    episodes = VideoEpisodes(fields, assets, config.data_dir, config.seed, config.steps, config.size)
    given = {
        "steps": config.steps,
        "size": config.size,
        "quality": asdict(SCENE_QUALITY),
        "table": table_sha256(fields.load_table()),
        "networks": [file_sha256(path) for path in _networks(method, config.data_dir)],
        "version": VERSION,
    }
    cache = TaskCache(config.folder / "video" / f"{config.objects}-{config.seed}" / method)

    def piece(number: int) -> Piece:
        stream = Stream.VIDEO_SCENE
        draw = draw_scene(
            config.names or (), config.objects, config.seed, number, stream, MIN_LIGHT_ELEVATION_DEG
        )  # fmt: skip
        own = _circumstances(draw, method, fields, assets, config.data_dir)
        return Piece(f"{number:04d}", cache, {**given, **own}, partial(episodes.measure, number, draw, method))

    return [piece(number) for number in range(config.tasks)]


def _networks(method: str, data_dir: Path) -> list[Path]:
    """Networks that a method's predictions depend on."""
    match method:
        case "copied":
            return []
        case "fitvid":
            return [fitvid_path(data_dir)]
        case "paper":
            return [weights_path(data_dir)]
        case _:
            return [network_path(data_dir)]


def _circumstances(
    draw: Draw, method: str, fields: FieldLibrary, assets: AssetLibrary, data_dir: Path
) -> dict[str, Any]:
    """What an episode begins with, and by which fields it is shown; shapes come from ours in any case."""
    paths = {name: (fields.info(name).path, field_path(method, name, fields, data_dir)) for name in draw.names}
    digests = {name: [file_sha256(path) for path in pair] for name, pair in paths.items()}
    return {
        "objects": {name: [assets.digest(name), *told] for name, told in digests.items()},
        "arrangement": draw.seed,
        "light": draw.light.direction.tolist(),
    }


def _first_episode(results: Mapping[str, Sequence[TaskResult]]) -> UInt8[np.ndarray, "H W 3"]:
    """The first episode: a row for the truth and for each method; some of the steps."""
    shown = {TITLES[method]: part[0].shown for method, part in results.items()}
    first = next(iter(shown.values()))
    rows = {"simulator": [one.truth for one in first], **{who: [one.ours for one in row] for who, row in shown.items()}}
    return image_grid(rows, [one.label for one in first])
