"""`osf lerobot`: episodes as a data set for programs that learn from demonstrations."""

from __future__ import annotations

from dataclasses import asdict, dataclass, field
from pathlib import Path
from typing import Any, Literal

import tyro

from app.storage.paths import default_data_dir


@dataclass(frozen=True)
class LeRobot:
    """Write episodes as one LeRobot data set (format v3.0): actions, and what was known before each of them.

    Needs pyarrow, but not LeRobot: pip install 'osf-manipulation[lerobot]'.
    """

    episodes: tyro.conf.Positional[tuple[Path, ...]]
    """Folders that `osf episode` has left."""
    out: Path
    """Folder for the data set, new or empty."""
    obs: Literal["poses", "pixels", "both"] = "both"
    """What is observed besides the pusher: poses of objects and goals, images of cameras and goal, or both."""
    image_side: int = 128
    """Of images [px], even."""
    data_dir: Path = field(default_factory=default_data_dir)
    """Where fetched objects are."""
    json: bool = False
    """Print what was made as one JSON object in the last line."""

    def run(self) -> dict[str, Any]:
        """Write it."""
        from app.episodes.lerobot.export import write_lerobot
        from osfcore.objects.asset_library import AssetLibrary

        library = AssetLibrary(self.data_dir / "objects")
        size = write_lerobot(self.episodes, library, self.out, obs=self.obs, image_side=self.image_side)
        if not self.json:
            print(f"{self.out}: {size.episodes} episodes, {size.frames} frames, {size.tasks} tasks")
        return {"out": str(self.out), **asdict(size)}
