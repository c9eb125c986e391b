"""Robots for tests: the example's server, and a table that takes its time."""

import contextlib
import importlib.util
import threading
import time
from pathlib import Path

import numpy as np
import uvicorn

from osfcore.geometry.cameras import default_cameras
from osfcore.geometry.states import Observation
from osfcore.geometry.workspace import STEP_S
from osfcore.world.scene_request import SceneRequest
from osfcore.world.tabletop import Tabletop
from tests.live import free_port

SERVER = Path(__file__).parents[3] / "examples" / "robot_server.py"
NAMES = ("005_tomato_soup_can", "009_gelatin_box")


class Marble:
    """A pusher alone: does of each motion as much as it is told to, and remembers what it was asked."""

    def __init__(self, place=(0.0, 0.0), shares=()):
        self.place, self.shares = np.array(place, float), list(shares)
        self.way, self.velocities, self.told = [self.place.copy()], [], []

    def reset(self, seed):
        return self.observe()

    def observe(self, *, masks=False):
        return Observation((), np.zeros((0, 1, 1, 3), np.float32), (), None, np.array([*self.place, 0.06]), 0.0)

    def act(self, action):
        share = self.shares.pop() if self.shares else 1.0
        self.velocities.append(np.array(action))
        self.place = self.place + share * STEP_S * action[:2]
        self.way.append(self.place.copy())

    def start(self):
        self.told.append("start")

    def stop(self):
        self.told.append("stop")

    def close(self):
        self.told.append("close")


def until(holds, timeout_s=20.0):
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
