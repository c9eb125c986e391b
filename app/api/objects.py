"""Which objects there are, how they look, adding and deleting one's own."""

from __future__ import annotations

import contextlib
from typing import Annotated, Literal

from fastapi import APIRouter, Path, Query, Request, Response
from pydantic import BaseModel, Field

from osfcore.errors import OsfError
from osfcore.objects.catalogue import CATALOGUE
from osfcore.objects.fetch import MAX_MASS_KG, NewObject

from ..jobs.params import ObjectName
from .bodies import PNG, refuse_form, upload
from .dependencies import Services, ServicesDep, slow
from .jobs import JobOut
from .models import FileName, Label, Vector3
from .paging import DamagedOut
from .problems import named_in_path, problems


class SymmetryOut(BaseModel):
    """Which rotations look the same."""

    kind: Literal["none", "discrete", "continuous"]
    reason: str


class ObjectOut(BaseModel):
    """An object of the catalogue or one that a user added."""

    name: str
    label: str
    mass_kg: float = Field(description="[kg]")
    size_m: Vector3 | None = Field(description="Extents of the bounding box [m]; null until it has been fetched.")
    symmetry: SymmetryOut
    licence: str
    attribution: str
    available: bool = Field(description="Whether it is on this machine and can be used in scenes.")
    own: bool = Field(description="Whether it was added here, and can be deleted; others are fetched.")
    version: str | None = Field(description="Changes with its looks and facts; null until it is on this machine.")


class ObjectList(BaseModel):
    """All known objects."""

    objects: list[ObjectOut]
    damaged: list[DamagedOut] = Field(description="What can only be fetched again or deleted.")


UPLOAD_PATH = "/api/objects"
router = APIRouter(prefix=UPLOAD_PATH, tags=["objects"], responses=problems())
Name = Annotated[str, Path(examples=["006_mustard_bottle"])]
_MESH_BODY = upload("model/gltf-binary", "application/zip", "application/octet-stream")


@router.get("")
def list_all(services: ServicesDep) -> ObjectList:
    """List the objects of the catalogue and those that were added."""
    there = services.objects.names()
    names = dict.fromkeys((*CATALOGUE, *there))
    listed = []
    for name in names:
        with contextlib.suppress(OsfError):  # a damaged object of the user's must not hide the others
            listed.append(_object(services, name, is_there=name in there))
    damaged = [DamagedOut(id=name, reason=reason) for name, reason in services.objects.damaged().items()]
    return ObjectList(objects=listed, damaged=damaged)


@router.post("", status_code=202, responses=problems(409, 415, 429, 507), openapi_extra=_MESH_BODY)
async def add(
    services: ServicesDep,
    request: Request,
    response: Response,
    name: Annotated[ObjectName, Query(description="What scenes call it.")],
    mass_kg: Annotated[
        float | None, Query(ge=0.0001, le=MAX_MASS_KG, description="Mass [kg]; guessed from the volume if left out.")
    ] = None,
    label: Annotated[Label, Query(description="Name for a person; from the name if empty.")] = "",
    scale: Annotated[
        float, Query(ge=1e-6, le=1e6, description="Metres for one unit of the file, such as 0.001 for millimetres.")
    ] = 1.0,
    licence: Annotated[Label, Query(description="Of the mesh.")] = "unknown",
    file_name: Annotated[FileName, Query(description="What the file is called; its end tells PLY from STL.")] = "mesh",
) -> JobOut:
    """Add an object from a GLB, PLY or STL, or from a zip of a mesh with the files that it names; answers the job."""
    refuse_form(request, "model/gltf-binary, application/zip or application/octet-stream")
    new = NewObject(name, mass_kg, label, scale, licence)
    job = await services.own_objects.receive(new, request.stream(), file_name)
    response.headers["Location"] = f"/api/jobs/{job.id}"
    return JobOut.of(job)


@router.get("/{name}", responses=problems(404))
def get(services: ServicesDep, name: Name) -> ObjectOut:
    """Return what is known of one object."""
    with named_in_path():
        return _object(services, name, is_there=services.runner.library.has(name))


@router.delete("/{name}", response_class=Response, status_code=204, responses=problems(404, 409, 507))
def delete(services: ServicesDep, name: Name) -> Response:
    """Delete an object that was added here, damaged or not; its field stays, for a new object of that name."""
    with named_in_path():
        services.own_objects.delete(name)
    services.objects.outdate()
    return Response(status_code=204)


@router.get("/{name}/thumbnail.png", response_class=Response, responses={**problems(404, 409, 503), **PNG})
@slow
def thumbnail(
    services: ServicesDep,
    name: Name,
    v: Annotated[Label, Query(description="Anything; another one gets past a browser's cache.")] = "",
) -> Response:
    """Show an object from all around: 24 views of 96 px side by side, 15 degrees apart, transparent around it."""
    with named_in_path():
        services.runner.library.info(name)
        png = services.thumbnails.png(name)
    lasting = "private, max-age=604800" if v else "no-cache"
    return Response(png, media_type="image/png", headers={"Cache-Control": lasting})


def _object(services: Services, name: str, *, is_there: bool) -> ObjectOut:
    library = services.runner.library
    info = library.info(name)
    size_m, version = None, None
    if is_there:
        with contextlib.suppress(OsfError):  # deleted or damaged in this moment
            size_m, version = library.size_m(name).tolist(), library.digest(name)[:12]
    return ObjectOut(
        name=info.name,
        label=info.label,
        mass_kg=info.mass_kg,
        size_m=size_m,
        symmetry=SymmetryOut(kind=info.symmetry.kind, reason=info.symmetry.reason),
        licence=info.licence,
        attribution=info.attribution,
        available=size_m is not None,
        own=name not in CATALOGUE,
        version=version,
    )
