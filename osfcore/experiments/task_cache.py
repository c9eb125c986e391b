"""Results of finished tasks on disk, so that a long evaluation can be killed, resumed and run in pieces."""

from __future__ import annotations

import hashlib
import io
import json
import zipfile
from collections.abc import Mapping
from dataclasses import dataclass
from dataclasses import fields as fields_of
from pathlib import Path
from typing import Any

import numpy as np

from osfcore.errors import CorruptFile
from osfcore.fields.table_field import TableField
from osfcore.inspection.contact_sheet import Comparison
from osfcore.io.files import write_atomically, write_json


@dataclass(frozen=True, eq=False, slots=True)
class TaskResult:
    """What one task left.

    Attributes:
        figures: plain JSON.
        shown: images for contact sheets.
    """

    figures: dict[str, Any]
    shown: tuple[Comparison, ...]


class TaskCache:
    """One folder of results: NAME.json and NAME.npz for each task.

    Args:
        folder: made at the first write.
    """

    def __init__(self, folder: Path) -> None:
        self.folder = folder

    def read(self, name: str, circumstances: Mapping[str, Any]) -> TaskResult | None:
        """The result of a task, or None if it has to be done (again).

        Args:
            name: of the task.
            circumstances: plain JSON that tells everything the result depends on; another one makes it stale.
        """
        try:
            content = json.loads((self.folder / f"{name}.json").read_text())
            if content["circumstances"] != json.loads(json.dumps(circumstances)):
                return None
            arrays = io.BytesIO((self.folder / f"{name}.npz").read_bytes())
            with np.load(arrays, allow_pickle=False) as stored:
                labels, truth, ours = (stored[key] for key in ("labels", "truth", "ours"))
            shown = tuple(Comparison(str(a), b, c) for a, b, c in zip(labels, truth, ours, strict=True))
            return TaskResult(dict(content["figures"]), shown)
        except (OSError, ValueError, KeyError, TypeError, EOFError, zipfile.BadZipFile):
            return None  # not there, or damaged: the task can always be done again

    def write(self, name: str, circumstances: Mapping[str, Any], result: TaskResult) -> None:
        """Keep the result of a task.

        Args:
            name: of the task.
            circumstances: plain JSON, as `read` will be asked.
            result: with one comparison or more, all of one image size.

        Raises:
            CannotWrite: if the disk refuses.
        """
        arrays = io.BytesIO()
        np.savez_compressed(
            arrays,
            labels=np.array([c.label for c in result.shown]),
            truth=np.stack([c.truth for c in result.shown]),
            ours=np.stack([c.ours for c in result.shown]),
        )
        write_atomically(self.folder / f"{name}.npz", arrays.getvalue())
        # Last: where the JSON is, the images are.
        write_json(self.folder / f"{name}.json", {"circumstances": circumstances, "figures": result.figures})


def file_sha256(path: Path) -> str:
    """What a result that depends on a file depends on.

    Raises:
        CorruptFile: if it cannot be read.
    """
    try:
        return hashlib.sha256(path.read_bytes()).hexdigest()
    except OSError as error:
        raise CorruptFile(path, "it cannot be read") from error


def table_sha256(table: TableField) -> str:
    """The same of a table."""
    arrays = [np.asarray(getattr(table, entry.name)).tobytes() for entry in fields_of(table)]
    return hashlib.sha256(b"".join(arrays)).hexdigest()
