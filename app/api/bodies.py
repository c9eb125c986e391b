"""Bodies of requests, within bounds, and bodies of answers: images, files, compressed ones and none."""

from __future__ import annotations

import contextlib
import json
import os
import stat
import sys
from collections.abc import Callable, Coroutine, Mapping
from pathlib import Path
from typing import Annotated, Any, TypeVar

import anyio
from fastapi import HTTPException, Query, Request, Response
from fastapi.exceptions import RequestValidationError
from fastapi.routing import APIRoute
from pydantic import ValidationError
from starlette.datastructures import Headers, MutableHeaders
from starlette.middleware.gzip import DEFAULT_EXCLUDED_CONTENT_TYPES, GZipMiddleware
from starlette.responses import FileResponse
from starlette.staticfiles import NotModifiedResponse
from starlette.types import ASGIApp, Message, Receive, Scope, Send

from .models import Input
from .problems import NotFound, too_large

JSON = "application/json"
SMALL_BODY_BYTES = 256 << 10  # of JSON that describes a scene, a goal or an order
MAX_MEMBERS = 100  # of one JSON object: each unknown one is a mistake to report, at some cost
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


def is_photo(kind: str) -> bool:
    """Whether a media type may be that of a photo; browsers call formats that they do not know octet-stream."""
    return kind.startswith("image/") or kind == "application/octet-stream"


def refuse_form(request: Request, kinds: str) -> None:
    """Refuse a form: a file is the body itself here.

    Args:
        request: that brings a file.
        kinds: of media that are taken, as a header says them.

    Raises:
        HTTPException: if the body is a form, as `curl -F` and, without a header, `curl --data-binary` send it.
    """
    if (kind := kind_of(request)) in ("multipart/form-data", "application/x-www-form-urlencoded"):
        how = f"send the file itself as the body, with the header Content-Type: {kinds}"
        raise HTTPException(415, f"The body is a form ({kind}), which is not read here; {how}.")


async def whole_body(request: Request, max_bytes: int) -> bytes:
    """All of it.

    Raises:
        HTTPException: if it is too large.
    """
    body = bytearray()
    async for chunk in request.stream():
        body += chunk
        if len(body) > max_bytes:
            raise HTTPException(413, too_large(max_bytes))
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
        raise HTTPException(422, sentence)
    return dict(members)


def parsed(model: type[Model], body: bytes) -> Model:
    """A JSON body.

    Raises:
        RequestValidationError: as FastAPI does for a body that it reads itself.
        HTTPException: if an object in it has too many members.
    """
    with contextlib.suppress(ValueError, RecursionError):  # the model says so in its own words
        bounded_json(body)
    try:
        return model.model_validate_json(body)
    except ValidationError as error:
        entries: list[dict[str, Any]] = [{**entry, "loc": ("body", *entry["loc"])} for entry in error.errors()]
        raise RequestValidationError(entries) from None


class HeadMiddleware:
    """Answers HEAD as GET is answered, without the body."""

    def __init__(self, app: ASGIApp) -> None:
        self._app = app

    async def __call__(self, scope: Scope, receive: Receive, send: Send) -> None:
        """Pass on one request."""
        if scope["type"] != "http" or scope["method"] != "HEAD":
            await self._app(scope, receive, send)
            return
        with anyio.CancelScope() as answering:

            async def send_head(message: Message) -> None:
                if message["type"] == "http.response.body":
                    await send({"type": "http.response.body"})
                    answering.cancel()  # a stream would go on for ever
                else:
                    await send(message)

            await self._app({**scope, "method": "GET"}, receive, send_head)


class CompressionMiddleware(GZipMiddleware):
    """Compresses answers, but for parts of files, streams, and media types that are compressed already."""

    def __init__(self, app: ASGIApp) -> None:
        packed = ("application/octet-stream", "application/pdf")
        super().__init__(app, compresslevel=5, exclude_content_types=(*DEFAULT_EXCLUDED_CONTENT_TYPES, *packed))

    async def __call__(self, scope: Scope, receive: Receive, send: Send) -> None:
        """Pass on one request."""

        async def send_marked(message: Message) -> None:
            if message["type"] == "http.response.start":
                headers = MutableHeaders(scope=message)
                tag = headers.get("etag", "")
                if tag.startswith('"') and headers.get("content-encoding") == "gzip":
                    headers["ETag"] = f"W/{tag}"  # other bytes than of the file of which a part may be asked for
            await send(message)

        await super().__call__(scope, receive, send_marked)


BINARY = {"schema": {"type": "string", "format": "binary"}}


def binary(description: str, *kinds: str) -> dict[int | str, dict[str, Any]]:
    """The OpenAPI entry of an answer that is a file of one of some media types."""
    return {200: {"content": dict.fromkeys(kinds, BINARY), "description": description}}


def upload(*kinds: str, description: str | None = None) -> dict[str, Any]:
    """The OpenAPI entry of a request whose body is a file of one of some media types."""
    body = {"required": True, "content": dict.fromkeys(kinds, BINARY)}
    return {"requestBody": body if description is None else {**body, "description": description}}


PNG = binary("The image.", "image/png")
JPEG = binary("The photo.", "image/jpeg")
FORGOTTEN: dict[int | str, dict[str, Any]] = {204: {"description": "It is gone, with all its files."}}
Forget = Annotated[
    bool, Query(description="Remove one that has finished for good, with all its files; nothing is answered then.")
]


class OpenFile(FileResponse):
    """A file that is opened now: headers and content are of the same version, also those of a range.

    Args:
        path: of the file.
        gone: the sentence of the problem if there is none.
        media_type: of its content.
        headers: further ones.
        filename: under which it is saved; None if it is only shown.
        disposition: whether a browser saves it or shows it, if it has a filename.

    Raises:
        NotFound: if there is no such file, or no plain one.
    """

    def __init__(
        self,
        path: Path,
        gone: str,
        *,
        media_type: str,
        headers: Mapping[str, str] | None = None,
        filename: str | None = None,
        disposition: str = "attachment",
    ) -> None:
        try:
            self._file = path.open("rb", buffering=0)
        except (FileNotFoundError, NotADirectoryError, IsADirectoryError):
            raise NotFound(gone) from None
        status = os.fstat(self._file.fileno())
        if not stat.S_ISREG(status.st_mode):
            self._file.close()
            raise NotFound(gone)
        super().__init__(
            # Opened again, it is the same file, whatever has its name by then; on Windows it keeps its name while open.
            path if sys.platform == "win32" else f"/dev/fd/{self._file.fileno()}",
            headers=headers,
            media_type=media_type,
            filename=filename,
            stat_result=status,
            content_disposition_type=disposition,
        )

    async def __call__(self, scope: Scope, receive: Receive, send: Send) -> None:
        """Send the file, or that it is the one that is known; close it, also if whoever asked has gone."""
        try:
            known = Headers(scope=scope).get("if-none-match", "")
            if self.headers["etag"] in [tag.strip().removeprefix("W/") for tag in known.split(",")]:
                await NotModifiedResponse(self.headers)(scope, receive, send)
            else:
                await super().__call__(scope, receive, send)
        finally:
            self._file.close()
