"""Photos of tables, and of the board that calibrates the camera.

Send a photo, mark objects in it, let them be found, make it a table or a goal. Places are pixels of the photo as
`photo.jpg` shows it.
"""

from __future__ import annotations

from typing import Annotated

from fastapi import APIRouter, Depends, HTTPException, Path, Query, Request, Response
from pydantic import BaseModel, Field, FiniteFloat
from starlette.concurrency import run_in_threadpool

from osfcore.geometry.workspace import TABLE_SIDE_M
from osfcore.photo.board import BOARD_FORM, Board, board_of, board_pdf
from osfcore.photo.calibration import MOST_PHOTOS, CalibrationJson, board_place, calibration_to_json
from osfcore.photo.camera_files import known_camera
from osfcore.photo.found_scene import FoundLight, FoundObject, FoundPose, TableSource

from ..jobs.job import Job
from ..jobs.kinds.photos import sheet_name
from ..jobs.params import Identifier, Seed
from ..processes.messages.photo_messages import CameraSource, Mark, Points, Stroke
from ..storage.records import MarkedObject, TablePhoto
from .bodies import JPEG, PNG, BoundedRoute, OpenFile, is_photo, kind_of, refuse_form, upload, whole_body
from .dependencies import Services, ServicesDep, slow
from .goals import GoalOut
from .jobs import JobOut
from .models import Box, DisplayName, Excerpt, Input, Pixel
from .paging import DEFAULT_PAGE, AfterEntry, DamagedOut, Limit, PageOut, page
from .problems import named_in_path, problems
from .scenes import SceneOut, scene_out

BoardText = Annotated[str, Field(max_length=100)]
_BOARD = f"Board that may be in view: {BOARD_FORM}; empty for the one to print."


class CameraIn(Excerpt):
    """A calibrated camera, as a calibration gives it; its stated accuracy does not matter."""

    name: DisplayName
    T_world_camera: list[list[FiniteFloat]] | None = None
    K: list[list[FiniteFloat]]
    width: int = Field(ge=1, le=100_000)
    height: int = Field(ge=1, le=100_000)
    radial: FiniteFloat = 0.0


class SightingOut(BaseModel):
    """The board in a photo."""

    id: str = Field(description="Identifier; it is forgotten when the service ends.")
    name: str
    width: int = Field(description="Of the photo as it was sent [px].")
    height: int = Field(description="[px]")
    corners: list[list[float]] = Field(description="Of the board's squares [px].")


_OnTable = Annotated[float, Field(ge=-TABLE_SIDE_M / 2, le=TABLE_SIDE_M / 2)]


class PlaceIn(Input):
    """Where the board's centre lies on the table."""

    x_m: _OnTable = 0.0
    y_m: _OnTable = 0.0
    turn_deg: float = Field(default=0.0, ge=-360, le=360, description="To the left, seen from above.")


class CalibrateIn(Input):
    """Photos of the board by one camera."""

    photos: list[Identifier] = Field(max_length=MOST_PHOTOS)
    table: Identifier | None = Field(None, description="The board lying on the table; shows where the camera stands.")
    place: PlaceIn = Field(default_factory=PlaceIn)
    name: DisplayName = Field("camera", description="Of the camera.")


class AdviceOut(BaseModel):
    """What to photograph next."""

    words: str = Field(description="The end of a sentence.")
    expected_error_mm: float = Field(description="Mean error on the table after that.")


class CalibrationOut(BaseModel):
    """What the photos show so far."""

    missing: str = Field(description="Why they do not suffice, a sentence; empty where they do.")
    next: AdviceOut | None = Field(description="Null if nothing helps.")
    camera: CalibrationJson = Field(description="As `osf photo estimate --camera` takes it, if nothing is missing.")


PointIn = Annotated[list[Pixel], Field(min_length=2, max_length=2)]
Clicks = Annotated[list[PointIn], Field(max_length=50)]
Focal = Annotated[FiniteFloat, Field(ge=1, le=100_000, description="Focal length in pixels of the photo as sent.")]


