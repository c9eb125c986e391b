"""`osf reproduce`: the paper's experiments in one report."""

from __future__ import annotations

import os
import platform
import shlex
import sys
from dataclasses import dataclass, field, replace
from datetime import date
from pathlib import Path
from typing import TYPE_CHECKING, Any, Literal

from app.cli.progress_bar import follow
from app.cli.workers import worker_pool
from app.storage.paths import default_data_dir
from osfcore.extras import need

if TYPE_CHECKING:
    from osfcore.experiments.reproduction.reproduction import Scale


@dataclass(frozen=True)
class ReproduceCommand:
    """The paper's experiments, its rivals, and what else there is to know, as one HTML page.

    A killed run goes on when started again. Without --quick it takes days on two cores.
    """

    out: Path
    """Folder for report.html, its figures as JSON, its pictures, and the results of all tasks."""
    quick: bool = False
    """A look in a quarter of an hour on two cores: three tasks a cell, short episodes, fewer cells."""
    only: tuple[
        Literal["relighting", "video", "methods", "families", "ablations", "ladder", "factors", "attribution"], ...
    ] = ()
    """Parts of the report; all by default."""
    tasks: int | None = None
    """Tasks of each cell; 3 with --quick, else 100 of the methods with three objects and 50 of all others."""
    objects: int | None = None
    """In a scene; 1 with --quick, else 2, 3 and 4 for the methods and 3 for everything else."""
    actions: int | None = None
    """That an episode may have; 12 with --quick, else 30."""
    seed: int = 0
    """Of everything random."""
    names: tuple[str, ...] | None = None
    """Objects; by default all of which every method has a field."""
    workers: int = 2
    """Processes that work side by side."""
    cluster: str | None = None
    """Address of a Dask scheduler whose workers do the work instead; they need the same data folder."""
    data_dir: Path = field(default_factory=default_data_dir)
    """Where fetched objects and trained fields are."""
    json: bool = False
    """Print the result as one JSON object in the last line."""

    def run(self) -> dict[str, Any]:
        """Measure with a progress bar; the result holds all figures of the report."""
        from osfcore.experiments.reproduction.reproduction import (
            PAGE_FILE,
            PARTS,
            QUICK,
            About,
            Reproduce,
            Scale,
            reproduce,
        )
        from osfcore.fields.field_library import FieldLibrary
        from osfcore.objects.asset_library import AssetLibrary

        need("experiments", "This command")  # before hours of work
        scale = self._changed(QUICK if self.quick else Scale())
        about = About(date.today().isoformat(), _machine(), _command(), self.seed, ())
        config = Reproduce(self.out, self.data_dir, about, scale, self.quick, self.only or PARTS, self.names)
        fields, assets = FieldLibrary(self.data_dir), AssetLibrary(self.data_dir / "objects")
        with worker_pool(self.workers, self.cluster) as executor:
            last = follow(reproduce(config, fields, assets, executor))
        assert last is not None
        assert last.report is not None, "the last step brings the report"
        if not self.json:
            for finding in last.report["findings"]:
                print(finding)
            print(f"The report: {self.out / PAGE_FILE}")
        return last.report

    def _changed(self, scale: Scale) -> Scale:
        """A scale with what was asked for."""
        if self.tasks is not None:
            scale = replace(scale, tasks=self.tasks, headline=self.tasks)
        if self.objects is not None:
            scale = replace(scale, objects=self.objects, counts=(self.objects,))
        if self.actions is not None:
            scale = replace(scale, settings=replace(scale.settings, steps=self.actions))
        return scale


def _machine() -> str:
    return f"{os.cpu_count()} cores, {platform.machine()}, {platform.system()}, Python {platform.python_version()}"


def _command() -> str:
    return shlex.join(["osf", *sys.argv[1:]])
