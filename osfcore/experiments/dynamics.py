"""Measure predictions of pushes: open loop over episodes that nothing was trained on.

Episodes of both policies with two, three, four and six objects are collected once into the output folder, from random
streams that no other collection uses. Windows of up to 30 actions are rolled out by the network, by a quasi-static
model and by nobody (everything stays), and scored for objects that truly moved. Pairs of objects that never meet in
training are scored apart, and so are objects that a second network has never seen; with the paper's network neither is,
for it has met them all. Episodes are the same for every method.
"""

from __future__ import annotations

import hashlib
from collections.abc import Callable, Iterator, Mapping, Sequence
from concurrent.futures import Executor
from dataclasses import dataclass, field
from dataclasses import fields as fields_of
from itertools import islice
from pathlib import Path
from typing import Any, Literal, NamedTuple, get_args

import cv2
import numpy as np
import torch
from jaxtyping import Bool, Float, Int, UInt8
from torch import Tensor

from osfcore.dynamics.dynamics_model import DynamicsModel
from osfcore.dynamics.graph import PropagationNetwork, read_metrics, read_network, shipped, unroll
from osfcore.dynamics.motion import SUBSTEPS, Motion, going_on, is_on_table, lowest_point, pusher_path
from osfcore.dynamics.rollout import PushModel, load_shapes, network_path
from osfcore.dynamics.shapes import ObjectShape, ShapeTable, part_outlines
from osfcore.dynamics.train import has_held_out_pair
from osfcore.errors import InvalidInput
from osfcore.experiments.bench_rollouts import BENCH_NAMES, bench_rollouts
from osfcore.experiments.charts import Axis, Chart, Curve, write_charts
from osfcore.experiments.factors import UNSEEN_NETWORK
from osfcore.experiments.harness import EvaluationStep, check_run, chosen_objects
from osfcore.experiments.rivals.quasistatic import push
from osfcore.fields.field_library import FieldLibrary
from osfcore.geometry.poses import Pose, rotate, rotation_angle
from osfcore.geometry.workspace import PUSHER_RADIUS_M
from osfcore.inspection.contact_sheet import put_text
from osfcore.io.files import write_json
from osfcore.io.image_file import write_png
from osfcore.io.push_file import PushEpisode, read_pushes
from osfcore.metrics.pose_errors import rotation_error
from osfcore.objects.asset import Symmetry
from osfcore.objects.asset_library import AssetLibrary
from osfcore.paper import dynamics as paper
from osfcore.random_streams import Stream, stream_seed
from osfcore.world.collect_pushes import CollectPushes, collect_pushes
from osfcore.world.simulators import Simulator, default_simulator

# What is rolled out, by whom, and how far it ends from the truth.


HORIZONS = (1, 2, 3, 4, 6, 8, 10, 15, 20, 25, 30)
LONGEST = HORIZONS[-1]
MOVED_MM, MOVED_DEG = 10.0, 5.0  # what counts as truly moved within a window
_START_EVERY = 4  # steps
_CHUNK = 512  # windows


@dataclass(frozen=True, eq=False, slots=True)
class Windows:
    """Pieces of episodes with equally many objects: W windows of `LONGEST` actions.

    Attributes:
        names: of the objects of each window.
        positions: true ones, one action before the start (or at it, where there was none), at the start, and after each
            action [m].
        quaternions: likewise.
        pusher: likewise [m].
        actions: velocities [m/s].
        on_table: how many actions pass before something comes near the table's edge.
    """

    names: tuple[tuple[str, ...], ...]
    positions: Float[np.ndarray, "W T2 N 3"]
    quaternions: Float[np.ndarray, "W T2 N 4"]
    pusher: Float[np.ndarray, "W T2 3"]
    actions: Float[np.ndarray, "W T 3"]
    on_table: Int[np.ndarray, "W"]

    def chunks(self) -> Iterator[Windows]:
        """Yield a few hundred windows at a time, to bound the memory that predictions take."""
        for first in range(0, len(self.names), _CHUNK):
            yield Windows(*(getattr(self, entry.name)[first : first + _CHUNK] for entry in fields_of(self)))


