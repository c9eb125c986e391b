"""Which objects there are."""

import contextlib
from typing import Annotated

from fastapi import APIRouter, Path

from app.api.dependencies import Services, ServicesDep
from app.api.problems import named_in_path
from app.api.routes import problems
from app.api.schemas.common import ObjectList, ObjectOut
from osfcore.errors import OsfError
from osfcore.objects.catalogue import CATALOGUE

router = APIRouter(prefix="/api/objects", tags=["objects"], responses=problems())


@router.get("")
def list_all(services: ServicesDep) -> ObjectList:
    """List the objects of the catalogue and those that were added."""
    names = dict.fromkeys((*CATALOGUE, *services.objects.names()))
    listed = []
    for name in names:
        with contextlib.suppress(OsfError):  # a damaged object of the user's must not hide the others
            listed.append(_object(services, name))
    return ObjectList(objects=listed)


@router.get("/{name}", responses=problems(404))
def get(services: ServicesDep, name: Annotated[str, Path(examples=["006_mustard_bottle"])]) -> ObjectOut:
    """Tell what is known of one object."""
    with named_in_path():
        return _object(services, name)


def _object(services: Services, name: str) -> ObjectOut:
    library = services.runner.library
    info = library.info(name)
    try:
        size_m = library.size_m(name)
    except OsfError:  # not fetched, or damaged
        size_m = None
    return ObjectOut.of(info, size_m)
