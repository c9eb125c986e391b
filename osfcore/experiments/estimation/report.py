"""What the parts of the evaluation of estimators amount to."""

from __future__ import annotations

from collections.abc import Iterable, Mapping, Sequence
from dataclasses import dataclass, field
from typing import Any

import numpy as np

from osfcore.experiments.estimation.scores import (
    FrameScore,
    TrackScore,
    coverage,
    flagged_shares,
    is_right,
    median,
    objects_of,
    quantile,
    ratios_of,
    share_right,
)
from osfcore.experiments.estimation.spoiled_inputs import BadScore, summary

DRIFT_STEPS = (5, 10, 15, 20)
_OF = ("median", "mean", "p90", "p95")
_MOVED_M = 0.01
_LIGHT_DEG = 10.0


@dataclass(frozen=True, eq=False, slots=True)
class EstimateReport:
    """The scores of all tasks; None for parts that were not asked for.

    Attributes:
        first: one first frame for each task, from all cameras.
        tracks: one episode for each task.
        goals: each task's goals, which move one object, two, and so on.
        fixed_light: first frames with the light held overhead.
        views: first frames from fewer cameras, by their number.
        bad: spoiled inputs.
        factors: first frames under factors of variation, by name.
    """

    first: tuple[FrameScore, ...]
    tracks: tuple[TrackScore, ...] | None = None
    goals: tuple[tuple[FrameScore, ...], ...] | None = None
    fixed_light: tuple[FrameScore, ...] | None = None
    views: Mapping[int, tuple[FrameScore, ...]] | None = None
    bad: tuple[BadScore, ...] | None = None
    factors: Mapping[str, tuple[FrameScore, ...]] = field(default_factory=dict)

    @property
    def all_goals(self) -> tuple[FrameScore, ...]:
        """The goals of all tasks in one row."""
        return tuple(goal for task in self.goals or () for goal in task)

    def by_views(self) -> dict[int, tuple[FrameScore, ...]]:
        """First frames by number of cameras, the main ones among them."""
        cameras = 4  # the default ones
        return {**(self.views or {}), cameras: self.first}

    def to_json(self) -> dict[str, Any]:
        """The report as plain numbers: millimetres, degrees, seconds, shares in [0, 1]; null for what was not measured.

        `flagged_good` and `flagged_bad` are over first frames and goals together.
        """
        flagged_good, flagged_bad = flagged_shares([*self.first, *self.all_goals])
        return {
            "tasks": len(self.first),
            **_frames(self.first, "first"),
            "by_object": _by_object(self.first),
            **_uncertainty(self.first),
            **_goals(self.goals),
            "flagged_good": flagged_good,
            "flagged_bad": flagged_bad,
            **_tracks(self.tracks),
            "frac_1cm_5deg_fixed_light": None if self.fixed_light is None else share_right(self.fixed_light),
            "fixed_light": None if self.fixed_light is None else _brief(self.fixed_light),
            "by_views": None if self.views is None else {str(n): _brief(f) for n, f in self.by_views().items()},
            **(summary(self.bad) if self.bad is not None else {}),
            **({"by_factor": {name: _varied(frames) for name, frames in self.factors.items()}} if self.factors else {}),
        }


def _frames(frames: Sequence[FrameScore], what: str) -> dict[str, Any]:
    objects = objects_of(frames)
    position, rotation = [o.position_mm for o in objects], [o.rotation_deg for o in objects]
    return {
        "objects_total": sum(len(frame.names) for frame in frames),
        "frac_1cm_5deg": share_right(frames),
        **_spread("position_mm", position),
        **_spread("rotation_deg", rotation),
        **_spread("adds_mm", [o.adds_mm for o in objects]),
        **_spread("light_deg", [frame.light_deg for frame in frames if frame.light_deg is not None]),
        **_spread(f"{what}_s", [frame.seconds for frame in frames]),
        f"{what}_refused": sum(bool(frame.refused) for frame in frames),
        f"{what}_out_of_view": sum(bool(o.absent) for o in objects),
    }


def _spread(what: str, values: Sequence[float]) -> dict[str, float | None]:
    """Median, mean and tails."""
    return {
        f"{what}_median": median(values),
        f"{what}_mean": float(np.mean(values)) if len(values) else None,
        f"{what}_p90": quantile(values, 0.9),
        f"{what}_p95": quantile(values, 0.95),
    }


def _by_object(frames: Sequence[FrameScore]) -> dict[str, dict[str, Any]]:
    """Of each object: how often it was seen, how often it was right, and its errors."""
    rows: dict[str, dict[str, Any]] = {}
    for name in sorted({name for frame in frames for name in frame.names}):
        own = [o for o in objects_of(frames) if o.name == name]
        shown = sum(name in frame.names for frame in frames)
        rows[name] = {
            "frames": shown,
            "frac_1cm_5deg": sum(o.is_right for o in own) / shown,
            **_spread("position_mm", [o.position_mm for o in own]),
            **_spread("rotation_deg", [o.rotation_deg for o in own]),
        }
    return rows


def _uncertainty(frames: Sequence[FrameScore]) -> dict[str, Any]:
    """How honest claimed deviations are, and how large; of right estimates alone."""
    ratios = ratios_of(frames)
    claimed = [o.position_std_mm for o in objects_of(frames) if o.is_right and o.position_std_mm is not None]
    return {
        "two_sigma_coverage": coverage(ratios.pooled),
        "two_sigma_coverage_position": coverage(ratios.position),
        "two_sigma_coverage_rotation": coverage(ratios.rotation),
        "two_sigma_coverage_light": coverage(ratios.light),
        "mean_position_std_mm": float(np.mean(claimed)) if claimed else None,
    }


