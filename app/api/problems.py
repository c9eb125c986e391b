"""Errors as RFC 9457 problem+json: one sentence for a person, a status for a program, never a traceback."""

from __future__ import annotations

import logging
from collections.abc import Iterator, Mapping
from contextlib import contextmanager
from typing import Any

from fastapi import FastAPI, Request, Response
from fastapi.exceptions import RequestValidationError
from fastapi.responses import JSONResponse
from pydantic import BaseModel, Field
from starlette.exceptions import HTTPException
from starlette.requests import ClientDisconnect
from starlette.routing import Route

from osfcore.contrib.robots.robot import ConnectionLost, RobotRefused, RobotStopped
from osfcore.errors import (
    CannotWrite,
    CorruptFile,
    FetchFailed,
    InvalidInput,
    MissingAssets,
    NoRoom,
    OsfError,
    OverlappingObjects,
    UnknownName,
    WorkerDied,
)
from osfcore.extras import MissingExtra
from osfcore.photo.table_layout import NoPhotographedTable
from osfcore.plugins import BrokenPlugin

from ..episodes.clip import NoClip
from ..jobs.kinds.objects import MeshRefused
from ..jobs.process import JobDied, JobStopped
from ..jobs.registry import QueueFull, WrongJobState
from ..processes.client import ProcessBusy, ProcessUnavailable
from ..processes.photo_process import PhotoRefused
from ..processes.server import InternalError, OutOfMemory
from ..services.disturber import NoRoomToNudge
from ..services.driver import NotDriving
from ..services.episodes import EpisodeGoesOn, GoalUnknown, NoGoal, NoTrajectory
from ..services.estimates import NoImages, NoPrior, NoScene
from ..services.fields import MissingFields, NoPublishedField, NoTrainedField, ShippedField
from ..services.goals import DraftUnsound, GoalRefused, NoDraft, NoPhoto, NoTable
from ..services.image_sets import TooManySets
from ..services.objects import CatalogueObject, ObjectNeeded, ObjectTaken
from ..services.photos import NotFoundYet, NothingMarked, PhotoDoubtful
from ..services.pushes import CannotExecute, NoPush, NothingToPush
from ..services.robot import NoPicture, NoRobot, NothingAsked, RobotBusy
from ..services.runner import SceneNeeded, SetInUse, TrainingAlready, WorkshopInUse
from ..services.scenes import SceneHeld, TooManyScenes
from ..storage.database import CannotStore
from ..storage.paths import without_places
from ..storage.records import TooManyGoals, TooManyPhotos
from ..storage.uploads import UploadNotStored, UploadRefused
from ..storage.usage import StorageFull
from .dependencies import TooManyStreams

_log = logging.getLogger(__name__)
_MEDIA_TYPE = "application/problem+json"


class ProblemPointer(BaseModel):
    """One thing that is wrong with a request."""

    pointer: str | None = Field(default=None, description="JSON pointer into the request body.")
    parameter: str | None = Field(default=None, description="Name of the path, query or header parameter.")
    detail: str


class Problem(BaseModel):
    """An error, as in RFC 9457."""

    type: str = "about:blank"
    title: str
    status: int
    detail: str = Field(description="One sentence for a person.")
    errors: list[ProblemPointer] | None = None


_MOST_POINTERS = 20  # mistakes that are listed of one request
_LARGEST_SHOWN = 1e9  # numbers below this are repeated in a sentence
_WORDS = {  # title of each problem, and when routes answer it
    400: ("Bad request", "The request cannot be read."),
    401: ("Token needed", "The service needs a token."),
    403: ("Forbidden", "The request comes from another site."),
    404: ("Not found", "There is no such thing."),
    405: ("Method not allowed", "The path does not offer this method."),
    409: ("Conflict", "It does not fit the present state."),
    413: ("Request too large", "The request is too large."),
    415: ("Unsupported media type", "The body is of no kind that is read here."),
    421: ("Misdirected request", "The service is not known under this host name."),
    422: ("Invalid input", "The input is not valid; the detail says what is allowed."),
    429: ("Too many requests", "Too many jobs wait already."),
    500: ("Internal error", "The service failed on this request."),
    503: ("Not available now", "The simulation, the neural renderer or the predictor is being restarted."),
    507: ("Out of space", "The disk is full, or the service holds as much as it may."),
}


class NotFound(OsfError):
    """What the path names does not exist."""


