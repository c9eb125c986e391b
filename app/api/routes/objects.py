"""Which objects there are, how they look, adding and deleting one's own."""

import contextlib
from typing import Annotated

from fastapi import APIRouter, HTTPException, Path, Query, Request, Response, status
from starlette.requests import ClientDisconnect

from app.api.dependencies import Services, ServicesDep
from app.api.lanes import slow
from app.api.problems import named_in_path
from app.api.routes import PNG, problems
from app.api.schemas.common import ObjectList, ObjectName, ObjectOut
from app.api.schemas.jobs import JobOut
from app.api.schemas.limits import FILE_NAME, LABEL, MASS_KG, SCALE, sized, within
from osfcore.errors import OsfError
from osfcore.objects.catalogue import CATALOGUE
from osfcore.objects.fetch import DEFAULT_NAMES, NewObject

UPLOAD_PATH = "/api/objects"
router = APIRouter(prefix=UPLOAD_PATH, tags=["objects"], responses=problems())
Name = Annotated[str, Path(examples=["006_mustard_bottle"])]
_BINARY = {"schema": {"type": "string", "format": "binary"}}
_MESH_BODY = {"requestBody": {"required": True, "content": {"model/gltf-binary": _BINARY, "application/zip": _BINARY}}}


@router.get("")
def list_all(services: ServicesDep) -> ObjectList:
    """List the objects of the catalogue and those that were added."""
    names = dict.fromkeys((*CATALOGUE, *services.objects.names()))
    listed = []
    for name in names:
        with contextlib.suppress(OsfError):  # a damaged object of the user's must not hide the others
            listed.append(_object(services, name))
    return ObjectList(objects=listed)


@router.post("", status_code=status.HTTP_202_ACCEPTED, responses=problems(409, 429, 507), openapi_extra=_MESH_BODY)
async def add(
    services: ServicesDep,
    request: Request,
    response: Response,
    name: Annotated[ObjectName, Query(description="What scenes call it.")],
    mass_kg: Annotated[float, Query(**within(MASS_KG), description="Mass [kg].")],
    label: Annotated[str, Query(**sized(LABEL), description="Name for a person; from the name if empty.")] = "",
    scale: Annotated[
        float, Query(**within(SCALE), description="Metres for one unit of the file, such as 0.001 for millimetres.")
    ] = 1.0,
    licence: Annotated[str, Query(**sized(LABEL), description="Of the mesh.")] = "unknown",
    file_name: Annotated[str, Query(**sized(FILE_NAME), description="What the file is called, for people.")] = "mesh",
) -> JobOut:
    """Add an object from a GLB, or from a zip of an OBJ with its MTL and texture; answers the job that makes it."""
    new = NewObject(name, mass_kg, label, scale, licence)
    try:
        job = await services.own_objects.receive(new, request.stream(), file_name)
    except ClientDisconnect:
        raise HTTPException(status.HTTP_400_BAD_REQUEST, "The upload broke off.") from None
    response.headers["Location"] = f"/api/jobs/{job.id}"
    return JobOut.of(job)


@router.get("/{name}", responses=problems(404))
def get(services: ServicesDep, name: Name) -> ObjectOut:
    """Tell what is known of one object."""
    with named_in_path():
        return _object(services, name)


@router.delete(
    "/{name}", response_class=Response, status_code=status.HTTP_204_NO_CONTENT, responses=problems(404, 409, 507)
)
def delete(services: ServicesDep, name: Name) -> Response:
    """Delete an object that was added here; its field stays, and counts again for a new object of that name."""
    with named_in_path():
        services.own_objects.delete(name)
    services.objects.outdate()
    return Response(status_code=status.HTTP_204_NO_CONTENT)


@router.get("/{name}/thumbnail.png", response_class=Response, responses={**problems(404, 409, 503), **PNG})
@slow
def thumbnail(
    services: ServicesDep,
    name: Name,
    v: Annotated[str, Query(**sized(LABEL), description="Anything; another one gets past a browser's cache.")] = "",
) -> Response:
    """Show an object from all around: 24 views of 96 px side by side, 15 degrees apart, transparent around it."""
    with named_in_path():
        services.runner.library.info(name)
        png = services.thumbnails.png(name)
    lasting = "private, max-age=604800" if v else "no-cache"
    return Response(png, media_type="image/png", headers={"Cache-Control": lasting})


def _object(services: Services, name: str) -> ObjectOut:
    library = services.runner.library
    info = library.info(name)
    try:
        size_m, version = library.size_m(name), library.digest(name)[:12]
    except OsfError:  # not fetched, or damaged
        size_m, version = None, None
    is_own = name not in CATALOGUE
    return ObjectOut.of(info, size_m, version, is_own=is_own, is_fetchable=name in DEFAULT_NAMES)
