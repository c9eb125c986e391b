"""Requests and responses that concern a robot."""

from __future__ import annotations

import time
from typing import Annotated

from pydantic import BaseModel, Field, FiniteFloat

from app.api.schemas.common import Input, ObjectName, Seed
from app.api.schemas.jobs import JobOut
from app.api.schemas.limits import HORIZON, NAME, OBJECTS, PIXEL, SAMPLES, STEPS, sized, within
from app.services.robots.robot_pictures import CameraNow
from app.services.robots.robot_table import AskedDrive, RobotNow, State
from app.storage.database import utc_of
from osfcore.io.scene_file import CameraJson, camera_to_json

Pixel = Annotated[FiniteFloat, Field(**within(PIXEL))]
Box = Annotated[list[Pixel], Field(min_length=4, max_length=4, description="Left, top, right, bottom [px].")]
Name = Annotated[str, Field(**sized(NAME))]


class RobotSettingsIn(Input):
    """What shall be other than by default."""

    steps: int | None = Field(None, **within(STEPS), description="Actions at most, of 0.2 s each.")
    samples: int | None = Field(None, **within(SAMPLES), description="Sequences of actions in each round of a plan.")
    horizon: int | None = Field(None, **within(HORIZON), description="Actions in each.")
    despite_doubts: bool | None = Field(None, description="Go on with a goal image that is not explained well.")


class RobotEpisodeIn(Input):
    """An episode with the robot."""

    goal: str = Field(**sized(NAME), description="Identifier of a goal image that one of the robot's cameras took.")
    names: list[ObjectName] = Field(**sized(OBJECTS), description="Objects on the robot's table.")
    boxes: dict[Name, dict[Name, Box]] = Field(
        default={}, max_length=16, description="By camera and object, as the table lies, if it delivers no masks."
    )
    seed: Seed = 0
    settings: RobotSettingsIn = RobotSettingsIn()  # pyright: ignore[reportCallIssue]

    def asked(self) -> AskedDrive:
        """What the service's own modules take."""
        boxes = {
            camera: {name: (box[0], box[1], box[2], box[3]) for name, box in of.items()}
            for camera, of in self.boxes.items()
        }
        return AskedDrive(self.goal, tuple(self.names), boxes, self.seed, self.settings.model_dump(exclude_none=True))


class ConfirmationIn(Input):
    """Permission to move."""

    episode: str = Field(**sized(NAME), description="Identifier of the episode that asks.")


class RobotLimitsOut(BaseModel):
    """What holds for the robot's pusher, whatever is planned."""

    box: list[float] = Field(description="x0, y0, x1, y1 of the pusher's centre [m].")
    top_speed_m_s: float


class RobotCameraOut(BaseModel):
    """A camera of the robot, and when it saw what its picture shows."""

    name: str
    width: int = Field(description="Of its picture [px].")
    height: int = Field(description="[px]")
    seen_at: str | None = Field(description="UTC, ISO 8601; null if it has shown nothing yet.")
    age_s: float | None = Field(description="How long ago that was, by the clock of the service [s].")

    @staticmethod
    def of(now: CameraNow) -> RobotCameraOut:
        """From the service's own."""
        camera, at_s = now.camera, None if now.picture is None else now.picture.at_s
        seen_at = None if at_s is None else utc_of(at_s)
        age_s = None if at_s is None else max(0.0, time.time() - at_s)
        return RobotCameraOut(name=camera.name, width=camera.width, height=camera.height, seen_at=seen_at, age_s=age_s)


class RobotOut(BaseModel):
    """The robot as it is now."""

    host: str | None = Field(description="Where it is; null if the service has none.")
    state: State = Field(
        description='"looking" before anything may move, "asked" while it waits for permission, "driving", '
        '"stopped", "lost" if it does not answer, else "idle".'
    )
    text: str = Field(description="What it does, or what happened, for a person.")
    limits: RobotLimitsOut | None
    cameras: list[CameraJson]
    masks: list[str] = Field(description="Objects whose masks it delivers; where others lie, boxes are needed.")
    deadman_s: float | None = Field(description="Without a new command it halts after this time [s].")
    episode: JobOut | None = Field(description="The job that drives it now, or did last.")

    @staticmethod
    def of(now: RobotNow) -> RobotOut:
        """From the service's own."""
        about, limits = now.description, now.limits
        return RobotOut(
            host=now.host,
            state=now.state,
            text=now.text,
            limits=None if limits is None else RobotLimitsOut.model_validate(limits, from_attributes=True),
            cameras=[] if about is None else [CameraJson.model_validate(camera_to_json(c)) for c in about.cameras],
            masks=[] if about is None else sorted(about.masks),
            deadman_s=None if about is None else about.deadman_s,
            episode=None if now.episode is None else JobOut.of(now.episode),
        )
