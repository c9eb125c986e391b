"""What the evaluation of predicted pushes amounts to."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from typing import Any

import numpy as np
from jaxtyping import Bool, Float

from osfcore.dynamics.training.holdout import has_held_out_pair
from osfcore.experiments.dynamics.scores import HORIZONS, LONGEST, Errors, Predicted, Windows

_TOLD = (1, 4, 10, 30)
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

    def of_count(self, objects: int) -> list[Scored]:
        """Both policies with that many objects."""
        return [scored for key, scored in self.by_set.items() if key.endswith(f" {objects}")]


def report_json(report: DynamicsReport) -> dict[str, Any]:
    """The report as plain numbers: millimetres and degrees; null for what was not measured."""
    main = report.of_count(3)
    result: dict[str, Any] = {"windows": _windows(main, 4)}
    for horizon in _TOLD:
        result |= _figures(main, horizon)
    still = np.concatenate([scored.errors["network"].of_still(LONGEST) for scored in main])
    result["still_drift_mm_30"] = _rounded(np.mean(still)) if len(still) else None
    result["still_drift_median_mm_30"] = _median([still])
    result["still_windows_30"] = len(still)
    for horizon in _TOLD:
        result[f"constant_mm_{horizon}"] = _median(_moved(main, "constant", horizon))
        result[f"analytic_mm_{horizon}"] = _median(_moved(main, "analytic", horizon))
        result[f"analytic_deg_{horizon}"] = _median(_moved(main, "analytic", horizon, deg=True))
    result["rollout_steps_per_s"] = round(report.rollout_steps_per_s)
    result["by_objects"] = {str(count): _row(report.of_count(count)) for count in _counts(report)}
    result["by_policy"] = {key.split()[0]: _row([s]) for key, s in report.by_set.items() if key.endswith(" 3")}
    result["by_name"] = _by_name(main)
    result["unseen_pairs"] = _pairs(list(report.by_set.values()) if report.holds_out_pairs else [])
    return result | _unseen(report)


def _counts(report: DynamicsReport) -> list[int]:
    return sorted({int(key.split()[1]) for key in report.by_set})


def _figures(scored: Sequence[Scored], horizon: int) -> dict[str, Any]:
    mm, deg = _moved(scored, "network", horizon), _moved(scored, "network", horizon, deg=True)
    return {
        f"median_mm_{horizon}": _median(mm),
        f"median_deg_{horizon}": _median(deg),
        f"mean_mm_{horizon}": _mean(mm),
        f"mean_deg_{horizon}": _mean(deg),
        f"windows_{horizon}": _windows(scored, horizon),
    }


def _row(scored: Sequence[Scored]) -> dict[str, Any]:
    """The main figures of some sets."""
    return {
        "windows": _windows(scored, 4),
        "median_mm_4": _median(_moved(scored, "network", 4)),
        "median_deg_4": _median(_moved(scored, "network", 4, deg=True)),
        "median_mm_10": _median(_moved(scored, "network", 10)),
        "constant_mm_4": _median(_moved(scored, "constant", 4)),
        "analytic_mm_4": _median(_moved(scored, "analytic", 4)),
    }


def _moved(scored: Sequence[Scored], who: str, horizon: int, *, deg: bool = False) -> list[Float[np.ndarray, "_"]]:
    return [s.errors[who].of_moved(horizon, deg=deg) for s in scored]


def _windows(scored: Sequence[Scored], horizon: int) -> int:
    return sum(len(values) for values in _moved(scored, "network", horizon))


def _by_name(scored: Sequence[Scored]) -> dict[str, Any]:
    """Errors after four actions of each object."""
    names = sorted({name for s in scored for row in s.windows.names for name in row})
    rows = {}
    for name in names:
        mm, deg = (np.concatenate([_at(s, "network", _is(s, (name,)), deg=d) for s in scored]) for d in (False, True))
        rows[name] = {"windows": len(mm), "median_mm_4": _median([mm]), "median_deg_4": _median([deg])}
    return rows


def _pairs(scored: Sequence[Scored]) -> dict[str, Any]:
    """Scenes in which two objects meet that never do in training."""
    masks = [_held_out(s) for s in scored]
    mm = [_at(s, "network", mask) for s, mask in zip(scored, masks, strict=True)]
    way = [_at(s, "constant", mask) for s, mask in zip(scored, masks, strict=True)]
    return {"windows": sum(map(len, mm)), "median_mm_4": _median(mm), "constant_mm_4": _median(way)}


def _held_out(scored: Scored) -> Bool[np.ndarray, "W N"]:
    rows = np.array([has_held_out_pair(names) for names in scored.windows.names])
    return np.repeat(rows[:, None], len(scored.windows.names[0]), axis=1)


def _unseen(report: DynamicsReport) -> dict[str, Any]:
    """What it costs never to have seen an object: the same windows by both networks."""
    if report.unseen is None:
        return {"unseen_objects": [], "unseen_objects_mm_4": None, "unseen_objects_windows": 0,
                "unseen_objects_deg_4": None, "seen_objects_mm_4": None, "seen_objects_deg_4": None}  # fmt: skip
    chosen = _is(report.unseen, report.unseen_names)
    mm = {who: _at(report.unseen, who, chosen) for who in ("without", "network")}
    deg = {who: _at(report.unseen, who, chosen, deg=True) for who in ("without", "network")}
    return {
        "unseen_objects": list(report.unseen_names),
        "unseen_objects_windows": len(mm["without"]),
        "unseen_objects_mm_4": _median([mm["without"]]),
        "unseen_objects_deg_4": _median([deg["without"]]),
        "seen_objects_mm_4": _median([mm["network"]]),
        "seen_objects_deg_4": _median([deg["network"]]),
    }


def _is(scored: Scored, names: Sequence[str]) -> Bool[np.ndarray, "W N"]:
    return np.array([[name in names for name in row] for row in scored.windows.names])


def _at(scored: Scored, who: str, chosen: Bool[np.ndarray, "W N"], *, deg: bool = False) -> Float[np.ndarray, "M"]:
    """Errors after four actions of chosen objects that truly moved."""
    errors, at = scored.errors[who], HORIZONS.index(4)
    return (errors.deg if deg else errors.mm)[at][errors.moved[at] & errors.valid[at] & chosen]


def _median(parts: Sequence[Float[np.ndarray, "_"]]) -> float | None:
    values = np.concatenate(parts) if parts else np.zeros(0)
    return _rounded(np.median(values)) if len(values) else None


def _mean(parts: Sequence[Float[np.ndarray, "_"]]) -> float | None:
    values = np.concatenate(parts) if parts else np.zeros(0)
    return _rounded(np.mean(values)) if len(values) else None


def _rounded(value: float | np.floating) -> float:
    return round(float(value), _DIGITS)
