"""Closes connections whose requests do not arrive: half a header or half a body holds nothing for long.

uvicorn limits only how long a connection stays idle after an answer.
"""

from __future__ import annotations

import asyncio

import h11
from starlette.types import ASGIApp, Message, Receive, Scope, Send
from uvicorn.protocols.http.h11_impl import H11Protocol

HEAD_S = 10.0  # from the first byte, or the connection, to the end of the header
BODY_S = 20.0  # between two pieces of a body
STALL_S = 60.0  # that a client may leave its answer unread


class PromptProtocol(H11Protocol):
    """HTTP/1.1, with a deadline for each header, and for a client that does not read.

    Attributes:
        head_s: how long a header may take [s].
        stall_s: how long a client may leave its answer unread [s].
    """

    head_s = HEAD_S
    stall_s = STALL_S
    _deadline: asyncio.TimerHandle | None = None
    _stalled: asyncio.TimerHandle | None = None
    _is_handed_over = False

    def connection_made(self, transport: asyncio.Transport) -> None:  # type: ignore[override]
        """Expect a request soon."""
        super().connection_made(transport)
        self._expect()

    def data_received(self, data: bytes) -> None:
        """Take what came, and expect the rest of a header soon."""
        super().data_received(data)
        self._expect()

    def connection_lost(self, exc: Exception | None) -> None:
        """Expect no more."""
        self._forget()
        self.resume_writing()
        super().connection_lost(exc)

    def pause_writing(self) -> None:
        """Wait until the client has read what was sent, as long as it keeps reading."""
        super().pause_writing()
        if self._stalled is None:
            self._watch_reading()

    def resume_writing(self) -> None:
        """Go on: the client has read."""
        if self._stalled is not None:
            self._stalled.cancel()
            self._stalled = None
        super().resume_writing()

    def _watch_reading(self) -> None:
        unread = self.transport.get_write_buffer_size()
        self._stalled = self.loop.call_later(self.stall_s, self._check_reading, unread)

    def _check_reading(self, unread: int) -> None:
        if self.transport.get_write_buffer_size() < unread:
            self._watch_reading()
        else:
            self._stalled = None
            self.transport.abort()

    def handle_websocket_upgrade(self, event: h11.Request) -> None:
        """Hand the connection over: it may now be silent for as long as it likes."""
        super().handle_websocket_upgrade(event)
        self._is_handed_over = True

    def _expect(self) -> None:
        is_idle = self.cycle is None or self.cycle.response_complete
        if self._is_handed_over or not is_idle:
            self._forget()
        elif self._deadline is None and not self.transport.is_closing():
            self._deadline = self.loop.call_later(self.head_s, self._close)

    def _forget(self) -> None:
        if self._deadline is not None:
            self._deadline.cancel()
            self._deadline = None

    def _close(self) -> None:
        self._deadline = None
        if self.cycle is None or self.cycle.response_complete:
            self.transport.close()


class BodyTimeoutMiddleware:
    """Treats a client whose body stops coming as one that has left.

    Args:
        app: to protect.
        seconds: between two pieces of a body.
    """

    def __init__(self, app: ASGIApp, *, seconds: float = BODY_S) -> None:
        self._app, self._seconds = app, seconds

    async def __call__(self, scope: Scope, receive: Receive, send: Send) -> None:
        """Pass on one request."""
        if scope["type"] != "http":
            await self._app(scope, receive, send)
            return
        is_whole = False

        async def receive_in_time() -> Message:
            nonlocal is_whole
            if is_whole:  # now it waits for the client to leave, which may take as long as it likes
                return await receive()
            try:
                message = await asyncio.wait_for(receive(), self._seconds)
            except TimeoutError:
                message = {"type": "http.disconnect"}
            is_whole = message["type"] != "http.request" or not message.get("more_body", False)
            return message

        await self._app(scope, receive_in_time, send)
