import contextlib
import io
import json
import socket
import threading
import time
from urllib.parse import urlsplit

import cv2
import httpx2
import numpy as np
import pytest
from fastapi import FastAPI, Response
from PIL import Image

from osfcore.contrib.robots.connect import connect
from osfcore.contrib.robots.guarded_world import GuardedWorld
from osfcore.contrib.robots.http_robot import HttpRobot, SentCamera, observation_of
from osfcore.contrib.robots.robot import ConnectionLost, RobotRefused, RobotStopped, SafetyLimits
from osfcore.errors import CorruptFile, InvalidInput
from osfcore.geometry.cameras import Camera
from osfcore.io.image_file import encode_png
from osfcore.photo.lens import Lens
from tests.live import free_port
from tests.support.errors import about
from tests.support.robots import NAMES, dripping, example, serving, until
from tests.support.same import assert_same

FAST = SafetyLimits(top_speed_m_s=0.42)
LEFT = np.array([-0.3, 0.0, 0.0])


@pytest.fixture
def robot(server):
    with contextlib.closing(connect(server[0], NAMES)) as robot:
        yield robot


def test_it_describes_itself_and_sends_radiance_with_masks_on_demand(robot, server):
    assert_same(robot.description.cameras, server[1].cameras, atol=1e-9)
    assert robot.description.limits.box == (-0.35, -0.35, 0.35, 0.35)
    assert robot.description.masks == set(NAMES)
    seen, truth = robot.observe(masks=True), server[1].observe(masks=True)
    assert np.abs(seen.images - truth.images).mean() < 0.01  # of JPEG
    np.testing.assert_array_equal(seen.masks, truth.masks)
    np.testing.assert_allclose(seen.pusher, truth.pusher, atol=1e-12)
    assert seen.names == NAMES
    with contextlib.closing(HttpRobot(server[0], ("025_mug",))) as other:
        assert other.observe(masks=True).masks is None  # it has none of the mug


def test_it_moves_once_it_is_started(robot, server):
    robot.stop()
    before = server[1].truth().pusher
    with pytest.raises(RobotRefused):
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
    with pytest.raises(RobotStopped, check=about("a key was pressed")):
        guard.act(LEFT)
    other.join()
    place = server[1].truth().pusher
    assert abs(place[0] - before) < 0.055
    with pytest.raises(RobotStopped):
        guard.act(LEFT)
    np.testing.assert_array_equal(server[1].truth().pusher, place)


def test_a_client_that_is_cut_off_leaves_a_robot_that_stands(server):
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


def test_after_a_lost_connection_nothing_is_sent_any_more(server):
    with serving(example().robot(server[1])) as url:
        guard = GuardedWorld(HttpRobot(url, NAMES), FAST)
        guard.observe()
        guard.act(np.zeros(3))
    with pytest.raises(ConnectionLost, check=about(url)):
        guard.act(LEFT)
    with pytest.raises(RobotStopped):
        guard.act(LEFT)
    guard.close()


def test_malformed_addresses_are_refused_and_what_does_not_answer_is_no_robot(server):
    for url in ("robot:8080", "ftp://robot", "http://", "http://robot:99999", "ros://"):
        with pytest.raises(InvalidInput, check=about("address of the robot")):
            connect(url)
    with pytest.raises(ConnectionLost):
        connect(f"http://127.0.0.1:{free_port()}")
    with serving(FastAPI()) as url, pytest.raises(RobotRefused, check=about("Not Found")):
        connect(url)
    robot = HttpRobot(server[0], NAMES)
    robot.close()
    with pytest.raises(ConnectionLost):
        robot.observe()


class Odd:
    """A server whose answers can be spoilt: `robot` and `picture`, or any path's by another response."""

    def __init__(self, good):
        self.good, self.robot, self.picture, self.spoilt = good, good, b"", {}

    def app(self):
        app = FastAPI()

        @app.middleware("http")
        async def spoil(request, handle):
            return self.spoilt.get(request.url.path) or await handle(request)

        app.get("/robot")(lambda: self.robot)
        app.get("/pusher")(lambda: {"position": [0.0, 0.0, 0.06]})
        app.get("/images/{name}")(lambda name: Response(self.picture))
        return app


