"""Finished episodes as a data set of LeRobot: what was known before each action, and the action.

Images are drawn anew from the recorded states, as the cameras of `OSFTabletop-v0` see them under usual conditions: the
frames that an episode keeps are for people, small, labelled, and one for each plan rather than for each action.
"""

from __future__ import annotations

from collections.abc import Iterator, Mapping, Sequence
from pathlib import Path
from typing import Literal, get_args

import numpy as np
from jaxtyping import Float, UInt8
from PIL import Image, ImageOps

from osfcore.contrib.export.lerobot import (
    GOAL_IMAGE,
    DatasetSize,
    LeRobotEpisode,
    environment_state,
    image_name,
    instruction,
    write_dataset,
)
from osfcore.errors import CorruptFile, InvalidInput, OsfError
from osfcore.geometry.cameras import default_cameras
from osfcore.geometry.states import pose_rows
from osfcore.io.files import new_folder, reading_png
from osfcore.io.image_file import to_uint8
from osfcore.objects.asset_library import AssetLibrary
from osfcore.world.imaging import RayTracer, TracedMesh

from .file_names import GOAL_FILE, REPORT_FILE
from .record import FinishedEpisode, read_episode

Kind = Literal["poses", "pixels", "both"]
KINDS: tuple[Kind, ...] = get_args(Kind)


class NothingPushed(OsfError):
    """An episode without actions."""

    def __init__(self, folder: Path) -> None:
        super().__init__(f"{folder} has pushed nothing, so there is nothing to learn from it; leave it out.")


def write_lerobot(
    folders: Sequence[Path], library: AssetLibrary, out: Path, *, obs: Kind = "both", image_side: int = 128
) -> DatasetSize:
    """Write what episodes have left in their folders as one data set; it appears only when it is whole.

    Args:
        folders: each with `report.json`, `trajectory.npz` and `goal.png`.
        library: meshes of the objects, from which images are drawn.
        out: a folder, new or empty.
        obs: what is observed, besides the pusher: poses, images or both.
        image_side: of images [px], even.

    Raises:
        MissingExtra: if what writes data sets is not installed.
        NoEpisode, NothingPushed: if a folder holds none, or one without actions.
        InvalidInput: if a choice is not among those, the output folder is not empty, an episode has another number of
            objects than the first, or no poses of its goal, where poses are observed.
        CorruptFile, UnknownName, MissingAssets: if something in a folder is damaged, or an object is not here.
        CannotWrite: if the disk refuses.
    """
    if obs not in KINDS:
        raise InvalidInput("kind of observations", repr(obs), f"one of {', '.join(KINDS)}")
    if image_side % 2:
        raise InvalidInput("image size [px]", image_side, "even, as videos need it")
    out = new_folder(out)
    read = [read_episode(folder) for folder in folders]
    for episode in read:
        _check(episode, read[0], obs)
    return write_dataset(out, _episodes(read, library, obs, image_side))


def _check(episode: FinishedEpisode, first: FinishedEpisode, obs: Kind) -> None:
    course = episode.trajectory
    if len(course.states) < 2:
        raise NothingPushed(episode.folder)
    if any(state.pusher is None for state in course.states):
        raise InvalidInput(f"the pusher of {episode.folder}", "nowhere", "at a known place before each action")
    if obs == "pixels":
        return
    if course.goal is None:
        raise InvalidInput(
            f"the goal of {episode.folder}", "an image without poses", "of known poses; write it with --obs pixels"
        )
    expected = len(first.trajectory.names)
    if len(course.names) != expected:
        allowed = f"{expected}, as in {first.folder}; write the others apart, or all with --obs pixels"
        raise InvalidInput(f"the number of objects in {episode.folder}", len(course.names), allowed)


def _episodes(
    read: Sequence[FinishedEpisode], library: AssetLibrary, obs: Kind, image_side: int
) -> Iterator[LeRobotEpisode]:
    meshes: dict[str, TracedMesh] = {}
    for episode in read:
        course = episode.trajectory
        images = {}
        if obs != "poses":
            meshes |= {name: TracedMesh(library.load(name).mesh) for name in course.names if name not in meshes}
            images = _images(episode, meshes, image_side)
        environment = None
        if obs != "pixels" and course.goal is not None:
            goal = pose_rows(course.goal)
            environment = np.array([environment_state(pose_rows(state.poses), goal) for state in course.states[:-1]])
        pusher = np.array([state.pusher[:2] for state in course.states[:-1] if state.pusher is not None])
        moved = episode.report.get("moved")
        task = instruction(course.names, [str(name) for name in moved] if isinstance(moved, list) else ())
        yield LeRobotEpisode(task, _actions(episode), pusher, environment, images)


def _actions(episode: FinishedEpisode) -> Float[np.ndarray, "T 2"]:
    expected = (len(episode.trajectory.states) - 1, 3)
    try:
        actions = np.array(episode.report.get("actions"), float)
    except (TypeError, ValueError):
        actions = np.zeros(0)
    if actions.shape != expected:
        raise CorruptFile(episode.folder / REPORT_FILE, f"it does not have the {expected[0]} actions of the episode")
    return actions[:, :2]


def _images(
    episode: FinishedEpisode, meshes: Mapping[str, TracedMesh], side: int
) -> dict[str, UInt8[np.ndarray, "T h w 3"]]:
    """What each camera saw before each action, and the goal beside it."""
    tracer, cameras = RayTracer(meshes), default_cameras(side)
    states = episode.trajectory.states[:-1]
    views = np.array([[to_uint8(picture.rgb) for picture in tracer.render(state, cameras)] for state in states])
    seen = {image_name(camera.name): views[:, number] for number, camera in enumerate(cameras)}
    path = episode.folder / GOAL_FILE
    with reading_png(path, "it is no image"), Image.open(path) as image:
        goal = np.asarray(ImageOps.pad(image.convert("RGB"), (side, side)))
    return {**seen, GOAL_IMAGE: np.broadcast_to(goal, (len(states), side, side, 3))}
