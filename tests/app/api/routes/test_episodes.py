"""Episodes as a program asks for them; one that really runs is in tests/app/test_episodes.py."""

import json
import urllib.request

import numpy as np
import pytest

from app.episodes.file_names import FRAMES_FOLDER, REPORT_FILE
from app.episodes.frames import HEIGHT, WIDTH
from osfcore.io.image_file import write_png
from osfcore.io.scene_file import Scene, scene_to_json
from tests.app.api.test_problems import is_problem
from tests.app.conftest import LONG, keep_busy, leave_running, running

BOX = "003_cracker_box"


@pytest.fixture(scope="module")
def busy(service):
    """A job that keeps its turn."""
    job = keep_busy(service)
    yield job
    service.delete(f"/api/jobs/{job}")


def poses_of(scene):
    return [{key: entry[key] for key in ("name", "position", "quaternion")} for entry in scene["objects"]]


@pytest.fixture
def waiting(service, scene, busy):
    accepted = service.post("/api/episodes", json={"poses": poses_of(scene), "seed": 7, "settings": {"steps": 5}})
    assert accepted.status_code == 202
    assert accepted.headers["location"] == f"/api/episodes/{accepted.json()['id']}"
    yield accepted.json()
    service.delete(f"/api/episodes/{accepted.json()['id']}")


@pytest.fixture(scope="module")
def restarted(library, tmp_path_factory):
    """A service that had been stopped after an episode's first look, and the episode as it was asked for."""
    data_dir = tmp_path_factory.mktemp("restarted")
    with running(library, data_dir) as client:
        keep_busy(client)
        scene = client.post("/api/scenes", json={"seed": 1, "objects": [BOX]}).json()
        episode = client.post("/api/episodes", json={"poses": poses_of(scene)}).json()
    leave_running(data_dir, episode["id"])
    with running(library, data_dir) as client:
        yield client, episode


@pytest.fixture
def interrupted(restarted):
    """The client, the episode's name and its folder."""
    client, episode = restarted
    runner = client.app.state.services.runner
    folder, record = runner.jobs.folder(episode["id"]), runner.scene(episode["scene"])
    write_png(folder / FRAMES_FOLDER / "000.png", np.full((HEIGHT, WIDTH, 3), 99, np.uint8))
    millimetres = dict.fromkeys(episode["objects"], 1.5)
    step = {
        "step": 0,
        "seconds": {"first": 9.5},
        "image_cost": 0.01,
        "to_goal_mm": millimetres,
        "to_goal_deg": millimetres,
        "estimate_off_mm": millimetres,
        "truth": scene_to_json(Scene(record.state, ())),
    }
    notice = {"step": 0, "matter": "lamp", "text": "The lamp was moved."}
    (folder / REPORT_FILE).write_text(json.dumps({"steps": [step], "noticed": [notice]}))
    return client, episode["id"], folder


def test_an_episode_waits_for_its_turn(service, scene, waiting):
    assert (waiting["status"], waiting["position"], waiting["scene"]) == ("queued", 1, scene["id"])
    assert (waiting["goal"], waiting["seed"], waiting["settings"]["steps"]) == (None, 7, 5)
    assert waiting["objects"] == [entry["name"] for entry in scene["objects"]]
    assert (waiting["steps"], waiting["files"], waiting["outcome"], waiting["stage"]) == ([], [], None, None)
    assert service.get(f"/api/episodes/{waiting['id']}").json() == waiting
    assert service.get("/api/episodes").json()["episodes"][0] == waiting
    is_problem(service.get(f"/api/episodes/{waiting['id']}/frames/0.png"), 404)
    is_problem(service.get(f"/api/episodes/{waiting['id']}/files/{REPORT_FILE}"), 404)
    cancelled = service.delete(f"/api/episodes/{waiting['id']}").json()
    assert (cancelled["status"], cancelled["position"]) == ("cancelled", None)


