"""Bodies of requests: JSON within bounds, and bodies of more than one kind, at which a handler has to look itself."""

from __future__ import annotations

import contextlib
import json
from collections.abc import Callable, Coroutine
from typing import Any, TypeVar

from fastapi import HTTPException, Request, Response, status
from fastapi.exceptions import RequestValidationError
from fastapi.routing import APIRoute
from pydantic import ValidationError

from app.api.problems import too_large
from app.api.schemas.common import Input

JSON = "application/json"
SMALL_BODY_BYTES = 256 << 10  # of JSON that describes a scene, a goal or an order
MAX_MEMBERS = 100  # of one JSON object: each unknown one is a mistake that is told, at some cost
Model = TypeVar("Model", bound=Input)


class BoundedRoute(APIRoute):
    """A route that refuses JSON objects with very many members before they are looked at one by one."""

    def get_route_handler(self) -> Callable[[Request], Coroutine[Any, Any, Response]]:
        """The handler, with requests that read JSON within bounds."""
        handle = super().get_route_handler()

        async def handle_bounded(request: Request) -> Response:
            return await handle(_BoundedRequest(request.scope, request.receive))

        return handle_bounded


class _BoundedRequest(Request):
    async def json(self) -> Any:  # noqa: ANN401  any JSON
        """The body as JSON.

        Raises:
            HTTPException: if an object in it has too many members.
        """
        return bounded_json(await self.body())


def kind_of(request: Request) -> str:
    """The media type of a body, without parameters; empty if it does not say."""
    return request.headers.get("content-type", "").split(";")[0].strip().lower()


async def whole_body(request: Request, max_bytes: int) -> bytes:
    """All of it.

    Raises:
        HTTPException: if it is too large.
    """
    body = bytearray()
    async for chunk in request.stream():
        body += chunk
        if len(body) > max_bytes:
            raise HTTPException(status.HTTP_413_CONTENT_TOO_LARGE, too_large(max_bytes))
    return bytes(body)


def bounded_json(body: bytes) -> Any:  # noqa: ANN401  any JSON
    """What a JSON text says.

    Raises:
        JSONDecodeError: if it is no JSON.
        HTTPException: if an object in it has too many members.
    """
    return json.loads(body, object_pairs_hook=_checked)


def _checked(members: list[tuple[str, Any]]) -> dict[str, Any]:
    if len(members) > MAX_MEMBERS:
        sentence = f"An object in the body has {len(members)} members; at most {MAX_MEMBERS} are read."
        raise HTTPException(status.HTTP_422_UNPROCESSABLE_CONTENT, sentence)
    return dict(members)


def parsed(model: type[Model], body: bytes) -> Model:
    """A JSON body.

    Raises:
        RequestValidationError: as FastAPI does for a body that it reads itself.
        HTTPException: if an object in it has too many members.
    """
    with contextlib.suppress(ValueError, RecursionError):  # told in the words of the model
        bounded_json(body)
    try:
        return model.model_validate_json(body)
    except ValidationError as error:
        entries: list[dict[str, Any]] = [{**entry, "loc": ("body", *entry["loc"])} for entry in error.errors()]
        raise RequestValidationError(entries) from None
