"""state.json: what an estimator believes as a file, checked when read.

    {"objects": [{"name", "position": [3], "quaternion": [w, x, y, z], "doubt": "",
                  "uncertainty": {"position_std_m", "rotation_std_rad"}}],
     "light": {"position": [3], "uncertainty": {"direction_std_rad"}}, "pusher": {"position": [3]},
     "trusted": true, "reason": ""}

It is a scene.json without cameras, with more to it: whatever reads scenes reads it too. A plain scene.json is a state
without uncertainty that is trusted. An uncertainty of null is one without bounds, for JSON has no infinity.
"""

from __future__ import annotations

from pathlib import Path
from typing import Any

import numpy as np

from osfcore.errors import InvalidInput, shown
from osfcore.geometry.estimated_state import EstimatedState
from osfcore.io.files import as_mapping, read_json, write_json
from osfcore.io.scene_file import Scene, scene_from_json, scene_to_json


def estimated_to_json(estimated: EstimatedState) -> dict[str, Any]:
    """The state as plain lists and numbers."""
    result = scene_to_json(Scene(estimated.state, ()))
    del result["cameras"]
    deviations = zip(estimated.position_std, estimated.rotation_std, estimated.doubts, strict=True)
    for entry, (position, rotation, doubt) in zip(result["objects"], deviations, strict=True):
        entry["uncertainty"] = {"position_std_m": _number(position), "rotation_std_rad": _number(rotation)}
        entry["doubt"] = doubt
    result["light"]["uncertainty"] = {"direction_std_rad": _number(estimated.light_std)}
    return {**result, "trusted": estimated.trusted, "reason": estimated.reason}


def estimated_from_json(data: object) -> EstimatedState:
    """The state of parsed JSON.

    Raises:
        InvalidInput: if something is missing or out of range; the message names it.
    """
    state = scene_from_json(data).state
    root = as_mapping(data, "state")
    objects = root["objects"]
    position = [_deviation(entry, "position_std_m", shown(entry["name"])) for entry in objects]
    rotation = [_deviation(entry, "rotation_std_rad", shown(entry["name"])) for entry in objects]
    light = _deviation(root["light"], "direction_std_rad", "light")
    doubts = tuple(_text(entry, "doubt", shown(entry["name"])) for entry in objects)
    return EstimatedState(state, np.array(position), np.array(rotation), light, doubts, _reason(root))


def is_estimated(data: object) -> bool:
    """Whether parsed JSON says how far a state may be trusted, as a scene.json does not."""
    return isinstance(data, dict) and ("trusted" in data or "reason" in data)


def read_estimated(path: Path) -> EstimatedState:
    """The state in a file; also of a scene.json.

    Raises:
        CorruptFile: if it cannot be read or is neither; the message says why.
    """
    return read_json(path, estimated_from_json)


def write_estimated(path: Path, estimated: EstimatedState) -> None:
    """Write a state; the file appears only when it is whole.

    Raises:
        CannotWrite: if the disk refuses.
    """
    write_json(path, estimated_to_json(estimated))


def _number(value: float) -> float | None:
    return float(value) if np.isfinite(value) else None


def _deviation(entry: dict[str, Any], key: str, what: str) -> float:
    """A standard deviation; 0 where nothing is said of it."""
    value = as_mapping(entry.get("uncertainty", {}), f"uncertainty of {what}").get(key, 0.0)
    if value is None:
        return float("inf")
    is_number = isinstance(value, int | float) and not isinstance(value, bool)
    if not is_number or not 0 <= value < 1e300:  # also false for NaN
        raise InvalidInput(f"{key} of {what}", shown(repr(value)), "a finite number of at least 0, or null")
    return float(value)


def _text(entry: dict[str, Any], key: str, what: str) -> str:
    value = entry.get(key, "")
    if not isinstance(value, str):
        raise InvalidInput(f"{key} of {what}", shown(repr(value)), "a text")
    return value


def _reason(root: dict[str, Any]) -> str:
    reason = _text(root, "reason", "state")
    trusted = root.get("trusted", not reason)
    if not isinstance(trusted, bool):
        raise InvalidInput("trusted", shown(repr(trusted)), "true or false")
    if trusted == bool(reason):
        raise InvalidInput(
            "reason", shown(repr(reason)), "empty where trusted is true and a sentence where it is false"
        )
    return reason