def test_an_episode_toward_a_goal_image_names_it_even_when_it_has_gone(service, services, scene, busy):
    goal = service.post("/api/goals", json={"random": {"moved": 1}}).json()
    service.post("/api/goals/draft", json={})
    episode = service.post("/api/episodes", json={"goal": goal["id"], "scene": scene["id"]}).json()
    is_problem(service.get("/api/goals/draft"), 404)  # the table is the episode's
    service.delete(f"/api/goals/{goal['id']}")
    assert service.get(f"/api/episodes/{episode['id']}").json()["goal"] == goal["id"]
    truth = services.runner.jobs.get(episode["id"]).params["goal"]["truth"]
    assert truth == goal["objects"]
    service.delete(f"/api/episodes/{episode['id']}")


@pytest.mark.parametrize(
    ("body", "status", "words"),
    [
        ({}, 422, "needs a goal"),
        ({"goal": "none"}, 422, "no such goal"),
        ({"goal": "g", "scene": "nowhere"}, 422, "no such scene"),
        ({"goal": "g", "seed": -1}, 422, "#/seed"),
        ({"goal": "g", "settings": {"steps": 0}}, 422, "#/settings/steps"),
        ({"goal": "g", "settings": {"noise_m": 1}}, 422, "#/settings/noise_m"),
        ({"goal": "g", "settings": {"cost": "both"}}, 422, "#/settings/cost"),
        ({"poses": []}, 422, "#/poses"),
        ({"poses": [{"name": BOX, "position": [0, 0, 0], "quaternion": [1, 0, 0, 0]}]}, 422, "each once"),
    ],
)
def test_mistakes_are_told(service, scene, body, status, words):
    before = service.get("/api/episodes").json()
    assert words in str(is_problem(service.post("/api/episodes", json=body), status))
    assert service.get("/api/episodes").json() == before


def test_poses_that_are_none_are_refused_at_once(service, scene):
    poses = poses_of(scene)
    poses[0]["quaternion"] = [0, 0, 0, 0]
    assert "unit quaternion" in is_problem(service.post("/api/episodes", json={"poses": poses}), 422)["detail"]


def test_missing_episodes_and_jobs_of_other_kinds_are_not_found(service, busy):
    paths = [
        ("get", ""), ("delete", ""), ("post", "/pause"), ("post", "/resume"), ("post", "/step"), ("patch", "/settings"),
        ("get", "/events"), ("get", "/frames/0.png"), ("get", "/files/report.json"),
    ]  # fmt: skip
    for method, tail in paths:
        body = {"json": {"steps": 5}} if method == "patch" else {}
        for name in ("none", busy):
            is_problem(getattr(service, method)(f"/api/episodes/{name}{tail}", **body), 404)


def test_orders_that_do_not_fit_say_so(service, waiting):
    address = f"/api/episodes/{waiting['id']}"
    for order in ("pause", "resume", "step"):
        assert "is queued" in is_problem(service.post(f"{address}/{order}"), 409)["detail"]
    is_problem(service.patch(f"{address}/settings", json={"steps": 5}), 409)
    is_problem(service.patch(f"{address}/settings", json={"steps": 0}), 422)


def test_orders_reach_the_job(service, services, waiting, monkeypatch):
    jobs, given = services.runner.jobs, []

    def note(order):
        def call(name, *more):
            given.append((order, name, *more))
            return jobs.get(name)

        return call

    for order in ("pause", "resume", "step", "change"):
        monkeypatch.setattr(jobs, order, note(order))
    address = f"/api/episodes/{waiting['id']}"
    for order in ("pause", "resume", "step"):
        assert service.post(f"{address}/{order}").json()["id"] == waiting["id"]
    assert service.patch(f"{address}/settings", json={"samples": 8}).status_code == 200
    assert [order for order, *_ in given] == ["pause", "resume", "step", "change"]
    settings = given[-1][2]["settings"]
    assert (settings["steps"], settings["plan"]["samples"]) == (5, 8)  # what is left out stays


