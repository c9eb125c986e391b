"""Too few descriptors for all who come, and processes that die meanwhile: all comes back once there are more."""

import contextlib
import os
import resource
import signal
import socket
import time
import urllib.error
from pathlib import Path

import pytest

from tests.app.conftest import until
from tests.live import call, children, free_port, start_service, stop_service

pytestmark = pytest.mark.soak
COLLECT = {"kind": "collect_table", "params": {"images": 60, "size": 16}}


def descriptors(process):
    """How many a process has open."""
    return len(list(Path(f"/proc/{process}/fd").iterdir()))


def test_a_service_that_was_short_of_descriptors_is_as_it_was(data_dir):
    port = free_port()
    service = start_service(data_dir, port)
    before = resource.prlimit(service.pid, resource.RLIMIT_NOFILE)
    connections = []
    try:
        scene = call(port, "POST", "scenes", {"count": 2, "seed": 1})["id"]
        idle = descriptors(service.pid)
        resource.prlimit(service.pid, resource.RLIMIT_NOFILE, (idle + 3, before[1]))
        for _ in range(100):
            with contextlib.suppress(OSError):
                connections.append(socket.create_connection(("127.0.0.1", port), timeout=5))
        for _ in range(5):
            for child in children(service.pid):
                with contextlib.suppress(ProcessLookupError):
                    os.kill(child, signal.SIGKILL)
            time.sleep(1)
        for connection in connections:
            connection.close()
        for _ in range(5):
            with contextlib.suppress(urllib.error.URLError, OSError):
                call(port, "POST", "jobs", COLLECT)
        resource.prlimit(service.pid, resource.RLIMIT_NOFILE, before)

        def is_well():
            with contextlib.suppress(urllib.error.URLError, OSError):
                call(port, "POST", f"scenes/{scene}/actions", {"actions": [[0.1, 0, 0]]})
                return call(port, "GET", "health")["status"] == "ok"
            return False

        until(is_well, 60)
        job = call(port, "POST", "jobs", COLLECT)["id"]
        until(lambda: call(port, "GET", f"jobs/{job}")["state"] == "done", 60)
        until(lambda: descriptors(service.pid) <= idle + 5, 60)
    finally:
        stop_service(service)
