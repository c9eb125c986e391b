"""Robots for tests: the example's server before a simulated table."""

import contextlib
import importlib.util
import socket
import threading
import time
from dataclasses import replace
from pathlib import Path

import numpy as np
import uvicorn

from osfcore.control import closed_loop, estimators
from osfcore.estimation.steps import EstimateStep
from osfcore.geometry.cameras import default_cameras
from osfcore.geometry.poses import Pose
from osfcore.progress import Progress
from osfcore.world.scenes import SceneRequest
from osfcore.world.tabletop import Tabletop
from tests.live import free_port
from tests.support.tabletop_scenes import perfect_fit, sure

SERVER = Path(__file__).parents[2] / "examples" / "robot_server.py"
NAMES = ("005_tomato_soup_can", "009_gelatin_box")


def until(holds, timeout_s=120.0):
    """Wait for something."""
    end = time.monotonic() + timeout_s
    while not holds():
        assert time.monotonic() < end, "it did not come about"
        time.sleep(0.002)


def example():
    """The module of the example."""
    spec = importlib.util.spec_from_file_location("robot_server", SERVER)
    module = importlib.util.module_from_spec(spec)
    spec.loader.exec_module(module)
    return module


def simulated(library, size=64):
    """The table of a robot, with both objects at rest."""
    table = Tabletop(library, request=SceneRequest(names=NAMES), cameras=default_cameras(size))
    table.arrange(1)
    return table


@contextlib.contextmanager
def serving(app):
    """The address of an app that answers while the context is open."""
    port = free_port()
    server = uvicorn.Server(uvicorn.Config(app, port=port, log_level="critical", timeout_graceful_shutdown=1))
    thread = threading.Thread(target=server.run)
    thread.start()
    try:
        while not server.started:
            assert thread.is_alive()
            thread.join(0.01)
        yield f"http://127.0.0.1:{port}"
    finally:
        server.should_exit = True
        thread.join()


@contextlib.contextmanager
def dripping(first):
    """The address of a server that answers with these bytes, and then with one now and then, for ever."""
    ends = threading.Event()

    def drip(client):
        with client, contextlib.suppress(OSError):
            client.sendall(first)
            while not ends.wait(0.02):
                client.sendall(b"a")

    def accept():
        with contextlib.suppress(OSError):
            while True:
                threading.Thread(target=drip, args=server.accept()[:1]).start()

    with socket.create_server(("127.0.0.1", 0)) as server:
        thread = threading.Thread(target=accept)
        thread.start()
        yield f"http://127.0.0.1:{server.getsockname()[1]}"
        ends.set()
        server.shutdown(socket.SHUT_RDWR)
        thread.join()


def toward_middle(state):
    """A state with the box 6 cm nearer to the middle."""
    place = state.pose(NAMES[1]).position
    way = np.array([*(-0.06 * place[:2] / np.linalg.norm(place[:2])), 0.0])
    shifts = np.stack([way if name == NAMES[1] else np.zeros(3) for name in state.names])
    return replace(state, poses=Pose(state.poses.position + shifts, state.poses.quaternion))


def know_truth(monkeypatch, table, wanted):
    """Let estimators know where everything is, and where it should be: looks then take no time."""

    def steps(state, image_model=None):
        yield EstimateStep(Progress(1, 1, "Done"), "done", state, estimate=sure(state))

    monkeypatch.setattr(estimators, "estimate_first", lambda *_: steps(table.truth()))
    monkeypatch.setattr(estimators, "estimate_next", lambda *_, usual: steps(table.truth()))
    monkeypatch.setattr(closed_loop, "estimate_goal_image", lambda *_: steps(replace(wanted, pusher=None)))
    monkeypatch.setattr(closed_loop, "prefer_current_poses", lambda _models, _goal, found, _now: found)
    monkeypatch.setattr(closed_loop, "expected_fit", lambda *_: perfect_fit(len(NAMES)))


def noted(app, paths):
    """An app, of which every path that is asked for is noted."""

    async def noting(scope, receive, send):
        if scope["type"] == "http":
            paths.append(scope["path"])
        await app(scope, receive, send)

    return noting
