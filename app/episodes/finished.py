"""Reads what a finished episode has left in its folder, for those who write it in other formats."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass
from pathlib import Path
from typing import Any

from app.episodes.file_names import REPORT_FILE, TRAJECTORY_FILE
from app.episodes.trajectory import Trajectory, read_trajectory
from osfcore.errors import OsfError
from osfcore.io.files import as_mapping, read_json


class NoEpisode(OsfError):
    """A folder that holds no episode."""

    def __init__(self, folder: Path) -> None:
        super().__init__(f"{folder} holds no episode: give a folder that 'osf episode' has left.")


@dataclass(frozen=True, eq=False, slots=True)
class FinishedEpisode:
    """An episode that is over, or was ended early.

    Attributes:
        folder: where frames and goal image are.
        trajectory: its course.
        report: of it.
    """

    folder: Path
    trajectory: Trajectory
    report: Mapping[str, Any]


def read_episode(folder: Path) -> FinishedEpisode:
    """What an episode has left.

    Raises:
        NoEpisode: if there is none.
        CorruptFile: if a file is damaged.
    """
    if not (folder / TRAJECTORY_FILE).is_file() or not (folder / REPORT_FILE).is_file():
        raise NoEpisode(folder)
    trajectory = read_trajectory(folder / TRAJECTORY_FILE)
    return FinishedEpisode(folder, trajectory, read_json(folder / REPORT_FILE, as_mapping))