@pytest.fixture(scope="module")
def odd(server):
    one = Odd(httpx2.get(f"{server[0]}/robot").json())
    with serving(one.app()) as url:
        yield url, one


@pytest.fixture
def odd_robot(odd):
    """A robot of sound description, whose other answers are spoilt; a machine may be as slow as it likes."""
    odd[1].robot = odd[1].good
    with contextlib.closing(HttpRobot(odd[0], NAMES, timeout_s=120.0)) as robot:
        yield robot
    odd[1].spoilt = {}


DEEP = b"[" * 100_000 + b"]" * 100_000


@pytest.mark.parametrize(
    "answer",
    [
        Response(b"no gzip", headers={"Content-Encoding": "gzip"}),
        Response(DEEP),
        Response(b'{"position": ' + DEEP + b"}"),
        Response(b'{"detail": ' + DEEP + b"}", 409),
        Response(b"\xff", 500),
        Response(b"0" * 40_000_000),
    ],
)
def test_whatever_a_robot_answers_is_a_refusal(odd, odd_robot, answer):
    odd[1].spoilt = dict.fromkeys(("/pusher", "/act", "/stop"), answer)
    with pytest.raises(RobotRefused):
        odd_robot.observe()
    guard = GuardedWorld(odd_robot, FAST)
    guard.stop("a key was pressed")
    with pytest.raises(RobotStopped, check=about("a key was pressed")):
        guard.check()


def test_a_robot_whose_place_never_changes_is_stopped(odd, odd_robot):
    odd[1].spoilt = dict.fromkeys(("/start", "/act", "/stop"), Response(status_code=204))
    odd[1].picture = encode_png(np.zeros((64, 64, 3), np.uint8))
    guard = GuardedWorld(odd_robot, FAST)
    guard.observe()
    guard.act(LEFT)
    guard.observe()
    guard.act(LEFT)
    with pytest.raises(RobotStopped, check=about("hardly moved")):
        guard.observe()


def test_pictures_that_are_too_large_are_refused_before_they_are_decoded(odd, odd_robot):
    odd[1].picture = b"0" * 33_000_000
    with pytest.raises(RobotRefused, check=about("32 MB")):
        odd_robot.observe()
    large = io.BytesIO()
    Image.new("1", (2048, 3000)).save(large, "PNG")
    odd[1].picture = large.getvalue()
    with pytest.raises(CorruptFile, check=about("2048 x 3000 pixels")):
        odd_robot.observe()


@pytest.mark.parametrize("first", [b"HTTP/1.1 200 OK\r\nA: ", b"HTTP/1.1 200 OK\r\nContent-Length: 900000\r\n\r\n"])
def test_an_answer_that_drips_is_not_waited_for(first):
    with dripping(first) as url, pytest.raises(ConnectionLost, check=about("no whole answer")):
        HttpRobot(url, NAMES, timeout_s=0.3)


@pytest.mark.parametrize(
    ("change", "what"),
    [
        ({"cameras": []}, "cameras"),
        ({"limits": {"box": [0, 0, 0, 0], "top_speed_m_s": 0.1}}, "safety box"),
        ({"limits": {"box": [0.0, 0.0, 1.0], "top_speed_m_s": 0.1}}, "box"),
        ({"deadman_s": 5.0}, "halts without a command"),
        ({"pusher_radius_m": 0.5}, "radius of the robot's pusher"),
    ],
)
def test_a_robots_description_is_checked(odd, change, what):
    url, server = odd
    server.robot = server.good | change
    with pytest.raises(InvalidInput, check=about(what)):
        HttpRobot(url, NAMES)


