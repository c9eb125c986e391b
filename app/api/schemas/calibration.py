"""Requests and responses that concern the calibration of a camera."""

from __future__ import annotations

from typing import Annotated

from pydantic import BaseModel, ConfigDict, Field, FiniteFloat

from app.api.schemas.common import Input
from app.api.schemas.limits import BOARD_PHOTOS, BOARD_PLACE_M, BOARD_TURN_DEG, FOCAL, GOAL_NAME, NAME, sized, within
from osfcore.photo.calibration import Calibration, CalibrationJson, Sighting, calibration_to_json

Identifier = Annotated[str, Field(**sized(NAME))]


class CameraIn(BaseModel):
    """A calibrated camera, as a calibration tells it; what it says of its accuracy does not matter."""

    model_config = ConfigDict(extra="ignore", strict=True)

    name: str = Field(**sized(GOAL_NAME))
    T_world_camera: list[list[FiniteFloat]] | None = None
    K: list[list[FiniteFloat]]
    width: int = Field(**within(FOCAL))
    height: int = Field(**within(FOCAL))
    radial: FiniteFloat = 0.0


class SightingOut(BaseModel):
    """The board in a photo."""

    id: str = Field(description="Identifier; it is forgotten when the service ends.")
    name: str
    width: int = Field(description="Of the photo as it was sent [px].")
    height: int = Field(description="[px]")
    corners: list[list[float]] = Field(description="Of the board's squares [px].")

    @staticmethod
    def of(identifier: str, seen: Sighting) -> SightingOut:
        """From the core's own."""
        width, height = seen.size
        corners = seen.points_px.round(2).tolist()
        return SightingOut(id=identifier, name=seen.name, width=width, height=height, corners=corners)


class PlaceIn(Input):
    """Where the board's centre lies on the table."""

    x_m: float = Field(0.0, **within(BOARD_PLACE_M))
    y_m: float = Field(0.0, **within(BOARD_PLACE_M))
    turn_deg: float = Field(0.0, **within(BOARD_TURN_DEG), description="To the left, seen from above.")


class CalibrateIn(Input):
    """Photos of the board by one camera."""

    photos: list[Identifier] = Field(**sized(BOARD_PHOTOS))
    table: Identifier | None = Field(None, description="The board lying on the table; tells where the camera stands.")
    place: PlaceIn = Field(default_factory=lambda: PlaceIn(x_m=0.0, y_m=0.0, turn_deg=0.0))
    name: str = Field("camera", **sized(GOAL_NAME), description="Of the camera.")


class AdviceOut(BaseModel):
    """What to photograph next."""

    words: str = Field(description="The end of a sentence.")
    expected_error_mm: float = Field(description="Mean error on the table after that.")


class CalibrationOut(BaseModel):
    """What the photos tell so far."""

    missing: str = Field(description="Why they do not suffice, a sentence; empty where they do.")
    next: AdviceOut | None = Field(description="Null if nothing helps.")
    camera: CalibrationJson = Field(description="As `osf photo estimate --camera` takes it, if nothing is missing.")

    @staticmethod
    def of(found: Calibration, name: str) -> CalibrationOut:
        """From the core's own."""
        camera = CalibrationJson.model_validate(calibration_to_json(found, name))
        advice = found.advice
        following = None if advice is None else AdviceOut(words=advice.words, expected_error_mm=1e3 * advice.mean_m)
        return CalibrationOut(missing=found.missing, next=following, camera=camera)