class StrokeIn(Input):
    """A line of the brush."""

    adds: bool = Field(description="Whether what it covers belongs to the object; else it does not.")
    radius: float = Field(ge=0.1, le=1000, allow_inf_nan=False, description="Of the brush [px].")
    points: Annotated[list[PointIn], Field(min_length=1, max_length=500)]


class MarkIn(Input):
    """How a person points at an object: a box around it, and as many clicks and strokes as it takes."""

    box: Box
    on: Clicks = Field(default=[], description="Clicks on the object.")
    off: Clicks = Field(default=[], description="Clicks beside it.")
    strokes: list[StrokeIn] = Field(default=[], max_length=50)

    def mark(self) -> Mark:
        """Unchecked."""
        strokes = tuple(Stroke(each.adds, each.radius, _points(each.points)) for each in self.strokes)
        left, top, right, bottom = self.box
        return Mark((left, top, right, bottom), _points(self.on), _points(self.off), strokes)


class PhotoPatch(Input):
    """Another focal length; null for what board or file give. A calibrated camera counts instead of it."""

    focal_px: Focal | None
    camera: CameraIn | None = Field(None, description="`camera` of a calibration.")
    board: BoardText | None = Field(None, description=f"{_BOARD} Null keeps the present one.")


class FindIn(Input):
    """How to look for what is marked."""

    together: list[str] = Field(
        default=[],
        max_length=8,
        description="Further photos of the same table, each with the board or with objects that another shows as well.",
    )
    seed: Seed = 0


class ChoiceIn(Input):
    """Which of the poses of an object is right."""

    choice: int = Field(ge=0, le=100, description="Number in `poses`.")


class MakeTableIn(Input):
    """What to make a table of a photo with."""

    despite_doubts: bool = Field(False, description="Whether what was not found for certain counts all the same.")


class MakeGoalIn(MakeTableIn):
    """What to make a goal of a photo with."""

    scene: Identifier | None = Field(
        None,
        description="That the goal is for; null for the one shown if it holds the photo's objects, else for a new one.",
    )


class PoseFound(FoundPose):
    """One of the poses that explain the photo."""

    picture: str | None = Field(
        description="Path of its sheet: photo, outlines of mask and object, object; may be null."
    )


class ObjectFound(BaseModel):
    """What was found of an object."""

    poses: list[PoseFound] = Field(description="The most likely first.")
    doubt: str = Field(description="Why it should not be trusted, a sentence; empty where it may be.")
    outline: list[list[list[float]]] = Field(description="Polygons around its mask, as it was found with the pose.")


class MarkedOut(BaseModel):
    """An object that was marked."""

    name: str
    label: str
    box: list[float]
    on: list[list[float]]
    off: list[list[float]]
    strokes: list[StrokeIn]
    outline: list[list[list[float]]] = Field(description="Closed polygons around the first mask and its holes.")
    doubt: str = Field(description="A sentence if the outline does not fill its box; empty if it does.")
    choice: int | None = Field(description="The pose that a person took; null before that.")
    found: ObjectFound | None


class PhotoFacts(BaseModel):
    """A photo of a table."""

    id: str
    name: str
    created_at: str = Field(description="UTC, ISO 8601.")
    width: int = Field(description="[px]")
    height: int = Field(description="[px]")
    focal_px: float = Field(description="In pixels of the photo as it was sent.")
    focal_source: CameraSource = Field(description="The board, the user, the file, how objects stand, or nothing.")
    on_board: bool = Field(description="Whether the board is in view.")
    board: str = Field(description="That was looked for, in words; empty for the one to print.")
    marked: list[str] = Field(description="Names of the objects that are marked in it.")


