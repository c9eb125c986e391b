"""Ten thousand malformed requests over all routes and sockets: refused in words and at once, and forgotten.

OSF_SOAK_REQUESTS says how many (10000).
"""

import http.client
import json
import logging
import os
import random
import socket
import threading
import time
import urllib.request
from concurrent.futures import ThreadPoolExecutor

import pytest
import viser
import websockets.exceptions
from websockets.sync.client import connect

from tests.app.conftest import LONG, until
from tests.live import call, free_port, resident_mb, start_service, stop_service

pytestmark = pytest.mark.soak
REQUESTS = int(os.environ.get("OSF_SOAK_REQUESTS", "10000"))
SLOWEST_S = 2.0
PROTOCOL = f"viser-v{viser.__version__}"
SILENT = logging.getLogger(__name__)  # of sockets that the service has closed
SILENT.disabled = True
CLIENTS = 4
ENDLESS = ("/events",)
JUNK = (
    None, True, -1, 0, 1, 2**31, 2**63, 10**400, 0.5, 1e308, "", "a", "\ud800", "../..", "a" * 10_000, "\0", [], [[]],
    [1, 2, 3], ["a"] * 5000, {}, {"a": {}}, {"position": [0, 0, 0]}, {"kind": "train_field"},
    {f"k{n}": 0 for n in range(500)},
)  # fmt: skip
RAW = (
    b"", b"{", b"[" * 5000, b"\xff\xfe", b'{"a": NaN}', b"null", b"[]", b'"a"', b"\x89PNG\r\n\x1a\n" + bytes(200),
    b"\xff\xd8\xff\xe1" + bytes(300), b"PK\x03\x04" + bytes(300), b"PK\x05\x06" + b"\xff" * 18, bytes(100_000),
)  # fmt: skip
KINDS = (
    "application/json",
    "text/plain",
    "image/png",
    "image/jpeg",
    "application/zip",
    "",
    "application/json; charset=x",
)
KEYS = (
    "objects", "count", "seed", "light", "poses", "image_size", "actions", "kind", "params", "scene", "goal", "name",
    "random", "settings", "state", "before", "visitor", "mode", "prior", "zzz",
)  # fmt: skip
SOCKETS = (
    b"\r\n\r\n", b"GET\r\n\r\n", b"GET / HTTP/9.9\r\n\r\n", b"GET /api/health HTTP/1.1\r\n\r\n", bytes(500),
    b"GET /api/health HTTP/1.1\r\nHost: \xff\r\n\r\n",
    b"POST /api/scenes HTTP/1.1\r\nHost: a\r\nContent-Length: -1\r\n\r\n",
    b"POST /api/scenes HTTP/1.1\r\nHost: localhost\r\nTransfer-Encoding: chunked\r\n\r\nzz\r\n",
    b"GET /" + b"a" * 100_000 + b" HTTP/1.1\r\nHost: localhost\r\n\r\n",
    b"GET /api/health HTTP/1.1\r\nHost: localhost\r\n" + b"X: y\r\n" * 3000 + b"\r\n",
)  # fmt: skip


