"""`osf check`: validates what people bring: scenes, image sets, push files."""

from __future__ import annotations

from dataclasses import dataclass
from pathlib import Path
from typing import Any

import tyro

from osfcore.errors import CorruptFile


@dataclass(frozen=True)
class Check:
    """Validate a scene.json, an image set folder or a push file, and draw an overlay if asked to."""

    path: tyro.conf.Positional[Path]
    """File or folder to check."""
    overlay: Path | None = None
    """For an image set: PNG to write, with the object frame's axes and the light drawn into some of its images."""
    json: bool = False
    """Print the result as one JSON object in the last line."""

    def run(self) -> dict[str, Any]:
        """Check; the result tells what it is and how much is in it."""
        from osfcore.check import check_path, draw_overlay

        if not self.path.exists():
            raise CorruptFile(self.path, "there is no such file or folder")
        report = check_path(self.path)
        if self.overlay is not None:
            draw_overlay(self.path, self.overlay)
        if not self.json:
            print(f"{self.path} is a good {report.kind}: {report.summary}.")
        return {"path": str(self.path), "kind": report.kind, **report.facts}