_ERRORS: dict[int, tuple[type[OsfError], ...]] = {
    404: (NotFound, NoRobot, NoPicture, NoDraft, NoImages, NoPush),
    409: (
        CannotExecute, CatalogueObject, CorruptFile, DraftUnsound, EpisodeGoesOn, GoalRefused, GoalUnknown,
        MissingAssets, MissingExtra, MissingFields, NoClip, NoPhoto, NoPhotographedTable, NoPrior, NoPublishedField,
        NoRoomToNudge, NoScene, NoTable, NoTrainedField, NoTrajectory, NotDriving, NotFoundYet, NothingAsked,
        NothingMarked, NothingToPush, ObjectNeeded, ObjectTaken, PhotoDoubtful, RobotBusy, RobotStopped, SceneHeld,
        SceneNeeded, SetInUse, ShippedField, TooManyGoals, TooManyPhotos, TooManyScenes, TooManySets, TrainingAlready,
        WorkshopInUse, WrongJobState,
    ),
    422: (InvalidInput, MeshRefused, NoGoal, NoRoom, OverlappingObjects, PhotoRefused, UnknownName, UploadRefused),
    429: (QueueFull,),
    500: (BrokenPlugin, InternalError),
    503: (
        ConnectionLost, FetchFailed, JobDied, JobStopped, OutOfMemory, ProcessBusy, ProcessUnavailable, RobotRefused,
        TooManyStreams, WorkerDied,
    ),
    507: (CannotStore, CannotWrite, StorageFull, UploadNotStored),
}  # fmt: skip
STATUSES = {kind: status for status, kinds in _ERRORS.items() for kind in kinds}


@contextmanager
def named_in_path() -> Iterator[None]:
    """Answer 404 instead of 422 where the name that is unknown stands in the path."""
    try:
        yield
    except UnknownName as error:
        raise NotFound(str(error)) from None


def problem(
    status: int, detail: str, pointers: list[ProblemPointer] | None = None, headers: dict[str, str] | None = None
) -> JSONResponse:
    """A response of the problem media type.

    Args:
        status: of HTTP; decides the title.
        detail: one sentence for a person.
        pointers: where in the request it lies; left out if None.
        headers: further ones.
    """
    # Lone surrogates come in through JSON escapes, but no UTF-8 goes out with them.
    clean = detail.encode("utf-8", "replace").decode("utf-8")
    title = _WORDS[status][0] if status in _WORDS else "Error"
    body = Problem(title=title, status=status, detail=clean, errors=pointers)
    return JSONResponse(body.model_dump(exclude_none=True), status, headers, _MEDIA_TYPE)


def too_large(most_bytes: int) -> str:
    """That a request or file is larger than it may be."""
    scale, unit = next((s, u) for s, u in ((1e6, "MB"), (1e3, "KB"), (1, "bytes")) if most_bytes >= s or s == 1)
    most = f"{most_bytes / scale:.0f} {unit}"
    return f"This is larger than {most}, which is the most; send something smaller."


def status_of(error: OsfError) -> int:
    """The HTTP status that says what an error says; one of an unknown class is a defect, a mere sentence is not."""
    if type(error) is OsfError:
        return 422
    return next((STATUSES[kind] for kind in type(error).__mro__ if kind in STATUSES), 500)


def install(app: FastAPI) -> None:
    """Make the app answer every error as a problem; `app.state.settings` says which places no sentence may name."""
    app.add_exception_handler(OsfError, _on_osf_error)
    app.add_exception_handler(HTTPException, _on_http_error)
    app.add_exception_handler(RequestValidationError, _on_validation_error)
    app.add_exception_handler(ClientDisconnect, _on_broken_upload)
    app.add_exception_handler(Exception, _on_defect)


async def _on_osf_error(request: Request, error: Exception) -> JSONResponse:
    assert isinstance(error, OsfError)
    status = status_of(error)
    detail = without_places(str(error), request.app.state.settings.data_dir)
    return problem(status, detail, headers={"Retry-After": "2"} if status in (429, 503) else None)


async def _on_http_error(request: Request, error: Exception) -> Response:
    assert isinstance(error, HTTPException)
    if error.status_code == 204:
        return Response(status_code=204)
    detail, headers = str(error.detail), dict(error.headers or {})
    if error.status_code == 404 and detail == "Not Found":
        detail = f"There is nothing at {request.url.path}."
    if error.status_code == 405:
        detail = f"{request.url.path} does not offer {request.method}."
        headers["Allow"] = ", ".join(_methods(request))
    return problem(error.status_code, detail, headers=headers)


