"""Bodies that come in more than one kind, so that a handler has to look itself."""

from __future__ import annotations

from typing import Any, TypeVar

from fastapi import HTTPException, Request, status
from fastapi.exceptions import RequestValidationError
from pydantic import ValidationError

from app.api.schemas.common import Input

JSON = "application/json"
Model = TypeVar("Model", bound=Input)


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
            raise HTTPException(status.HTTP_413_CONTENT_TOO_LARGE, f"The request is larger than {max_bytes} bytes.")
    return bytes(body)


def parsed(model: type[Model], body: bytes) -> Model:
    """A JSON body.

    Raises:
        RequestValidationError: as FastAPI does for a body that it reads itself.
    """
    try:
        return model.model_validate_json(body)
    except ValidationError as error:
        entries: list[dict[str, Any]] = [{**entry, "loc": ("body", *entry["loc"])} for entry in error.errors()]
        raise RequestValidationError(entries) from None
