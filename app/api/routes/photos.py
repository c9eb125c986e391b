"""Photos of tables: send one, mark objects in it, let them be found, make it a table or a goal."""

from typing import Annotated

from fastapi import APIRouter, Depends, HTTPException, Path, Query, Request, Response, status
from fastapi.responses import FileResponse
from starlette.concurrency import run_in_threadpool
from starlette.requests import ClientDisconnect

from app.api.bodies import BoundedRoute, kind_of, whole_body
from app.api.dependencies import Services, ServicesDep
from app.api.lanes import slow
from app.api.open_file import OpenFile
from app.api.problems import named_in_path
from app.api.routes import JPEG, PNG, problems
from app.api.schemas.goals import GoalOut
from app.api.schemas.limits import FOCAL, GOAL_NAME, NAME, sized, within
from app.api.schemas.paging import DEFAULT_PAGE, AfterEntry, DamagedOut, Limit, page
from app.api.schemas.photos import (
    ChoiceIn,
    FindIn,
    GoalMadeOut,
    MakeGoalIn,
    MakeTableIn,
    MarkIn,
    PhotoList,
    PhotoPatch,
    TableMadeOut,
    TablePhotoOut,
    facts_of,
)
from app.storage.records import TablePhoto
from osfcore.photo.board import Board, board_pdf
from osfcore.photo.calibration import known_camera

UPLOAD_PATH = "/api/photos"
_ANY_FILE = "application/octet-stream"  # what browsers call formats that they do not know
PHOTO_BODY = {
    "requestBody": {
        "required": True,
        "description": "A photo.",
        "content": {"image/*": {"schema": {"type": "string", "format": "binary"}}},
    }
}
router = APIRouter(prefix=UPLOAD_PATH, tags=["photos"], responses=problems(), route_class=BoundedRoute)
ObjectPath = Annotated[str, Path(**sized(NAME), description="Name of an object.", examples=["025_mug"])]


PhotoPath = Annotated[str, Path(description="Identifier of a photo.")]


def _known_photo(services: ServicesDep, photo: PhotoPath) -> TablePhoto:
    with named_in_path():
        return services.photos.get(photo)


PhotoDep = Annotated[TablePhoto, Depends(_known_photo)]


async def photo_body(request: Request, max_bytes: int) -> bytes:
    """The photo that is sent.

    Raises:
        HTTPException: if it is none, or the upload broke off.
    """
    kind = kind_of(request)
    if not (kind.startswith("image/") or kind == _ANY_FILE):
        raise HTTPException(status.HTTP_415_UNSUPPORTED_MEDIA_TYPE, "Send a photo, such as a JPEG or PNG file.")
    try:
        return await whole_body(request, max_bytes)
    except ClientDisconnect:
        raise HTTPException(status.HTTP_400_BAD_REQUEST, "The upload broke off.") from None


@router.post("", status_code=status.HTTP_201_CREATED, responses=problems(409, 415, 503, 507), openapi_extra=PHOTO_BODY)
async def create(
    services: ServicesDep,
    request: Request,
    response: Response,
    name: Annotated[str, Query(**sized(GOAL_NAME), description="For people.")] = "Photo",
    focal_px: Annotated[
        float | None, Query(**within(FOCAL), description="Focal length in pixels, if it is known.")
    ] = None,
) -> TablePhotoOut:
    """Keep a photo of a table, of any size and usual format; its camera is found if the printed board is in view."""
    data = await photo_body(request, services.settings.max_photo_bytes)
    photo = await run_in_threadpool(services.photos.receive, data, name, focal_px)
    response.headers["Location"] = f"{UPLOAD_PATH}/{photo.id}"
    return _out(services, photo)


@router.get("")
def list_all(services: ServicesDep, limit: Limit = DEFAULT_PAGE, after: AfterEntry = None) -> PhotoList:
    """List photos of tables, newest first."""
    shown, total, following = page(services.photos.all(), limit, after, newest_first=True)
    damaged = [DamagedOut(id=each.id, reason=each.reason) for each in services.photos.damaged()]
    return PhotoList(photos=[facts_of(photo) for photo in shown], damaged=damaged, total=total, next=following)


@router.get("/board.pdf", response_class=Response, responses={200: {"content": {"application/pdf": {}}}})
def board() -> Response:
    """The board to print, an A4 page; laid on the table it tells where the camera was."""
    return Response(board_pdf(Board()), media_type="application/pdf")


@router.get("/{photo}", responses=problems(404, 409))
def get(services: ServicesDep, photo: PhotoDep) -> TablePhotoOut:
    """Tell what is marked in a photo, and what was found."""
    return _out(services, photo)


