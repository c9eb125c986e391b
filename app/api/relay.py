"""The 3D viewer on the service's own port: its client page, and a relay for its websocket.

The page at /viewer/ connects to its own address without the trailing slash, so nothing has to be rewritten.
"""

from __future__ import annotations

import asyncio
import contextlib

import websockets
from fastapi import APIRouter, WebSocket
from fastapi.responses import FileResponse
from starlette.types import Message
from starlette.websockets import WebSocketDisconnect, WebSocketState
from websockets.asyncio.client import ClientConnection, connect
from websockets.typing import Subprotocol

from app.api.dependencies import ServicesDep
from app.api.security import is_same_origin

router = APIRouter(include_in_schema=False)
_PASSED_CLOSE_CODES = (1000, 1001, 1002, 1011, 1012)
_INTERNAL_ERROR = 1011
_OPEN_TIMEOUT_S = 5.0


@router.get("/viewer")
@router.get("/viewer/")
def page(services: ServicesDep) -> FileResponse:
    """The viewer's client, one file."""
    # no-cache, because a client of another version than the server is refused by it
    return FileResponse(services.viewer.client_page, media_type="text/html", headers={"Cache-Control": "no-cache"})


@router.websocket("/viewer")
async def relay(browser: WebSocket, services: ServicesDep) -> None:
    """Pass frames both ways between a browser and the viewer on loopback."""
    if not is_same_origin(browser, services.settings.allowed_origins):
        await browser.close(code=1008)  # before accepting: the browser sees 403
        return
    offered = [Subprotocol(name) for name in browser.scope.get("subprotocols", [])]
    try:
        # Compressing again, size limits, proxies and pings between two ends of one machine would only cost or break.
        upstream = await connect(
            f"ws://127.0.0.1:{services.viewer.port}",
            subprotocols=offered or None,
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
        await _pump_both(browser, upstream)


async def _pump_both(browser: WebSocket, upstream: ClientConnection) -> None:
    """Relay until either end closes, then end the other direction as well and close both."""
    pumps = [asyncio.create_task(_to_viewer(browser, upstream)), asyncio.create_task(_to_browser(browser, upstream))]
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


async def _to_viewer(browser: WebSocket, upstream: ClientConnection) -> None:
    with contextlib.suppress(websockets.ConnectionClosed):
        while (message := await browser.receive())["type"] == "websocket.receive":
            await upstream.send(_payload(message))


async def _to_browser(browser: WebSocket, upstream: ClientConnection) -> None:
    with contextlib.suppress(websockets.ConnectionClosed, WebSocketDisconnect, RuntimeError):
        async for message in upstream:
            if isinstance(message, str):
                await browser.send_text(message)
            else:
                await browser.send_bytes(message)


def _payload(message: Message) -> str | bytes:
    data = message.get("bytes")
    return message["text"] if data is None else data
