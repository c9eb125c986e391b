"""Writes episodes as a data set of LeRobot, format v3.0 (as of lerobot 0.4.4), without LeRobot.

    meta/info.json, stats.json, tasks.parquet    what there is; statistics of all; tasks in words
    meta/episodes/chunk-000/file-000.parquet     a row for each episode: where it is, statistics
    data/chunk-CCC/file-FFF.parquet              a row for each action, a file for each episode
    videos/KEY/chunk-CCC/file-FFF.mp4            what a camera saw before each action, a file for each episode

The format lets episodes share files; with one for each they are written as they come, and can be taken out by hand.
"""

from __future__ import annotations

from collections.abc import Iterable, Mapping
from dataclasses import dataclass, field
from pathlib import Path

import numpy as np
from jaxtyping import Float, UInt8

from osfcore.export.lerobot.conventions import ACTION, ENVIRONMENT, IMAGES, STATE
from osfcore.extras import need
from osfcore.io.files import folder_at_once


@dataclass(frozen=True, eq=False, slots=True)
class LeRobotEpisode:
    """An episode of T actions, each with what was known before it.

    Attributes:
        task: what should be done, in words.
        actions: velocities (vx, vy) [m/s].
        pusher: its places [m].
        environment: environment states; None to leave them out.
        images: linear RGB by name, such as "camera_0"; all of one size with even sides.
    """

    task: str
    actions: Float[np.ndarray, "T 2"]
    pusher: Float[np.ndarray, "T 2"]
    environment: Float[np.ndarray, "T D"] | None = None
    images: Mapping[str, UInt8[np.ndarray, "T h w 3"]] = field(default_factory=dict)

    @property
    def vectors(self) -> dict[str, np.ndarray]:
        """All but images, by key."""
        told = {ACTION: self.actions, STATE: self.pusher, ENVIRONMENT: self.environment}
        return {key: rows.astype(np.float32) for key, rows in told.items() if rows is not None}

    @property
    def videos(self) -> dict[str, np.ndarray]:
        """Images, by key."""
        return {f"{IMAGES}.{name}": images for name, images in self.images.items()}


@dataclass(frozen=True, slots=True)
class DatasetSize:
    """What a data set holds: episodes, frames (one for each action) and different tasks."""

    episodes: int
    frames: int
    tasks: int


def write_dataset(folder: Path, episodes: Iterable[LeRobotEpisode]) -> DatasetSize:
    """Write a data set; the folder appears only when it is whole.

    Args:
        folder: new or empty.
        episodes: of one kind; they are taken one after the other.

    Raises:
        MissingExtra: if what writes Parquet files or videos is not installed.
        InvalidInput: if there is no episode, one has no actions, or is of another kind than the first.
        CannotWrite: if the disk refuses.
    """
    need("lerobot", "A LeRobot data set")
    from osfcore.export.lerobot.writer import Writer

    with folder_at_once(folder) as partial:
        writer = Writer(partial)
        for episode in episodes:
            writer.add(episode)
        return writer.close()
