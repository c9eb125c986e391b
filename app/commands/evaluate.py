"""`osf eval`: the paper's experiments, measured on what nothing was trained on."""

from __future__ import annotations

from dataclasses import dataclass, field
from pathlib import Path
from typing import TYPE_CHECKING, Any, Literal

import tyro

from app.commands.progress_bar import follow
from app.paths import default_data_dir
from osfcore.errors import InvalidInput

if TYPE_CHECKING:
    from collections.abc import Iterator

    from osfcore.evaluate.fields import EvaluationStep


@dataclass(frozen=True)
class Evaluate:
    """Measure trained fields: each object alone on unseen views under unseen lights, and scenes under harsh lights.

    Results are kept in the output folder: a killed evaluation goes on when started again, and may be run in pieces.
    """

    what: tyro.conf.Positional[Literal["fields"]]
    """What to evaluate."""
    out: Path
    """Folder for results and contact sheets (truth, ours, difference)."""
    names: tuple[str, ...] | None = None
    """Objects; by default all that have a field and a mesh."""
    tasks: int = 20
    """Scenes against the simulator, each with its own objects and light; 0 for objects alone."""
    objects: int = 3
    """Objects in a scene."""
    seed: int = 0
    """Of views, lights and scenes."""
    data: Path | None = None
    """With --weights: measure on the test images of this set in the OSF format instead of the simulator's."""
    weights: Path | None = None
    """With --data: the field to measure."""
    data_dir: Path = field(default_factory=default_data_dir)
    """Where fetched objects and trained fields are."""
    json: bool = False
    """Print the result as one JSON object in the last line."""

    def run(self) -> dict[str, Any]:
        """Measure with a progress bar; the result holds means and every object's figures."""
        last = follow(self._steps())
        assert last is not None
        assert last.report is not None, "the last step brings the report"
        result = last.report.to_json()
        if not self.json:
            _show(result)
        return result

    def _steps(self) -> Iterator[EvaluationStep]:
        from osfcore.evaluate.fields import EvaluateFields, EvaluateSet, evaluate_fields, evaluate_set
        from osfcore.fields.library import FieldLibrary
        from osfcore.objects.library import AssetLibrary

        if self.data is not None and self.weights is not None:
            return evaluate_set(EvaluateSet(self.data, self.weights, self.out))
        if self.data is not None or self.weights is not None:
            raise InvalidInput("choice of --data and --weights", "one alone", "both or none")
        config = EvaluateFields(self.out, self.names, self.tasks, self.objects, self.seed)
        return evaluate_fields(config, FieldLibrary(self.data_dir), AssetLibrary(self.data_dir / "objects"))


def _show(result: dict[str, Any]) -> None:
    from rich.console import Console
    from rich.table import Table

    table = Table(box=None, pad_edge=False, padding=(0, 1, 0, 0))
    for title in ("object", "full dB", "mask dB", "SSIM", "MB", "minutes"):
        table.add_column(title, justify="left" if title == "object" else "right", no_wrap=True)
    for name, row in result["objects"].items():
        minutes = "" if row["minutes"] is None else f"{row['minutes']:.1f}"
        figures = (f"{row['psnr_full']:.2f}", f"{row['psnr_mask']:.2f}", f"{row['ssim']:.4f}", f"{row['file_mb']:.2f}")
        table.add_row(name, *figures, minutes)
    means = (f"{result['psnr_full_mean']:.2f}", f"{result['psnr_mask_mean']:.2f}", f"{result['ssim_mean']:.4f}")
    table.add_row("mean (size: most)", *means, f"{result['max_file_mb']:.2f}", "")
    console = Console()
    console.print(table)
    if result["scenes"]:
        shares = {"whole": "scene_psnr_mean", "objects": "scene_psnr_object_mean", "shadow": "scene_psnr_shadow_mean"}
        told = [f"{what} {result[key]:.2f} dB" for what, key in shares.items() if result[key] is not None]
        console.print(f"{result['scenes']} scenes: {', '.join(told)}", highlight=False)
