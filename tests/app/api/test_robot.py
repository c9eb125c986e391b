import contextlib
import io
import json
import multiprocessing
import time
from concurrent.futures import ThreadPoolExecutor

import httpx2
import numpy as np
import pytest
from PIL import Image

from app.episodes.file_names import REPORT_FILE
from app.jobs.context import JobCancelled, JobStep
from app.jobs.kinds.robots import write_pictures
from app.jobs.process import JobClock
from app.services import runner
from app.services.robot import RobotTable
from osfcore.contrib.robots.robot import ConnectionLost
from osfcore.geometry.cameras import default_cameras
from osfcore.geometry.states import Observation
from osfcore.io.files import write_json
from osfcore.io.scene_file import camera_to_json
from tests.app.conftest import running, until
from tests.live import free_port
from tests.support.robots import NAMES, dripping, example, noted, serving, simulated
from tests.support.ros_robots import StandIn

PAGE = {"X-OSF-Visitor": "page"}
GREY = 188  # in sRGB, half the radiance


class Process:
    """In place of a job's process: does nothing by itself, and notes its orders."""

    latest = None

    def __init__(self, job, data_dir, folder, on_event):
        self.id, self.clock, self.pid = job.id, JobClock(), None
        self.orders, self.is_cancelled, self.outcome = [], False, None
        self._on_event = on_event
        Process.latest = self

    def reports(self, drives, done=0):
        self._on_event(JobStep(done, 30, "Pushing", {"drives": drives, "doubts": []}))

    def order(self, message):
        self.orders.append(message)
        return True

    def cancel(self, grace_s):
        self.is_cancelled = True

    def wait(self):
        time.sleep(0.01)
        return JobCancelled() if self.is_cancelled else self.outcome

    def end(self):
        pass


@pytest.fixture(scope="module")
def robot(library):
    """Address of a robot, and what it was asked."""
    asked = []
    with contextlib.closing(simulated(library)) as table, serving(noted(example().robot(table), asked)) as url:
        yield url, asked


@contextlib.contextmanager
def service_with(monkeypatch, library, tmp_path, lease_s=60.0, **settings):
    """A client of a service; a page may be silent for `lease_s`, by default longer than any test takes."""
    monkeypatch.setattr(runner, "JobProcess", Process)
    monkeypatch.setattr(RobotTable.__init__, "__defaults__", (lease_s,))
    with running(library, tmp_path, standby=False, **settings) as client:
        yield client


@pytest.fixture
def lease_s():
    return 60.0


@pytest.fixture
def service(monkeypatch, library, tmp_path, robot, lease_s):
    robot[1].clear()
    with service_with(monkeypatch, library, tmp_path, lease_s, robot=robot[0], robot_top_speed_m_s=0.05) as client:
        yield client


def photographed(client, name="0"):
    """A goal that a camera of the robot has seen."""
    png = io.BytesIO()
    Image.new("RGB", (64, 64)).save(png, "PNG")
    camera = json.dumps({**camera_to_json(default_cameras(64)[0]), "name": name})
    headers = {"Content-Type": "image/png"}
    return client.post("/api/goals", params={"camera": camera}, content=png.getvalue(), headers=headers).json()["id"]


def begun(client, drives="asked"):
    """An episode of the robot that is so far."""
    asked = client.post("/api/robot/episodes", json={"goal": photographed(client), "names": list(NAMES)})
    assert asked.status_code == 202, asked.text
    assert asked.json()["state"] == "looking"
    until(lambda: client.app.state.services.runner.jobs.live("robot")[0].state == "running")
    Process.latest.reports("asked")
    if drives == "driving":
        assert allow(client, asked.json()["episode"]["id"]).status_code == 200
        Process.latest.reports("driving")
    assert state(client) == drives
    return asked.json()["episode"]["id"]


def allow(client, episode, **more):
    return client.post("/api/robot/confirmation", json={"episode": episode}, **more)


def state(client):
    return client.get("/api/robot").json()["state"]


def test_it_has_limits_that_hold_for_both(service, robot):
    answer = service.get("/api/robot").json()
    assert (answer["host"], answer["state"], answer["episode"]) == (robot[0].removeprefix("http://"), "idle", None)
    assert answer["limits"] == {"box": [-0.35, -0.35, 0.35, 0.35], "top_speed_m_s": 0.05}
    assert [camera["name"] for camera in answer["cameras"]] == ["0", "1", "2", "3"]
    assert answer["masks"] == sorted(NAMES)


