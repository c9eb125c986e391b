import contextlib
import json
import socket
import threading
import time
from urllib.parse import urlsplit

import httpx2
import numpy as np
import pytest
from fastapi import FastAPI, Response

from osfcore.errors import CorruptFile, InvalidInput
from osfcore.robots.connect import connect
from osfcore.robots.guarded_world import GuardedWorld
from osfcore.robots.http_robot import HttpRobot
from osfcore.robots.robot import ConnectionLost, RobotRefused, RobotStopped, SafetyLimits
from tests.core.robots.robots import NAMES, example, serving, until
from tests.live import free_port

FAST = SafetyLimits(top_speed_m_s=0.42)
LEFT = np.array([-0.3, 0.0, 0.0])


@pytest.fixture
def robot(server):
    with contextlib.closing(connect(server[0], NAMES)) as robot:
        yield robot


def test_it_describes_itself(robot, server):
    told = robot.description
    assert [camera.name for camera in told.cameras] == ["0", "1", "2", "3"]
    for camera, true in zip(told.cameras, server[1].cameras, strict=True):
        np.testing.assert_allclose(camera.T_world_camera.matrix(), true.T_world_camera.matrix(), atol=1e-9)
        np.testing.assert_allclose(camera.intrinsics, true.intrinsics, atol=1e-12)
    assert told.limits.box == (-0.35, -0.35, 0.35, 0.35)
    assert told.deadman_s == 0.2
    assert told.masks == set(NAMES)


def test_pictures_come_as_radiance_with_masks_on_demand(robot, server):
    seen, truth = robot.observe(masks=True), server[1].observe(masks=True)
    assert np.abs(seen.images - truth.images).mean() < 0.01  # of JPEG
    np.testing.assert_array_equal(seen.masks, truth.masks)
    np.testing.assert_allclose(seen.pusher, truth.pusher, atol=1e-12)
    assert seen.names == NAMES
    assert robot.observe().masks is None


def test_masks_that_the_robot_lacks_are_none(server):
    with contextlib.closing(HttpRobot(server[0], ("025_mug",))) as robot:
        assert robot.observe(masks=True).masks is None


def test_it_moves_as_told_once_it_is_started(robot, server):
    robot.stop()
    before = server[1].truth().pusher
    with pytest.raises(RobotRefused, match="was stopped, or not started"):
        robot.act(LEFT)
    np.testing.assert_allclose(server[1].truth().pusher, before, atol=1e-12)
    robot.start()
    robot.act(LEFT)
    np.testing.assert_allclose(server[1].truth().pusher - before, [-0.06, 0, 0], atol=5e-3)
    robot.act(-LEFT)
    robot.stop()


def test_a_stop_from_another_thread_ends_the_motion_early(robot, server):
    guard = GuardedWorld(robot, FAST)
    before = guard.observe().pusher[0]

    def stop_once_it_moves():
        until(lambda: abs(server[1].truth().pusher[0] - before) > 0.005)
        guard.stop("a key was pressed")

    other = threading.Thread(target=stop_once_it_moves)
    other.start()
    with pytest.raises(RobotStopped, match="a key was pressed"):
        guard.act(LEFT)
    other.join()
    place = server[1].truth().pusher
    assert abs(place[0] - before) < 0.055
    with pytest.raises(RobotStopped):
        guard.act(LEFT)
    np.testing.assert_array_equal(server[1].truth().pusher, place)


def test_who_is_cut_off_leaves_a_robot_that_stands(server):
    url, table = server
    with contextlib.closing(HttpRobot(url, NAMES)) as robot:
        robot.start()
    before = table.truth().pusher
    body = json.dumps({"velocity": LEFT[:2].tolist(), "duration_s": 0.2}).encode()
    address = urlsplit(url)
    with socket.create_connection((address.hostname, address.port)) as raw:
        head = f"POST /act HTTP/1.1\r\nHost: robot\r\nContent-Type: application/json\r\nContent-Length: {len(body)}"
        raw.sendall(head.encode() + b"\r\n\r\n" + body)  # and nobody waits for the answer
    until(lambda: abs(table.truth().pusher[0] - before[0]) > 0.005)
    time.sleep(0.4)  # twice the dead-man's time
    place = table.truth().pusher
    assert abs(place[0] - before[0]) < 0.065
    time.sleep(0.1)
    np.testing.assert_array_equal(table.truth().pusher, place)


