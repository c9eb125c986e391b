"""Goals: photos of how the table should look. Upload one, compose one by hand, draw one at random."""

import json
from typing import Annotated

from fastapi import APIRouter, Depends, HTTPException, Path, Query, Request, Response, status
from fastapi.responses import FileResponse
from starlette.concurrency import run_in_threadpool
from starlette.requests import ClientDisconnect

from app.api.bodies import JSON, SMALL_BODY_BYTES, BoundedRoute, kind_of, parsed, whole_body
from app.api.dependencies import Services, ServicesDep
from app.api.lanes import slow
from app.api.open_file import OpenFile
from app.api.problems import NotFound, named_in_path
from app.api.routes import JPEG, PNG, problems
from app.api.schemas.goals import (
    DraftIn,
    DraftKeep,
    DraftOut,
    DraftPatch,
    GoalCheckOut,
    GoalIn,
    GoalList,
    GoalOut,
    GoalPatch,
)
from app.api.schemas.limits import CAMERA_JSON, GOAL_NAME, NAME, sized
from app.api.schemas.paging import DEFAULT_PAGE, AfterEntry, DamagedOut, Limit, page
from app.services.goals.goals import Draft, NoDraft
from app.storage.records import GoalRecord
from osfcore.errors import InvalidInput, OsfError
from osfcore.geometry.cameras import Camera
from osfcore.io.scene_file import camera_from_json

UPLOAD_PATH = "/api/goals"
_ANY_FILE = "application/octet-stream"  # what browsers call formats that they do not know
_BINARY = {"schema": {"type": "string", "format": "binary"}}
_BODY = {
    "requestBody": {
        "required": True,
        "description": "A photo, or JSON for a goal that is made from a scene of the simulation.",
        "content": {
            JSON: {"schema": {"$ref": "#/components/schemas/GoalIn"}, "example": {"random": {"seed": 0}}},
            "image/*": _BINARY,
        },
    }
}
router = APIRouter(prefix=UPLOAD_PATH, tags=["goals"], responses=problems(), route_class=BoundedRoute)


GoalPath = Annotated[str, Path(description="Identifier of a goal.")]


def _known_goal(services: ServicesDep, goal: GoalPath) -> GoalRecord:
    with named_in_path():
        return services.goals.get(goal)


FoundDep = Annotated[GoalRecord, Depends(_known_goal)]


@router.post("", status_code=status.HTTP_201_CREATED, responses=problems(409, 415, 503, 507), openapi_extra=_BODY)
async def create(
    services: ServicesDep,
    request: Request,
    response: Response,
    name: Annotated[str, Query(**sized(GOAL_NAME), description="Of a photo, for people.")] = "Photo",
    camera: Annotated[
        str | None,
        Query(
            **sized(CAMERA_JSON), description="Of a photo: its camera as JSON, as in scene.json; else the goal camera."
        ),
    ] = None,
) -> GoalOut:
    """Keep a photo of how the table should look, or make a goal image of objects that lie elsewhere.

    A photo may be of any size and usual format. It shows the table without the pusher; its middle counts as what the
    scenes' goal camera sees, unless `camera` says otherwise or it is cropped later.
    """
    kind = kind_of(request)
    try:
        if kind.startswith("image/") or kind == _ANY_FILE:
            data = await whole_body(request, services.settings.max_photo_bytes)
            seen_by = None if camera is None else _camera(camera)
            record = await run_in_threadpool(services.goals.receive, data, name, seen_by)
        elif kind == JSON:
            body = parsed(GoalIn, await whole_body(request, SMALL_BODY_BYTES))
            record = await services.lanes.slow.run(_made, services, body)
        else:
            told = "Send a photo, such as a JPEG or PNG file, or JSON that says how the objects lie."
            raise HTTPException(status.HTTP_415_UNSUPPORTED_MEDIA_TYPE, told)
    except ClientDisconnect:
        raise HTTPException(status.HTTP_400_BAD_REQUEST, "The upload broke off.") from None
    response.headers["Location"] = f"{UPLOAD_PATH}/{record.id}"
    return GoalOut.of(record)


@router.get("")
def list_all(services: ServicesDep, limit: Limit = DEFAULT_PAGE, after: AfterEntry = None) -> GoalList:
    """List goals, newest first."""
    shown, total, following = page(services.goals.all(), limit, after, newest_first=True)
    damaged = [DamagedOut(id=each.id, reason=each.reason) for each in services.goals.damaged()]
    return GoalList(goals=[GoalOut.of(record) for record in shown], damaged=damaged, total=total, next=following)