@dataclass(frozen=True, eq=False, slots=True)
class Predicted:
    """Poses of the objects after each action [m]."""

    positions: Float[np.ndarray, "W T N 3"]
    quaternions: Float[np.ndarray, "W T N 4"]


@dataclass(frozen=True, eq=False, slots=True)
class Errors:
    """How far one predictor ends from the truth, for every horizon, window and object.

    Attributes:
        mm: error of the position [mm].
        deg: error of the orientation, by the object's symmetry [deg].
        moved: whether the object truly moved.
        valid: whether everything was on the table up to then.
    """

    mm: Float[np.ndarray, "H W N"]
    deg: Float[np.ndarray, "H W N"]
    moved: Bool[np.ndarray, "H W N"]
    valid: Bool[np.ndarray, "H W N"]

    def of_moved(
        self, horizon: int, *, deg: bool = False, among: Bool[np.ndarray, "W N"] | bool = True
    ) -> Float[np.ndarray, "M"]:
        """Return errors of objects that truly moved within so many actions [mm or deg].

        Args:
            horizon: one of `HORIZONS`.
            deg: errors of orientations instead of positions.
            among: objects that count.
        """
        at = HORIZONS.index(horizon)
        return (self.deg if deg else self.mm)[at][self.moved[at] & self.valid[at] & among]

    def of_still(self, horizon: int) -> Float[np.ndarray, "M"]:
        """Return position errors of objects that did not move [mm]."""
        at = HORIZONS.index(horizon)
        return self.mm[at][~self.moved[at] & self.valid[at]]


def windows_of(episodes: Sequence[PushEpisode]) -> Windows:
    """Cut episodes of one length and number of objects into windows."""
    parts: list[tuple[object, ...]] = []
    for e in episodes:
        inside = is_on_table(e)
        for start in range(0, len(e.actions) - LONGEST + 1, _START_EVERY):
            steps = np.clip(np.arange(start - 1, start + LONGEST + 1), 0, None)
            leaves = np.flatnonzero(~inside[start : start + LONGEST + 1])
            last = int(leaves[0]) - 1 if len(leaves) else LONGEST
            taken = e.actions[start : start + LONGEST]
            parts.append((e.names, e.positions[steps], e.quaternions[steps], e.pusher[steps], taken, last))
    names, *arrays = zip(*parts, strict=True)
    return Windows(names, *(np.array(array) for array in arrays))  # pyright: ignore[reportArgumentType]


def constant(windows: Windows) -> Predicted:
    """Predict that nothing ever moves."""
    shape = (len(windows.names), LONGEST, windows.positions.shape[2])
    return Predicted(
        np.broadcast_to(windows.positions[:, 1:2], (*shape, 3)),
        np.broadcast_to(windows.quaternions[:, 1:2], (*shape, 4)),
    )


def learned(network: PropagationNetwork, shapes: Mapping[str, ObjectShape], windows: Windows) -> Predicted:
    """Predict by the network, which knows the poses of one action before the start.

    Args:
        network: on the CPU.
        shapes: of all objects in the windows, by name.
        windows: what to predict.
    """

    def roll(table: ShapeTable, number: Tensor, part: Windows) -> Iterator[Motion]:
        start = going_on(_at_rest(table, number, part, 0), _at_rest(table, number, part, 1))
        velocity = torch.as_tensor(part.actions[..., :2], dtype=torch.float32).transpose(0, 1)
        return islice(unroll(network, table, number, start, velocity), SUBSTEPS - 1, None, SUBSTEPS)

    return _rolled(shapes, windows, roll)


def analytic(shapes: Mapping[str, ObjectShape], windows: Windows) -> Predicted:
    """Predict by the quasi-static model."""

    def roll(table: ShapeTable, number: Tensor, part: Windows) -> Iterator[Motion]:
        shifts = torch.as_tensor(np.diff(part.pusher[:, 1:, :2], axis=1), dtype=torch.float32)
        return push(table, number, _at_rest(table, number, part, 1), shifts.transpose(0, 1))

    return _rolled(shapes, windows, roll)


