"""Fields, and the image sets that people upload to train them from."""

from __future__ import annotations

from typing import Annotated, Any, Literal

from fastapi import APIRouter, Path, Query, Request, Response
from pydantic import BaseModel, Field

from osfcore.fields.field_library import FieldInfo
from osfcore.paper.method import Method

from ..jobs.kinds.fields import TrainFieldParams
from ..jobs.params import Identifier
from ..services.fields import NoTrainedField
from ..services.image_sets import SetRecord
from .bodies import PNG, OpenFile, refuse_form, upload
from .dependencies import Services, ServicesDep
from .models import FileName, Input
from .paging import DEFAULT_PAGE, AfterEntry, DamagedOut, Limit, PageOut, page
from .problems import named_in_path, problems


class FieldOut(BaseModel):
    """A trained field."""

    name: str
    label: str
    source: Literal["shipped", "trained"] = Field(description="With the program, or trained on this machine.")
    bytes: int = Field(description="Size of the weights.")
    metrics: dict[str, Any] = Field(description="What was measured on unseen views under unseen lights [dB].")
    published: Literal["shipped", "trained"] | None = Field(
        description="Where the field as published beside it comes from; null if there is none."
    )
    has_mesh: bool = Field(description="Whether scenes can simulate it: they need a mesh of the same name.")
    note: str | None = Field(description="What is missing, in words.")


class FieldList(BaseModel):
    """All fields, sorted by name."""

    fields: list[FieldOut]


class UseIn(Input):
    """A field that was trained and is not in use, since the one that was there was better."""

    job: Identifier = Field(description="Identifier of the job that trained it.")


class SetOut(BaseModel):
    """An uploaded image set that was found sound."""

    id: str
    file_name: str
    created_at: str = Field(description="UTC, ISO 8601.")
    train: int = Field(description="Images to learn from.")
    test: int = Field(description="Images that only measure.")
    summary: str

    @staticmethod
    def of(record: SetRecord) -> SetOut:
        """From the store of sets."""
        return SetOut.model_validate(record, from_attributes=True)


class SetList(PageOut):
    """Uploaded image sets, oldest first."""

    sets: list[SetOut]
    damaged: list[DamagedOut] = Field(description="What can only be deleted, on each page.")


UPLOAD_PATH = "/api/fields/sets"
NEEDS_MESH = "It needs a mesh of the same name before scenes can hold it; add one with 'osf assets add'."
router = APIRouter(prefix="/api/fields", tags=["fields"], responses=problems())
FieldName = Annotated[str, Path(examples=["006_mustard_bottle"])]
SetId = Annotated[str, Path(description="Identifier of an image set.")]


@router.get("")
def list_all(services: ServicesDep) -> FieldList:
    """List the fields: what is shipped with the program and what was trained here."""
    return FieldList(fields=[_out(services, info) for info in services.fields.all()])


@router.post("/sets", status_code=201, responses=problems(409, 415, 507), openapi_extra=upload("application/zip"))
async def upload_set(
    services: ServicesDep,
    request: Request,
    response: Response,
    file_name: Annotated[FileName, Query(description="What the zip is called, for people.")] = "set.zip",
) -> SetOut:
    """Upload a zipped image set in the OSF format: train/anno.json, test/anno.json and RGBA PNGs beside them."""
    refuse_form(request, "application/zip")
    record = await services.runner.sets.receive(request.stream(), file_name)
    response.headers["Location"] = f"{UPLOAD_PATH}/{record.id}"
    return SetOut.of(record)


@router.get("/sets")
def list_sets(services: ServicesDep, limit: Limit = DEFAULT_PAGE, after: AfterEntry = None) -> SetList:
    """List the uploaded image sets, oldest first."""
    sets = services.runner.sets
    shown, total, following = page(sets.all()[::-1], limit, after, newest_first=False)
    damaged = DamagedOut.of(sets.damaged())
    return SetList(sets=[SetOut.of(record) for record in shown], damaged=damaged, total=total, next=following)


@router.get("/sets/{set_id}", responses=problems(404, 409))
def get_set(services: ServicesDep, set_id: SetId) -> SetOut:
    """Return what is in an uploaded image set."""
    return SetOut.of(_found_set(services, set_id))


@router.delete("/sets/{set_id}", status_code=204, responses=problems(404, 409, 507))
def delete_set(services: ServicesDep, set_id: SetId) -> None:
    """Delete an uploaded image set, damaged or not."""
    with named_in_path():
        services.runner.remove_set(set_id)


@router.get("/sets/{set_id}/overlay.png", response_class=Response, responses={**problems(404, 409), **PNG})
def overlay(services: ServicesDep, set_id: SetId) -> OpenFile:
    """Show how a set was understood: axes, light and the silhouettes' box, drawn into some of its images."""
    _found_set(services, set_id)
    path = services.runner.sets.overlay(set_id)
    gone = "The overlay of this image set has been removed from the data directory."
    return OpenFile(path, gone, media_type="image/png")


@router.get("/{name}", responses=problems(404))
def get(services: ServicesDep, name: FieldName) -> FieldOut:
    """Return what is known of one field."""
    return _out(services, _known_field(services, name))


@router.post("/{name}/use", include_in_schema=False)  # which in OpenAPI is a path that /sets/{set_id} is, too
@router.patch("/{name}", responses=problems(404, 409, 507))
def use(services: ServicesDep, name: FieldName, body: UseIn) -> FieldOut:
    """Use a field that was trained here, though it is not as good as the one that is in use."""
    _known_field(services, name)
    job = services.runner.jobs.get(body.job, "train_field")
    params = TrainFieldParams.from_json(job.params)
    is_ours = params.method == "ours"  # one as published is in use anyway, elsewhere
    if params.name != name or job.state != "done" or not is_ours:
        raise NoTrainedField(name)
    services.fields.use(name, services.runner.jobs.folder(job.id))
    services.runner.storage.outdate()
    return _out(services, services.fields.get(name))


@router.delete("/{name}", status_code=204, responses=problems(404, 409, 507))
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