def _goals(goals: Sequence[Sequence[FrameScore]] | None) -> dict[str, Any]:
    flat = [goal for task in goals or () for goal in task]
    row = _frames(flat, "goal")
    by_moved: dict[str, float | None] = {}
    for moved in range(max((len(task) for task in goals or ()), default=0)):
        by_moved[str(moved + 1)] = share_right([task[moved] for task in goals or () if len(task) > moved])
    errors = [f"{what}_{of}" for what in ("position_mm", "rotation_deg", "light_deg") for of in _OF]
    keys = ("frac_1cm_5deg", "objects_total", *errors)
    own = (*(f"goal_s_{of}" for of in _OF), "goal_refused", "goal_out_of_view")
    if goals is None:
        return {**dict.fromkeys([f"goal_{key}" for key in keys] + list(own)), "goal_frac_1cm_5deg_by_moved": None}
    return {
        **{f"goal_{key}": row[key] for key in keys},
        **{key: row[key] for key in own},
        "goal_frac_1cm_5deg_by_moved": by_moved,
    }


def _tracks(tracks: Sequence[TrackScore] | None) -> dict[str, Any]:
    """How tracking went.

    An episode is lost when one of its objects is; `track_lost_from_wrong_start` counts those among them whose lost
    objects were all wrong in the first frame already. Steps at which an object lay beside the table or hidden from all
    cameras are left out of drift and losses and counted here, as pairs of object and step.
    """
    keys = (
        "refine_hz", *(f"refine_s_{of}" for of in _OF), "track_episodes", "track_lost", "track_lost_from_wrong_start",
        "track_objects_lost", "track_frac_1cm_5deg", "track_off_table", "track_out_of_view", "drift_mm", "drift_deg",
        "track_moved", "track_resting",
    )  # fmt: skip
    if tracks is None:
        return dict.fromkeys(keys)
    seconds = [second for track in tracks for second in track.seconds]
    typical = median(seconds)
    lost = [[n for n, step in enumerate(track.lost_at) if step is not None] for track in tracks]
    pairs = list(zip(tracks, lost, strict=True))
    excused = [bool(gone) and not any(track.right_at_start[n] for n in gone) for track, gone in pairs]
    absent = [why for track in tracks for row in track.absent for why in row]
    right = [is_right(p, r) for track in tracks for step in range(len(track.seconds)) for p, r in _seen(track, step)]
    values = (
        1 / typical if typical else None, *_spread("", seconds).values(), len(tracks), sum(map(bool, lost)),
        sum(excused), sum(map(len, lost)), sum(right) / len(right) if right else None,
        absent.count("off the table"), absent.count("out of view"), drift(tracks, 0), drift(tracks, 1),
        _apart(tracks, has_moved=True), _apart(tracks, has_moved=False),
    )  # fmt: skip
    return dict(zip(keys, values, strict=True))


def drift(tracks: Iterable[TrackScore], which: int) -> dict[str, float | None]:
    """Median error of position [mm] (0) or rotation [deg] (1) over all visible objects, by step."""
    known = list(tracks)
    return {str(step): median(errors_at(known, step, which)) for step in DRIFT_STEPS}


def errors_at(tracks: Iterable[TrackScore], step: int, which: int) -> list[float]:
    """Errors of all visible objects at one step.

    Args:
        tracks: those that ended before this step have none.
        step: from 1.
        which: 0 for position [mm], 1 for rotation [deg].
    """
    return [pair[which] for track in tracks if len(track.seconds) >= step for pair in _seen(track, step - 1)]


def _apart(tracks: Sequence[TrackScore], *, has_moved: bool) -> dict[str, float | None]:
    """Errors over all steps of the objects that were pushed at least 1 cm away in their episode, or of all others."""
    rows = [
        (track.position_mm[step][n], track.rotation_deg[step][n])
        for track in tracks
        for n, way_m in enumerate(track.moved_m)
        if (way_m >= _MOVED_M) == has_moved
        for step in range(len(track.seconds))
        if not track.absent[step][n]
    ]
    position, rotation = ([row[k] for row in rows] for k in (0, 1))
    return {**_spread("position_mm", position), **_spread("rotation_deg", rotation)}


def _seen(track: TrackScore, step: int) -> list[tuple[float, float]]:
    """Errors at a step of the objects that some image shows."""
    rows = zip(track.position_mm[step], track.rotation_deg[step], track.absent[step], strict=True)
    return [(position, rotation) for position, rotation, why in rows if not why]


def _brief(frames: Sequence[FrameScore]) -> dict[str, Any]:
    row = _frames(frames, "first")
    keys = (
        "frac_1cm_5deg", "position_mm_median", "rotation_deg_median", "adds_mm_median", "light_deg_median",
        "first_s_median", "first_refused",
    )  # fmt: skip
    return {key: row[key] for key in keys}


def _varied(frames: Sequence[FrameScore]) -> dict[str, Any]:
    """As `_brief`, with the share of lights that are right, and objects that are wrong without a warning."""
    lights = [frame.light_deg for frame in frames]
    objects = objects_of(frames)
    return {
        **_brief(frames),
        "objects_total": sum(len(frame.names) for frame in frames),
        "light_frac_10deg": sum(deg is not None and deg < _LIGHT_DEG for deg in lights) / max(len(lights), 1),
        "light_deg_max": max((deg for deg in lights if deg is not None), default=None),
        "wrong_unflagged": sum(not o.is_right and not o.flagged for o in objects),
        "right_flagged": sum(o.is_right and o.flagged for o in objects),
    }
