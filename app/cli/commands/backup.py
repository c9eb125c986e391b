"""`osf backup` and `osf restore`: everything that the service keeps, in one file and back."""

from __future__ import annotations

from dataclasses import dataclass, field
from pathlib import Path
from typing import Any

import tyro

from app.storage.paths import default_data_dir


@dataclass(frozen=True)
class Backup:
    """Write everything that the service keeps to one zip; it may go on running meanwhile."""

    out: tyro.conf.Positional[Path]
    """FILE.zip to write; an older one is replaced once the new one is whole."""
    data_dir: Path = field(default_factory=default_data_dir)
    """Folder for everything that osf keeps (also: OSF_DATA_DIR)."""
    json: bool = False
    """Print the result as one JSON object in the last line."""

    def run(self) -> dict[str, Any]:
        """Write the backup; return what it holds."""
        from app.storage.backup import back_up

        manifest = back_up(self.data_dir, self.out)
        if not self.json:
            print(f"{self.out} holds {manifest.files} files ({manifest.bytes / 1e6:.1f} MB) of {self.data_dir}.")
        return {"path": str(self.out), **manifest.model_dump()}


@dataclass(frozen=True)
class Restore:
    """Make a data directory from a backup; it must not exist or be empty."""

    archive: tyro.conf.Positional[Path]
    """FILE.zip that `osf backup` wrote."""
    data_dir: Path = field(default_factory=default_data_dir)
    """Folder to make (also: OSF_DATA_DIR)."""
    json: bool = False
    """Print the result as one JSON object in the last line."""

    def run(self) -> dict[str, Any]:
        """Make the folder; return what it holds."""
        from app.storage.backup import restore

        manifest = restore(self.archive, self.data_dir)
        if not self.json:
            print(f"{self.data_dir} holds the {manifest.files} files that were stored on {manifest.created_at}.")
        return {"data_dir": str(self.data_dir), **manifest.model_dump()}
