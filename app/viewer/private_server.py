"""viser on a loopback port that only this service's relay can use.

Any page in a browser on this machine, and any other user of it, can reach a loopback port. So each start draws a
secret, which the relay sends with its handshake; without it the port answers 403 to everything.
"""

from __future__ import annotations

import contextlib
import hmac
import http
import io
import secrets
from collections.abc import Callable, Iterator
from typing import Any

import viser
import websockets.asyncio.server
from websockets.asyncio.server import ServerConnection
from websockets.http11 import Request, Response

SECRET_HEADER = "X-OSF-Viewer-Secret"


class PrivateViser(viser.ViserServer):
    """viser bound to a free loopback port, closed to whoever does not know its secret, unable to open a public tunnel.

    Attributes:
        secret: to be sent as `SECRET_HEADER` with the handshake.
    """

    secret: str

    def __init__(self) -> None:
        self.secret = secrets.token_urlsafe(32)
        # The banner would tell the port. viser has no hook for handshakes, so its call of `serve` is given one.
        with contextlib.redirect_stdout(io.StringIO()), _guarding(self._refuse):
            super().__init__(host="127.0.0.1", port=0, verbose=False)

    def _refuse(self, connection: ServerConnection, request: Request) -> Response | None:
        given = request.headers.get_all(SECRET_HEADER)
        if len(given) == 1 and hmac.compare_digest(given[0].encode(), self.secret.encode()):
            return None
        return connection.respond(http.HTTPStatus.FORBIDDEN, "The 3D view is at /viewer/ of the service.\n")

    def request_share_url(self, verbose: bool = True) -> str | None:
        """Refuse: any client could ask for this."""
        del verbose
        return None


@contextlib.contextmanager
def _guarding(refuse: Callable[[ServerConnection, Request], Response | None]) -> Iterator[None]:
    """Let servers that are opened meanwhile ask `refuse` about each handshake, instead of serving files."""
    serve = websockets.asyncio.server.serve

    def guarded(*arguments: Any, **options: Any) -> Any:  # noqa: ANN401
        return serve(*arguments, **{**options, "process_request": refuse})

    websockets.asyncio.server.serve = guarded  # pyright: ignore[reportAttributeAccessIssue]
    try:
        yield
    finally:
        websockets.asyncio.server.serve = serve
