"""`osf record`: make the stories that the page plays before anything is run."""

from __future__ import annotations

from dataclasses import dataclass, field
from pathlib import Path
from typing import Any

from app.cli.progress_bar import follow
from app.storage.paths import default_data_dir


@dataclass(frozen=True)
class Record:
    """Run the examples as episodes and keep what the page plays of them: small files, one folder for each.

    The stories that come with the program were made like this, with `--out static/stories`.
    """

    out: Path
    """Folder for the stories."""
    names: tuple[str, ...] | None = None
    """Examples, as the page and /api/presets call them; all without it."""
    data_dir: Path = field(default_factory=default_data_dir)
    """Where fetched objects are."""
    json: bool = False
    """Print what was made as one JSON object in the last line."""

    def run(self) -> dict[str, Any]:
        """Make them one after the other; tells how each episode ended."""
        from app.services.examples.presets import PRESETS, preset
        from app.services.examples.story_recording import record_story

        outcomes = {}
        for name in self.names or [one.id for one in PRESETS]:
            last = follow(record_story(preset(name), self.data_dir, self.out / name))
            assert last is not None
            assert last.report is not None, "the last step brings the report"
            outcomes[name] = last.report["text"]
            if not self.json:
                print(f"{name}: {last.report['text']} {last.report['steps_done']} pushes.")
        return {"out": str(self.out), "stories": outcomes}