class TablePhotoOut(PhotoFacts):
    """A photo of a table, with what is marked and what was found in it."""

    notes: list[str] = Field(description="Sentences about photo, camera, table and light.")
    objects: list[MarkedOut]
    job: JobOut | None = Field(description="The search for what is marked now; null if there was none.")
    table: TableSource | None = Field(description="How it is known where the table is; null if it is not, or not yet.")
    light: FoundLight | None = Field(description="In the frame of the poses.")
    doubts: list[str] = Field(description="Why nothing is made of it unless despite_doubts; empty where nothing is.")
    scene: str | None = Field(description="The table that it became.")


class PhotoList(PageOut):
    """Photos of tables, newest first."""

    photos: list[PhotoFacts]
    damaged: list[DamagedOut] = Field(description="What can only be deleted, on each page.")


class TableMadeOut(BaseModel):
    """A table that was made of a photo."""

    scene: SceneOut
    notes: list[str] = Field(description="Sentences about what does not lie as in the photo.")


class GoalMadeOut(TableMadeOut):
    """A goal that was made of a photo, and the table that it is for."""

    goal: GoalOut


class PictureOut(BaseModel):
    """What became of a picture: one of both."""

    goal: GoalOut | None = Field(description="It is one of the goal camera.")
    photo: TablePhotoOut | None = Field(description="It is a photograph, in which objects can be marked and found.")


def _facts(photo: TablePhoto) -> PhotoFacts:
    return PhotoFacts(
        id=photo.id,
        name=photo.name,
        created_at=photo.created_at,
        width=photo.width,
        height=photo.height,
        focal_px=round(float(photo.K[0, 0]) * photo.sent_width / photo.width, 2),
        focal_source=photo.source,
        on_board=photo.T_world_camera is not None,
        board=photo.board,
        marked=[entry.name for entry in photo.objects],
    )


def _found(job: Job, found: FoundObject) -> ObjectFound:
    poses = []
    for number, pose in enumerate(found.poses()):
        file = sheet_name(found.name, number)
        picture = f"/api/jobs/{job.id}/files/{file}" if file in job.files else None
        poses.append(PoseFound(**pose.model_dump(include=set(FoundPose.model_fields)), picture=picture))
    return ObjectFound(poses=poses, doubt=found.doubt, outline=found.outline)


def _marked(marked: MarkedObject, label: str, found: ObjectFound | None) -> MarkedOut:
    mark = marked.mark
    strokes = [StrokeIn(adds=s.adds, radius=s.radius, points=_lists(s.points)) for s in mark.strokes]
    return MarkedOut(
        name=marked.name, label=label, box=list(mark.box), on=_lists(mark.on), off=_lists(mark.off),
        strokes=strokes, outline=[_lists(line) for line in marked.outline], doubt=marked.doubt, choice=marked.choice,
        found=found,
    )  # fmt: skip


def _points(points: list[list[float]]) -> Points:
    return tuple((x, y) for x, y in points)


def _lists(points: Points) -> list[list[float]]:
    return [[x, y] for x, y in points]


UPLOAD_PATH = "/api/photos"
_PHOTO_BODY = upload("image/*", description="A photo.")
router = APIRouter(prefix=UPLOAD_PATH, tags=["photos"], responses=problems(), route_class=BoundedRoute)
PICTURES_UPLOAD_PATH = "/api/pictures"
pictures_router = APIRouter(
    prefix=PICTURES_UPLOAD_PATH, tags=["photos"], responses=problems(), route_class=BoundedRoute
)
ObjectPath = Annotated[Identifier, Path(description="Name of an object.", examples=["025_mug"])]


PhotoPath = Annotated[str, Path(description="Identifier of a photo.")]


def _known_photo(services: ServicesDep, photo: PhotoPath) -> TablePhoto:
    with named_in_path():
        return services.photos.get(photo)


PhotoDep = Annotated[TablePhoto, Depends(_known_photo)]


