"""What keeps other sites out of a service on localhost: host and origin checks, and headers for the page.

A page of another site may send requests here, or rebind its own name to this address; both show in the headers.
"""

from __future__ import annotations

import ipaddress
from collections.abc import Callable, Iterable
from urllib.parse import urlsplit

from starlette.datastructures import Headers, MutableHeaders
from starlette.middleware.body_limit import RequestBodyLimitMiddleware
from starlette.requests import HTTPConnection
from starlette.types import ASGIApp, Message, Receive, Scope, Send

from ..problems import problem, too_large

_UNSAFE_METHODS = frozenset({"POST", "PUT", "PATCH", "DELETE"})
_COMMON = "object-src 'none'; base-uri 'none'; frame-ancestors 'self'; form-action 'self'"
_SITE_POLICY = f"default-src 'self'; img-src 'self' data: blob:; {_COMMON}"
# The viewer's client is one file of inline script that starts workers and wasm from blobs, and fetches textures, wasm
# and its lamp from blobs and data; it may connect to this service alone.
_VIEWER_POLICY = (
    "default-src 'self' data: blob:; script-src 'self' 'unsafe-inline' 'wasm-unsafe-eval' blob:;"
    " style-src 'self' 'unsafe-inline'; worker-src 'self' blob: data:; connect-src 'self' data: blob:;"
    f" {_COMMON}"
)
_DOCS_POLICY = (
    "default-src 'self'; script-src 'self' 'unsafe-inline'; style-src 'self' 'unsafe-inline'; img-src 'self' data:;"
    f" {_COMMON}"
)


def is_known_host(host: str, allowed: Iterable[str]) -> bool:
    """Whether a Host header names this service: localhost, an allowed name, or any plain address.

    A plain address cannot be rebound: whoever can send it reaches this machine anyway.
    """
    try:
        name = urlsplit(f"//{host}").hostname or ""
        if name == "localhost" or name.endswith(".localhost") or "*" in allowed or name in {a.lower() for a in allowed}:
            return True
        ipaddress.ip_address(name)
    except ValueError:
        return False
    return True


def is_same_origin(connection: HTTPConnection, allowed: Iterable[str] = ()) -> bool:
    """Whether a request comes from this service's own page, an allowed origin, or no page at all."""
    origin = connection.headers.get("origin")
    if origin is None or origin.rstrip("/") in allowed:
        return True
    try:
        return urlsplit(origin).netloc.lower() == connection.headers.get("host", "").lower() != ""
    except ValueError:
        return False


class BodyLimitMiddleware:
    """Refuses requests larger than what `limit_of` returns for their path [bytes].

    Starlette's limit answers in plain text, before any handler of the app is asked; here that becomes a problem.
    """

    def __init__(self, app: ASGIApp, *, limit_of: Callable[[str], int]) -> None:
        self._app = app
        self._limit_of = limit_of

    async def __call__(self, scope: Scope, receive: Receive, send: Send) -> None:
        """Pass on one request, counting what comes in."""
        limit = self._limit_of(scope.get("path", ""))
        is_refused = False

        async def send_problem(message: Message) -> None:
            nonlocal is_refused
            if message["type"] == "http.response.start" and message["status"] == 413:
                is_refused = True
                await problem(413, too_large(limit))(scope, receive, send)
            elif not is_refused:
                await send(message)

        await RequestBodyLimitMiddleware(self._app, max_body_size=limit)(scope, receive, send_problem)


class SecurityMiddleware:
    """Refuses unknown hosts and foreign origins, and adds headers to every response."""

    def __init__(self, app: ASGIApp, *, allowed_hosts: Iterable[str], allowed_origins: Iterable[str]) -> None:
        self._app = app
        self._allowed_hosts = frozenset(allowed_hosts)
        self._allowed_origins = frozenset(allowed_origins)

    async def __call__(self, scope: Scope, receive: Receive, send: Send) -> None:
        """Check and pass on one request."""
        if scope["type"] == "lifespan":
            await self._app(scope, receive, send)
            return
        is_known = is_known_host(Headers(scope=scope).get("host", ""), self._allowed_hosts)
        if scope["type"] == "websocket":
            if is_known:
                await self._app(scope, receive, send)
            else:
                await send({"type": "websocket.close", "code": 1008})
            return
        path = scope["path"]

        async def send_with_headers(message: Message) -> None:
            if message["type"] == "http.response.start":
                _add_headers(MutableHeaders(scope=message), path)
            await send(message)

        if not is_known:
            detail = "The service is not known under this host name; set OSF_ALLOWED_HOSTS to allow it."
            await problem(421, detail)(scope, receive, send_with_headers)
        elif scope["method"] in _UNSAFE_METHODS and not is_same_origin(HTTPConnection(scope), self._allowed_origins):
            detail = "Requests from other sites are refused; set OSF_ALLOWED_ORIGINS to allow one."
            await problem(403, detail)(scope, receive, send_with_headers)
        else:
            await self._app(scope, receive, send_with_headers)


def _add_headers(headers: MutableHeaders, path: str) -> None:
    if path == "/viewer" or path.startswith("/viewer/"):
        policy = _VIEWER_POLICY
    elif path == "/docs":
        policy = _DOCS_POLICY
    else:
        policy = _SITE_POLICY
    headers["Content-Security-Policy"] = policy
    headers["X-Content-Type-Options"] = "nosniff"
    headers["Referrer-Policy"] = "same-origin"
    headers["Cross-Origin-Opener-Policy"] = "same-origin"
    headers["Cross-Origin-Resource-Policy"] = "same-origin"
    headers.setdefault("Cache-Control", "no-cache")  # pages and scripts of an updated service go together
