"""`osf check`: validates what people bring: scenes, states, observations, image sets, push files, fields."""

from __future__ import annotations

import contextlib
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import tyro

from osfcore.errors import CorruptFile, OsfError


@dataclass(frozen=True)
class Check:
    """Validate a scene, state, push file, field, results of BOP, or a folder: observation, image set, scene of BOP."""

    path: tyro.conf.Positional[Path]
    """File or folder to check; an image set may be zipped."""
    overlay: Path | None = None
    """For an image set: PNG to write, with axes, light and the silhouettes' box drawn into some of its images; for an
    observation with axes, workspace and masks; for a scene of BOP with masks and the annotated objects' axes."""
    json: bool = False
    """Print the result as one JSON object in the last line."""

    def run(self) -> dict[str, Any]:
        """Check; the result tells what it is and how much is in it."""
        from osfcore.inspection.check import check_overlay_place, check_path, draw_overlay

        if self.overlay is not None:
            check_overlay_place(self.overlay)
        if not self.path.exists():
            raise CorruptFile(self.path, "there is no such file or folder")
        try:
            report = check_path(self.path)
        except CorruptFile:
            if self.overlay is not None:
                # What contradicts itself is best seen; what cannot even be drawn was told already.
                with contextlib.suppress(OsfError):
                    draw_overlay(self.path, self.overlay)
                    self._say(f"{self.overlay} shows how cameras, light and silhouettes were understood.")
            raise
        if self.overlay is not None:
            draw_overlay(self.path, self.overlay)
        self._say(f"{self.path} is a good {report.kind}: {report.summary}.")
        return {"path": str(self.path), "kind": report.kind, **report.facts}

    def _say(self, sentence: str) -> None:
        if not self.json:
            print(sentence)