async def _photo_body(request: Request, max_bytes: int) -> bytes:
    """The photo that is sent.

    Raises:
        HTTPException: if it is none, or the upload broke off.
    """
    refuse_form(request, "image/jpeg, or of another picture")
    if not is_photo(kind_of(request)):
        raise HTTPException(415, "Send a photo, such as a JPEG or PNG file.")
    return await whole_body(request, max_bytes)


@router.post("", status_code=201, responses=problems(409, 415, 503, 507), openapi_extra=_PHOTO_BODY)
async def create(
    services: ServicesDep,
    request: Request,
    response: Response,
    name: Annotated[DisplayName, Query(description="For people.")] = "Photo",
    focal_px: Annotated[
        float | None, Query(ge=1, le=100_000, description="Focal length in pixels, if it is known.")
    ] = None,
    board: Annotated[BoardText, Query(description=_BOARD)] = "",
) -> TablePhotoOut:
    """Keep a photo of a table, of any size and usual format; its camera is found if the printed board is in view."""
    data = await _photo_body(request, services.settings.max_photo_bytes)
    photo = await run_in_threadpool(services.photos.receive, data, name, focal_px, board)
    response.headers["Location"] = f"{UPLOAD_PATH}/{photo.id}"
    return _out(services, photo)


@pictures_router.post("", status_code=201, responses=problems(409, 415, 503, 507), openapi_extra=_PHOTO_BODY)
async def create_picture(
    services: ServicesDep, request: Request, name: Annotated[DisplayName, Query(description="For people.")] = "Photo"
) -> PictureOut:
    """Keep a picture as what it is: a goal if it is one of the goal camera, else a photo of a table."""
    data = await _photo_body(request, services.settings.max_photo_bytes)
    return await services.slow_lane.run(_kept, services, data, name)


@router.get("")
def list_all(services: ServicesDep, limit: Limit = DEFAULT_PAGE, after: AfterEntry = None) -> PhotoList:
    """List photos of tables, newest first."""
    shown, total, following = page(services.photos.all(), limit, after, newest_first=True)
    damaged = DamagedOut.of(services.photos.damaged())
    return PhotoList(photos=[_facts(photo) for photo in shown], damaged=damaged, total=total, next=following)


@router.get("/board.pdf", response_class=Response, responses={200: {"content": {"application/pdf": {}}}})
def board() -> Response:
    """The board to print, an A4 page; laid on the table it shows where the camera was."""
    return Response(board_pdf(Board()), media_type="application/pdf")


@router.get("/{photo}", responses=problems(404, 409))
def get(services: ServicesDep, photo: PhotoDep) -> TablePhotoOut:
    """Return what is marked in a photo, and what was found."""
    return _out(services, photo)


@router.patch("/{photo}", responses=problems(404, 409, 503, 507))
@slow
def set_camera(services: ServicesDep, photo: PhotoDep, body: PhotoPatch) -> TablePhotoOut:
    """Give a photo another focal length, the calibrated camera that took it, or another board."""
    camera = None if body.camera is None else known_camera(body.camera.model_dump())
    return _out(services, services.photos.set_camera(photo.id, body.focal_px, camera, body.board))


@router.delete("/{photo}", status_code=204, responses=problems(404, 507))
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


@router.post("/{photo}/find", status_code=202, responses=problems(404, 409, 429, 507))
@slow
def find(services: ServicesDep, photo: PhotoDep, body: FindIn) -> TablePhotoOut:
    """Find the marked objects and the lamp; `job` has its progress."""
    return _out(services, services.photos.find(photo.id, body.together, body.seed))


@router.post("/{photo}/table", status_code=201, responses=problems(404, 409, 503, 507))
@slow
def make_table(services: ServicesDep, photo: PhotoDep, body: MakeTableIn) -> TableMadeOut:
    """Make a table whose objects lie as in the photo, under its lamp, and show it."""
    made = services.photo_tables.make_table(photo.id, despite_doubts=body.despite_doubts)
    return TableMadeOut(scene=scene_out(services, made.scene), notes=list(made.notes))


