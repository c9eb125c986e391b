"""`osf eval photos`: objects and lamps in real photographs."""

from __future__ import annotations

from dataclasses import dataclass, field
from pathlib import Path
from typing import Any, Literal

from app.cli.progress_bar import follow
from app.storage.paths import default_data_dir
from osfcore.errors import InvalidInput


@dataclass(frozen=True)
class EvaluatePhotosCommand:
    """Real photographs: objects by their masks, without a start or from poses of another program; lamps."""

    data: Path | None = None
    """Folder of folders with photo.json, or of chrome balls under lamps."""
    lamps: Literal["photographed", "simulated"] = "photographed"
    """simulated: near lamps over simulated tables instead, without data."""
    tasks: int = 20
    """Simulated scenes with a near lamp; a fourth as many have a distant one."""
    views: int = 1
    """Photographs of each simulated scene, 1 to 4."""
    start: str = "none"
    """none; perturbed (3 cm and 20 deg off the truth); or a source of poses in photo.json, such as posecnn_raw."""
    plane: Literal["known", "free"] = "free"
    """Whether the table's plane is known, from the measured depth."""
    masks: Literal["given", "boxes"] = "given"
    """The folder's, or what a box around each of them and one click give, as a user has it."""
    mask_error: int = 0
    """Masks are grown and shrunk by that many pixels in turn."""
    repeats: int = 1
    """Random starts of each object."""
    loss: Literal["all", "iou"] = "all"
    """Outline, shading and texture; the outline alone, as in the paper."""
    out: Path | None = None
    """Folder for report.json and contact sheets; DATA_DIR/photos by default."""
    seed: int = 0
    """Of everything random."""
    data_dir: Path = field(default_factory=default_data_dir)
    """Where trained fields are."""
    json: bool = False
    """Print the result as one JSON object in the last line."""

    def run(self) -> dict[str, Any]:
        """Measure with a progress bar; the result holds what report.json does."""
        from osfcore.experiments.photos import EvaluatePhotos, evaluate_photos
        from osfcore.fields.field_library import FieldLibrary

        if self.lamps == "simulated":
            return self._simulated_lamps()
        if self.data is None:
            allowed = "a folder of photographs, or --lamps simulated, which needs none"
            raise InvalidInput("data", "missing", allowed)
        folder = self.data_dir / "photos" if self.out is None else self.out
        config = EvaluatePhotos(folder, self.data, self.start, self.plane, self.mask_error, self.repeats, self.loss,
                                self.seed, self.masks)  # fmt: skip
        last = follow(evaluate_photos(config, FieldLibrary(self.data_dir)))
        assert last is not None
        assert last.report is not None, "the last step brings the report"
        report = last.report
        if not self.json:
            _show(folder, report)
        return report

    def _simulated_lamps(self) -> dict[str, Any]:
        """Measure lamps in simulated scenes."""
        from osfcore.experiments.lamps import EvaluateLamps, evaluate_lamps
        from osfcore.fields.field_library import FieldLibrary
        from osfcore.objects.asset_library import AssetLibrary

        folder = self.data_dir / "lamps" if self.out is None else self.out
        config = EvaluateLamps(folder, self.tasks, self.views, self.seed)
        last = follow(evaluate_lamps(config, AssetLibrary(self.data_dir / "objects"), FieldLibrary(self.data_dir)))
        assert last is not None
        assert last.report is not None, "the last step brings the report"
        report = last.report
        if not self.json:
            _show_lamps(folder, report)
        return report


def _show(folder: Path, report: dict[str, Any]) -> None:
    """The report for people."""
    for score in report["scores"]:
        turned = "" if score["rotation_deg"] is None else f", {score['rotation_deg']:.1f} deg"
        depth = "" if score["depth_mm"] is None else f", depth {score['depth_mm']:+.0f} mm"
        print(f"{score['scene']} {score['name']}: IoU {score['iou']:.3f}{turned}{depth}  {score['doubt']}".rstrip())
    if report["objects_total"]:
        print(
            f"{report['objects_total']} objects: IoU median {report['iou_median']:.3f}, least {report['iou_min']:.3f}; "
            f"{report['coarse_s_median']:.1f} + {report['refine_s_median']:.1f} s each. "
            f"Masks agree with the given ones by {report['mask_iou_median']:.3f} in the median, "
            f"{report['mask_iou_min']:.3f} at least."
        )
    if report["light_deg_median"] is not None:
        print(f"Lamps: median error {report['light_deg_median']:.1f} deg, most {report['light_deg_max']:.1f} deg.")
    print(f"Pictures and figures: {folder}")


def _show_lamps(folder: Path, report: dict[str, Any]) -> None:
    """The report of simulated lamps for people."""
    for score in report["scores"]:
        true = "a distant lamp" if score["true_m"] is None else f"a lamp {score['true_m']:.2f} m away"
        found = "unknown" if score["distance_m"] is None else f"{score['distance_m']:.2f} m"
        print(f"Scene {score['number']}, {true}: direction {score['direction_deg']:.1f} deg off, distance {found}.")
    print(
        f"{report['lamp_tasks']} near lamps: direction {report['lamp_direction_deg_median']:.1f} deg off (median), "
        f"{100 * report['lamp_within_5deg']:.0f} % within 5 deg; distance unknown of {report['lamp_undetermined']}."
    )
    if report["lamp_distance_percent_median"] is not None:
        print(f"Distances known: {report['lamp_distance_percent_median']:.1f} % off (median).")
    print(f"Figures: {folder}")
