"""`osf mcap`: an episode for Foxglove and other readers of MCAP."""

from __future__ import annotations

from dataclasses import dataclass, field
from pathlib import Path
from typing import Any

import tyro

from app.storage.paths import default_data_dir


@dataclass(frozen=True)
class Mcap:
    """Write an episode as one MCAP file: true, estimated and wanted poses, plans, images and notes over simulated time.

    Foxglove and Lichtblick play it. Needs foxglove-sdk: pip install 'osf-manipulation[mcap]'.
    """

    episode: tyro.conf.Positional[Path]
    """Folder that `osf episode` has left."""
    out: Path
    """The MCAP file; one of that name is replaced."""
    data_dir: Path = field(default_factory=default_data_dir)
    """Where fetched objects are."""
    json: bool = False
    """Print what was made as one JSON object in the last line."""

    def run(self) -> dict[str, Any]:
        """Write it."""
        from app.episodes.mcap.export import write_mcap
        from osfcore.io.output_paths import check_place
        from osfcore.objects.asset_library import AssetLibrary

        check_place(self.out)
        seconds = write_mcap(self.episode, AssetLibrary(self.data_dir / "objects"), self.out)
        size = self.out.stat().st_size
        if not self.json:
            print(f"{self.out}: {seconds:g} s, {size / 1e6:.1f} MB")
        return {"out": str(self.out), "seconds": round(seconds, 3), "bytes": size}
