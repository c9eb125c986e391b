"""One running service for all tests that do not stop or break it."""

import contextlib
import http.client
import json
import multiprocessing
import os
import resource
import shutil
import socket
import threading
import time
from pathlib import Path

import pytest
import uvicorn
from starlette.testclient import TestClient

from app.api.app_factory import create_app
from app.services.service_settings import Settings
from app.storage.database import Store

LOCALHOST = "http://localhost"
LONG = {"kind": "collect_pushes", "params": {"episodes": 100_000, "steps": 2, "objects": 1}}


def until(condition, timeout_s=120.0):
    """Wait until a condition holds; fails the test if it never does."""
    end = time.monotonic() + timeout_s
    while time.monotonic() < end:
        value = condition()
        if value:
            return value
        time.sleep(0.02)
    pytest.fail(f"did not happen within {timeout_s:g} s")


def newest_child(name):
    """Process id of the child of that name that was started last, 0 where none runs.

    By its time of start: process ids begin again at 1 once the largest was given.
    """

    def start_ticks(pid):
        try:
            return int(Path(f"/proc/{pid}/stat").read_text().rsplit(")", 1)[1].split()[19])
        except OSError:
            return 0  # ended meanwhile

    pids = [child.pid for child in multiprocessing.active_children() if child.name == name]
    return max(pids, key=start_ticks, default=0)


@contextlib.contextmanager
def full_disk():
    """While open, this process can write to no file: what a full disk does, without one."""
    soft, hard = resource.getrlimit(resource.RLIMIT_FSIZE)
    resource.setrlimit(resource.RLIMIT_FSIZE, (0, hard))
    try:
        yield
    finally:
        resource.setrlimit(resource.RLIMIT_FSIZE, (soft, hard))


def running(library, data_dir, **settings):
    """A client of a running service with real objects, as a context."""
    if not (data_dir / "objects").exists():
        shutil.copytree(library.root, data_dir / "objects", copy_function=os.link)
    app = create_app(Settings(data_dir=data_dir, **{"demo_scene": False, **settings}))
    return TestClient(app, base_url=LOCALHOST, raise_server_exceptions=False)


def keep_busy(client):
    """Start a job that keeps its turn, so that nothing else that is asked for begins; returns its name."""
    job = client.post("/api/jobs", json=LONG).json()["id"]
    until(lambda: client.get(f"/api/jobs/{job}").json()["done"] > 0)
    client.post(f"/api/jobs/{job}/pause")
    return job


def leave_running(data_dir, job):
    """Let a job that waits, of a service that was stopped, be one that ran when that happened."""
    with contextlib.closing(Store(data_dir)) as store:
        for number, fields in store.jobs():
            if fields["id"] == job:
                store.save_job(job, number, {**fields, "state": "running"})


@pytest.fixture(scope="session")
def service(library, tmp_path_factory):
    """A service with real objects and no scene yet; scenes and jobs of other tests may be there."""
    with running(library, tmp_path_factory.mktemp("service"), max_scenes=200) as client:
        yield client


@pytest.fixture
def services(service):
    return service.app.state.services


@pytest.fixture
def scene(service):
    """A fresh scene of two objects, removed afterwards."""
    made = service.post("/api/scenes", json={"seed": 1, "objects": ["003_cracker_box", "006_mustard_bottle"]}).json()
    yield made
    service.delete(f"/api/scenes/{made['id']}")


class Live:
    """A service behind a real socket, for what streams."""

    def __init__(self, app):
        self.app = app
        self._server = uvicorn.Server(
            uvicorn.Config(
                app,
                port=0,
                log_level="warning",
                lifespan="on",
                ws_max_size=64 << 20,
                ws_per_message_deflate=False,
                timeout_graceful_shutdown=2,  # as 'osf serve' has it
            )
        )
        self._listener = socket.create_server(("127.0.0.1", 0))
        self.port = self._listener.getsockname()[1]
        self.url = f"http://127.0.0.1:{self.port}"
        self._thread = threading.Thread(target=self._server.run, args=([self._listener],))
        self._thread.start()
        until(lambda: self._server.started)

    @property
    def services(self):
        return self.app.state.services

    def stop(self):
        self.services.closing.set()
        self._server.should_exit = True
        self._thread.join()
        self._listener.close()

    def request(self, method, path, body=None, headers=()):
        """Status and JSON of one request."""
        connection = http.client.HTTPConnection("127.0.0.1", self.port, timeout=30)
        data = None if body is None else json.dumps(body)
        kind = {"Content-Type": "application/json"} if data else {}
        connection.request(method, path, data, {**kind, **dict(headers)})
        with connection.getresponse() as response:
            text = response.read()
            connection.close()
            return response.status, json.loads(text) if text else None


@pytest.fixture(scope="session")
def live(library, tmp_path_factory):
    """A service behind a real socket."""
    live = Live(running(library, tmp_path_factory.mktemp("live")).app)
    yield live
    live.stop()
