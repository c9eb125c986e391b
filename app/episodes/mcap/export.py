"""Writes an episode as an MCAP file, for Foxglove, Lichtblick, and whatever else reads MCAP."""

from __future__ import annotations

import io
from pathlib import Path

from app.episodes.file_names import REPORT_FILE, TRAJECTORY_FILE
from app.episodes.trajectory import read_trajectory
from osfcore.errors import OsfError
from osfcore.extras import need
from osfcore.geometry.workspace import STEP_S
from osfcore.io.files import as_mapping, read_json, write_atomically
from osfcore.objects.asset_library import AssetLibrary


class NoEpisode(OsfError):
    """A folder that holds no episode."""

    def __init__(self, folder: Path) -> None:
        super().__init__(f"{folder} holds no episode: give a folder that 'osf episode' has left.")


def write_mcap(folder: Path, library: AssetLibrary, path: Path) -> float:
    """Write what an episode has left in its folder as one file; it appears only when it is whole.

    Args:
        folder: with `report.json`, `trajectory.npz`, `frames/`, and `goal.png` if the goal was an image.
        library: meshes of the objects.
        path: an MCAP file, which is replaced.

    Returns:
        How long the episode is in simulated time [s].

    Raises:
        MissingExtra: if what writes MCAP is not installed.
        NoEpisode: if there is none.
        CorruptFile, UnknownName, MissingAssets: if something in the folder is damaged, or an object is not here.
        CannotWrite: if the disk refuses.
    """
    need("mcap", "An MCAP file")
    if not (folder / TRAJECTORY_FILE).is_file() or not (folder / REPORT_FILE).is_file():
        raise NoEpisode(folder)
    trajectory, report = read_trajectory(folder / TRAJECTORY_FILE), read_json(folder / REPORT_FILE, as_mapping)
    meshes = {name: library.load(name).mesh for name in trajectory.names}
    import foxglove

    from app.episodes.mcap import contents

    context, data = foxglove.Context(), io.BytesIO()
    with foxglove.open_mcap(data, context=context):
        log = contents.Log(context)
        contents.log_scene(log, trajectory, meshes)
        contents.log_transforms(log, trajectory)
        contents.log_plans(log, trajectory.rounds)
        contents.log_images(log, folder, trajectory.rounds)
        contents.log_words(log, report)
    write_atomically(path, data.getvalue())
    return STEP_S * (len(trajectory.states) - 1)