def test_cameras_of_one_name_and_too_many_of_them_are_refused(odd):
    url, server = odd
    (camera, *_) = server.good["cameras"]
    for cameras, what in (
        ([camera] * 4, "cameras of the robot"),
        ([camera | {"name": str(n)} for n in range(17)], "number of the robot's cameras"),
    ):
        server.robot = server.good | {"cameras": cameras}
        with pytest.raises(InvalidInput, check=about(what)):
            HttpRobot(url, NAMES)


def test_damaged_pictures_are_refused(odd, odd_robot):
    for odd[1].picture in (b"", b"no picture"):
        with pytest.raises(CorruptFile):
            odd_robot.observe()


def test_closing_lets_a_stop_from_another_thread_arrive(odd):
    log, may_answer = [], threading.Event()
    app = odd[1].app()
    odd[1].robot = odd[1].good

    @app.post("/stop")
    def stop():
        log.append("begun")
        assert may_answer.wait(20)
        log.append("stopped")

    with serving(app) as url:
        robot = HttpRobot(url, NAMES, timeout_s=30.0)
        other = threading.Thread(target=robot.stop)
        other.start()
        until(lambda: log == ["begun"])
        closing = threading.Thread(target=robot.close)
        closing.start()
        may_answer.set()
        closing.join()
        assert log == ["begun", "stopped"]
        other.join()


# Pictures of cameras

LOOK = Camera.look_at("side", (0.6, 0.1, 0.5), (0, 0, 0), size=64)


def sent(width, height, focal, coefficients=()):
    K = np.array([[focal, 0, width / 2], [0, focal, height / 2], [0, 0, 1.0]])
    return SentCamera("side", LOOK.T_world_camera, Lens(K, coefficients), width, height)


def test_large_pictures_are_reduced_and_points_stay_where_they_are():
    camera = sent(1280, 720, 900.0)
    kept = camera.kept()
    assert (kept.width, kept.height) == (640, 360)
    point = np.array([0.05, -0.03, 0.02])
    whole = Camera("side", LOOK.T_world_camera, camera.lens.intrinsics, 1024, 720)
    np.testing.assert_allclose(kept.project(point), whole.project(point) / 2, atol=1e-12)
    assert camera.radiance(encode_png(np.zeros((720, 1280, 3), np.uint8))).shape == (360, 640, 3)


def test_bent_lines_are_straightened():
    """A dot is drawn where OpenCV's model projects it to, and found where a pinhole would."""
    camera = sent(320, 240, 250.0, (-0.2, 0.05, 0.0, 0.0, 0.0))
    K = camera.lens.intrinsics - np.array([[0, 0, 0.5], [0, 0, 0.5], [0, 0, 0]])
    point = np.array([[0.4, -0.3, 1.0]])
    bent = cv2.projectPoints(point, np.zeros(3), np.zeros(3), K, np.array(camera.lens.coefficients))[0].ravel()
    straight = (K @ point[0])[:2]
    assert np.linalg.norm(bent - straight) > 4
    picture = np.zeros((240, 320, 3), np.uint8)
    cv2.circle(picture, np.round(16 * bent).astype(int).tolist(), 16 * 3, (255, 255, 255), -1, cv2.LINE_AA, 4)
    found = camera.radiance(encode_png(picture))[..., 0]
    assert 0 <= found.min() <= found.max() <= 1
    rows, columns = np.indices(found.shape)
    np.testing.assert_allclose([np.average(axis, weights=found) for axis in (columns, rows)], straight, atol=0.3)


def test_sizes_that_do_not_fit_are_refused():
    for shape in ((64, 48), (32, 32)):
        with pytest.raises(InvalidInput, check=about("camera side")):
            sent(64, 64, 80.0).radiance(encode_png(np.zeros((*shape, 3), np.uint8)))
    for size in ((0, 10), (5000, 100)):
        with pytest.raises(InvalidInput, check=about("camera side")):
            sent(*size, 80.0).kept()
    with pytest.raises(InvalidInput, check=about("sizes of the robot's cameras")):
        observation_of((sent(64, 64, 80.0), sent(80, 64, 80.0)), [b"", b""], (), np.zeros(3), 0.0)
