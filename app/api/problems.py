"""Errors as RFC 9457 problem+json: one sentence for a person, a status for a program, never a traceback."""

from __future__ import annotations

import logging
from collections.abc import Iterator
from contextlib import contextmanager
from typing import Any

from fastapi import FastAPI, Request
from fastapi.exceptions import RequestValidationError
from fastapi.responses import JSONResponse
from starlette.exceptions import HTTPException

from app.api.schemas.common import Problem, ProblemPointer
from app.storage.paths import without_places
from osfcore.errors import OsfError, UnknownName

_log = logging.getLogger(__name__)

STATUS_OF_KIND = {
    "WrongJobState": 409,
    "SceneHeld": 409,
    "TooManyScenes": 409,
    "TooManySets": 409,
    "SetInUse": 409,
    "SceneNeeded": 409,
    "WorkshopInUse": 409,
    "TrainingAlready": 409,
    "ShippedField": 409,
    "NoTrainedField": 409,
    "ObjectTaken": 409,
    "ObjectNeeded": 409,
    "CatalogueObject": 409,
    "MissingFields": 409,
    "NoPublishedField": 409,
    "NoScene": 409,
    "NoTable": 409,
    "NoTrajectory": 409,
    "NoClip": 409,
    "GoalUnknown": 409,
    "EpisodeGoesOn": 409,
    "NotDriving": 409,
    "NoRobot": 404,
    "NoPicture": 404,
    "RobotBusy": 409,
    "NothingAsked": 409,
    "ConnectionLost": 503,
    "RobotRefused": 503,
    "NoRoomToNudge": 409,
    "GoalRefused": 409,
    "NoPhoto": 409,
    "TooManyPhotos": 409,
    "NothingMarked": 409,
    "NotFoundYet": 409,
    "NoPhotographedTable": 409,
    "PhotoDoubtful": 409,
    "NoDraft": 404,
    "DraftUnsound": 409,
    "TooManyGoals": 409,
    "NothingToPush": 409,
    "NoPrior": 409,
    "NoImages": 404,
    "QueueFull": 429,
    "ProcessUnavailable": 503,
    "ProcessHangs": 503,
    "ProcessBusy": 503,
    "ProcessFrozen": 503,
    "TooManyStreams": 503,
    "CannotStore": 507,
    "StorageFull": 507,
    "UploadNotStored": 507,
    "CannotWrite": 507,
    "CorruptFile": 409,
    "InternalError": 500,
    "NotFound": 404,
}
_MOST_POINTERS = 20  # mistakes that are told of one request
_TITLES = {
    400: "Bad request",
    401: "Token needed",
    403: "Forbidden",
    404: "Not found",
    405: "Method not allowed",
    409: "Conflict",
    413: "Request too large",
    415: "Unsupported media type",
    421: "Misdirected request",
    422: "Invalid input",
    429: "Too many requests",
    500: "Internal error",
    503: "Not available now",
    507: "Out of space",
}


class NotFound(OsfError):
    """What the path names does not exist."""


@contextmanager
def named_in_path() -> Iterator[None]:
    """Answer 404 instead of 422 where the name that is unknown stands in the path."""
    try:
        yield
    except UnknownName as error:
        raise NotFound(str(error)) from None


class ProblemResponse(JSONResponse):
    """A JSON response of the problem media type."""

    media_type = "application/problem+json"


def problem(
    status: int, detail: str, pointers: list[ProblemPointer] | None = None, headers: dict[str, str] | None = None
) -> ProblemResponse:
    """A response of the problem media type.

    Args:
        status: of HTTP; decides the title.
        detail: one sentence for a person.
        pointers: where in the request it lies; left out if None.
        headers: further ones.
    """
    # Lone surrogates come in through JSON escapes, but no UTF-8 goes out with them.
    clean = detail.encode("utf-8", "replace").decode("utf-8")
    body = Problem(title=_TITLES.get(status, "Error"), status=status, detail=clean, errors=pointers)
    return ProblemResponse(body.model_dump(exclude_none=True), status, headers)


def too_large(most_bytes: int) -> str:
    """That a request or file is larger than it may be."""
    scale, unit = next((s, u) for s, u in ((1e6, "MB"), (1e3, "KB"), (1, "bytes")) if most_bytes >= s or s == 1)
    most = f"{most_bytes / scale:.0f} {unit}"
    return f"This is larger than {most}, which is the most; send something smaller."


def status_of(error: OsfError) -> int:
    """The HTTP status that says what an error says."""
    return STATUS_OF_KIND.get(type(error).__name__, 422)


def install(app: FastAPI) -> None:
    """Make the app answer every error as a problem; `app.state.settings` tells which places no sentence may name."""
    app.add_exception_handler(OsfError, _on_osf_error)
    app.add_exception_handler(HTTPException, _on_http_error)
    app.add_exception_handler(RequestValidationError, _on_validation_error)
    app.add_exception_handler(Exception, _on_defect)


async def _on_osf_error(request: Request, error: Exception) -> ProblemResponse:
    assert isinstance(error, OsfError)
    status = status_of(error)
    detail = without_places(str(error), request.app.state.settings.data_dir)
    return problem(status, detail, headers={"Retry-After": "2"} if status in (429, 503) else None)


async def _on_http_error(request: Request, error: Exception) -> ProblemResponse:
    assert isinstance(error, HTTPException)
    detail = str(error.detail)
    if error.status_code == 404 and detail == "Not Found":
        detail = f"There is nothing at {request.url.path}."
    if error.status_code == 405:
        detail = f"{request.url.path} does not offer {request.method}."
    return problem(error.status_code, detail, headers=dict(error.headers or {}))


async def _on_validation_error(_: Request, error: Exception) -> ProblemResponse:
    assert isinstance(error, RequestValidationError)
    entries = error.errors()
    pointers = [_pointer(entry, error.body) for entry in entries[:_MOST_POINTERS]]
    first = pointers[0] if pointers else ProblemPointer(pointer="#", detail="unreadable")
    more = f" (and {len(entries) - 1} more)" if len(entries) > 1 else ""
    return problem(422, f"{first.pointer or first.parameter}: {first.detail}{more}", pointers)


async def _on_defect(request: Request, error: Exception) -> ProblemResponse:
    _log.error("%s %s failed", request.method, request.url.path, exc_info=error)
    return problem(500, f"The service failed on this request ({type(error).__name__}); its log tells more.")


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