@router.patch("/{photo}", responses=problems(404, 409, 503, 507))
@slow
def set_camera(services: ServicesDep, photo: PhotoDep, body: PhotoPatch) -> TablePhotoOut:
    """Give a photo another focal length, or the calibrated camera that took it."""
    camera = None if body.camera is None else known_camera(body.camera.model_dump())
    return _out(services, services.photos.set_camera(photo.id, body.focal_px, camera))


@router.delete("/{photo}", status_code=status.HTTP_204_NO_CONTENT, responses=problems(404, 507))
def remove(services: ServicesDep, photo: PhotoPath) -> None:
    """Delete a photo, damaged or not; tables and goals that were made of it stay."""
    with named_in_path():
        services.photos.remove(photo)


@router.put("/{photo}/objects/{name}", responses=problems(404, 409, 503, 507))
@slow
def mark(services: ServicesDep, photo: PhotoDep, name: ObjectPath, body: MarkIn) -> TablePhotoOut:
    """Point at an object, or anew; its mask is found."""
    with named_in_path():
        return _out(services, services.photos.mark(photo.id, name, body.mark()))


@router.delete("/{photo}/objects/{name}", responses=problems(404, 409, 507))
@slow
def unmark(services: ServicesDep, photo: PhotoDep, name: ObjectPath) -> TablePhotoOut:
    """Forget what was marked of an object."""
    with named_in_path():
        return _out(services, services.photos.unmark(photo.id, name))


@router.post("/{photo}/objects/{name}/choice", responses=problems(404, 409, 507))
@slow
def choose(services: ServicesDep, photo: PhotoDep, name: ObjectPath, body: ChoiceIn) -> TablePhotoOut:
    """Take one of the poses that were found of an object."""
    with named_in_path():
        return _out(services, services.photos.choose(photo.id, name, body.choice))


@router.post("/{photo}/find", status_code=status.HTTP_202_ACCEPTED, responses=problems(404, 409, 429, 507))
@slow
def find(services: ServicesDep, photo: PhotoDep, body: FindIn) -> TablePhotoOut:
    """Find the marked objects and the lamp; `job` tells how far that is."""
    return _out(services, services.photos.find(photo.id, body.together, body.seed))


@router.post("/{photo}/table", status_code=status.HTTP_201_CREATED, responses=problems(404, 409, 503, 507))
@slow
def make_table(services: ServicesDep, photo: PhotoDep, body: MakeTableIn) -> TableMadeOut:
    """Make a table whose objects lie as in the photo, under its lamp, and show it."""
    made = services.photo_tables.make_table(photo.id, despite_doubts=body.despite_doubts)
    return TableMadeOut(scene=services.scene_out(made.scene), notes=list(made.notes))


@router.post("/{photo}/goal", status_code=status.HTTP_201_CREATED, responses=problems(404, 409, 503, 507))
@slow
def make_goal(services: ServicesDep, photo: PhotoDep, body: MakeGoalIn) -> GoalMadeOut:
    """Make a goal in which objects lie as in the photo."""
    made = services.photo_tables.make_goal(photo.id, body.scene, despite_doubts=body.despite_doubts)
    scene = services.scene_out(made.scene)
    return GoalMadeOut(scene=scene, notes=list(made.notes), goal=GoalOut.of(made.goal))


@router.get("/{photo}/photo.jpg", response_class=FileResponse, responses={**problems(404, 409), **JPEG})
def picture(services: ServicesDep, photo: PhotoDep) -> OpenFile:
    """Show a photo, upright, no side longer than 2048 px."""
    return OpenFile(services.photos.picture(photo.id), f"{photo.name} has been deleted.", media_type="image/jpeg")


@router.get("/{photo}/objects/{name}/mask.png", response_class=FileResponse, responses={**problems(404, 409), **PNG})
def mask(services: ServicesDep, photo: PhotoDep, name: ObjectPath) -> OpenFile:
    """Show the mask of a marked object."""
    with named_in_path():
        photo.marked(name)
    return OpenFile(services.photos.mask(photo.id, name), f"{name} is not marked.", media_type="image/png")


@router.get("/{photo}/drawing.png", response_class=Response, responses={**problems(404, 409, 503), **PNG})
@slow
def drawing(services: ServicesDep, photo: PhotoDep) -> Response:
    """Show how the scene that was found looks from the photo's camera, with its shadows."""
    png = services.photo_tables.drawing(photo.id)
    return Response(png, media_type="image/png", headers={"Cache-Control": "no-store"})


def _out(services: Services, photo: TablePhoto) -> TablePhotoOut:
    job = services.photos.job(photo)
    found = services.photos.found(photo) if job is not None and job.state == "done" else None
    doubts = () if found is None else services.photos.doubts(photo, found)
    return TablePhotoOut.of(photo, job, found, doubts, services.objects.labels())
