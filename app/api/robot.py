"""A robot: how it is, an episode with it, permission for its first motion, and a stop that anybody may call."""

from __future__ import annotations

import time
from typing import Annotated

from fastapi import APIRouter, Depends, Header, Path, Response
from pydantic import BaseModel, Field

from osfcore.io.scene_file import CameraJson

from ..episodes.settings import ChosenSettings
from ..jobs.params import Identifier, Seed
from ..services.robot import AskedDrive, CameraNow, RobotNow, State
from ..storage.database import utc_of
from .bodies import JPEG, BoundedRoute
from .dependencies import VISITOR_HEADER, ServicesDep, only_the_driver, slow, urgent
from .jobs import JobOut
from .models import Box, Horizon, Input, ObjectNames, Samples, Steps, Visitor
from .problems import named_in_path, problems


class RobotSettingsIn(Input):
    """What shall be other than by default."""

    steps: Steps | None = Field(None, description="Actions at most, of 0.2 s each.")
    samples: Samples | None = Field(None, description="Sequences of actions in each round of a plan.")
    horizon: Horizon | None = Field(None, description="Actions in each.")
    despite_doubts: bool | None = Field(None, description="Go on with a goal image that is not explained well.")


class RobotEpisodeIn(Input):
    """An episode with the robot."""

    goal: Identifier = Field(description="Identifier of a goal image that one of the robot's cameras took.")
    names: ObjectNames = Field(description="Objects on the robot's table.")
    boxes: dict[Identifier, dict[Identifier, Box]] = Field(
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
        settings = ChosenSettings.defaults().changed(self.settings.model_dump(exclude_none=True))
        return AskedDrive(self.goal, tuple(self.names), boxes, self.seed, settings)


class ConfirmationIn(Input):
    """Permission to move."""

    episode: Identifier = Field(description="Identifier of the episode that asks.")


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
            cameras=[] if about is None else [CameraJson.of(camera) for camera in about.cameras],
            masks=[] if about is None else sorted(about.masks),
            deadman_s=None if about is None else about.deadman_s,
            episode=None if now.episode is None else JobOut.of(now.episode),
        )


router = APIRouter(prefix="/api/robot", tags=["robot"], responses=problems(), route_class=BoundedRoute)
_DRIVER = [Depends(only_the_driver)]
Page = Annotated[Visitor | None, Header(alias=VISITOR_HEADER, description="What a page calls itself.")]


@router.get("")
@slow
def get(services: ServicesDep) -> RobotOut:
    """Return which robot there is, its limits, and what it does. `host` is null where the service has none."""
    return RobotOut.of(services.robot.now())


@router.get("/cameras", responses=problems(404, 503))
@slow
def cameras(services: ServicesDep) -> list[RobotCameraOut]:
    """Return for each camera when it saw what its picture shows.

    While an episode looks or moves that is its own last look, for nothing shall hold up the robot; else the robot looks
    now, at most once a second.
    """
    return [RobotCameraOut.of(now) for now in services.robot.pictures.all()]


@router.get("/cameras/{name:path}.jpg", response_class=Response, responses={**problems(404, 503), **JPEG})
@slow
def picture(
    services: ServicesDep, name: Annotated[str, Path(description="Name of one of the robot's cameras.")]
) -> Response:
    """Show what a camera of the robot saw last; when that was, and when the robot looks, is as for all of them."""
    with named_in_path():
        seen = services.robot.pictures.one(name)
    return Response(seen.jpeg, media_type="image/jpeg", headers={"Cache-Control": "no-store"})


@router.post("/episodes", status_code=202, responses=problems(404, 409, 429, 503, 507), dependencies=_DRIVER)
@slow
def create(services: ServicesDep, body: RobotEpisodeIn) -> RobotOut:
    """Queue an episode: it looks, plans, and then asks; nothing moves before it is allowed."""
    return RobotOut.of(services.robot.begin(body.asked()))


@router.post("/confirmation", responses=problems(404, 409), dependencies=_DRIVER)
@urgent
def allow(services: ServicesDep, body: ConfirmationIn, page: Page = None) -> RobotOut:
    """Let the robot move. A page that does so must confirm every second that it is there, or the robot is stopped."""
    return RobotOut.of(services.robot.allow(body.episode, page))


@router.post("/stop")
@urgent
def stop(services: ServicesDep) -> RobotOut:
    """Stop the robot at once, whoever drives and whatever else is at work; again if one likes."""
    return RobotOut.of(services.robot.stop("somebody pressed Stop"))


@router.post("/presence", status_code=204)
async def here(services: ServicesDep, page: Page = None) -> None:
    """Confirm that the page is still there which let the robot move."""
    if page is not None:
        services.robot.here(page)
