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
from contextvars import ContextVar
from typing import Any

import viser
import websockets.asyncio.server
from websockets.asyncio.server import ServerConnection
from websockets.http11 import Request, Response

SECRET_HEADER, PAGE_HEADER = "X-OSF-Viewer-Secret", "X-OSF-Page"
# Set during a handshake; whatever viser does for that connection afterwards runs in the same context.
_page: ContextVar[str | None] = ContextVar("page", default=None)


class PrivateViser(viser.ViserServer):
    """viser bound to a free loopback port, closed to whoever does not know its secret, unable to open a public tunnel.

    Attributes:
        secret: to be sent as `SECRET_HEADER` with the handshake.
    """

    secret: str

    def __init__(self) -> None:
        self.secret = secrets.token_urlsafe(32)
        # The banner would show the port. viser has no hook for handshakes, so its call of `serve` is given one.
        with contextlib.redirect_stdout(io.StringIO()), _guarding(self._refuse):
            super().__init__(host="127.0.0.1", port=0, verbose=False)
        self._pages: dict[int, str] = {}
        self.on_client_connect(self._note_page)
        self.on_client_disconnect(self._forget_page)

    def page_of(self, client: int) -> str | None:
        """What the page calls itself in which a browser shows the view; None where it is on its own."""
        return self._pages.get(client)

    async def _note_page(self, client: viser.ClientHandle) -> None:
        """Asynchronous, so that it runs in the connection's context, and before other callbacks."""
        page = _page.get()
        if page is not None:
            self._pages[client.client_id] = page

    async def _forget_page(self, client: viser.ClientHandle) -> None:
        self._pages.pop(client.client_id, None)

    def _refuse(self, connection: ServerConnection, request: Request) -> Response | None:
        given = request.headers.get_all(SECRET_HEADER)
        if len(given) == 1 and hmac.compare_digest(given[0].encode(), self.secret.encode()):
            _page.set(request.headers.get(PAGE_HEADER))
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
