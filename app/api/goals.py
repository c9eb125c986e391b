"""Goals: photos of how the table should look. Upload one, compose one by hand, draw one at random."""

from __future__ import annotations

import json
from typing import Annotated

from fastapi import APIRouter, Depends, HTTPException, Path, Query, Request, Response
from pydantic import BaseModel, Field, model_validator
from starlette.concurrency import run_in_threadpool

from osfcore.errors import InvalidInput, OsfError
from osfcore.geometry.cameras import Camera
from osfcore.geometry.poses import Pose
from osfcore.io.scene_file import CameraJson, ObjectJson, camera_from_json

from ..jobs.params import Identifier, ObjectCount, Seed
from ..services.goals import Draft, GoalVerdict, NoDraft
from ..storage.photos import PhotoCrop
from ..storage.records import GoalRecord, Source
from .bodies import (
    JPEG,
    JSON,
    PNG,
    SMALL_BODY_BYTES,
    BoundedRoute,
    OpenFile,
    is_photo,
    kind_of,
    parsed,
    refuse_form,
    upload,
    whole_body,
)
from .dependencies import Services, ServicesDep, slow
from .models import DisplayName, Input, LightIn, Poses, SceneRef
from .paging import DEFAULT_PAGE, AfterEntry, DamagedOut, Limit, PageOut, page
from .problems import named_in_path, problems
from .scenes import SceneObject

GoalName = Annotated[DisplayName, Field(description="For people.")]


class RandomLayout(Input):
    """Some objects elsewhere, each 7.5 to 20 cm away."""

    seed: Seed = 0
    moved: ObjectCount | None = Field(None, description="How many; null as the seed will have it.")


class GoalIn(Input):
    """A goal image made in the simulation, of objects that lie elsewhere."""

    scene: SceneRef
    objects: Poses | None = Field(None, description="Those that lie elsewhere; they come to rest as if let go.")
    random: RandomLayout | None = Field(None, description="Instead of objects.")
    light: LightIn | None = Field(None, description="In which the image is taken; null for the scene's.")
    name: GoalName = "Goal"

    @model_validator(mode="after")
    def _says_one(self) -> GoalIn:
        if (self.objects is None) == (self.random is None):
            raise ValueError("give either objects or random")
        return self


class DraftIn(Input):
    """Which scene's objects shall be laid out."""

    scene: SceneRef


class DraftPatch(Input):
    """Objects of the draft that shall lie elsewhere."""

    objects: Poses

    def named_poses(self) -> tuple[tuple[str, Pose], ...]:
        """Names and poses, unchecked."""
        return tuple(entry.named_pose() for entry in self.objects)


class DraftKeep(Input):
    """How the goal is called."""

    name: GoalName = "Composed"


class CropIn(Input):
    """A rectangle of the photo that becomes the goal image, in pixels of the photo as it was sent."""

    left: float = Field(allow_inf_nan=False, description="Before it is turned [px].")
    top: float = Field(allow_inf_nan=False, description="Before it is turned [px].")
    width: float = Field(allow_inf_nan=False, description="Its height follows from the camera's proportions [px].")
    turn_deg: float = Field(0.0, allow_inf_nan=False, description="Clockwise about its centre.")


class GoalPatch(Input):
    """Another part of the photo."""

    crop: CropIn


class CropOut(BaseModel):
    """The rectangle of the photo that is the goal image [px, degrees]."""

    left: float
    top: float
    width: float
    turn_deg: float


class PhotoOut(BaseModel):
    """The photo that a goal image was cut out of."""

    width: int = Field(description="As it was sent [px].")
    height: int = Field(description="As it was sent [px].")
    crop: CropOut


class GoalCheckOut(BaseModel):
    """Whether a goal can be one for a table."""

    verdict: GoalVerdict = Field(
        description='"bare": nothing is on the table; "elsewhere": not the table as its camera would see it; '
        '"others": not these objects.'
    )
    refused: bool = Field(description="Whether episodes refuse it unless they are asked to go on despite doubts.")
    text: str = Field(description="What is wrong and what to do; empty if nothing is.")
    scene: str | None = Field(description="The table that it was made for, if that is another one and still there.")


