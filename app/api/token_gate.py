"""An optional password: with OSF_TOKEN set, every request must bring it.

Programs send it as `Authorization: Bearer TOKEN`. A browser opens `/?token=TOKEN` once, which becomes a cookie.
"""

from __future__ import annotations

import hmac
from urllib.parse import parse_qs

from starlette.requests import HTTPConnection
from starlette.responses import RedirectResponse
from starlette.types import ASGIApp, Receive, Scope, Send

from app.api.problems import problem

COOKIE = "osf_token"
_OPEN = ("/api/health",)  # whoever runs the service may look whether it lives
_REFUSED = "This service needs a token: open its page as /?token=TOKEN, or send the header Authorization: Bearer TOKEN."


class TokenMiddleware:
    """Refuses requests without the token.

    Args:
        app: to protect.
        token: that requests must bring.
    """

    def __init__(self, app: ASGIApp, *, token: str) -> None:
        self._app = app
        self._token = token.encode()

    async def __call__(self, scope: Scope, receive: Receive, send: Send) -> None:
        """Check and pass on one request."""
        if scope["type"] == "lifespan" or scope["path"] in _OPEN:
            await self._app(scope, receive, send)
            return
        connection = HTTPConnection(scope)
        if self._is_right(_presented(connection)):
            await self._app(scope, receive, send)
        elif scope["type"] == "websocket":
            await send({"type": "websocket.close", "code": 1008})
        elif scope["method"] == "GET" and self._is_right(_in_query(scope)):
            # The address without the token, so that it is neither kept in the history nor copied along.
            answer = RedirectResponse(scope.get("root_path", "") + (scope["path"] or "/"), 303)
            value = parse_qs(scope["query_string"].decode("latin-1"))["token"][0]
            answer.set_cookie(COOKIE, value, httponly=True, samesite="strict", max_age=30 * 24 * 3600)
            await answer(scope, receive, send)
        else:
            await problem(401, _REFUSED, headers={"WWW-Authenticate": "Bearer"})(scope, receive, send)

    def _is_right(self, token: str) -> bool:
        return hmac.compare_digest(token.encode("utf-8", "replace"), self._token)


def _presented(connection: HTTPConnection) -> str:
    scheme, _, token = connection.headers.get("authorization", "").partition(" ")
    return token.strip() if scheme.lower() == "bearer" else connection.cookies.get(COOKIE, "")


def _in_query(scope: Scope) -> str:
    return parse_qs(scope.get("query_string", b"").decode("latin-1")).get("token", [""])[0]
