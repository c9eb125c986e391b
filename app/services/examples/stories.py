"""Stories: recorded episodes of the examples that come with the program, to be watched before anything is run.

Each is a folder below the page's `stories/`: `story.json` (what the page tells), `trajectory.npz` (what the 3D view
draws), `prepared.json` (estimates of first frame and goal image, for running the example live), pictures.
"""

from __future__ import annotations

from dataclasses import dataclass, field
from pathlib import Path
from typing import Any

from app.episodes.file_names import PREPARED_FILE, TRAJECTORY_FILE
from app.storage.paths import static_folder
from osfcore.errors import UnknownName
from osfcore.io.files import as_mapping, read_json

STORY_FILE = "story.json"


@dataclass(frozen=True, slots=True)
class Stories:
    """The stories in a folder.

    Attributes:
        root: the folder.
    """

    root: Path = field(default_factory=lambda: static_folder() / "stories")

    def names(self) -> tuple[str, ...]:
        """Those that there are, sorted."""
        return tuple(sorted(path.parent.name for path in self.root.glob(f"*/{STORY_FILE}")))

    def trajectory(self, name: str) -> Path:
        """The file with the course of a story.

        Raises:
            UnknownName: if there is none of this name.
        """
        return self._folder(name) / TRAJECTORY_FILE

    def prepared(self, name: str) -> Path | None:
        """The file with what was found out beforehand about an example; None if there is none."""
        path = self.root / name / PREPARED_FILE
        return path if name in self.names() and path.is_file() else None

    def told(self, name: str) -> dict[str, Any]:
        """What the page tells of a story.

        Raises:
            UnknownName: if there is none of this name.
            CorruptFile: if the file is damaged.
        """
        return read_json(self._folder(name) / STORY_FILE, as_mapping)

    def _folder(self, name: str) -> Path:
        if name not in self.names():
            raise UnknownName("story", name[:80], self.names())
        return self.root / name