def test_a_service_without_a_robot_says_so(monkeypatch, library, tmp_path):
    with service_with(monkeypatch, library, tmp_path) as client:
        assert client.get("/api/robot").json()["host"] is None
        answer = client.post("/api/robot/episodes", json={"goal": "x", "names": ["025_mug"]})
        assert (answer.status_code, "osf serve --robot" in answer.json()["detail"]) == (404, True)
        assert client.post("/api/robot/stop").status_code == 200


def test_a_robot_that_does_not_answer_is_lost(monkeypatch, library, tmp_path):
    with service_with(monkeypatch, library, tmp_path, robot=f"http://127.0.0.1:{free_port()}") as client:
        answer = client.get("/api/robot").json()
        assert (answer["state"], "does not answer" in answer["text"]) == ("lost", True)
        assert client.post("/api/robot/episodes", json={"goal": "x", "names": ["025_mug"]}).status_code == 503


def test_a_robot_that_drips_holds_nobody_up_for_ever(monkeypatch, library, tmp_path):
    first = b"HTTP/1.1 200 OK\r\nContent-Length: 900000\r\n\r\n"
    with dripping(first) as url, service_with(monkeypatch, library, tmp_path, robot=url) as client:
        with ThreadPoolExecutor(24) as many:
            states = list(many.map(lambda _: state(client), range(24)))
        assert states == ["lost"] * 24


def test_pictures_of_the_robot_are_decoded_in_a_process_of_its_own(service):
    def decoders():  # other services may run in this process
        return {child.pid for child in multiprocessing.active_children() if child.name == "osf-decoder-of-photos"}

    before = decoders()
    assert service.get("/api/robot/cameras/0.jpg").status_code == 200
    assert decoders() - before


def test_no_request_names_the_robot(service, robot):
    body = {"goal": photographed(service), "names": list(NAMES), "url": "http://10.0.0.1"}
    assert service.post("/api/robot/episodes", json=body).status_code == 422
    begun(service)
    (job,) = service.app.state.services.runner.jobs.live("robot")
    assert (job.params["url"], job.params["top_speed_m_s"]) == (robot[0], 0.05)


def test_nothing_moves_before_it_is_allowed_by_name(service, robot):
    episode = begun(service)
    assert allow(service, "another").status_code == 409
    assert Process.latest.orders == []
    assert allow(service, episode).status_code == 200
    assert [order.params for order in Process.latest.orders] == [{"allowed": True}]
    assert not {"/start", "/act"} & set(robot[1])


def test_it_does_one_thing_at_a_time(service):
    begun(service)
    answer = service.post("/api/robot/episodes", json={"goal": photographed(service), "names": list(NAMES)})
    assert answer.status_code == 409


@pytest.mark.parametrize("drives", ["asked", "driving"])
def test_a_stop_reaches_the_robot_and_ends_the_episode_however_often(service, robot, drives):
    episode = begun(service, drives)
    robot[1].clear()
    for _ in range(3):
        answer = service.post("/api/robot/stop").json()
        assert answer["state"] == "stopped"
        assert answer["text"] == "The robot was stopped: somebody pressed Stop."
    assert "/stop" in robot[1]
    until(lambda: service.get(f"/api/jobs/{episode}").json()["state"] == "cancelled")
    assert allow(service, episode).status_code == 409
    assert state(service) == "stopped"


@pytest.mark.slow
@pytest.mark.parametrize(
    ("how", "words"),
    [
        (lambda client, _: client.post("/api/robot/stop"), "somebody pressed Stop"),
        (lambda client, episode: client.delete(f"/api/jobs/{episode}"), "its job was cancelled"),
        (lambda client, _: client.app.state.services.robot.close(), "the service was ended"),
    ],
)
def test_job_and_report_of_what_was_stopped_say_how(service, how, words):
    episode = begun(service)
    assert allow(service, episode, headers=PAGE).status_code == 200
    Process.latest.reports("driving")
    report = service.app.state.services.runner.jobs.folder(episode) / REPORT_FILE
    write_json(report, {"outcome": None, "text": None, "steps": []})
    how(service, episode)
    until(lambda: service.get(f"/api/jobs/{episode}").json()["state"] == "cancelled")
    result = service.get(f"/api/jobs/{episode}").json()["result"]
    answer = json.loads(report.read_text())
    assert (result["outcome"], answer["outcome"]) == ("stopped", "stopped")
    assert words in result["text"]
    assert answer["text"] == result["text"]


