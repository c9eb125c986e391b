"""What all evaluations of the command line share."""

from __future__ import annotations

from abc import ABC, abstractmethod
from collections.abc import Iterator
from concurrent.futures import Executor
from contextlib import nullcontext
from dataclasses import dataclass, field
from pathlib import Path
from typing import TYPE_CHECKING, Any

from app.cli.progress_bar import follow
from app.cli.workers import worker_pool
from app.storage.paths import default_data_dir
from osfcore.extras import need

if TYPE_CHECKING:
    from osfcore.fields.field_library import FieldLibrary
    from osfcore.objects.asset_library import AssetLibrary


@dataclass(frozen=True)
class Evaluation(ABC):
    """What all evaluations share. A killed one goes on when started again, and may be run in pieces."""

    out: Path | None = None
    """Folder for results and pictures; DATA_DIR/evaluation by default."""
    names: tuple[str, ...] | None = None
    """Objects; by default all that have a field and a mesh."""
    tasks: int = 20
    """Scenes against the simulator, each with its own objects and light."""
    seed: int = 0
    """Of everything random."""
    data_dir: Path = field(default_factory=default_data_dir)
    """Where fetched objects and trained fields are."""
    json: bool = False
    """Print the result as one JSON object in the last line."""

    @property
    def folder(self) -> Path:
        """Where results are kept."""
        return self.data_dir / "evaluation" if self.out is None else self.out

    def run(self) -> dict[str, Any]:
        """Measure with a progress bar; the result holds what the evaluation's report does."""
        from osfcore.fields.field_library import FieldLibrary
        from osfcore.objects.asset_library import AssetLibrary

        need("experiments", "This command")  # before hours of work
        fields, assets = FieldLibrary(self.data_dir), AssetLibrary(self.data_dir / "objects")
        with self._pool() as executor:
            last = follow(self._steps(fields, assets, executor))
        assert last is not None
        assert last.report is not None, "the last step brings the report"
        report = last.report if isinstance(last.report, dict) else last.report.to_json()
        if not self.json:
            self._show(report)
        return report

    def _pool(self) -> Any:  # noqa: ANN401  a context that gives an executor, or none
        return nullcontext()

    @abstractmethod
    def _steps(self, fields: FieldLibrary, assets: AssetLibrary, executor: Executor | None) -> Iterator[Any]:
        """The evaluation's steps, of which the last brings the report."""

    @abstractmethod
    def _show(self, report: dict[str, Any]) -> None:
        """Print the report for people."""


@dataclass(frozen=True)
class ParallelEvaluation(Evaluation):
    """One whose work is shared out."""

    workers: int = 2
    """Processes that work side by side."""
    cluster: str | None = None
    """Address of a Dask scheduler whose workers do the work instead; they need the same data folder."""

    def _pool(self) -> Any:  # noqa: ANN401
        return worker_pool(self.workers, self.cluster)