class GoalOut(BaseModel):
    """A goal image that is kept."""

    id: str
    name: str
    created_at: str = Field(description="UTC, ISO 8601.")
    source: Source = Field(
        description="An uploaded photo, a layout by hand or at random, or found in a photo of a table."
    )
    scene: str | None = Field(description="That it was made from; null for an upload.")
    width: int = Field(description="[px]")
    height: int = Field(description="[px]")
    camera: CameraJson = Field(description="That took the image.")
    objects: list[ObjectJson] | None = Field(description="Where they are in the image; null where nobody knows.")
    photo: PhotoOut | None = Field(description="That the image was cut out of; null if it was made here.")

    @staticmethod
    def of(record: GoalRecord) -> GoalOut:
        """From the record on disk."""
        return GoalOut(
            id=record.id,
            name=record.name,
            created_at=record.created_at,
            source=record.source,
            scene=record.scene,
            width=record.camera.width,
            height=record.camera.height,
            camera=CameraJson.of(record.camera),
            objects=None if record.poses is None else [ObjectJson.of(*placed) for placed in record.poses],
            photo=None if record.photo is None else PhotoOut.model_validate(record.photo, from_attributes=True),
        )


class GoalList(PageOut):
    """Goals, newest first."""

    goals: list[GoalOut]
    damaged: list[DamagedOut] = Field(description="What can only be deleted, on each page.")


class DraftOut(BaseModel):
    """A goal that is being composed, the same for all visitors."""

    scene: str
    objects: list[SceneObject]
    problem: str = Field(description="Why the objects cannot be there; empty if they can.")
    revision: int = Field(description="Grows with every change.")

    @staticmethod
    def of(draft: Draft, labels: dict[str, str]) -> DraftOut:
        """From the service's own."""
        objects = [SceneObject.labelled(name, pose, labels) for name, pose in draft.poses]
        return DraftOut(scene=draft.scene, objects=objects, problem=draft.problem, revision=draft.revision)


UPLOAD_PATH = "/api/goals"
_BODY = upload("image/*", description="A photo, or JSON for a goal that is made from a scene of the simulation.")
_BODY["requestBody"]["content"][JSON] = {
    "schema": {"$ref": "#/components/schemas/GoalIn"}, "example": {"random": {"seed": 0}},
}  # fmt: skip
router = APIRouter(prefix=UPLOAD_PATH, tags=["goals"], responses=problems(), route_class=BoundedRoute)


GoalPath = Annotated[str, Path(description="Identifier of a goal.")]


def _known_goal(services: ServicesDep, goal: GoalPath) -> GoalRecord:
    with named_in_path():
        return services.goals.get(goal)


FoundDep = Annotated[GoalRecord, Depends(_known_goal)]


@router.post("", status_code=201, responses=problems(409, 415, 503, 507), openapi_extra=_BODY)
async def create(
    services: ServicesDep,
    request: Request,
    response: Response,
    name: Annotated[DisplayName, Query(description="Of a photo, for people.")] = "Photo",
    camera: Annotated[
        str | None,
        Query(max_length=4000, description="Of a photo: its camera as JSON, as in scene.json; else the goal camera."),
    ] = None,
) -> GoalOut:
    """Keep a photo of how the table should look, or make a goal image of objects that lie elsewhere.

    A photo may be of any size and usual format. It shows the table without the pusher; its middle counts as what the
    scenes' goal camera sees, unless `camera` says otherwise or it is cropped later.
    """
    refuse_form(request, "image/jpeg, or of another picture")
    kind = kind_of(request)
    if is_photo(kind):
        data = await whole_body(request, services.settings.max_photo_bytes)
        seen_by = None if camera is None else _camera(camera)
        record = await run_in_threadpool(services.goals.receive, data, name, seen_by)
    elif kind == JSON:
        body = parsed(GoalIn, await whole_body(request, SMALL_BODY_BYTES))
        record = await services.slow_lane.run(_made, services, body)
    else:
        advice = "Send a photo, such as a JPEG or PNG file, or JSON that says how the objects lie."
        raise HTTPException(415, advice)
    response.headers["Location"] = f"{UPLOAD_PATH}/{record.id}"
    return GoalOut.of(record)


