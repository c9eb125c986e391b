"""`osf eval photos`: objects and lamps in real photographs."""

from __future__ import annotations

from dataclasses import dataclass, field
from pathlib import Path
from typing import Any, Literal

from app.cli.progress_bar import follow
from app.storage.paths import default_data_dir


@dataclass(frozen=True)
class EvaluatePhotosCommand:
    """Real photographs: objects by their masks, without a start or from poses of another program; lamps."""

    data: Path
    """Folder of folders with photo.json, or of chrome balls under lamps."""
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
        from osfcore.experiments.photos.evaluation import EvaluatePhotos, evaluate_photos
        from osfcore.fields.field_library import FieldLibrary

        folder = self.data_dir / "photos" if self.out is None else self.out
        config = EvaluatePhotos(folder, self.data, self.start, self.plane, self.mask_error, self.repeats, self.loss,
                                self.seed, self.masks)  # fmt: skip
        last = follow(evaluate_photos(config, FieldLibrary(self.data_dir)))
        assert last is not None
        assert last.report is not None, "the last step brings the report"
        report = last.report.to_json()
        if not self.json:
            _show(folder, report)
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
