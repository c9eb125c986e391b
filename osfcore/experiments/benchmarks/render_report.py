"""What a benchmark of rendering reports."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import asdict, dataclass
from typing import Any

import numpy as np

from osfcore.inspection.contact_sheet import Comparison


@dataclass(frozen=True, slots=True)
class Cost:
    """One row of a table.

    Attributes:
        size: number of objects, side of the image [px], or scenes in a batch.
        ms: median time of a call [ms].
        ms_per_image: the same for each image [ms].
    """

    size: int
    ms: float
    ms_per_image: float


@dataclass(frozen=True, eq=False, slots=True)
class RenderReport:
    """What rendering costs; medians.

    Attributes:
        tinyrenderer_ms: one new scene by plain TinyRenderer with its shadow [ms].
        scene_exact_ms: the same scene by us, carefully [ms].
        scene_ms: the same scene by us, at planning quality [ms].
        planning_renders_per_s: images a second when planning.
        planning_psnr: of planning images against exact ones [dB].
        reference_ms: one such scene by the reference renderer [ms].
        threads: that we may use; TinyRenderer has one.
        objects: cost by number of objects.
        resolution: cost by side of the image.
        batch: cost by number of scenes in one call, at planning quality.
        shown: a scene by TinyRenderer and by us.
    """

    tinyrenderer_ms: float
    scene_exact_ms: float
    scene_ms: float
    planning_renders_per_s: float
    planning_psnr: float
    reference_ms: float
    threads: int
    objects: tuple[Cost, ...]
    resolution: tuple[Cost, ...]
    batch: tuple[Cost, ...]
    shown: tuple[Comparison, ...]

    def to_json(self) -> dict[str, Any]:
        """The report as plain numbers, with how steeply cost grows: 1 is in proportion, less is better."""
        growth = {
            "objects": slope([c.size for c in self.objects], [c.ms for c in self.objects]),
            "pixels": slope([c.size**2 for c in self.resolution], [c.ms for c in self.resolution]),
            "batch": slope([c.size for c in self.batch], [c.ms for c in self.batch]),
        }
        return {
            "tinyrenderer_ms": self.tinyrenderer_ms,
            "scene_exact_ms": self.scene_exact_ms,
            "ratio_exact": self.tinyrenderer_ms / self.scene_exact_ms,
            "scene_ms": self.scene_ms,
            "ratio": self.tinyrenderer_ms / self.scene_ms,
            "planning_renders_per_s": self.planning_renders_per_s,
            "planning_psnr": self.planning_psnr,
            "reference_ms": self.reference_ms,
            "threads": self.threads,
            "by_objects": [asdict(cost) for cost in self.objects],
            "by_resolution": [asdict(cost) for cost in self.resolution],
            "by_batch": [asdict(cost) for cost in self.batch],
            "growth": growth,
        }


def slope(sizes: Sequence[float], costs: Sequence[float]) -> float | None:
    """The exponent p of the best fit cost ~ size^p; None with fewer than two sizes."""
    if len(sizes) < 2:
        return None
    return float(np.polyfit(np.log(sizes), np.log(costs), 1)[0])