@pytest.mark.slow
def test_one_that_was_interrupted_still_shows_what_it_has_done(interrupted):
    service, name, _ = interrupted
    address = f"/api/episodes/{name}"
    told = service.get(address).json()
    assert told["status"] == "interrupted"
    assert "the steps until then are kept" in told["error"]
    assert [step["step"] for step in told["steps"]] == [0]
    assert told["notices"][0]["matter"] == "lamp"
    assert "episode.viser" in told["files"]
    assert service.get(f"{address}/files/episode.viser").headers["content-type"] == "application/octet-stream"
    assert service.get(f"{address}/files/video.mp4").content[4:8] == b"ftyp"
    assert service.get(f"{address}/frames/0.png?part=now").headers["content-type"] == "image/png"
    is_problem(service.get(f"{address}/frames/1.png"), 404)
    is_problem(service.get(f"{address}/frames/0.png?part=other"), 422)
    is_problem(service.get(f"{address}/files/..%2f..%2fservice.sqlite3"), 404)
    is_problem(service.delete(address), 409)
    (listed,) = [one for one in service.get("/api/episodes").json()["episodes"] if one["id"] == name]
    assert listed == {**told, "steps": [], "notices": []}


@pytest.mark.parametrize("report", ["{", '{"steps": [{}]}', '{"steps": [], "noticed": [1]}', '{"steps": [5]}'])
def test_a_damaged_report_is_told_and_does_not_hide_the_list(interrupted, report):
    service, name, folder = interrupted
    (folder / REPORT_FILE).write_text(report)
    detail = is_problem(service.get(f"/api/episodes/{name}"), 409)["detail"]
    assert REPORT_FILE in detail
    assert name in [one["id"] for one in service.get("/api/episodes").json()["episodes"]]


@pytest.mark.slow
def test_its_events_end_with_it(live):
    _, scene = live.request("POST", "/api/scenes", {"seed": 1, "objects": [BOX]})
    _, job = live.request("POST", "/api/jobs", LONG)
    _, episode = live.request("POST", "/api/episodes", {"poses": poses_of(scene)})
    told = []
    with urllib.request.urlopen(f"{live.url}/api/episodes/{episode['id']}/events", timeout=60) as stream:
        for line in stream:  # it ends by itself
            if line.startswith(b"data:"):
                told.append(json.loads(line[5:]))
                if len(told) == 1:
                    live.request("DELETE", f"/api/episodes/{episode['id']}")
    assert {job["id"] for job in told} == {episode["id"]}
    assert (told[0]["state"], told[-1]["state"], told[-1]["kind"]) == ("queued", "cancelled", "episode")
    live.request("DELETE", f"/api/jobs/{job['id']}")
    live.request("DELETE", f"/api/scenes/{scene['id']}")


def test_the_method_as_published_is_a_setting(service, scene, busy):
    body = {"poses": poses_of(scene), "settings": {"method": "paper", "steps": 2}}
    episode = service.post("/api/episodes", json=body)
    assert episode.status_code == 202, episode.text
    episode = episode.json()
    settings = episode["settings"]
    assert (settings["method"], settings["cost"], settings["steps"]) == ("paper", "image", 2)
    service.delete(f"/api/episodes/{episode['id']}")
    refused = service.post("/api/episodes", json={**body, "settings": {"method": "paper", "cost": "pose"}})
    assert is_problem(refused, 422)
    assert "cost is pose, but it must be image with the method as published" in refused.json()["detail"]


def test_an_object_without_a_field_as_published_is_a_conflict_in_words(service, services, scene, monkeypatch):
    monkeypatch.setattr(type(services.fields), "published", lambda _: ())
    body = {"poses": poses_of(scene), "settings": {"method": "paper"}}
    refused = service.post("/api/episodes", json=body)
    assert is_problem(refused, 409)
    assert refused.json()["detail"].startswith(
        "There is no field as published for 003_cracker_box, 006_mustard_bottle;"
    )
