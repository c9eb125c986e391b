"""Calibrating a camera: photos of the board are sent one by one, and each time it is told what they tell so far."""

from typing import Annotated

from fastapi import APIRouter, Query, Request
from starlette.concurrency import run_in_threadpool

from app.api.bodies import BoundedRoute
from app.api.dependencies import ServicesDep
from app.api.lanes import slow
from app.api.routes import problems
from app.api.routes.photos import PHOTO_BODY, photo_body
from app.api.schemas.calibration import CalibrateIn, CalibrationOut, SightingOut
from app.api.schemas.limits import GOAL_NAME, sized
from osfcore.photo.calibration import board_place

UPLOAD_PATH = "/api/calibration/photos"
router = APIRouter(prefix="/api/calibration", tags=["photos"], responses=problems(), route_class=BoundedRoute)


@router.post("/photos", responses=problems(415, 503), openapi_extra=PHOTO_BODY)
async def sight(
    services: ServicesDep,
    request: Request,
    name: Annotated[str, Query(**sized(GOAL_NAME), description="For people.")] = "Photo",
) -> SightingOut:
    """Look for the printed board in a photo; the photo itself is not kept."""
    data = await photo_body(request, services.settings.max_photo_bytes)
    return SightingOut.of(*await run_in_threadpool(services.board_photos.add, data, name))


@router.post("", responses=problems(503))
@slow
def assess(services: ServicesDep, body: CalibrateIn) -> CalibrationOut:
    """Tell what photos of the board tell of the camera so far, what is missing and what helps most."""
    place = board_place(body.place.x_m, body.place.y_m, body.place.turn_deg)
    return CalibrationOut.of(services.board_photos.assess(body.photos, body.table, place), body.name)