def _methods(request: Request) -> list[str]:
    """What a path offers, over all its routes; files of the page, which have none, can be read."""
    path = request.scope["path"].removeprefix(request.scope.get("root_path", ""))
    routes = [route for route in request.app.state.routes if isinstance(route, Route) and route.path_regex.match(path)]
    methods = {method for route in routes for method in route.methods or ()} or {"GET"}
    return sorted(methods | ({"HEAD"} if "GET" in methods else set()))


async def _on_validation_error(_: Request, error: Exception) -> JSONResponse:
    assert isinstance(error, RequestValidationError)
    entries = error.errors()
    pointers = [_pointer(entry, error.body) for entry in entries[:_MOST_POINTERS]]
    sentence = _sentence(entries[0]) if entries else "The request cannot be read."
    more = f" There {'is one mistake' if len(entries) == 2 else f'are {len(entries) - 1} mistakes'} more."
    return problem(422, sentence + (more if len(entries) > 1 else ""), pointers)


async def _on_broken_upload(_: Request, __: Exception) -> JSONResponse:
    return problem(400, "The upload broke off.")


async def _on_defect(request: Request, error: Exception) -> JSONResponse:
    _log.error("%s %s failed", request.method, request.url.path, exc_info=error)
    return problem(500, f"The service failed on this request ({type(error).__name__}); its log has more.")


_MUST = {
    "missing": "is missing",
    "int_type": "must be a whole number",
    "int_parsing": "must be a whole number",
    "int_from_float": "must be a whole number",
    "float_type": "must be a number",
    "float_parsing": "must be a number",
    "finite_number": "must be a finite number",
    "greater_than_equal": "must be at least {ge}",
    "greater_than": "must be more than {gt}",
    "less_than_equal": "must be at most {le}",
    "less_than": "must be less than {lt}",
    "bool_type": "must be true or false",
    "bool_parsing": "must be true or false",
    "string_type": "must be a text",
    "string_too_short": "must have at least {min_length} characters",
    "string_too_long": "must have at most {max_length} characters",
    "too_short": "must have at least {min_length} entries",
    "too_long": "must have at most {max_length} entries",
    "list_type": "must be a list",
    "literal_error": "must be {expected}",
    "extra_forbidden": "is not known here",
}  # of the kinds of mistakes that pydantic finds


def _sentence(entry: Mapping[str, Any]) -> str:
    """What is wrong in a request, for a person; the value only where it is a number."""
    *_, name = [str(part).replace("_", " ") for part in entry["loc"] if not isinstance(part, int)] or ["the request"]
    subject = "The request" if name in ("body", "query") else name.capitalize()
    must = _MUST.get(entry["type"])
    if must is None:
        return f"{subject} cannot be used: {entry['msg']}."
    value = entry.get("input")
    is_shown = isinstance(value, int | float) and not isinstance(value, bool) and abs(value) < _LARGEST_SHOWN
    now = f" is {value:g}, but it" if is_shown and must.startswith("must") else ""
    return f"{subject}{now} {must.format(**entry.get('ctx', {}))}."


def _pointer(entry: dict[str, Any], body: object) -> ProblemPointer:
    """Where and what; the input itself is left out, for it may be NaN, huge or secret."""
    where, *path = [str(part) for part in entry["loc"]] or ["body"]
    detail = str(entry["msg"]).encode("utf-8", "replace").decode("utf-8")
    if where == "body":
        if path and isinstance(body, dict) and path[0] not in body and path[0] == body.get("kind"):
            path = path[1:]  # the name of the chosen variant, which is no place in the body
        escaped = (part.replace("~", "~0").replace("/", "~1") for part in path)
        return ProblemPointer(pointer="#" + "".join(f"/{part}" for part in escaped), detail=detail)
    return ProblemPointer(parameter="/".join(path), detail=detail)


def problems(*statuses: int) -> dict[int | str, dict[str, Any]]:
    """OpenAPI entries for the errors that a route answers, besides those that any route does."""
    content = {_MEDIA_TYPE: {"schema": {"$ref": "#/components/schemas/Problem"}}}
    return {
        status: {"content": content, "description": _WORDS[status][1]}
        for status in (400, 401, 403, 413, 421, 422, *statuses)
    }
