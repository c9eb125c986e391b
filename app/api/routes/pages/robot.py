"""A robot: how it is, an episode with it, permission for its first motion, and a stop that anybody may call."""

from typing import Annotated

from fastapi import APIRouter, Depends, Header, Path, Response, status

from app.api.bodies import BoundedRoute
from app.api.dependencies import VISITOR_HEADER, ServicesDep, only_the_driver
from app.api.lanes import slow, urgent
from app.api.problems import named_in_path
from app.api.routes import JPEG, problems
from app.api.schemas.limits import NAME, VISITOR, sized
from app.api.schemas.robots import ConfirmationIn, RobotCameraOut, RobotEpisodeIn, RobotOut

router = APIRouter(prefix="/api/robot", tags=["robot"], responses=problems(), route_class=BoundedRoute)
_DRIVER = [Depends(only_the_driver)]
Page = Annotated[
    str | None,
    Header(alias=VISITOR_HEADER, **sized(NAME), pattern=f"^{VISITOR}$", description="What a page calls itself."),
]


@router.get("")
@slow
def get(services: ServicesDep) -> RobotOut:
    """Tell which robot there is, its limits, and what it does. `host` is null where the service has none."""
    return RobotOut.of(services.robot.now())


@router.get("/cameras", responses=problems(404, 503))
@slow
def cameras(services: ServicesDep) -> list[RobotCameraOut]:
    """Tell of each camera when it saw what its picture shows.

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


@router.post(
    "/episodes", status_code=status.HTTP_202_ACCEPTED, responses=problems(404, 409, 429, 503, 507), dependencies=_DRIVER
)
@slow
def create(services: ServicesDep, body: RobotEpisodeIn) -> RobotOut:
    """Queue an episode: it looks, plans, and then asks; nothing moves before it is allowed."""
    return RobotOut.of(services.robot.begin(body.asked()))


@router.post("/confirmation", responses=problems(404, 409), dependencies=_DRIVER)
@urgent
def allow(services: ServicesDep, body: ConfirmationIn, page: Page = None) -> RobotOut:
    """Let the robot move. A page that says so must tell every second that it is there, or the robot is stopped."""
    return RobotOut.of(services.robot.allow(body.episode, page))


@router.post("/stop")
@urgent
def stop(services: ServicesDep) -> RobotOut:
    """Stop the robot at once, whoever drives and whatever else is at work; again if one likes."""
    return RobotOut.of(services.robot.stop("somebody pressed Stop"))


@router.post("/presence", status_code=status.HTTP_204_NO_CONTENT)
async def here(services: ServicesDep, page: Page = None) -> None:
    """Tell that the page is still there which let the robot move."""
    if page is not None:
        services.robot.here(page)
