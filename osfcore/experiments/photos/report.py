"""Figures of photographs."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import asdict, dataclass
from typing import Any

import numpy as np

_RIGHT_MM, _RIGHT_DEG, _DEPTH_MM = 15.0, 10.0, 10.0


@dataclass(frozen=True, slots=True)
class PhotoScore:
    """One object in one photograph.

    Attributes:
        scene: the photograph's folder.
        name: of the object.
        is_true: the reference is the truth, not another program's answer.
        iou: of the field's silhouette and the mask.
        depth_mm: median of drawn minus measured depth; None without measured depth.
        position_mm: distance from the reference; None without one.
        rotation_deg: angle to it, symmetries counted.
        doubt: why the pose should not be trusted; "" where it may be.
        ratio: loss of the best other orientation over that of the pose.
        coarse_s: of the search over rotations.
        refine_s: of the refinement.
        mask_iou: of the mask that was searched with and the given one.
    """

    scene: str
    name: str
    is_true: bool
    iou: float
    depth_mm: float | None
    position_mm: float | None
    rotation_deg: float | None
    doubt: str
    ratio: float
    coarse_s: float
    refine_s: float
    mask_iou: float = 1.0

    @property
    def is_turned_right(self) -> bool:
        """Whether the rotation is within 10 degrees of the reference."""
        return self.rotation_deg is not None and self.rotation_deg <= _RIGHT_DEG

    @property
    def is_right(self) -> bool:
        """Whether the position is within 15 mm as well."""
        return self.is_turned_right and self.position_mm is not None and self.position_mm <= _RIGHT_MM


@dataclass(frozen=True, slots=True)
class PhotoReport:
    """All figures; None where nothing tells.

    Attributes:
        scores: of each search.
        lamps_deg: error of each lamp, by what it shone on.
        without_field: objects that have no field and were left out.
    """

    scores: tuple[PhotoScore, ...]
    lamps_deg: Mapping[str, tuple[float, ...]]
    without_field: int

    def to_json(self) -> dict[str, Any]:
        """Figures by name, and the scores that they come from."""
        scores, true = self.scores, [s for s in self.scores if s.is_true]
        referred = [s for s in scores if s.rotation_deg is not None]
        depths = [abs(s.depth_mm) for s in scores if s.depth_mm is not None]
        lamps = [error for errors in self.lamps_deg.values() for error in errors]
        return {
            "objects_total": len(scores),
            "objects_without_field": self.without_field,
            "iou_median": _median([s.iou for s in scores]),
            "iou_mean": _mean([s.iou for s in scores]),
            "iou_min": min((s.iou for s in scores), default=None),
            "mask_iou_median": _median([s.mask_iou for s in scores]),
            "mask_iou_min": min((s.mask_iou for s in scores), default=None),
            "depth_within_10mm": _mean([d <= _DEPTH_MM for d in depths]),
            "depth_mm_median": _median(depths),
            "frac_15mm_10deg": _mean([s.is_right for s in true]),
            "frac_10deg": _mean([s.is_turned_right for s in referred]),
            "wrong_unflagged": sum(not s.is_turned_right and not s.doubt for s in referred),
            "right_flagged": sum(s.is_turned_right and bool(s.doubt) for s in referred),
            "light_deg_median": _median(lamps),
            "light_deg_max": max(lamps, default=None),
            "light_deg": {name: [round(e, 2) for e in errors] for name, errors in self.lamps_deg.items()},
            "refine_s_median": _median([s.refine_s for s in scores]),
            "refine_s_p95": _quantile([s.refine_s for s in scores], 0.95),
            "coarse_s_median": _median([s.coarse_s for s in scores]),
            "coarse_s_p95": _quantile([s.coarse_s for s in scores], 0.95),
            "scores": [asdict(s) for s in scores],
        }


def report_of(
    scores: Sequence[PhotoScore], lamps_deg: Mapping[str, Sequence[float]], without_field: int
) -> PhotoReport:
    """The report of an evaluation."""
    return PhotoReport(tuple(scores), {name: tuple(errors) for name, errors in lamps_deg.items()}, without_field)


def _mean(values: Sequence[float]) -> float | None:
    return float(np.mean(values)) if values else None


def _median(values: Sequence[float]) -> float | None:
    return _quantile(values, 0.5)


def _quantile(values: Sequence[float], q: float) -> float | None:
    return float(np.quantile(values, q)) if values else None