def test_why_it_was_stopped_is_known_after_the_service_was_started_anew(monkeypatch, library, tmp_path, robot):
    with service_with(monkeypatch, library, tmp_path, robot=robot[0]) as client:
        begun(client, "driving")
        client.post("/api/robot/stop")
    with service_with(monkeypatch, library, tmp_path, robot=robot[0]) as client:
        answer = client.get("/api/robot").json()
        assert (answer["state"], answer["text"]) == ("stopped", "The robot was stopped: somebody pressed Stop.")


def test_anybody_may_stop_it_while_only_the_driver_may_begin(service, robot):
    service.app.state.services.driver.arrive("page")
    other = {"X-OSF-Visitor": "other"}
    body = {"goal": photographed(service), "names": list(NAMES)}
    assert service.post("/api/robot/episodes", json=body, headers=other).status_code == 409
    assert allow(service, begun(service), headers=other).status_code == 409
    assert service.post("/api/robot/stop", headers=other).json()["state"] == "stopped"
    assert "/stop" in robot[1]


@pytest.mark.parametrize("lease_s", [3.0])
def test_a_page_that_falls_silent_stops_the_robot(service, robot, lease_s):
    episode = begun(service)
    robot[1].clear()
    allowed_at = time.monotonic()
    assert allow(service, episode, headers=PAGE).status_code == 200
    Process.latest.reports("driving")
    while time.monotonic() < allowed_at + 1.2 * lease_s:
        service.post("/api/robot/presence", headers=PAGE)
        time.sleep(0.1)
    assert (state(service), robot[1]) == ("driving", [])
    until(lambda: service.get(f"/api/jobs/{episode}").json()["state"] == "cancelled")
    assert state(service) == "stopped"
    text = service.get(f"/api/jobs/{episode}").json()["result"]["text"]
    assert "was closed, or has lost its connection" in text
    assert service.get("/api/robot").json()["text"] == text
    until(lambda: "/stop" in robot[1])


@pytest.mark.parametrize("lease_s", [0.4])
def test_another_page_does_not_keep_it_moving(service):
    assert allow(service, begun(service), headers=PAGE).status_code == 200

    def stopped():
        service.post("/api/robot/presence", headers={"X-OSF-Visitor": "other"})
        return state(service) == "stopped"

    until(stopped)


@pytest.mark.parametrize("lease_s", [0.4])
def test_programs_are_not_watched(service):
    begun(service, "driving")
    time.sleep(1.0)
    assert state(service) == "driving"


@pytest.mark.parametrize(("outcome", "then"), [({"drives": "over", "text": "Done."}, "idle"), (None, "lost")])
def test_however_an_episode_ends_the_robot_is_stopped(service, robot, outcome, then):
    begun(service, "driving")
    if outcome is None:
        Process.latest.reports("lost")
    robot[1].clear()
    Process.latest.outcome = outcome or ConnectionLost("http://robot", "no route")
    until(lambda: state(service) == then)
    until(lambda: "/stop" in robot[1])


def test_the_end_of_the_service_stops_it(monkeypatch, library, tmp_path, robot):
    with service_with(monkeypatch, library, tmp_path, robot=robot[0]) as client:
        begun(client, "driving")
        robot[1].clear()
    assert "/stop" in robot[1]


@pytest.mark.parametrize(
    ("change", "words"),
    [
        ({"names": ["no such thing"]}, "no such thing"),
        ({"names": [NAMES[0], NAMES[0]]}, "each named once"),
        ({"goal": "nothing"}, "no such goal"),
        ({"settings": {"steps": 0}}, ""),
    ],
)
def test_what_cannot_be_is_refused_at_once(service, change, words):
    body = {"goal": photographed(service), "names": list(NAMES), **change}
    answer = service.post("/api/robot/episodes", json=body)
    assert answer.status_code in (409, 422)
    assert words in answer.json()["detail"]


def test_a_goal_of_another_camera_is_refused(service):
    body = {"goal": photographed(service, "above"), "names": list(NAMES)}
    answer = service.post("/api/robot/episodes", json=body)
    assert (answer.status_code, "camera of the robot named 'above'" in answer.json()["detail"]) == (422, True)


