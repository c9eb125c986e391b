"""Writes an episode as an MCAP file, for Foxglove, Lichtblick, and whatever else reads MCAP."""

from __future__ import annotations

import io
from pathlib import Path

from app.episodes.finished import read_episode
from osfcore.extras import need
from osfcore.geometry.workspace import STEP_S
from osfcore.io.files import write_atomically
from osfcore.objects.asset_library import AssetLibrary


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
    episode = read_episode(folder)
    trajectory = episode.trajectory
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
        contents.log_words(log, episode.report)
    write_atomically(path, data.getvalue())
    return STEP_S * (len(trajectory.states) - 1)
