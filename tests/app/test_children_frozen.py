"""What a person can still do while every child process is stopped, and what comes back."""

import contextlib
import os
import signal
import urllib.error

import pytest

from tests.app.conftest import until
from tests.live import begun, call, children, free_port, start_service, stop_service


@pytest.fixture
def service(data_dir):
    """Port and process of a service in a process of its own, with a scene."""
    port = free_port()
    process = start_service(data_dir, port)
    yield port, process.pid
    stop_service(process)


def freeze(service):
    """Stop every child of a process."""
    for child in children(service):
        with contextlib.suppress(ProcessLookupError):
            os.kill(child, signal.SIGSTOP)


@pytest.mark.slow
def test_an_episode_can_be_cancelled_while_every_child_is_stopped_and_all_comes_back(service):
    port, pid = service
    scene = call(port, "POST", "scenes", {"objects": ["006_mustard_bottle"], "seed": 3})
    episode = begun(port, scene["id"], {"steps": 3})
    until(lambda: call(port, "GET", f"episodes/{episode}")["status"] == "running")
    freeze(pid)
    assert call(port, "DELETE", f"episodes/{episode}")["status"] == "cancelled"
    assert call(port, "GET", "health")["version"]

    def pushes():
        try:
            return call(port, "POST", f"scenes/{scene['id']}/actions", {"actions": [[0.1, 0, 0]]})
        except urllib.error.HTTPError as refusal:
            assert refusal.code == 503
            return None

    assert until(pushes, 60)["revision"] > scene["revision"]
    assert call(port, "GET", "health")["status"] == "ok"


@pytest.mark.slow
def test_health_tells_that_the_simulation_is_gone_until_it_is_back(service):
    port, pid = service
    seen = []

    def told(status):
        seen.append(call(port, "GET", "health"))
        return seen[-1]["status"] == status

    for child in children(pid):
        os.kill(child, signal.SIGSTOP)
    until(lambda: told("degraded"))
    assert "simulation" in seen[-1]["problems"][0]
    until(lambda: told("ok"), 60)
    assert seen[-1]["problems"] == []