def cameras(client):
    """Names of cameras, and when they saw what is shown."""
    return {camera["name"]: camera["seen_at"] for camera in client.get("/api/robot/cameras").json()}


def shown(client, name="0"):
    answer = client.get(f"/api/robot/cameras/{name}.jpg")
    assert (answer.status_code, answer.headers["Content-Type"]) == (200, "image/jpeg"), answer.text
    return pixels(answer.content)


def pixels(file):
    return np.asarray(Image.open(io.BytesIO(file)).convert("RGB"), int)


def looked(client, episode):
    """As an episode does that has looked, and has seen grey everywhere."""
    views = default_cameras(64)
    seen = Observation(views, np.full((4, 64, 64, 3), 0.5, np.float32), NAMES, None, None, 0.0)
    write_pictures(client.app.state.services.runner.jobs.folder(episode), seen)


def test_cameras_are_shown_as_they_see_it_and_asked_at_most_once_a_second(service, robot):
    assert service.get("/api/robot/cameras/0.jpg").status_code == 200
    asked = robot[1].count("/images/0")
    assert asked == 1
    (first, *_) = seen = service.get("/api/robot/cameras").json()
    assert [(camera["name"], camera["width"], camera["height"]) for camera in seen] == [
        (str(n), 64, 64) for n in range(4)
    ]
    assert first["age_s"] < 30
    assert shown(service).shape == (64, 64, 3)
    before = cameras(service)
    until(lambda: cameras(service) != before)
    assert all(seen > before[name] for name, seen in cameras(service).items())


def test_a_picture_is_what_the_camera_sent(service, robot):
    sent = pixels(httpx2.get(f"{robot[0]}/images/1").content)
    assert np.abs(shown(service, "1") - sent).mean() < 2


def test_an_episode_that_looks_or_moves_is_not_held_up_by_who_watches(service, robot):
    episode = begun(service, "driving")
    looked(service, episode)
    robot[1].clear()
    before = cameras(service)
    assert all(before.values())
    assert np.all(shown(service) == GREY)
    time.sleep(1.1)
    assert cameras(service) == before
    assert robot[1] == []


def test_before_the_first_look_there_is_no_picture_and_that_is_said(service, robot):
    begun(service, "driving")
    assert set(cameras(service).values()) == {None}
    answer = service.get("/api/robot/cameras/0.jpg")
    assert (answer.status_code, "first look" in answer.json()["detail"]) == (404, True)


def test_whoever_is_asked_for_permission_sees_the_table_as_it_is_now(service):
    looked(service, begun(service))
    before = cameras(service)
    until(lambda: cameras(service) != before)
    assert not np.all(shown(service) == GREY)


def test_a_camera_that_there_is_not_is_said(service):
    answer = service.get("/api/robot/cameras/above.jpg")
    assert (answer.status_code, "no camera of the robot named 'above'" in answer.json()["detail"]) == (404, True)


def test_what_was_seen_stays_when_the_robot_is_lost(monkeypatch, library, tmp_path):
    with contextlib.closing(simulated(library)) as table, contextlib.ExitStack() as going:
        url = going.enter_context(serving(example().robot(table)))
        with service_with(monkeypatch, library, tmp_path, robot=url) as client:
            before, picture = cameras(client), shown(client)
            going.close()
            time.sleep(1.1)
            assert cameras(client) == before
            np.testing.assert_array_equal(shown(client), picture)


def test_without_a_robot_there_are_no_cameras(monkeypatch, library, tmp_path):
    with service_with(monkeypatch, library, tmp_path) as client:
        for path in ("cameras", "cameras/0.jpg"):
            answer = client.get(f"/api/robot/{path}")
            assert (answer.status_code, "osf serve --robot" in answer.json()["detail"]) == (404, True)


def test_cameras_of_ros_are_shown_too_with_slashes_in_their_names(monkeypatch, library, tmp_path):
    stand_in = StandIn()
    for topic, message in list(stand_in.messages().items()):
        if topic.startswith("/left/"):
            stand_in.extra[topic.replace("/left/", "/front/left/")] = message
    with stand_in.running() as url:
        url = url.replace("left,right", "front/left,right")
        with service_with(monkeypatch, library, tmp_path, robot=url) as client:
            assert list(cameras(client)) == ["front/left", "right"]
            assert shown(client, "front/left").shape == (64, 64, 3)
