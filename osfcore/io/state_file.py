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
from typing import Annotated, Any

import numpy as np
from pydantic import Field, FiniteFloat, model_validator

from osfcore.errors import InvalidInput, shown
from osfcore.geometry.estimated_state import EstimatedState
from osfcore.io.files import read_json, write_json
from osfcore.io.json_codec import Entry, Text, decode, encode
from osfcore.io.scene_file import ObjectJson, PointJson, StateJson, posed_objects, pusher_of

_Deviation = Annotated[FiniteFloat, Field(ge=0)]


class PoseUncertaintyJson(Entry):
    """Standard deviations; null for one without bounds."""

    position_std_m: _Deviation | None = Field(default=0.0, description="Per axis [m].")
    rotation_std_rad: _Deviation | None = Field(default=0.0, description="Per axis of a small rotation [rad].")


class EstimatedObjectJson(ObjectJson):
    """Where an object is believed to be."""

    uncertainty: PoseUncertaintyJson = PoseUncertaintyJson()
    doubt: Text = Field(default="", description="Why not to trust it; empty where it may be.")


class LightUncertaintyJson(Entry):
    """Standard deviation; null for one without bounds."""

    direction_std_rad: _Deviation | None = Field(default=0.0, description="Per axis [rad].")


class EstimatedLightJson(PointJson):
    """Where the light is believed to be, 1 m from the table's centre."""

    uncertainty: LightUncertaintyJson = LightUncertaintyJson()


class EstimateJson(StateJson):
    """A state and how far it can be trusted."""

    objects: list[EstimatedObjectJson]  # pyright: ignore[reportIncompatibleVariableOverride]
    light: EstimatedLightJson  # pyright: ignore[reportIncompatibleVariableOverride]
    trusted: bool
    reason: Text = Field(default="", description="Why not to trust it; empty where it may be.")

    @model_validator(mode="before")
    @classmethod
    def _trusted_without_a_reason_not_to(cls, data: object) -> object:
        return {"trusted": not data.get("reason"), **data} if isinstance(data, dict) else data

    @staticmethod
    def of_estimate(estimated: EstimatedState) -> EstimateJson:
        """From an estimate."""
        state, light_std = estimated.state, LightUncertaintyJson(direction_std_rad=_bounded(estimated.light_std))
        deviations = zip(estimated.position_std, estimated.rotation_std, estimated.doubts, strict=True)
        return EstimateJson(
            objects=[
                EstimatedObjectJson(
                    **dict(entry),
                    uncertainty=PoseUncertaintyJson(position_std_m=_bounded(m), rotation_std_rad=_bounded(rad)),
                    doubt=doubt,
                )
                for entry, (m, rad, doubt) in zip(posed_objects(state), deviations, strict=True)
            ],
            light=EstimatedLightJson(position=state.light.position.tolist(), uncertainty=light_std),
            **pusher_of(state),
            trusted=estimated.trusted,
            reason=estimated.reason,
        )

    def estimate(self) -> EstimatedState:
        """The estimate.

        Raises:
            InvalidInput: if a value is out of range, or `trusted` and `reason` contradict each other.
        """
        if self.trusted == bool(self.reason):
            allowed = "empty where trusted is true and a sentence where it is false"
            raise InvalidInput("reason", shown(repr(self.reason)), allowed)
        position = [_unbounded(entry.uncertainty.position_std_m) for entry in self.objects]
        rotation = [_unbounded(entry.uncertainty.rotation_std_rad) for entry in self.objects]
        light = _unbounded(self.light.uncertainty.direction_std_rad)
        doubts = tuple(entry.doubt for entry in self.objects)
        return EstimatedState(self.state(), np.array(position), np.array(rotation), light, doubts, self.reason)


def _bounded(value: float) -> float | None:
    return float(value) if np.isfinite(value) else None


def _unbounded(value: float | None) -> float:
    return np.inf if value is None else value


def estimated_to_json(estimated: EstimatedState) -> dict[str, Any]:
    """The state as plain lists and numbers."""
    return encode(EstimateJson.of_estimate(estimated))


def estimated_from_json(data: object) -> EstimatedState:
    """The state of parsed JSON.

    Raises:
        InvalidInput: if something is missing or out of range; the message names it.
    """
    return decode(EstimateJson, data, "state").estimate()


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
