"""Pictures of an evaluation of predicted pushes: errors by horizon, and trajectories seen from above."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from pathlib import Path

import cv2
import numpy as np
from jaxtyping import Float, UInt8

from osfcore.dynamics.contact_geometry import part_outlines
from osfcore.dynamics.shapes.object_shapes import ObjectShape, ShapeTable
from osfcore.experiments.charts import Axis, Chart, Curve, write_charts
from osfcore.experiments.dynamics.report import DynamicsReport, Scored
from osfcore.experiments.dynamics.scores import HORIZONS
from osfcore.geometry.poses import Pose
from osfcore.geometry.workspace import PUSHER_RADIUS_M
from osfcore.inspection.contact_sheet import put_text
from osfcore.io.image_file import write_png

GALLERY_HORIZON = 10  # actions
_EACH = 6  # windows of a kind
_CELL_PX, _SHOWN_M = 260, 0.5
_PAPER, _START, _TRUE, _PREDICTED, _PUSHER = 255, (190, 190, 190), (44, 160, 44), (214, 39, 40), (31, 119, 180)


def write_plots(folder: Path, report: DynamicsReport) -> None:
    """Draw dynamics.png: median errors by horizon, against doing without, and by number of objects.

    Raises:
        CannotWrite: if the disk refuses.
    """
    main = report.of_count(3)
    names = {"network": "graph network", "analytic": "quasi-static", "constant": "constant pose"}
    panels = []
    for deg, label in ((False, "median position error [mm]"), (True, "median rotation error [deg]")):
        curves = [_curve(title, main, who, deg=deg) for who, title in names.items()]
        panels.append(_panel("Objects that moved, 3 in a scene", label, curves))
    counts = sorted({int(key.split()[1]) for key in report.by_set})
    curves = [_curve(f"{count} objects", report.of_count(count), "network", deg=False) for count in counts]
    panels.append(_panel("Graph network", "median position error [mm]", curves))
    write_charts(folder / "dynamics.png", panels)


def _curve(name: str, scored: Sequence[Scored], who: str, *, deg: bool) -> Curve:
    values = []
    for horizon in HORIZONS:
        errors = np.concatenate([s.errors[who].of_moved(horizon, deg=deg) for s in scored])
        values.append(np.median(errors) if len(errors) else np.nan)
    return Curve(name, np.array(HORIZONS, float), np.array(values), dots=True)


def _panel(title: str, label: str, curves: Sequence[Curve]) -> Chart:
    return Chart(title, Axis("actions of 0.2 s", 0, HORIZONS[-1]), Axis(label, 0), curves)


def write_gallery(folder: Path, report: DynamicsReport, shapes: Mapping[str, ObjectShape]) -> None:
    """Draw trajectories.png: the best, the middle and the worst windows of three objects after ten actions.

    Args:
        folder: of the picture.
        report: with the network's predictions.
        shapes: of all objects in it, by name.

    Raises:
        CannotWrite: if the disk refuses.
    """
    at = HORIZONS.index(GALLERY_HORIZON)
    ranked = []
    for scored in report.of_count(3):
        e = scored.errors["network"]
        counted = e.moved[at] & e.valid[at]
        worst = np.where(counted, e.mm[at], -1).max(axis=1)
        ranked += [(float(worst[w]), scored, int(w)) for w in np.flatnonzero(worst >= 0)]
    ranked.sort(key=lambda entry: entry[0])
    middle = max((len(ranked) - _EACH) // 2, 0)
    rows = [
        _row(title, chosen, shapes)
        for title, chosen in (
            ("Best", ranked[:_EACH]),
            ("Middle", ranked[middle : middle + _EACH]),
            ("Worst", ranked[-_EACH:]),
        )
    ]
    write_png(folder / "trajectories.png", np.vstack(rows))


def _row(title: str, chosen: Sequence[tuple[float, Scored, int]], shapes: Mapping[str, ObjectShape]) -> np.ndarray:
    cells = [_cell(f"{title}: {mm:.1f} mm", scored, window, shapes) for mm, scored, window in chosen]
    blank = np.full((_CELL_PX, _CELL_PX, 3), _PAPER, np.uint8)
    return np.hstack([*cells, *[blank] * (_EACH - len(cells))])


def _cell(title: str, scored: Scored, window: int, shapes: Mapping[str, ObjectShape]) -> UInt8[np.ndarray, "h w 3"]:
    """One window from above: where things were (grey), came to (green), were predicted to come to (red)."""
    cell = np.full((_CELL_PX, _CELL_PX, 3), _PAPER, np.uint8)
    windows, end = scored.windows, GALLERY_HORIZON
    pusher = windows.pusher[window, 1 : end + 2, :2]
    ends = windows.positions[window, [1, end + 1], :, :2]
    farthest = np.linalg.norm(ends[1] - ends[0], axis=-1).argmax()
    middle = ends[:, farthest].mean(axis=0)

    def pixels(points: Float[np.ndarray, "n 2"]) -> np.ndarray:
        flat = (points - middle) / _SHOWN_M * [1, -1] + 0.5
        return np.round(flat * _CELL_PX).astype(np.int32).reshape(-1, 1, 2)

    for slot, name in enumerate(windows.names[window]):
        true_p, true_q = windows.positions[window, 1:, slot], windows.quaternions[window, 1:, slot]
        ours_p, ours_q = scored.network.positions[window, :, slot], scored.network.quaternions[window, :, slot]
        for p, q, colour in (
            (true_p[0], true_q[0], _START),
            (true_p[end], true_q[end], _TRUE),
            (ours_p[end - 1], ours_q[end - 1], _PREDICTED),
        ):
            mask = np.zeros(cell.shape[:2], np.uint8)
            for part in part_outlines(ShapeTable((shapes[name],)), 0, Pose(p, q)):
                cv2.fillConvexPoly(mask, pixels(part), 1)
            edges = cv2.findContours(mask, cv2.RETR_EXTERNAL, cv2.CHAIN_APPROX_NONE)[0]
            cv2.polylines(cell, edges, True, colour, 1, cv2.LINE_AA)
        cv2.polylines(cell, [pixels(true_p[: end + 1, :2])], False, _TRUE, 1, cv2.LINE_AA)
        path = np.concatenate([true_p[:1, :2], ours_p[:end, :2]])
        cv2.polylines(cell, [pixels(path)], False, _PREDICTED, 1, cv2.LINE_AA)
    cv2.polylines(cell, [pixels(pusher)], False, _PUSHER, 1, cv2.LINE_AA)
    for place, thickness in ((pusher[0], 1), (pusher[-1], -1)):
        centre = pixels(place[None])[0, 0]
        radius = round(PUSHER_RADIUS_M / _SHOWN_M * _CELL_PX)
        cv2.circle(cell, (int(centre[0]), int(centre[1])), radius, _PUSHER, thickness, cv2.LINE_AA)
    put_text(cell, title, (6, 16), _CELL_PX - 12)
    cv2.rectangle(cell, (0, 0), (_CELL_PX - 1, _CELL_PX - 1), _START, 1)
    return cell