def _rolled(
    shapes: Mapping[str, ObjectShape], windows: Windows, roll: Callable[[ShapeTable, Tensor, Windows], Iterator[Motion]]
) -> Predicted:
    """Return poses after each action.

    Args:
        shapes: of all objects in the windows, by name.
        windows: what to predict.
        roll: yields motions after each action of some windows, given a table of shapes and the objects' numbers in it.
    """
    names = tuple(sorted(shapes))
    table = ShapeTable(tuple(shapes[name] for name in names))
    centres, turned = [], []
    with torch.inference_mode():
        for part in windows.chunks():
            number = torch.tensor([[names.index(name) for name in row] for row in part.names])
            motions = list(roll(table, number, part))
            centres.append(torch.stack([motion.centre for motion in motions], dim=1).numpy())
            turned.append(torch.stack([motion.quaternion for motion in motions], dim=1).numpy())
    quaternions = np.concatenate(turned).astype(float)
    offsets = np.array([[shapes[name].centre for name in row] for row in windows.names])[:, None]
    return Predicted(np.concatenate(centres) - rotate(quaternions, offsets), quaternions)


def _at_rest(table: ShapeTable, number: Tensor, windows: Windows, at: int) -> Motion:
    """Return the scenes one action before the start (at = 0) or at it (1), without velocities."""
    quaternion = torch.as_tensor(windows.quaternions[:, at], dtype=torch.float32)
    offsets = table.centre[number].numpy()
    centre = windows.positions[:, at] + rotate(windows.quaternions[:, at], offsets)
    centre = torch.as_tensor(centre, dtype=torch.float32)
    lowest = lowest_point(table, number.flatten(), centre.flatten(0, 1), quaternion.flatten(0, 1)).view(number.shape)
    still = torch.zeros_like(centre)
    pusher = torch.as_tensor(windows.pusher[:, at, :2], dtype=torch.float32)
    return Motion(centre, quaternion, still, still, pusher, lowest.clamp(max=0))


def errors(windows: Windows, predicted: Predicted, symmetries: Mapping[str, Symmetry]) -> Errors:
    """Score a predictor at every horizon.

    Args:
        windows: with the truth.
        predicted: for these windows.
        symmetries: of all objects in them, by name.
    """
    at = np.array(HORIZONS)
    true_p, true_q = (np.moveaxis(a[:, 1 + at], 1, 0) for a in (windows.positions, windows.quaternions))
    p, q = (np.moveaxis(a[:, at - 1], 1, 0) for a in (predicted.positions, predicted.quaternions))
    way_mm = 1e3 * np.linalg.norm(true_p - windows.positions[:, 1], axis=-1)
    start = np.broadcast_to(windows.quaternions[:, 1], true_q.shape)
    turned_deg = _angles(windows, symmetries, start, true_q)
    valid = at[:, None] <= windows.on_table
    return Errors(
        mm=1e3 * np.linalg.norm(p - true_p, axis=-1),
        deg=_angles(windows, symmetries, q, true_q),
        moved=(way_mm > MOVED_MM) | (turned_deg > MOVED_DEG),
        valid=np.broadcast_to(valid[..., None], way_mm.shape),
    )


def _angles(
    windows: Windows, symmetries: Mapping[str, Symmetry], a: Float[np.ndarray, "H W N 4"], b: np.ndarray
) -> Float[np.ndarray, "H W N"]:
    """Return symmetry-aware angles between orientations [deg]."""
    angles = np.asarray(rotation_angle(a, b))
    for window, names in enumerate(windows.names):
        for slot, name in enumerate(names):
            if symmetries[name].kind != "none":
                for h in range(len(HORIZONS)):
                    place = (h, window, slot)
                    angles[place] = rotation_error(symmetries[name], a[place], b[place])
    return np.rad2deg(angles)


# Whose predictions are evaluated: those of our model, or of the paper's as it is published.


DynamicsMethod = Literal["ours", "paper"]
METHODS: tuple[DynamicsMethod, ...] = get_args(DynamicsMethod)


class Predictor(NamedTuple):
    """One way to predict.

    Attributes:
        predict: gives poses in windows of episodes; it may use the poses of one action before the start.
        model: the same as planning uses it.
    """

    predict: Callable[[Windows], Predicted]
    model: DynamicsModel


