"""Fields, and the image sets that people upload to train them from."""

from typing import Annotated

from fastapi import APIRouter, HTTPException, Path, Query, Request, Response, status
from fastapi.responses import FileResponse
from starlette.requests import ClientDisconnect

from app.api.dependencies import Services, ServicesDep
from app.api.open_file import OpenFile
from app.api.problems import named_in_path
from app.api.routes import PNG, problems
from app.api.schemas.fields import FieldList, FieldOut, SetList, SetOut, UseIn
from app.api.schemas.limits import FILE_NAME, sized
from app.api.schemas.paging import DEFAULT_PAGE, AfterEntry, Limit, page
from app.services.fields import NoTrainedField
from app.services.image_sets import SetRecord
from osfcore.fields.field_library import FieldInfo
from osfcore.paper.method import Method

UPLOAD_PATH = "/api/fields/sets"
NEEDS_MESH = "It needs a mesh of the same name before scenes can hold it; add one with 'osf assets add'."
router = APIRouter(prefix="/api/fields", tags=["fields"], responses=problems())
FieldName = Annotated[str, Path(examples=["006_mustard_bottle"])]
SetId = Annotated[str, Path(description="Identifier of an image set.")]
_ZIP_BODY = {
    "requestBody": {
        "required": True,
        "content": {"application/zip": {"schema": {"type": "string", "format": "binary"}}},
    }
}


@router.get("")
def list_all(services: ServicesDep) -> FieldList:
    """List the fields: what is shipped with the program and what was trained here."""
    return FieldList(fields=[_out(services, info) for info in services.fields.all()])


@router.post("/sets", status_code=status.HTTP_201_CREATED, responses=problems(409, 507), openapi_extra=_ZIP_BODY)
async def upload_set(
    services: ServicesDep,
    request: Request,
    response: Response,
    file_name: Annotated[str, Query(**sized(FILE_NAME), description="What the zip is called, for people.")] = "set.zip",
) -> SetOut:
    """Upload a zipped image set in the OSF format: train/anno.json, test/anno.json and RGBA PNGs beside them."""
    try:
        record = await services.runner.sets.receive(request.stream(), file_name)
    except ClientDisconnect:
        raise HTTPException(status.HTTP_400_BAD_REQUEST, "The upload broke off.") from None
    response.headers["Location"] = f"{UPLOAD_PATH}/{record.id}"
    return SetOut.of(record)


@router.get("/sets")
def list_sets(services: ServicesDep, limit: Limit = DEFAULT_PAGE, after: AfterEntry = None) -> SetList:
    """List the uploaded image sets, oldest first."""
    shown, total, following = page(services.runner.sets.all(), limit, after, newest_first=False)
    return SetList(sets=[SetOut.of(record) for record in shown], total=total, next=following)


@router.get("/sets/{set_id}", responses=problems(404))
def get_set(services: ServicesDep, set_id: SetId) -> SetOut:
    """Tell what is in an uploaded image set."""
    return SetOut.of(_found_set(services, set_id))


@router.delete("/sets/{set_id}", status_code=status.HTTP_204_NO_CONTENT, responses=problems(404, 409, 507))
def delete_set(services: ServicesDep, set_id: SetId) -> None:
    """Delete an uploaded image set."""
    _found_set(services, set_id)
    services.runner.remove_set(set_id)


@router.get("/sets/{set_id}/overlay.png", response_class=FileResponse, responses={**problems(404), **PNG})
def overlay(services: ServicesDep, set_id: SetId) -> OpenFile:
    """Show how a set was understood: axes, light and the silhouettes' box, drawn into some of its images."""
    _found_set(services, set_id)
    path = services.runner.sets.overlay(set_id)
    gone = "The overlay of this image set has been removed from the data directory."
    return OpenFile(path, gone, media_type="image/png")


@router.get("/{name}", responses=problems(404))
def get(services: ServicesDep, name: FieldName) -> FieldOut:
    """Tell what is known of one field."""
    return _out(services, _known_field(services, name))


@router.post("/{name}/use", responses=problems(404, 409, 507))
def use(services: ServicesDep, name: FieldName, body: UseIn) -> FieldOut:
    """Use a field that was trained here, though it is not as good as the one that is in use."""
    _known_field(services, name)
    job = services.runner.jobs.get(body.job, "train_field")
    is_ours = job.params.get("method", "ours") == "ours"  # one as published is in use anyway, elsewhere
    if job.params["name"] != name or job.state != "done" or not is_ours:
        raise NoTrainedField(name)
    services.fields.use(name, services.runner.jobs.folder(job.id))
    services.runner.storage.outdate()
    return _out(services, services.fields.get(name))


@router.delete("/{name}", status_code=status.HTTP_204_NO_CONTENT, responses=problems(404, 409, 507))
def delete(
    services: ServicesDep,
    name: FieldName,
    method: Annotated[Method, Query(description='"paper" for the field as published.')] = "ours",
) -> None:
    """Delete a field that was trained here; a shipped one of the same name then counts again."""
    _known_field(services, name)
    if method == "paper":
        services.fields.remove_published(name)
    else:
        services.fields.remove(name)
    services.runner.storage.outdate()


def _out(services: Services, info: FieldInfo) -> FieldOut:
    has_mesh = services.fields.has_mesh(info.name)
    return FieldOut(
        name=info.name,
        label=services.objects.labels().get(info.name, info.name),
        source=info.source,
        bytes=info.bytes,
        metrics=dict(info.metrics),
        published=services.fields.origin_of_published(info.name),
        has_mesh=has_mesh,
        note=None if has_mesh else NEEDS_MESH,
    )


def _known_field(services: Services, name: str) -> FieldInfo:
    with named_in_path():
        return services.fields.get(name)


def _found_set(services: Services, set_id: str) -> SetRecord:
    with named_in_path():
        return services.runner.sets.get(set_id)