@router.post("/draft", status_code=status.HTTP_201_CREATED, responses=problems(409, 503))
@slow
def begin(services: ServicesDep, body: DraftIn) -> DraftOut:
    """Begin to compose a goal, from where the objects are now. All visitors see the same draft."""
    return _draft_out(services, services.goals.begin_draft(body.scene))


@router.get("/draft", responses=problems(404))
def draft(services: ServicesDep) -> DraftOut:
    """Tell what is being composed."""
    draft = services.goals.draft
    if draft is None:
        raise NotFound(str(NoDraft()))
    return _draft_out(services, draft)


@router.patch("/draft", responses=problems(404, 409, 503))
@slow
def lay_out(services: ServicesDep, body: DraftPatch) -> DraftOut:
    """Put objects of the draft elsewhere; where they cannot be, `problem` says so."""
    return _draft_out(services, services.goals.move_draft(body.named_poses()))


@router.delete("/draft", status_code=status.HTTP_204_NO_CONTENT)
@slow
def drop(services: ServicesDep) -> None:
    """End composing without keeping anything."""
    services.goals.drop_draft()


@router.get("/draft/image.png", response_class=Response, responses={**problems(404), **PNG})
def draft_image(services: ServicesDep) -> Response:
    """Show what the goal camera would see; while there is a problem, the last image without."""
    return Response(services.goals.draft_image(), media_type="image/png", headers={"Cache-Control": "no-store"})


@router.post("/draft/save", status_code=status.HTTP_201_CREATED, responses=problems(404, 409, 507))
@slow
def save(services: ServicesDep, body: DraftKeep, response: Response) -> GoalOut:
    """Keep the draft as a goal, and end composing."""
    record = services.goals.keep_draft(body.name)
    response.headers["Location"] = f"{UPLOAD_PATH}/{record.id}"
    return GoalOut.of(record)


@router.get("/{goal}", responses=problems(404, 409))
def get(record: FoundDep) -> GoalOut:
    """Tell about a goal."""
    return GoalOut.of(record)


@router.patch("/{goal}", responses=problems(404, 409, 507))
@slow
def crop(services: ServicesDep, record: FoundDep, body: GoalPatch) -> GoalOut:
    """Cut another part out of a goal's photo."""
    return GoalOut.of(services.goals.crop(record.id, body.crop.crop()))


@router.get("/{goal}/check", responses=problems(404, 409, 503))
@slow
def check(
    services: ServicesDep,
    record: FoundDep,
    scene: Annotated[str | None, Query(**sized(NAME), description="Identifier; by default the one shown.")] = None,
) -> GoalCheckOut:
    """Tell within seconds whether a goal shows the objects of a table; the first time this waits for models."""
    return GoalCheckOut.of(services.goal_checks.check(record.id, scene))


@router.get("/{goal}/photo.jpg", response_class=FileResponse, responses={**problems(404, 409), **JPEG})
def photo(services: ServicesDep, record: FoundDep) -> OpenFile:
    """Show the whole photo that a goal was cut out of, no side longer than 2048 px."""
    gone = f"{record.name} was not cut out of a photo."
    return OpenFile(services.goals.photo(record.id), gone, media_type="image/jpeg")


@router.get("/{goal}/image.png", response_class=FileResponse, responses={**problems(404, 409), **PNG})
def image(services: ServicesDep, record: FoundDep) -> OpenFile:
    """Show a goal."""
    path = services.goals.image(record.id)
    gone = "The image of this goal has been removed from the data directory."
    return OpenFile(path, gone, media_type="image/png")


@router.delete("/{goal}", status_code=status.HTTP_204_NO_CONTENT, responses=problems(404, 507))
def remove(services: ServicesDep, goal: GoalPath) -> None:
    """Delete a goal, damaged or not; episodes that had it keep their own copy."""
    with named_in_path():
        services.goals.remove(goal)


def _made(services: Services, body: GoalIn) -> GoalRecord:
    light = None if body.light is None else body.light.light()
    if body.random is not None:
        return services.goals.draw(body.scene, body.random.seed, body.random.moved, body.name, light)
    poses = tuple(entry.named_pose() for entry in body.objects or ())
    return services.goals.compose(body.scene, poses, body.name, light)


def _draft_out(services: Services, draft: Draft) -> DraftOut:
    return DraftOut.of(draft, services.objects.labels())


def _camera(text: str) -> Camera:
    try:
        return camera_from_json(json.loads(text))
    except OsfError:
        raise
    except (ValueError, RecursionError):
        raise InvalidInput("camera", text[:60], "a JSON object as in scene.json") from None
