import asyncio
import contextlib
import socket
import threading
import time

import pytest
import uvicorn
import websockets.sync.client

from app.api.guards.connection_timeouts import BodyTimeoutMiddleware, PromptProtocol
from tests.app.conftest import until

LARGE = bytes(64 << 20)


class Hasty(PromptProtocol):
    head_s = stall_s = 0.5


class Patient(PromptProtocol):
    head_s = stall_s = 30.0


async def app(scope, receive, send):
    """Answers with what was sent, or with much; a websocket is echoed."""
    if scope["type"] == "websocket":
        await receive()
        await send({"type": "websocket.accept"})
        while (message := await receive())["type"] == "websocket.receive":
            await send({"type": "websocket.send", "text": message["text"]})
        return
    body = b""
    while scope["path"] != "/large":
        message = await receive()
        if message["type"] == "http.disconnect":
            return
        body += message["body"]
        if not message["more_body"]:
            break
    await send({"type": "http.response.start", "status": 200, "headers": []})
    await send({"type": "http.response.body", "body": LARGE if scope["path"] == "/large" else body})


@contextlib.contextmanager
def serving(seconds, protocol):
    """The port of a server that waits this long for the next piece of a body."""
    config = uvicorn.Config(
        BodyTimeoutMiddleware(app, seconds=seconds),
        http=protocol,
        lifespan="off",
        log_level="warning",
        timeout_keep_alive=30,
    )
    server, listener = uvicorn.Server(config), socket.create_server(("127.0.0.1", 0))
    thread = threading.Thread(target=server.run, args=([listener],))
    thread.start()
    until(lambda: server.started)
    yield listener.getsockname()[1]
    server.should_exit = True
    thread.join()
    listener.close()


@pytest.fixture(scope="module")
def port():
    with serving(0.5, Hasty) as port:
        yield port


def until_closed(connection):
    """All that the server still sends."""
    connection.settimeout(20)
    received = b""
    with contextlib.suppress(ConnectionResetError):
        while data := connection.recv(1 << 20):
            received += data
    return received


@pytest.mark.parametrize(
    "sent",
    [
        b"",
        b"GET / HT",
        b"GET / HTTP/1.1\r\nHost: a\r\nX-Slow: ",
        b"POST / HTTP/1.1\r\nHost: a\r\nContent-Length: 10\r\n\r\nhalf",
        b"POST / HTTP/1.1\r\nHost: a\r\nContent-Length: 10\r\nConnection: close\r\n\r\n",
    ],
)
def test_half_a_request_is_not_waited_for(port, sent):
    with socket.create_connection(("127.0.0.1", port)) as connection:
        connection.sendall(sent)
        assert b"200 OK" not in until_closed(connection)


def test_a_header_that_comes_drop_by_drop_is_not_waited_for(port):
    with socket.create_connection(("127.0.0.1", port)) as connection:
        connection.sendall(b"GET / HTTP/1.1\r\nHost: a\r\n")
        started = time.monotonic()
        with contextlib.suppress(OSError):
            while time.monotonic() - started < 20:
                connection.sendall(b"X: y\r\n")
                time.sleep(0.1)
            pytest.fail("it was waited for")


@pytest.mark.slow
def test_a_body_may_take_its_time_if_it_keeps_coming():
    with serving(3.0, Patient) as port, socket.create_connection(("127.0.0.1", port)) as connection:
        connection.sendall(b"POST / HTTP/1.1\r\nHost: a\r\nConnection: close\r\nContent-Length: 8\r\n\r\n")
        for letter in b"abcdefgh":
            time.sleep(0.5)
            connection.sendall(bytes([letter]))
        assert b"abcdefgh" in until_closed(connection)


def test_a_client_that_does_not_read_its_answer_is_left(port):
    def is_left(after_s):
        with socket.create_connection(("127.0.0.1", port)) as connection:
            connection.sendall(b"GET /large HTTP/1.1\r\nHost: a\r\nConnection: close\r\n\r\n")
            time.sleep(after_s)
            return len(until_closed(connection)) < len(LARGE)

    assert any(is_left(after_s) for after_s in (1, 4, 16, 64)), "it was waited for"  # a busy machine notices late


def test_a_client_that_reads_slowly_gets_all(port):
    with socket.create_connection(("127.0.0.1", port)) as connection:
        connection.sendall(b"GET /large HTTP/1.1\r\nHost: a\r\nConnection: close\r\n\r\n")
        connection.settimeout(20)
        received = 0
        while data := connection.recv(4 << 20):
            received += len(data)
            time.sleep(0.02)
        assert received > len(LARGE)


def test_a_websocket_may_be_silent(port):
    with websockets.sync.client.connect(f"ws://127.0.0.1:{port}/", proxy=None) as connection:
        time.sleep(1.5)
        connection.send("still there")
        assert connection.recv(timeout=10) == "still there"


def test_whoever_waits_for_an_answer_may_wait():
    async def answer_late(scope, receive, send):
        assert (await receive())["body"] == b"x"
        left = asyncio.ensure_future(receive())  # as one that watches whether the client leaves
        await asyncio.sleep(0.3)
        assert not left.done()
        left.cancel()
        await send({"type": "http.response.start", "status": 200, "headers": []})

    sent, messages = [], [{"type": "http.request", "body": b"x", "more_body": False}]

    async def receive():
        return messages.pop() if messages else await asyncio.Event().wait()

    async def send(message):
        sent.append(message)

    asyncio.run(BodyTimeoutMiddleware(answer_late, seconds=0.1)({"type": "http"}, receive, send))
    assert sent[0]["status"] == 200