def load_predictor(
    method: DynamicsMethod, data_dir: Path | None, fields: FieldLibrary, shapes: Mapping[str, ObjectShape]
) -> Predictor:
    """Load a trained network, on the CPU.

    Args:
        method: whose network.
        data_dir: a network in it comes before the package's.
        fields: of the objects.
        shapes: of all objects that occur, by name.

    Raises:
        CorruptFile: if a file is broken.
    """
    if method == "ours":
        network = read_network(network_path(data_dir))
        return Predictor(lambda windows: learned(network, shapes, windows), PushModel(network, shapes))
    published, kappas = paper.read_network(paper.weights_path(data_dir)), paper.longest_axes(fields, shapes)
    return Predictor(lambda windows: as_published(published, kappas, windows), paper.PaperPushModel(published, kappas))


def as_published(network: paper.GraphNetwork, kappas: Mapping[str, float], windows: Windows) -> Predicted:
    """Predict by the paper's network, which looks at the poses at the start alone.

    Args:
        network: on the CPU.
        kappas: longest axes of all objects in the windows, by name [m].
        windows: what to predict.
    """
    placed, turned = [], []
    for part in windows.chunks():
        number = torch.tensor([[network.number(name) for name in row] for row in part.names])
        kappa = torch.tensor([[kappas[name] for name in row] for row in part.names])
        path = pusher_path(part.pusher[:, 1, :2], part.actions[..., :2])[:, ::SUBSTEPS]
        height = np.broadcast_to(part.pusher[:, 1:2, 2:], (*path.shape[:2], 1))
        pusher = _tensor(np.concatenate([path, height], axis=-1))
        start = paper.Scenes(_tensor(part.positions[:, 1]), _tensor(part.quaternions[:, 1]), pusher[:, 0])
        with torch.inference_mode():
            scenes = list(paper.unroll(network, number, kappa, start, _tensor(part.actions), pusher))
            placed.append(torch.stack([s.position for s in scenes], dim=1).numpy())
            turned.append(torch.stack([s.quaternion for s in scenes], dim=1).numpy())
    return Predicted(np.concatenate(placed).astype(float), np.concatenate(turned).astype(float))


def _tensor(array: np.ndarray) -> Tensor:
    return torch.as_tensor(np.ascontiguousarray(array), dtype=torch.float32)


# What the evaluation of predicted pushes amounts to.


_REPORTED = (1, 4, 10, 30)  # horizons
_DIGITS = 3


@dataclass(frozen=True, eq=False, slots=True)
class Scored:
    """One set of episodes, predicted and scored.

    Attributes:
        windows: what was rolled out.
        network: what the network predicted.
        errors: by predictor: network, constant, analytic, and without where a second network was asked.
    """

    windows: Windows
    network: Predicted
    errors: Mapping[str, Errors]


@dataclass(frozen=True, eq=False, slots=True)
class DynamicsReport:
    """All sets.

    Attributes:
        by_set: by policy and number of objects, such as "paper 3".
        unseen: scenes with objects that the second network has not seen.
        unseen_names: these objects.
        rollout_steps_per_s: steps of three-object scenes that are predicted in a second.
        holds_out_pairs: whether there are pairs of objects that never met in the network's training.
    """

    by_set: Mapping[str, Scored]
    unseen: Scored | None
    unseen_names: tuple[str, ...]
    rollout_steps_per_s: float
    holds_out_pairs: bool = True

    @property
    def counts(self) -> list[int]:
        """Numbers of objects in a scene, ascending."""
        return sorted({int(key.split()[1]) for key in self.by_set})

    def of_count(self, objects: int) -> list[Scored]:
        """Return the sets of both policies with that many objects."""
        return [scored for key, scored in self.by_set.items() if key.endswith(f" {objects}")]


