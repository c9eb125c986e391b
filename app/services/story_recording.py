"""Making the stories: each example is run as an episode, and what is worth shipping of it is kept, in small files."""

from __future__ import annotations

import io
import shutil
from collections.abc import Iterator
from pathlib import Path
from typing import Any

import numpy as np
from jaxtyping import UInt8
from PIL import Image

from osfcore.control.estimators import load_scene_models
from osfcore.control.events import GoalFound, Observed, Stepped
from osfcore.control.goal import GoalImage
from osfcore.control.prepared import PreparedLook, PreparedLooks, prepared_to_json
from osfcore.fields.field_library import FieldLibrary
from osfcore.geometry.states import EstimatedState, Observation
from osfcore.io.files import as_mapping, read_json, write_atomically, write_json
from osfcore.objects.asset_library import AssetLibrary

from ..episodes.file_names import FRAMES_FOLDER, PREPARED_FILE, REPORT_FILE, TRAJECTORY_FILE
from ..episodes.frames import TILE_PX, part_of, read_frames
from ..episodes.request import EpisodeOrder, EpisodeStep, run_episode
from ..episodes.trajectory import LOOK_S, ReplayClock, read_trajectory
from .examples import STORY_FILE, Preset
from .goals import GOAL_SIDE

NOW_COLUMNS = 8  # of the grid of pictures
_QUALITY = 82  # of WebP


def record_story(preset: Preset, data_dir: Path, out: Path) -> Iterator[EpisodeStep]:
    """Run an example and keep its story.

    Args:
        preset: the example.
        data_dir: where fetched objects are.
        out: folder of the story; the episode itself is left in `episode` beside it until the story is there.

    Raises:
        OsfError: if objects are missing, or the disk refuses.
    """
    folder = out / ".episode"
    order = EpisodeOrder(
        folder, data_dir, preset.objects, seed=preset.seed, light=preset.light,
        shifts_m=preset.shifts_m, goal_light=preset.goal_light, goal_side=GOAL_SIDE,
    )  # fmt: skip
    seen: Observation | None = None
    goal: GoalFound | None = None
    first: EstimatedState | None = None
    report: dict[str, Any] = {}
    for step in run_episode(order):
        match step.event:
            case Observed(0, observation):
                seen = observation
            case GoalFound():
                goal = step.event
            case Stepped(0, _, estimate):
                first = estimate
        report = step.report or report
        yield step
    assert seen is not None and goal is not None and first is not None, "every episode begins so"  # noqa: PT018
    prepared = _prepared(order, seen, first, goal)
    write_json(out / PREPARED_FILE, prepared_to_json(prepared))
    # What the goal camera saw after each round, row by row: a WebP is at most 16,383 px high.
    frames = list(read_frames(folder / FRAMES_FOLDER))
    _write_grid(out / "goal.webp", [part_of(frames[0], "goal")], columns=1)
    _write_grid(out / "now.webp", [part_of(frame, "now") for frame in frames], columns=NOW_COLUMNS)
    shutil.copyfile(folder / TRAJECTORY_FILE, out / TRAJECTORY_FILE)
    write_json(out / STORY_FILE, _summary(preset, read_json(folder / REPORT_FILE, as_mapping), out / TRAJECTORY_FILE))
    shutil.rmtree(folder)


def _prepared(order: EpisodeOrder, seen: Observation, first: EstimatedState, goal: GoalFound) -> PreparedLooks:
    assert goal.estimate is not None, "the goal of an example is an image"
    fields, assets = FieldLibrary(order.data_dir), AssetLibrary(order.data_dir / "objects")
    models = load_scene_models(seen.names, fields, assets, order.data_dir, order.device).appearance
    image = GoalImage(goal.camera, goal.image).observed(seen.names)
    return PreparedLooks(PreparedLook.of(models, seen, first), PreparedLook.of(models, image, goal.estimate))


def _summary(preset: Preset, report: dict[str, Any], trajectory: Path) -> dict[str, Any]:
    """What the page shows; lengths in mm, angles in degrees, times in seconds of the replay."""
    course, steps = read_trajectory(trajectory), report["steps"]
    clock = ReplayClock(course)
    return {
        "name": preset.id,
        "title": preset.title,
        "text": preset.text,
        "objects": list(course.names),
        "moved": report["moved"],
        "goal_look_s": LOOK_S["first"],
        "now_columns": NOW_COLUMNS,
        "step_s": [round(at_s, 3) for at_s in clock.step_s],
        "left_mm": [{name: step["truly_to_goal_mm"][name] for name in course.names} for step in steps],
        "pushes": report["steps_done"],
        "took_s": report["seconds"],
        "light_off_deg": steps[0]["light_off_deg"],
        "outcome": report["outcome"],
    }


def _write_grid(path: Path, images: list[UInt8[np.ndarray, "h w 3"]], columns: int) -> None:
    grid = np.zeros((-(-len(images) // columns) * TILE_PX, columns * TILE_PX, 3), np.uint8)
    for number, image in enumerate(images):
        row, column = divmod(number, columns)
        grid[row * TILE_PX :, column * TILE_PX :][:TILE_PX, :TILE_PX] = image
    data = io.BytesIO()
    Image.fromarray(grid).save(data, "WEBP", quality=_QUALITY, method=6)
    write_atomically(path, data.getvalue())
