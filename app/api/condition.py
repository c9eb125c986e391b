"""What is wrong with the service now, in sentences for people; nothing if all is well.

Everything is looked at when it is asked for, so that what was wrong is gone once its cause is.
"""

from __future__ import annotations

import os
import shutil
from pathlib import Path

from app.services.runner import Runner

LEAST_FREE_BYTES = 50 << 20  # on the disk of the data directory; with less, the next episode may not fit


def problems(runner: Runner, data_dir: Path) -> tuple[str, ...]:
    """What keeps scenes, jobs or storing from working.

    Args:
        runner: holds the simulation and the jobs.
        data_dir: where everything is stored.
    """
    found = [runner.jobs.problem, _disk_problem(data_dir), runner.storage.problem, runner.storing_problem()]
    if runner.simulation_status == "restarting":
        found.append("The simulation has stopped and is being restarted.")
    return tuple(sentence for sentence in found if sentence is not None)


def _disk_problem(data_dir: Path) -> str | None:
    try:
        if os.statvfs(data_dir).f_flag & os.ST_RDONLY:
            return "The disk of the data directory is read-only."
        free = shutil.disk_usage(data_dir).free
    except OSError as error:
        return f"The data directory cannot be reached ({error.strerror})."
    if free < LEAST_FREE_BYTES:
        return f"The disk of the data directory is nearly full: {free / 1e6:.0f} MB are left."
    return None