@router.get("")
def list_all(services: ServicesDep, limit: Limit = DEFAULT_PAGE, after: AfterEntry = None) -> GoalList:
    """List goals, newest first."""
    shown, total, following = page(services.goals.all(), limit, after, newest_first=True)
    damaged = DamagedOut.of(services.goals.damaged())
    return GoalList(goals=[GoalOut.of(record) for record in shown], damaged=damaged, total=total, next=following)


@router.post("/draft", status_code=201, responses=problems(409, 503))
@slow
def begin(services: ServicesDep, body: DraftIn) -> DraftOut:
    """Begin to compose a goal, from where the objects are now. All visitors see the same draft."""
    return _draft_out(services, services.goals.begin_draft(body.scene))


@router.get("/draft", responses=problems(404))
def draft(services: ServicesDep) -> DraftOut:
    """Return what is being composed."""
    draft = services.goals.draft
    if draft is None:
        raise NoDraft
    return _draft_out(services, draft)


@router.patch("/draft", responses=problems(404, 409, 503))
@slow
def lay_out(services: ServicesDep, body: DraftPatch) -> DraftOut:
    """Put objects of the draft elsewhere; where they cannot be, `problem` says so."""
    return _draft_out(services, services.goals.move_draft(body.named_poses()))


@router.delete("/draft", status_code=204)
@slow
def drop(services: ServicesDep) -> None:
    """End composing without keeping anything."""
    services.goals.drop_draft()


@router.get("/draft/image.png", response_class=Response, responses={**problems(404), **PNG})
def draft_image(services: ServicesDep) -> Response:
    """Show what the goal camera would see; while there is a problem, the last image without."""
    return Response(services.goals.draft_image(), media_type="image/png", headers={"Cache-Control": "no-store"})


@router.post("/draft/save", status_code=201, responses=problems(404, 409, 507))
@slow
def save(services: ServicesDep, body: DraftKeep, response: Response) -> GoalOut:
    """Keep the draft as a goal, and end composing."""
    record = services.goals.keep_draft(body.name)
    response.headers["Location"] = f"{UPLOAD_PATH}/{record.id}"
    return GoalOut.of(record)


@router.get("/{goal}", responses=problems(404, 409))
def get(record: FoundDep) -> GoalOut:
    """Return a goal."""
    return GoalOut.of(record)


@router.patch("/{goal}", responses=problems(404, 409, 507))
@slow
def crop(services: ServicesDep, record: FoundDep, body: GoalPatch) -> GoalOut:
    """Cut another part out of a goal's photo."""
    return GoalOut.of(services.goals.crop(record.id, PhotoCrop(**body.crop.model_dump())))


@router.get("/{goal}/check", responses=problems(404, 409, 503))
@slow
def check(
    services: ServicesDep,
    record: FoundDep,
    scene: Annotated[Identifier | None, Query(description="Identifier; by default the one shown.")] = None,
) -> GoalCheckOut:
    """Check within seconds whether a goal shows the objects of a table; the first time this waits for models."""
    found = services.goal_checks.check(record.id, scene)
    return GoalCheckOut(verdict=found.verdict, refused=found.is_refused, text=found.text, scene=found.scene)


@router.get("/{goal}/photo.jpg", response_class=Response, responses={**problems(404, 409), **JPEG})
def photo(services: ServicesDep, record: FoundDep) -> OpenFile:
    """Show the whole photo that a goal was cut out of, no side longer than 2048 px."""
    gone = f"{record.name} was not cut out of a photo."
    return OpenFile(services.goals.photo(record.id), gone, media_type="image/jpeg")


@router.get("/{goal}/image.png", response_class=Response, responses={**problems(404, 409), **PNG})
def image(services: ServicesDep, record: FoundDep) -> OpenFile:
    """Show a goal."""
    path = services.goals.image(record.id)
    gone = "The image of this goal has been removed from the data directory."
    return OpenFile(path, gone, media_type="image/png")


@router.delete("/{goal}", status_code=204, responses=problems(404, 507))
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