@router.post("/{photo}/goal", status_code=201, responses=problems(404, 409, 503, 507))
@slow
def make_goal(services: ServicesDep, photo: PhotoDep, body: MakeGoalIn) -> GoalMadeOut:
    """Make a goal in which objects lie as in the photo."""
    made = services.photo_tables.make_goal(photo.id, body.scene, despite_doubts=body.despite_doubts)
    scene = scene_out(services, made.scene)
    return GoalMadeOut(scene=scene, notes=list(made.notes), goal=GoalOut.of(made.goal))


@router.get("/{photo}/photo.jpg", response_class=Response, responses={**problems(404, 409), **JPEG})
def picture(services: ServicesDep, photo: PhotoDep) -> OpenFile:
    """Show a photo, upright, no side longer than 2048 px."""
    return OpenFile(services.photos.picture(photo.id), f"{photo.name} has been deleted.", media_type="image/jpeg")


@router.get("/{photo}/objects/{name}/mask.png", response_class=Response, responses={**problems(404, 409), **PNG})
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


def _kept(services: Services, data: bytes, name: str) -> PictureOut:
    picture = services.goals.read(data)
    if services.goal_checks.is_goal_view(picture):
        return PictureOut(goal=GoalOut.of(services.goals.receive_read(picture, name)), photo=None)
    return PictureOut(goal=None, photo=_out(services, services.photos.receive(data, name)))


def _out(services: Services, photo: TablePhoto) -> TablePhotoOut:
    job = services.photos.job(photo)
    found = services.photos.found(photo) if job is not None and job.state == "done" else None
    by_name = {} if job is None or found is None else {one.name: _found(job, one) for one in found.objects}
    labels = services.objects.labels()
    return TablePhotoOut(
        **_facts(photo if found is None else photo.as_found(found)).model_dump(),
        notes=list(photo.notes) if found is None else found.notes,
        objects=[_marked(one, labels.get(one.name, one.name), by_name.get(one.name)) for one in photo.objects],
        job=None if job is None else JobOut.of(job),
        table=None if found is None else found.table,
        light=None if found is None else found.light,
        doubts=[] if found is None else list(services.photos.doubts(photo, found)),
        scene=photo.scene,
    )


CALIBRATION_UPLOAD_PATH = "/api/calibration/photos"
calibration_router = APIRouter(
    prefix="/api/calibration", tags=["photos"], responses=problems(), route_class=BoundedRoute
)


@calibration_router.post("/photos", responses=problems(415, 503), openapi_extra=_PHOTO_BODY)
async def sight(
    services: ServicesDep,
    request: Request,
    name: Annotated[DisplayName, Query(description="For people.")] = "Photo",
    board: Annotated[BoardText, Query(description=_BOARD)] = "",
) -> SightingOut:
    """Look for the board in a photo; the photo itself is not kept."""
    described = board_of(board)
    data = await _photo_body(request, services.settings.max_photo_bytes)
    identifier, seen = await run_in_threadpool(services.board_photos.add, data, name, described)
    width, height = seen.size
    corners = seen.points_px.round(2).tolist()
    return SightingOut(id=identifier, name=seen.name, width=width, height=height, corners=corners)


@calibration_router.post("", responses=problems(503))
@slow
def assess(services: ServicesDep, body: CalibrateIn) -> CalibrationOut:
    """Return what photos of the board show of the camera so far, what is missing and what helps most."""
    place = board_place(body.place.x_m, body.place.y_m, body.place.turn_deg)
    found = services.board_photos.assess(body.photos, body.table, place)
    camera = CalibrationJson.model_validate(calibration_to_json(found, body.name))
    advice = found.advice
    following = None if advice is None else AdviceOut(words=advice.words, expected_error_mm=1e3 * advice.mean_m)
    return CalibrationOut(missing=found.missing, next=following, camera=camera)
