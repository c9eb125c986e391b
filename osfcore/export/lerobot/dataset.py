"""Writes episodes as a data set of LeRobot, format v3.0 (as of lerobot 0.4.4), without LeRobot.

    meta/info.json, stats.json, tasks.parquet    what there is; statistics of all; tasks in words
    meta/episodes/chunk-000/file-000.parquet     a row for each episode: where it is, statistics
    data/chunk-CCC/file-FFF.parquet              a row for each action, a file for each episode
    videos/KEY/chunk-CCC/file-FFF.mp4            what a camera saw before each action, a file for each episode

The format lets episodes share files; with one for each they are written as they come, and can be taken out by hand.
"""

from __future__ import annotations

from collections.abc import Iterable
from pathlib import Path

from osfcore.export.lerobot.episode import DatasetSize, LeRobotEpisode
from osfcore.extras import need
from osfcore.io.files import folder_at_once


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