def test_a_connection_that_is_lost_is_told_and_nothing_is_sent_any_more(server):
    with serving(example().robot(server[1])) as url:
        guard = GuardedWorld(HttpRobot(url, NAMES), FAST)
        guard.observe()
        guard.act(np.zeros(3))
    with pytest.raises(ConnectionLost, match="halts by itself"):
        guard.act(LEFT)
    with pytest.raises(RobotStopped, match="does not answer"):
        guard.act(LEFT)
    guard.close()


def test_nobody_there_is_told():
    with pytest.raises(ConnectionLost, match=r"The robot at http://127.0.0.1:\d+ does not answer"):
        connect(f"http://127.0.0.1:{free_port()}")


def test_what_is_used_after_closing_is_told(server):
    robot = HttpRobot(server[0], NAMES)
    robot.close()
    with pytest.raises(ConnectionLost):
        robot.observe()


@pytest.mark.parametrize("url", ["robot:8080", "ftp://robot", "http://", "http://robot:99999", "ros://"])
def test_addresses_that_are_none_are_refused(url):
    with pytest.raises(InvalidInput, match="address of the robot"):
        connect(url)


class Odd:
    """A server whose answers can be spoilt."""

    def __init__(self, good):
        self.good, self.robot, self.picture = good, good, b""

    def app(self):
        app = FastAPI()
        app.get("/robot")(lambda: self.robot)
        app.get("/pusher")(lambda: {"position": [0.0, 0.0, 0.06]})
        app.get("/images/{name}")(lambda name: Response(self.picture))
        return app


@pytest.fixture(scope="module")
def odd(server):
    import httpx2

    one = Odd(httpx2.get(f"{server[0]}/robot").json())
    with serving(one.app()) as url:
        yield url, one


@pytest.mark.parametrize(
    ("change", "words"),
    [
        ({"cameras": []}, "cameras"),
        ({"limits": {"box": [0, 0, 0, 0], "top_speed_m_s": 0.1}}, "safety box"),
        ({"limits": {"box": [0.0, 0.0, 1.0], "top_speed_m_s": 0.1}}, "box"),
        ({"deadman_s": 5.0}, "halts without a command"),
        ({"pusher_radius_m": 0.5}, "radius of the robot's pusher"),
    ],
)
def test_what_a_robot_says_of_itself_is_checked(odd, change, words):
    url, server = odd
    server.robot = server.good | change
    with pytest.raises(InvalidInput, match=words):
        HttpRobot(url, NAMES)


@pytest.mark.parametrize("picture", [b"", b"no picture"])
def test_a_picture_that_is_none_is_told(odd, picture):
    url, server = odd
    server.robot, server.picture = server.good, picture
    with contextlib.closing(HttpRobot(url, NAMES)) as robot, pytest.raises(CorruptFile, match="picture"):
        robot.observe()


def test_a_service_that_is_no_robot_is_told():
    app = FastAPI()
    with serving(app) as url, pytest.raises(RobotRefused, match="says: Not Found"):
        connect(url)


def test_closing_lets_a_stop_from_another_thread_arrive(server):
    described, told, may_answer = httpx2.get(f"{server[0]}/robot").json(), [], threading.Event()
    app = FastAPI()

    @app.get("/robot")
    def describe():
        return described

    @app.post("/stop")
    def stop():
        told.append("begun")
        assert may_answer.wait(20)
        told.append("stopped")

    with serving(app) as url:
        robot = HttpRobot(url, NAMES, timeout_s=30.0)
        other = threading.Thread(target=robot.stop)
        other.start()
        until(lambda: told == ["begun"])
        closing = threading.Thread(target=robot.close)
        closing.start()
        may_answer.set()
        closing.join()
        assert told == ["begun", "stopped"]
        other.join()
