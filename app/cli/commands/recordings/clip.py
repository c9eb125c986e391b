"""`osf clip`: a clip of an episode, to be shown to others."""

from __future__ import annotations

from concurrent.futures import ThreadPoolExecutor
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any

import tyro

from app.cli.progress_bar import follow
from app.storage.paths import default_data_dir


@dataclass(frozen=True)
class Clip:
    """Draw an episode in 1080p: 3D view, goal, table, distance, and what it came to; half a minute of work."""

    episode: tyro.conf.Positional[Path]
    """Folder that `osf episode` has left."""
    out: Path
    """The MP4."""
    data_dir: Path = field(default_factory=default_data_dir)
    """Where fetched objects are."""
    json: bool = False
    """Print what was made as one JSON object in the last line."""

    def run(self) -> dict[str, Any]:
        """Make it."""
        from app.episodes.clip.clip import FPS, clip_of
        from osfcore.objects.asset_library import AssetLibrary

        with ThreadPoolExecutor(2) as executor:
            last = follow(clip_of(self.episode, AssetLibrary(self.data_dir / "objects"), self.out, executor))
        assert last is not None, "a clip has frames"
        seconds = round(last.total / FPS, 1)
        if not self.json:
            print(f"{self.out}: {seconds:g} s")
        return {"out": str(self.out), "seconds": seconds}