def report_json(report: DynamicsReport) -> dict[str, Any]:
    """Return the report as plain numbers: millimetres and degrees; null for what was not measured."""
    main = report.of_count(3)
    result: dict[str, Any] = {"windows": len(_moved(main, "network", 4))}
    for horizon in _REPORTED:
        mm, deg = (_moved(main, "network", horizon, deg=deg) for deg in (False, True))
        result |= {f"median_mm_{horizon}": _median(mm), f"median_deg_{horizon}": _median(deg)}
        result |= {f"mean_mm_{horizon}": _mean(mm), f"mean_deg_{horizon}": _mean(deg), f"windows_{horizon}": len(mm)}
    still = np.concatenate([scored.errors["network"].of_still(LONGEST) for scored in main])
    result |= {"still_drift_mm_30": _mean(still), "still_drift_median_mm_30": _median(still)}
    result["still_windows_30"] = len(still)
    for horizon in _REPORTED:
        result[f"constant_mm_{horizon}"] = _median(_moved(main, "constant", horizon))
        result[f"constant_deg_{horizon}"] = _median(_moved(main, "constant", horizon, deg=True))
        result[f"analytic_mm_{horizon}"] = _median(_moved(main, "analytic", horizon))
        result[f"analytic_deg_{horizon}"] = _median(_moved(main, "analytic", horizon, deg=True))
    result["rollout_steps_per_s"] = round(report.rollout_steps_per_s)
    result["by_objects"] = {str(count): _row(report.of_count(count)) for count in report.counts}
    result["by_policy"] = {key.split()[0]: _row([s]) for key, s in report.by_set.items() if key.endswith(" 3")}
    names = sorted({name for s in main for row in s.windows.names for name in row})
    result["by_name"] = {name: _after_four(main, "network", (name,)) for name in names}

    def held_out(names: tuple[str, ...]) -> list[bool]:
        return [has_held_out_pair(names)] * len(names)

    every = list(report.by_set.values()) if report.holds_out_pairs else []
    mm, way = (_moved(every, who, 4, chosen=held_out) for who in ("network", "constant"))
    result["unseen_pairs"] = {"windows": len(mm), "median_mm_4": _median(mm), "constant_mm_4": _median(way)}
    # What it costs never to have seen an object: errors in the same windows by both networks.
    scored = [] if report.unseen is None else [report.unseen]
    without, seen = (_after_four(scored, who, report.unseen_names) for who in ("without", "network"))
    return result | {
        "unseen_objects": list(report.unseen_names if scored else ()),
        "unseen_objects_windows": without["windows"],
        "unseen_objects_mm_4": without["median_mm_4"],
        "unseen_objects_deg_4": without["median_deg_4"],
        "seen_objects_mm_4": seen["median_mm_4"],
        "seen_objects_deg_4": seen["median_deg_4"],
    }


def _row(scored: Sequence[Scored]) -> dict[str, Any]:
    """Return the main figures of some sets."""
    mm = _moved(scored, "network", 4)
    return {
        "windows": len(mm),
        "median_mm_4": _median(mm),
        "median_deg_4": _median(_moved(scored, "network", 4, deg=True)),
        "median_mm_10": _median(_moved(scored, "network", 10)),
        "constant_mm_4": _median(_moved(scored, "constant", 4)),
        "analytic_mm_4": _median(_moved(scored, "analytic", 4)),
    }


def _after_four(scored: Sequence[Scored], who: str, among: tuple[str, ...]) -> dict[str, Any]:
    """Return errors after four actions of objects with these names."""

    def chosen(names: tuple[str, ...]) -> list[bool]:
        return [name in among for name in names]

    mm, deg = (_moved(scored, who, 4, deg=deg, chosen=chosen) for deg in (False, True))
    return {"windows": len(mm), "median_mm_4": _median(mm), "median_deg_4": _median(deg)}


def _moved(
    scored: Sequence[Scored],
    who: str,
    horizon: int,
    *,
    deg: bool = False,
    chosen: Callable[[tuple[str, ...]], list[bool]] | None = None,
) -> Float[np.ndarray, "M"]:
    """Return errors of one predictor for objects that truly moved, of all sets [mm or deg].

    Args:
        scored: the sets.
        who: name of the predictor.
        horizon: actions.
        deg: errors of orientations instead of positions.
        chosen: which objects of a window count, given their names; all if None.
    """
    parts = [np.zeros(0)]
    for one in scored:
        among = True if chosen is None else np.array([chosen(names) for names in one.windows.names])
        parts.append(one.errors[who].of_moved(horizon, deg=deg, among=among))
    return np.concatenate(parts)


def _median(values: Float[np.ndarray, "M"]) -> float | None:
    return round(float(np.median(values)), _DIGITS) if len(values) else None


def _mean(values: Float[np.ndarray, "M"]) -> float | None:
    return round(float(np.mean(values)), _DIGITS) if len(values) else None


