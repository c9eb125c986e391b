"""`osf eval relighting` and `osf eval video`: how scenes look, now and after pushes, method by method."""

from __future__ import annotations

from collections.abc import Iterator, Mapping
from concurrent.futures import Executor
from dataclasses import dataclass
from typing import TYPE_CHECKING, Any, Literal

from app.cli.commands.evaluations.evaluation import ParallelEvaluation

if TYPE_CHECKING:
    from osfcore.fields.field_library import FieldLibrary
    from osfcore.objects.asset_library import AssetLibrary


@dataclass(frozen=True)
class EvaluateRelightingCommand(ParallelEvaluation):
    """Scenes under lights of many elevations, true poses and light given, as each method shows them."""

    methods: tuple[Literal["ours", "paper", "nerf"], ...] = ("ours", "paper", "nerf")
    """Our fields; KiloOSFs as published; compositional NeRFs, which know of no light."""
    objects: int = 3
    """Objects in a scene."""
    elevations: tuple[float, ...] = (5, 10, 20, 30, 45, 60, 75, 90)
    """Of the lights above the table [deg]."""

    def _steps(self, fields: FieldLibrary, assets: AssetLibrary, executor: Executor | None) -> Iterator[Any]:
        from osfcore.experiments.relighting import CompareRelighting, compare_relighting

        config = CompareRelighting(
            self.folder, self.data_dir, self.names, self.tasks, self.seed, self.methods, self.objects, self.elevations
        )  # fmt: skip
        return compare_relighting(config, fields, assets, executor)

    def _show(self, report: dict[str, Any]) -> None:
        measures = {"psnr": "PSNR", "ssim": "SSIM", "psnr_object": "objects dB", "psnr_shadow": "shadows dB"}
        _show_methods(report, {title: (key, "all") for key, title in measures.items()})
        print(f"{report['tasks']} scenes. Pictures and figures: {self.folder}")


@dataclass(frozen=True)
class EvaluateVideoCommand(ParallelEvaluation):
    """Pushes predicted as images of the goal camera, against the simulator, method by method."""

    methods: tuple[Literal["copied", "ours", "paper", "nerf", "fitvid"], ...] = (
        "copied", "ours", "paper", "nerf", "fitvid",
    )  # fmt: skip
    """The last frame, copied; ours; the method as published; ours with compositional NeRFs; FitVid."""
    objects: int = 3
    """Objects in a scene."""
    steps: int = 30
    """Actions of 0.2 s that are predicted."""

    def _steps(self, fields: FieldLibrary, assets: AssetLibrary, executor: Executor | None) -> Iterator[Any]:
        from osfcore.experiments.video_prediction import CompareVideos, compare_videos

        config = CompareVideos(
            self.folder, self.data_dir, self.names, self.tasks, self.seed, self.methods, self.objects, self.steps
        )  # fmt: skip
        return compare_videos(config, fields, assets, executor)

    def _show(self, report: dict[str, Any]) -> None:
        spans = next(iter(report["methods"].values()))["psnr"]["spans"]
        titles = {"psnr": "PSNR", "ssim": "SSIM", "mse": "MSE"}
        columns = {f"{title} {span}": (key, span) for key, title in titles.items() for span in spans}
        _show_methods(report, columns)
        print(f"Means over so many steps of {report['tasks']} episodes. Pictures and figures: {self.folder}")


def _show_methods(report: dict[str, Any], columns: Mapping[str, tuple[str, str]]) -> None:
    """A row for each method with its means, then one for how much ours differs from each other one.

    Args:
        report: of a comparison.
        columns: measure and span, by title.
    """
    from rich.console import Console
    from rich.table import Table

    table = Table(box=None, pad_edge=False, padding=(0, 1, 0, 0))
    for title in ("method", *columns):
        table.add_column(title, justify="left" if title == "method" else "right", no_wrap=True)
    for method, figures in report["methods"].items():
        told = [figures[key]["spans"][span]["mean"] for key, span in columns.values()]
        table.add_row(method, *map(_number, told))
    for method, figures in report["against"].items():
        told = [figures[key][span]["difference"] for key, span in columns.values()]
        table.add_row(f"ours - {method}", *map(_number, told))
    Console().print(table)


def _number(value: float | None) -> str:
    return "-" if value is None else f"{value:.4g}"
