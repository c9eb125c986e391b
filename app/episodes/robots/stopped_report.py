"""The report of a stopped episode with a robot, where its process had no time to tell so, or did not know why."""

from __future__ import annotations

import contextlib
from pathlib import Path

from app.episodes.file_names import REPORT_FILE
from osfcore.errors import OsfError
from osfcore.io.files import as_mapping, read_json, write_json

STOPPED = "stopped"


def tell_stopped(folder: Path, why: str) -> None:
    """Let a report, if there is one, tell that its episode was stopped, unless it tells of another end.

    Args:
        folder: of the episode.
        why: it was stopped, a sentence.
    """
    path = folder / REPORT_FILE
    with contextlib.suppress(OsfError):  # the job tells it, too, whatever has become of the file
        report = read_json(path, as_mapping)
        if report.get("outcome") in (None, STOPPED):
            write_json(path, {**report, "outcome": STOPPED, "text": why})
