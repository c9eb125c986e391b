"""The 3D viewer on the service's own port: its client page, and a relay for its websocket.

The page at /viewer/ connects to its own address without the trailing slash, so nothing has to be rewritten.
"""

from __future__ import annotations

import asyncio
import contextlib
import re
from collections.abc import Callable
from urllib.parse import urlsplit

import websockets
from fastapi import APIRouter, HTTPException, Request, WebSocket
from fastapi.responses import HTMLResponse
from starlette.websockets import WebSocketDisconnect, WebSocketState
from websockets.asyncio.client import ClientConnection, connect
from websockets.typing import Subprotocol

from osfcore.errors import shown

from ..viewer.private_server import PAGE_HEADER, SECRET_HEADER
from .dependencies import Services, ServicesDep
from .guards.security import is_same_origin
from .guards.token_gate import RateLimit
from .guards.viewer_messages import BURST, CAMERA, DROP, RATE, allowed_kind
from .models import VISITOR, Visitor

router = APIRouter(include_in_schema=False)
_PASSED_CLOSE_CODES = (1000, 1001, 1002, 1011, 1012)
_INTERNAL_ERROR = 1011
_OPEN_TIMEOUT_S = 5.0
_LOOKS = ("hideViserLogo", "darkMode")  # what the page asks of viser's client
_SCRIPTS = ("viewer-without-eval.js", "software-renderer.js")
_VIEWER = re.compile(rf"/viewer(/{VISITOR})?/?")


@router.get("/viewer")
@router.get("/viewer/")
@router.get("/viewer/{visitor}")
@router.get("/viewer/{visitor}/")
def client_page(request: Request, services: ServicesDep) -> HTMLResponse:
    """The viewer's client, one file; below what a page calls itself, it is the view of that page.

    Scripts of ours come before its own: it makes functions from strings, and expects a graphics card. A style of ours
    lets the page's colour be around the table.

    It obeys its address: `websocket` and `playbackPath` name where its messages come from, and messages may hold
    scripts. So nothing but looks and this service's own relay (viser writes it there) may be asked for.
    """
    for name, value in request.query_params.multi_items():
        if name not in _LOOKS and not _is_own(name, value, request, services):
            raise HTTPException(400, f"The 3D view cannot be opened with {shown(name)!r}; open it from the page.")
    # no-cache, because a client of another version than the server is refused by it
    root = request.scope.get("root_path", "")
    ours = f'<link rel="stylesheet" href="{root}/css/view.css">'
    ours += "".join(f'<script src="{root}/js/{name}"></script>' for name in _SCRIPTS)
    client = services.viewer.client_page.read_text("utf-8").replace("<head>", f"<head>{ours}", 1)
    return HTMLResponse(client, headers={"Cache-Control": "no-cache"})


def _is_own(name: str, address: str, request: Request, services: Services) -> bool:
    """Whether an address is where this service's relay is."""
    try:
        parts = urlsplit(address)
    except ValueError:
        return False
    scheme = {"ws": "http", "wss": "https"}.get(parts.scheme)
    is_here = parts.netloc.lower() == request.headers.get("host", "").lower()
    is_known = f"{scheme}://{parts.netloc}" in services.settings.allowed_origins
    path = parts.path.removeprefix(request.scope.get("root_path", ""))
    is_relay = scheme is not None and not parts.query and bool(_VIEWER.fullmatch(path))
    return name == "websocket" and is_relay and (is_here or is_known)


@router.websocket("/viewer")
async def relay(browser: WebSocket, services: ServicesDep) -> None:
    """Pass frames both ways between a browser and the viewer on loopback."""
    await _relay(browser, services, None)


@router.websocket("/viewer/{visitor}")
async def relay_of_page(browser: WebSocket, services: ServicesDep, visitor: Visitor) -> None:
    """Likewise, telling the viewer in which page the browser shows it."""
    await _relay(browser, services, visitor)


async def _relay(browser: WebSocket, services: Services, visitor: str | None) -> None:
    if not is_same_origin(browser, services.settings.allowed_origins):
        await browser.close(code=1008)  # before accepting: the browser sees 403
        return
    offered = [Subprotocol(name) for name in browser.scope.get("subprotocols", [])]
    page = {} if visitor is None else {PAGE_HEADER: visitor}
    try:
        # Compressing again, size limits, proxies and pings between two ends of one machine would only cost or break.
        upstream = await connect(
            f"ws://127.0.0.1:{services.viewer.port}",
            subprotocols=offered or None,
            additional_headers={SECRET_HEADER: services.viewer.server.secret, **page},
            compression=None,
            max_size=None,
            proxy=None,
            ping_interval=None,
            open_timeout=_OPEN_TIMEOUT_S,
        )
    except (OSError, TimeoutError, websockets.WebSocketException):
        await browser.close(code=_INTERNAL_ERROR)
        return
    async with upstream:
        await browser.accept(subprotocol=upstream.subprotocol)
        await _pump_both(browser, upstream, lambda frame: _may_pass(frame, services, visitor))


def _may_pass(frame: bytes, services: Services, visitor: str | None) -> bool:
    """Whether a message goes on to the viewer; a page that only watches moves nothing but its camera."""
    kind = allowed_kind(frame)
    if kind in (None, CAMERA) or services.driver.may_drive(visitor or ""):  # "" is the view without a page
        return kind is not None
    if kind == DROP:
        services.viewer.put_handles_back()
    return False


async def _pump_both(browser: WebSocket, upstream: ClientConnection, may_pass: Callable[[bytes], bool]) -> None:
    """Relay until either end closes, then end the other direction as well and close both."""
    ways = _to_viewer(browser, upstream, may_pass), _to_browser(browser, upstream)
    pumps = [asyncio.create_task(way) for way in ways]
    try:
        await asyncio.wait(pumps, return_when=asyncio.FIRST_COMPLETED)
    finally:
        for pump in pumps:
            pump.cancel()
        await asyncio.gather(*pumps, return_exceptions=True)
    code = upstream.close_code if upstream.close_code is not None else 1000
    await upstream.close()
    if browser.application_state is WebSocketState.CONNECTED and browser.client_state is WebSocketState.CONNECTED:
        with contextlib.suppress(RuntimeError, WebSocketDisconnect):
            await browser.close(code if code in _PASSED_CLOSE_CODES else _INTERNAL_ERROR)


async def _to_viewer(browser: WebSocket, upstream: ClientConnection, may_pass: Callable[[bytes], bool]) -> None:
    """Pass on what the page may send; end with whoever sends too much."""
    limit = RateLimit(RATE, BURST)
    with contextlib.suppress(websockets.ConnectionClosed):
        while (message := await browser.receive())["type"] == "websocket.receive" and limit.take():
            frame = message.get("bytes")
            if frame is not None and may_pass(frame):
                await upstream.send(frame)


async def _to_browser(browser: WebSocket, upstream: ClientConnection) -> None:
    with contextlib.suppress(websockets.ConnectionClosed, WebSocketDisconnect, RuntimeError):
        async for message in upstream:
            if isinstance(message, str):
                await browser.send_text(message)
            else:
                await browser.send_bytes(message)
