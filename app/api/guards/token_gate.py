"""An optional password: with a token set, every request must bring it.

Programs send it as `Authorization: Bearer TOKEN`. A browser opens `/?token=TOKEN` once and gets a cookie: a random
session, signed with a key made of the token, so that the token itself is kept nowhere, sessions outlive a restart, and
another token ends them all.
"""

from __future__ import annotations

import hashlib
import hmac
import secrets
import time
from collections import OrderedDict
from collections.abc import Callable
from urllib.parse import parse_qs

from itsdangerous import BadSignature, TimestampSigner
from starlette.requests import HTTPConnection
from starlette.responses import RedirectResponse
from starlette.types import ASGIApp, Receive, Scope, Send

from ..problems import problem


class RateLimit:
    """A token bucket.

    Args:
        rate: tokens that come back [1/s].
        burst: tokens at most.
        clock: the time, as a function [s].
    """

    def __init__(self, rate: float, burst: float, clock: Callable[[], float] = time.monotonic) -> None:
        self._rate, self._burst, self._clock = rate, burst, clock
        self._left, self._then = burst, clock()

    @property
    def is_empty(self) -> bool:
        """Whether there is no token now."""
        now = self._clock()
        self._left = min(self._burst, self._left + (now - self._then) * self._rate)
        self._then = now
        return self._left < 1

    def take(self) -> bool:
        """Take a token; False if there is none."""
        if self.is_empty:
            return False
        self._left -= 1
        return True


COOKIE = "osf_session"
_LIFE_S = 30 * 24 * 3600
OPEN = ("/api/health",)  # whoever runs the service may look whether it lives
_REFUSED = "This service needs a token: open its page as /?token=TOKEN, or send the header Authorization: Bearer TOKEN."
_TOO_MANY = "Too many wrong tokens have come in; wait a moment before the next one."
_WRONG_PER_S, _WRONG_AT_ONCE = 0.2, 10.0  # from one address
_MOST_ADDRESSES, _MOST_REMEMBERED = 1000, 100


class WrongTokens:
    """The wrong tokens of one address: guesses are limited, the same mistake made again and again is not.

    People behind one router have one address: a program there that was given a wrong token must not keep the others
    out.
    """

    def __init__(self) -> None:
        self._limit = RateLimit(_WRONG_PER_S, _WRONG_AT_ONCE)
        self._seen: OrderedDict[bytes, None] = OrderedDict()  # digests of them, the latest last

    def take(self, token: bytes) -> None:
        """Note a wrong token."""
        digest = hashlib.sha256(token).digest()
        if digest not in self._seen:
            self._limit.take()
        self._seen[digest] = None
        self._seen.move_to_end(digest)
        if len(self._seen) > _MOST_REMEMBERED:
            self._seen.popitem(last=False)

    def are_too_many(self, token: bytes) -> bool:
        """Return whether too many different ones have come for another token to be looked at."""
        return self._limit.is_empty and hashlib.sha256(token).digest() not in self._seen


class TokenMiddleware:
    """Refuses requests without the token or a session.

    Args:
        app: to protect.
        token: that requests must bring.
    """

    def __init__(self, app: ASGIApp, *, token: str) -> None:
        self._app = app
        self._token = token.encode()
        self._signer = TimestampSigner(self._token, salt="osf-session")
        self._wrong: OrderedDict[str, WrongTokens] = OrderedDict()  # by address of the client

    async def __call__(self, scope: Scope, receive: Receive, send: Send) -> None:
        """Check and pass on one request."""
        if scope["type"] == "lifespan" or scope["path"] in OPEN:
            await self._app(scope, receive, send)
            return
        connection = HTTPConnection(scope)
        login = _in_query(scope) if scope["type"] == "http" and scope["method"] == "GET" else None
        given = _in_header(connection) if login is None else login
        if self._is_session(connection.cookies.get(COOKIE, "")) and login is None:
            await self._app(scope, receive, send)
        elif given is not None and self._wrong_from(scope).are_too_many(given):
            await _refuse(scope, receive, send, 429, _TOO_MANY, {"Retry-After": "5"})
        elif given is None or not hmac.compare_digest(given, self._token):
            if given is not None:
                self._wrong_from(scope).take(given)
            await _refuse(scope, receive, send, 401, _REFUSED, {"WWW-Authenticate": "Bearer"})
        elif login is None:
            await self._app(scope, receive, send)
        else:
            await self._logged_in(scope)(scope, receive, send)

    def _wrong_from(self, scope: Scope) -> WrongTokens:
        """Return the wrong tokens from the address that a request comes from."""
        address = (scope.get("client") or ("",))[0]
        wrong = self._wrong.setdefault(address, WrongTokens())
        self._wrong.move_to_end(address)
        if len(self._wrong) > _MOST_ADDRESSES:
            self._wrong.popitem(last=False)
        return wrong

    def _is_session(self, cookie: str) -> bool:
        try:
            self._signer.unsign(cookie, max_age=_LIFE_S)
        except BadSignature:
            return False
        return True

    def _logged_in(self, scope: Scope) -> RedirectResponse:
        """To the address without the token, so that it is neither kept in the history nor copied along."""
        path = "/" + scope["path"].lstrip("/\\")  # two slashes would lead to another host
        answer = RedirectResponse(scope.get("root_path", "") + path, 303)
        session = self._signer.sign(secrets.token_urlsafe(16)).decode()
        is_https = scope["scheme"] == "https"
        answer.set_cookie(COOKIE, session, max_age=_LIFE_S, httponly=True, samesite="strict", secure=is_https)
        return answer


async def _refuse(
    scope: Scope, receive: Receive, send: Send, status: int, sentence: str, headers: dict[str, str]
) -> None:
    if scope["type"] == "websocket":
        await send({"type": "websocket.close", "code": 1008})
    else:
        await problem(status, sentence, headers=headers)(scope, receive, send)


def _in_header(connection: HTTPConnection) -> bytes | None:
    scheme, _, token = connection.headers.get("authorization", "").partition(" ")
    return token.strip().encode("latin-1") if scheme.lower() == "bearer" else None  # as the bytes came


def _in_query(scope: Scope) -> bytes | None:
    tokens = parse_qs(scope.get("query_string", b"").decode("latin-1"), errors="surrogateescape").get("token")
    return tokens[0].encode("utf-8", "surrogateescape") if tokens else None