# Pictures of an evaluation of predicted pushes: errors by horizon, and trajectories seen from above.


GALLERY_HORIZON = 10  # actions
_EACH = 6  # windows of a kind
_CELL_PX, _SHOWN_M = 260, 0.5
_PAPER, _START, _TRUE, _PREDICTED, _PUSHER = 255, (190, 190, 190), (44, 160, 44), (214, 39, 40), (31, 119, 180)


def write_plots(folder: Path, report: DynamicsReport) -> None:
    """Draw dynamics.svg: median errors by horizon, against doing without, and by number of objects.

    Raises:
        CannotWrite: if the disk refuses.
    """
    main = report.of_count(3)
    names = {"network": "graph network", "analytic": "quasi-static", "constant": "constant pose"}
    panels = []
    for deg, label in ((False, "median position error [mm]"), (True, "median rotation error [deg]")):
        curves = [_curve(title, main, who, deg=deg) for who, title in names.items()]
        panels.append(_panel("Objects that moved, 3 in a scene", label, curves))
    curves = [_curve(f"{count} objects", report.of_count(count), "network") for count in report.counts]
    panels.append(_panel("Graph network", "median position error [mm]", curves))
    write_charts(folder / "dynamics.svg", panels)


def _curve(name: str, scored: Sequence[Scored], who: str, *, deg: bool = False) -> Curve:
    values = [_moved(scored, who, horizon, deg=deg) for horizon in HORIZONS]
    medians = [np.median(errors) if len(errors) else np.nan for errors in values]
    return Curve(name, np.array(HORIZONS, float), np.array(medians), dots=True)


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
    kinds = {"Best": ranked[:_EACH], "Middle": ranked[middle : middle + _EACH], "Worst": ranked[-_EACH:]}
    blank = np.full((_CELL_PX, _CELL_PX, 3), _PAPER, np.uint8)
    rows = []
    for title, chosen in kinds.items():
        cells = [_cell(f"{title}: {mm:.1f} mm", scored, window, shapes) for mm, scored, window in chosen]
        rows.append(np.hstack([*cells, *[blank] * (_EACH - len(cells))]))
    write_png(folder / "trajectories.png", np.vstack(rows))


def _cell(title: str, scored: Scored, window: int, shapes: Mapping[str, ObjectShape]) -> UInt8[np.ndarray, "h w 3"]:
    """Draw one window from above: starts (grey), true ends (green), predicted ends (red)."""
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


REPORT_FILE = "dynamics.json"
COUNTS = (2, 3, 4, 6)  # objects in a scene
_STEPS = 50
_OTHERS = 2  # objects beside unseen ones
_UNSEEN = "unseen"


@dataclass(frozen=True, slots=True)
class EvaluateDynamics:
    """What to measure.

    Attributes:
        folder: for episodes, pictures and dynamics.json; those of the paper's method go into its folder "paper".
        tasks: episodes of each policy with three objects, and of both together with other numbers.
        seed: of the episodes.
        names: objects; all that have a field and a mesh if None.
        data_dir: where a network trained on this machine may be.
        method: whose predictions.
        simulator: what moves the objects.
    """

    folder: Path
    tasks: int = 20
    seed: int = 0
    names: tuple[str, ...] | None = None
    data_dir: Path | None = None
    method: DynamicsMethod = "ours"
    simulator: Simulator = field(default_factory=default_simulator)

    @property
    def results(self) -> Path:
        """Folder for pictures and dynamics.json."""
        return self.folder if self.method == "ours" else self.folder / self.method


class _Set(NamedTuple):
    """Episodes of one kind; the key names their policy and number of objects."""

    key: str
    policy: Literal["directed", "paper"]
    objects: int
    episodes: int
    names: tuple[str, ...]


