"""The parts of a report that compare images: relit scenes (Fig. 5) and predicted videos (Fig. 6)."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from pathlib import Path
from typing import Any

from osfcore.experiments.dynamics import video_prediction
from osfcore.experiments.fields import relighting
from osfcore.experiments.image_methods import TITLES
from osfcore.experiments.reproduction.page import PagePart
from osfcore.experiments.reproduction.sections import objects_in_words


def relighting_part(folder: Path, report: Mapping[str, Any]) -> PagePart:
    """Scenes under lights of all elevations.

    Args:
        folder: with the pictures.
        report: of `compare_relighting`.
    """
    columns = [(key, relighting.ALL, title) for key, title in _RELIT.items()]
    text = (
        f"{report['tasks']} scenes of {objects_in_words(report['objects'])}, poses and light given, under lights "
        f"between {min(report['elevations_deg']):g} and {max(report['elevations_deg']):g} deg above the table."
    )
    pictures = (
        (folder / relighting.CHART_FILE, "PSNR and SSIM by elevation of the light"),
        (folder / relighting.IMAGES_FILE, "One scene under a low, a middle and a high light, by each method"),
    )
    return PagePart("Scenes under any light (Fig. 5)", text, pictures, *_table(report, columns))


def video_part(folder: Path, report: Mapping[str, Any]) -> PagePart:
    """Pushes predicted as images.

    Args:
        folder: with the pictures.
        report: of `compare_videos`.
    """
    spans = list(next(iter(report["methods"].values()))["psnr"]["spans"])
    columns = [(key, span, f"{title}, {span} steps") for span in spans for key, title in _VIDEO.items()]
    text = (
        f"{report['tasks']} episodes of {objects_in_words(report['objects'])}, {report['steps']} actions known "
        "in advance, from the first frame's estimate; FitVid sees two frames of the goal camera."
    )
    pictures = (
        (folder / video_prediction.CHART_FILE, "PSNR and SSIM by predicted step"),
        (folder / video_prediction.IMAGES_FILE, "One episode as it was and as each method predicts it"),
    )
    return PagePart("Predicted futures as images (Fig. 6)", text, pictures, *_table(report, columns))


_RELIT = {"psnr": "PSNR [dB]", "ssim": "SSIM", "psnr_object": "on objects [dB]", "psnr_shadow": "in shadow [dB]"}
_VIDEO = {"psnr": "PSNR [dB]", "ssim": "SSIM"}


def _table(
    report: Mapping[str, Any], columns: Sequence[tuple[str, str, str]]
) -> tuple[tuple[str, ...], list[list[str]]]:
    """Heads and rows: means with intervals, and ours against each other method in the first column's measure."""
    key, span, _ = columns[0]
    rows = []
    for method, measures in report["methods"].items():
        cells = [_interval(measures[measure]["spans"][over], "mean") for measure, over, _ in columns]
        gap = report["against"].get(method)
        rows.append([TITLES[method], *cells, "" if gap is None else _interval(gap[key][span], "difference")])
    return ("", *(title for _, _, title in columns), "ours better by [dB]"), rows


def _interval(told: Mapping[str, Any], what: str) -> str:
    if told[what] is None:
        return "-"
    low, high = told["interval"]
    return f"{told[what]:.3g} ({low:.3g} to {high:.3g})"
