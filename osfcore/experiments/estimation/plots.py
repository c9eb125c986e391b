"""Pictures of an evaluation of estimators: curves of errors, and galleries of what went wrong."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from pathlib import Path

import numpy as np
from jaxtyping import UInt8
from scipy.special import erf

from osfcore.experiments.charts import Axis, Chart, Curve, cumulative, write_charts
from osfcore.experiments.estimation.report import EstimateReport, errors_at
from osfcore.experiments.estimation.scores import (
    FrameScore,
    TrackScore,
    median,
    objects_of,
    quantile,
    ratios_of,
    share_right,
)
from osfcore.experiments.estimation.spoiled_inputs import BadScore
from osfcore.inspection.contact_sheet import Comparison, contact_sheet, put_text
from osfcore.io.image_file import write_png

MOST_SHOWN = 20  # tasks in a gallery
_PER_ROW = 4
_LINE_PX = 16
_LEAST_WIDTH_PX = 680
_SHARE = Axis("share of objects", 0, 1)
_POSITION, _ROTATION = Axis("position error [mm]", 0, 20), Axis("rotation error [deg]", 0, 10)


@dataclass(frozen=True, eq=False, slots=True)
class Failure:
    """One entry of a gallery.

    Attributes:
        badness: the worst first.
        lines: what went wrong.
        shown: observed and rendered images.
    """

    badness: float
    lines: tuple[str, ...]
    shown: tuple[Comparison, ...]


def write_plots(folder: Path, report: EstimateReport) -> None:
    """Draw errors.png and calibration.png, and track.png and views.png where these parts were measured.

    Raises:
        CannotWrite: if the disk refuses.
    """
    write_charts(folder / "errors.png", errors_charts(report))
    write_charts(folder / "calibration.png", calibration_charts(report.first))
    if report.tracks:
        write_charts(folder / "track.png", track_charts(report.tracks))
    if report.views is not None:
        write_charts(folder / "views.png", views_charts(report))


def errors_charts(report: EstimateReport) -> list[Chart]:
    """Cumulative errors of position and rotation; refused objects keep a curve below 1."""
    kinds = {"first frame, 4 views": report.first, "goal, 1 view": report.all_goals}
    kinds["light held overhead"] = report.fixed_light or ()
    panels = []
    for axis, key in ((_POSITION, "position_mm"), (_ROTATION, "rotation_deg")):
        curves = []
        for name, frames in kinds.items():
            if frames:
                values = [getattr(score, key) for score in objects_of(frames)]
                curves.append(cumulative(name, values, axis, sum(len(frame.names) for frame in frames)))
        panels.append(Chart("Objects with at most this error", axis, _SHARE, curves))
    return panels


def calibration_charts(frames: Sequence[FrameScore]) -> list[Chart]:
    """How often errors lie within so many claimed deviations, against Gaussian errors."""
    axis, ratios = Axis("|error| / claimed deviation", 0, 5), ratios_of(frames)
    x = np.linspace(0, 5, 200)
    curves = [
        Curve("if it were Gaussian", x, erf(x / np.sqrt(2))),
        *(cumulative(key, getattr(ratios, key), axis) for key in ("position", "rotation", "light")),
    ]
    return [Chart("Right estimates: are deviations honest?", axis, Axis("share of components", 0, 1), curves)]


def track_charts(tracks: Sequence[TrackScore]) -> list[Chart]:
    """Errors along episodes: median, and what nine of ten stay below."""
    count = max((len(track.seconds) for track in tracks), default=0)
    steps = np.arange(1, count + 1)
    panels = []
    for which, axis in enumerate((_POSITION, _ROTATION)):
        values = [errors_at(tracks, int(step), which) for step in steps]
        curves = [
            Curve("median", steps.astype(float), np.array([median(v) for v in values], float), dots=True),
            Curve("90 % below", steps.astype(float), np.array([quantile(v, 0.9) for v in values], float), dots=True),
        ]
        errors = Axis(axis.label, 0)
        panels.append(Chart("Without masks, step by step", Axis("step", 0, max(count, 1)), errors, curves))
    return panels


def views_charts(report: EstimateReport) -> list[Chart]:
    """Accuracy by number of cameras."""
    views = report.by_views()
    x = np.array(sorted(views), float)
    axis = Axis("cameras", 0, float(x.max()) + 1)
    frames = [views[int(n)] for n in x]
    right = np.array([share_right(f) for f in frames], float)
    errors = [
        Curve(name, x, np.array([median(getattr(o, key) for o in objects_of(f)) for f in frames], float), dots=True)
        for name, key in (("position, median [mm]", "position_mm"), ("rotation, median [deg]", "rotation_deg"))
    ]
    light = np.array([median(frame.light_deg for frame in f) for f in frames], float)
    errors.append(Curve("light, median [deg]", x, light, dots=True))
    return [
        Chart("Under 1 cm and 5 deg", axis, _SHARE, [Curve("share", x, right, dots=True)]),
        Chart("Errors", axis, Axis("error", 0), errors),
    ]


# Galleries


def frame_failure(title: str, score: FrameScore, shown: Sequence[Comparison]) -> Failure | None:
    """A frame that was refused, or with an object that is wrong, or right and flagged; None if there is nothing to see.

    Args:
        title: of the task, for the first line.
        score: of the frame.
        shown: observed and rendered images.
    """
    if score.refused:
        return Failure(np.inf, (f"{title}: REFUSED: {score.refused}",), tuple(shown))
    if score.is_right and not any(o.flagged for o in score.objects):
        return None
    lines = [f"{title}, light off by {score.light_deg:.1f} deg"]
    for o in score.objects:
        verdict = "right" if o.is_right else "WRONG"
        warning = f"flagged: {o.doubt or 'the whole'}" if o.flagged else "unflagged"
        hidden = f", {o.absent}" if o.absent else ""
        lines.append(f"  {o.name}: {o.position_mm:.1f} mm, {o.rotation_deg:.1f} deg {verdict}{hidden}, {warning}")
    wrong = [o for o in score.objects if not o.is_right]
    badness = len(wrong) + sum(not o.flagged for o in wrong) * 10
    return Failure(float(badness), tuple(lines), tuple(shown))


def track_failure(title: str, score: TrackScore, shown: Sequence[Comparison]) -> Failure | None:
    """An episode in which an object was lost, or that had no start; None if there is nothing to see.

    Args:
        title: of the task, for the first line.
        score: of the episode.
        shown: observed and rendered images of the step at which the first object was lost.
    """
    if score.refused:
        return Failure(np.inf, (f"{title}: no start: {score.refused}",), tuple(shown))
    lost = {n: step for n, step in enumerate(score.lost_at) if step is not None}
    if not lost:
        return None
    lines = [f"{title}, shown at step {min(lost.values()) + 1}"]
    for n, step in lost.items():
        errors = f"{score.position_mm[step][n]:.0f} mm, {score.rotation_deg[step][n]:.0f} deg"
        start = "right" if score.right_at_start[n] else "wrong"
        warning = "flagged" if score.doubted[step][n] else "unflagged"
        lines.append(f"  {score.names[n]} LOST at step {step + 1}: {errors}, {warning}; first pose {start}")
    return Failure(float(len(lost)), tuple(lines), tuple(shown))


def bad_failure(title: str, score: BadScore, shown: Sequence[Comparison]) -> Failure | None:
    """A spoiled input that was believed although the answer is wrong; None otherwise.

    Args:
        title: of the case, for the only line.
        score: of the answer.
        shown: observed and rendered images.
    """
    if not score.is_confidently_wrong:
        return None
    errors = ", ".join(f"{p:.0f} mm / {r:.0f} deg" for p, r in zip(score.position_mm, score.rotation_deg, strict=True))
    return Failure(1.0, (f"{title}: {score.kind}: wrong without a warning ({errors})",), tuple(shown))


def write_gallery(path: Path, failures: Sequence[Failure | None]) -> None:
    """The worst of them below each other, or no file (an older one goes) where nothing failed.

    Raises:
        CannotWrite: if the disk refuses.
    """
    chosen = sorted((f for f in failures if f is not None and f.shown), key=lambda f: -f.badness)[:MOST_SHOWN]
    if chosen:
        write_png(path, gallery(chosen))
    else:
        path.unlink(missing_ok=True)


def gallery(failures: Sequence[Failure]) -> UInt8[np.ndarray, "H W 3"]:
    """For each: what went wrong in words, and below it observed images, rendered ones and their difference."""
    blocks = []
    for failure in failures:
        sheet = contact_sheet(failure.shown, per_row=_PER_ROW, truth="seen")
        words = np.full((_LINE_PX * len(failure.lines) + 4, max(sheet.shape[1], _LEAST_WIDTH_PX), 3), 255, np.uint8)
        for number, line in enumerate(failure.lines):
            put_text(words, line, (4, _LINE_PX * (number + 1) - 4), words.shape[1] - 8)
        blocks += [words, sheet]
    width = max(block.shape[1] for block in blocks)
    return np.vstack([np.pad(b, ((0, 0), (0, width - b.shape[1]), (0, 0)), constant_values=255) for b in blocks])