class Attacker:
    """Sends what nobody should send, one request after the other.

    Args:
        port: of the service.
        routes: path templates and methods.
        names: identifiers that exist, by the name of their parameter.
        seed: of what is sent.
    """

    def __init__(self, port, routes, names, seed):
        self.port, self.routes, self.names = port, routes, names
        self.rng, self.slowest, self.statuses = random.Random(seed), (0.0, ""), {}

    def run(self, count):
        """Send so many requests; returns itself."""
        for _ in range(count):
            kind = self.rng.random()
            if kind < 0.9:
                self.request()
            elif kind < 0.97:
                self.raw()
            else:
                self.viewer()
        return self

    def request(self):
        """A request to one of the routes, with junk in its path, query, headers or body."""
        rng = self.rng
        template, method = rng.choice(self.routes)
        path = "/".join(self._part(part) for part in template.split("/"))
        if rng.random() < 0.3:
            path += "?" + "&".join(
                f"{rng.choice(('size', 'seed', 'limit', 'step', 'x'))}={self._text()}" for _ in range(3)
            )
        body, kind = self._body(), rng.choice(KINDS) if rng.random() < 0.3 else KINDS[0]
        connection = http.client.HTTPConnection("127.0.0.1", self.port, timeout=60)
        start = time.monotonic()
        connection.request(method, path, body, {"Content-Type": kind} if kind else {})
        answer = connection.getresponse()
        text = answer.read()
        took_s = time.monotonic() - start
        connection.close()
        self.statuses[answer.status] = self.statuses.get(answer.status, 0) + 1
        said = f"{method} {path[:100]} {body[:100]!r}: {answer.status} {text[:200]!r} after {took_s:.2f} s"
        assert answer.status < 500, said
        assert "Traceback" not in text[:5000].decode("latin-1"), said
        if answer.status >= 400:  # what was not refused may have been real work
            self.slowest = max(self.slowest, (took_s, said))

    def raw(self):
        """Bytes that are no HTTP, or not quite; the service may say so or leave."""
        with socket.create_connection(("127.0.0.1", self.port), timeout=60) as connection:
            connection.settimeout(5)
            try:
                connection.sendall(self.rng.choice(SOCKETS))
                answer = connection.recv(1 << 16)
            except OSError:
                return
        assert b" 500 " not in answer[:20]

    def viewer(self):
        """Frames that no page sends."""
        rng = self.rng
        address = f"ws://127.0.0.1:{self.port}/viewer"
        try:
            with connect(address, subprotocols=[PROTOCOL], proxy=None, max_size=None, logger=SILENT) as browser:
                for _ in range(rng.randrange(20)):
                    browser.send(
                        rng.choice([rng.randbytes(rng.randrange(300)), "text", bytes(1 << 17), json.dumps(JUNK[1])])
                    )
        except (websockets.exceptions.WebSocketException, OSError):
            pass

    def _part(self, part):
        if not part.startswith("{"):
            return part
        known = self.names.get(part.strip("{}.png"), ())
        return self.rng.choice(known) if known and self.rng.random() < 0.6 else self._text()

    def _text(self):
        return self.rng.choice(
            ["-1", "0", "999999999999999999999", "nan", "%00", "%ff%fe", "..%2f..", "a" * 3000, "%F0%9F%8E%B2"]
        )

    def _body(self):
        rng = self.rng
        if rng.random() < 0.3:
            return rng.choice(RAW)
        keys = rng.sample(KEYS, rng.randrange(1, 6))
        return json.dumps({key: rng.choice(JUNK) for key in keys}).encode()


def stalls(port, is_over):
    """The longest that a look at the service's health took meanwhile [s]."""
    longest = 0.0
    while not is_over.wait(0.2):
        start = time.monotonic()
        call(port, "GET", "health")
        longest = max(longest, time.monotonic() - start)
    return longest


@pytest.fixture
def service(data_dir):
    port = free_port()
    process = start_service(data_dir, port)
    yield port, process.pid
    stop_service(process)


def test_malformed_requests_are_refused_at_once_and_leave_nothing(service):
    port, pid = service
    scene = call(port, "POST", "scenes", {"count": 2, "seed": 1})["id"]
    goal = call(port, "POST", "goals", {"random": {}})["id"]
    job = call(port, "POST", "jobs", LONG)["id"]  # it keeps its turn, so that nothing else that is accepted runs
    until(lambda: call(port, "GET", f"jobs/{job}")["done"] > 0, 60)
    call(port, "POST", f"jobs/{job}/pause")
    call(port, "POST", "predictions", {"actions": [[[0.1, 0, 0]]]})  # starts what is started only when it is needed
    photo = call(port, "GET", f"goals/{goal}/image.png")
    urllib.request.urlopen(
        urllib.request.Request(f"http://127.0.0.1:{port}/api/goals", photo, {"Content-Type": "image/png"})
    ).close()
    schema = call(port, "GET", "openapi.json")
    routes = [
        (path, method.upper())
        for path, methods in schema["paths"].items()
        for method in methods
        if not path.endswith(ENDLESS) and "neural" not in path
    ]
    names = {"scene": [scene], "goal": [goal], "job": [job], "camera": ["0", "goal"], "name": ["006_mustard_bottle"]}

    def attack(count, seed):
        with ThreadPoolExecutor(CLIENTS) as clients:
            parts = [
                clients.submit(Attacker(port, routes, names, seed + n).run, count // CLIENTS) for n in range(CLIENTS)
            ]
            return [part.result() for part in parts]

    attack(REQUESTS, 100)  # until caches are full
    before_mb, is_over = resident_mb(pid), threading.Event()
    with ThreadPoolExecutor(1) as watcher:
        longest = watcher.submit(stalls, port, is_over)
        try:
            attackers = attack(REQUESTS, 0)
        finally:
            is_over.set()
    after_mb = resident_mb(pid)
    statuses = {status: sum(a.statuses.get(status, 0) for a in attackers) for a in attackers for status in a.statuses}
    slowest_s, said = max(attacker.slowest for attacker in attackers)
    print(
        f"{REQUESTS} requests {statuses}; slowest {slowest_s:.2f} s ({said}); health at most {longest.result():.2f} s"
    )
    print(f"memory {before_mb:.0f} MB, then {after_mb:.0f} MB")
    assert slowest_s < SLOWEST_S, said
    assert longest.result() < SLOWEST_S
    assert after_mb < 1.1 * before_mb
    assert call(port, "GET", "health")["status"] == "ok"
