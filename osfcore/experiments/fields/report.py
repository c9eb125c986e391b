"""What an evaluation of fields reports."""

from __future__ import annotations

import json
from collections.abc import Mapping
from dataclasses import asdict, dataclass
from pathlib import Path
from typing import Any

import numpy as np

from osfcore.experiments.task_cache import TaskResult


@dataclass(frozen=True, slots=True)
class FieldFigures:
    """One field on unseen views under unseen lights; means over the images.

    Attributes:
        psnr_full: over whole images, over black [dB].
        psnr_mask: inside the silhouettes, dilated by 2 px [dB].
        ssim: over whole images.
        images: how many.
        file_mb: size of the weights [MB].
        minutes: training time, or None if that is not known.
    """

    psnr_full: float
    psnr_mask: float
    ssim: float
    images: int
    file_mb: float
    minutes: float | None


@dataclass(frozen=True, eq=False, slots=True)
class FieldsReport:
    """What was measured.

    Attributes:
        objects: by name.
        scene_psnr: mean over all images of all scenes, whole images [dB]; None without scenes.
        scene_psnr_object: the same over pixels that show an object.
        scene_psnr_shadow: the same over table pixels in shadow.
        scenes: how many.
    """

    objects: Mapping[str, FieldFigures]
    scene_psnr: float | None = None
    scene_psnr_object: float | None = None
    scene_psnr_shadow: float | None = None
    scenes: int = 0

    def to_json(self) -> dict[str, Any]:
        """The report as plain numbers, with means over the objects."""
        figures = list(self.objects.values())
        return {
            "psnr_full_mean": float(np.mean([f.psnr_full for f in figures])),
            "psnr_mask_mean": float(np.mean([f.psnr_mask for f in figures])),
            "ssim_mean": float(np.mean([f.ssim for f in figures])),
            "scene_psnr_mean": self.scene_psnr,
            "scene_psnr_object_mean": self.scene_psnr_object,
            "scene_psnr_shadow_mean": self.scene_psnr_shadow,
            "max_file_mb": max(f.file_mb for f in figures),
            "objects": {name: asdict(f) for name, f in self.objects.items()},
            "scenes": self.scenes,
        }


def field_figures(result: TaskResult, weights: Path) -> FieldFigures:
    """Figures with size and training time, which are read anew each time."""
    try:
        minutes = float(json.loads(weights.with_suffix(".json").read_text())["minutes"])
    except (
        OSError,
        ValueError,
        KeyError,
        TypeError,
        OverflowError,
        RecursionError,
    ):  # weights may come without metrics
        minutes = None
    return FieldFigures(**result.figures, file_mb=weights.stat().st_size / 1e6, minutes=minutes)