def evaluate_dynamics(
    config: EvaluateDynamics, fields: FieldLibrary, assets: AssetLibrary, executor: Executor | None = None
) -> Iterator[EvaluationStep[dict[str, Any]]]:
    """Collect, predict and score; pictures and dynamics.json go to `config.results`.

    Args:
        config: what to measure.
        fields: shapes come from them.
        assets: meshes for the simulator.
        executor: simulates episodes side by side, if given.

    Raises:
        UnknownName, MissingAssets: if an object lacks a field or a mesh.
        InvalidInput: if a number is out of range.
        CorruptFile, CannotWrite: as files are.
    """
    check_run(config.tasks, config.seed)
    if config.method not in METHODS:
        raise InvalidInput("method", repr(config.method), f"one of {', '.join(METHODS)}")
    names = chosen_objects(config.names, fields, assets)
    if len(names) < min(COUNTS) + 1:
        raise InvalidInput("number of objects with a field and a mesh", len(names), f"at least {min(COUNTS) + 1}")
    # Objects that the second shipped network has not seen, as far as they are there; the paper's has none.
    hidden = read_metrics(shipped(UNSEEN_NETWORK)).get("without", ()) if config.method == "ours" else ()
    unseen = tuple(name for name in hidden if name in names)
    sets = _sets(config, names, unseen)
    total = 2 * len(sets) + 1
    for done, entry in enumerate(sets):
        if not (path := _path(config, entry)).exists():
            seed = stream_seed(config.seed, Stream.HELD_OUT_PUSHES, entry.objects, int(entry.policy == "paper"))
            pushes = CollectPushes(
                path, entry.episodes, _STEPS, entry.objects, entry.policy, seed, names=entry.names,
                simulator=config.simulator,
            )  # fmt: skip
            for step in collect_pushes(pushes, assets, executor):
                yield EvaluationStep(done, total, f"Pushes, {entry.objects} objects: {step.note}")
    shapes = load_shapes(config.data_dir, fields, names)
    predictor = load_predictor(config.method, config.data_dir, fields, shapes)
    scored: dict[str, Scored] = {}
    for done, entry in enumerate(sets, len(sets)):
        yield EvaluationStep(done, total, f"Predicting {entry.policy} pushes of {entry.objects} objects")
        windows = windows_of(read_pushes(_path(config, entry)))
        symmetries = {name: assets.info(name).symmetry for name in entry.names}
        network = predictor.predict(windows)
        predictions = {"network": network, "constant": constant(windows), "analytic": analytic(shapes, windows)}
        if entry.key == _UNSEEN:
            predictions["without"] = learned(read_network(shipped(UNSEEN_NETWORK)), shapes, windows)
        found = {who: errors(windows, predicted, symmetries) for who, predicted in predictions.items()}
        scored[entry.key] = Scored(windows, network, found)
    yield EvaluationStep(total - 1, total, "Timing rollouts")
    bench_shapes = load_shapes(config.data_dir, fields, BENCH_NAMES)
    timed = load_predictor(config.method, config.data_dir, fields, bench_shapes).model
    report = DynamicsReport(
        by_set={key: value for key, value in scored.items() if key != _UNSEEN},
        unseen=scored.get(_UNSEEN),
        unseen_names=unseen,
        rollout_steps_per_s=bench_rollouts(timed, bench_shapes).rollout_steps_per_s,
        holds_out_pairs=config.method == "ours",
    )
    write_plots(config.results, report)
    write_gallery(config.results, report, shapes)
    figures = report_json(report)
    write_json(config.results / REPORT_FILE, figures)
    yield EvaluationStep(total, total, "Everything is measured", figures)


def _sets(config: EvaluateDynamics, names: tuple[str, ...], unseen: tuple[str, ...]) -> list[_Set]:
    sets = []
    for objects in (count for count in COUNTS if count <= len(names)):
        share = config.tasks if objects == 3 else -(-config.tasks // 2)
        sets += [_Set(f"{policy} {objects}", policy, objects, share, names) for policy in ("directed", "paper")]
    if unseen:
        others = tuple(name for name in names if name not in unseen)[:: max(len(names) // _OTHERS, 1)][:_OTHERS]
        sets.append(_Set(_UNSEEN, "directed", 3, config.tasks, tuple(sorted((*unseen, *others)))))
    return sets


def _path(config: EvaluateDynamics, entry: _Set) -> Path:
    """Return where the episodes of a set are kept; the name holds all that they depend on."""
    which = hashlib.sha256(" ".join(entry.names).encode()).hexdigest()[:8]
    engine = "" if config.simulator == "pybullet" else f"-{config.simulator}"
    return config.folder / f"pushes-{entry.key.replace(' ', '-')}-{entry.episodes}-{config.seed}-{which}{engine}.h5"
