import json
import urllib.request
from dataclasses import replace

import numpy as np
import pytest
from pydantic import ValidationError

from app.api.episodes import EpisodeIn, EpisodeOut, ServiceSettings, SettingsIn
from app.episodes.file_names import FRAMES_FOLDER, REPORT_FILE
from app.episodes.frames import HEIGHT, WIDTH
from app.episodes.settings import ChosenSettings
from app.jobs.job import Job
from osfcore.control.events import EpisodeSettings
from osfcore.io.image_file import write_png
from osfcore.io.scene_file import Scene, scene_to_json
from osfcore.paper.mppi import GaussianPlanSettings
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
    folder, record = runner.jobs.folder(episode["id"]), runner.scenes.get(episode["scene"])
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
    assert (settings["steps"], settings["samples"]) == (5, 8)  # what is left out stays


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


def test_whoever_has_seen_its_end_is_not_asked_to_connect_again(service, scene, busy):
    path = f"/api/episodes/{service.post('/api/episodes', json={'poses': poses_of(scene)}).json()['id']}"
    service.delete(path)
    ended = service.get(f"{path}/events")
    assert "id: end" in ended.text.splitlines()
    assert '"state":"cancelled"' in ended.text
    assert service.get(f"{path}/events", headers={"Last-Event-ID": "7"}).text == ended.text
    again = service.get(f"{path}/events", headers={"Last-Event-ID": "end"})
    assert (again.status_code, again.content) == (204, b"")


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


PARAMS = {"scene": "s", "names": ["box"], "seed": 3, "settings": {"steps": 5}, "goal": {"id": "g"}}
STEP = {
    "step": 0,
    "seconds": {"first": 9.5},
    "image_cost": 0.25,
    "ssim": 0.9,
    "to_goal_mm": {"box": 60.0},
    "to_goal_deg": {"box": 3.0},
    "estimate_off_mm": {"box": 1.0},
    "truth": {"objects": []},
    "estimate": {},
}
REPORT = {"steps": [STEP], "noticed": [{"step": 0, "matter": "goal", "text": "It is odd."}]}


def told(job, report=None, files=()):
    return EpisodeOut.of_job(job, "A box", report, files)


def test_only_what_was_said_is_handed_on():
    assert SettingsIn.model_validate({}).given() == {}
    assert SettingsIn.model_validate({"steps": 5, "acting": False, "cost": None}).given() == {
        "steps": 5,
        "acting": False,
    }
    asked = EpisodeIn.model_validate({"goal": "g", "settings": {"samples": 8}})
    assert (asked.scene, asked.goal, asked.poses, asked.seed) == (None, "g", None, 0)
    assert asked.chosen() == ChosenSettings.defaults().changed({"samples": 8})


@pytest.mark.parametrize(
    "body",
    [
        {"goal": ""},
        {"goal": "x" * 65},
        {"poses": []},
        {"seed": -1},
        {"settings": None},
        {"settings": {"steps": 0}},
        {"settings": {"steps": 1.5}},
        {"settings": {"cost": "both"}},
        {"settings": {"temperature": float("nan")}},
        {"settings": {"noise_m": 1}},
        {"more": 1},
    ],
)
def test_what_makes_no_sense_is_refused(body):
    with pytest.raises(ValidationError):
        EpisodeIn.model_validate(body)


def test_an_episode_that_waits_has_nothing_to_tell_yet():
    out = told(Job("a", "episode", PARAMS, position=2))
    assert (out.status, out.position, out.stage, out.outcome, out.text) == ("queued", 2, None, None, None)
    assert (out.steps, out.notices, out.files) == ([], [], [])
    assert (out.scene, out.goal, out.objects, out.seed, out.settings.steps) == ("s", "g", ["box"], 3, 5)


def test_a_running_one_tells_stage_steps_and_notices():
    job = Job("a", "episode", PARAMS, "running", 2, 5, "Pushing", result={"stage": "act", "steps": 3})
    out = told(job, REPORT, ("report.json",))
    assert (out.stage, out.done, out.total, out.note, out.files) == ("act", 2, 5, "Pushing", ["report.json"])
    assert out.steps[0].model_dump() == {key: STEP[key] for key in STEP if key not in ("truth", "estimate")} | {
        "truly_to_goal_mm": None,
        "light_off_deg": None,
    }
    assert out.notices[0].text == "It is odd."


@pytest.mark.parametrize("state", ["done", "failed", "cancelled", "interrupted"])
def test_one_that_is_over_tells_how_it_ended(state):
    result = {"stage": "next", "steps": 3, "outcome": "reached", "text": "It is there."}
    out = told(replace(Job("a", "episode", PARAMS, state), result=result, error="No." if state == "failed" else None))
    assert (out.status, out.outcome, out.text) == (state, "reached", "It is there.")
    assert EpisodeOut.model_validate_json(out.model_dump_json()) == out


def test_the_defaults_are_those_of_an_episode_without_settings():
    defaults = ServiceSettings.now().episode.defaults
    assert defaults.method == "ours"
    assert defaults.of_loop() == EpisodeSettings()


def test_what_counts_as_reached_is_what_an_episode_goes_by():
    told, rule = ServiceSettings.now().episode, EpisodeSettings()
    assert (told.reached_mm, told.reached_deg) == pytest.approx((1000 * rule.reached_m, np.rad2deg(rule.reached_rad)))


def test_the_method_as_published_has_defaults_of_its_own():
    published = ServiceSettings.now().episode.published
    assert (published.method, published.cost, published.replan_every) == ("paper", "image", 1)
    own = GaussianPlanSettings()
    assert (published.samples, published.horizon, published.temperature) == (own.samples, own.horizon, own.temperature)


def test_the_method_is_asked_for_among_the_settings():
    asked = EpisodeIn.model_validate({"scene": "s", "goal": "g", "settings": {"method": "paper", "steps": 4}}).chosen()
    assert (asked.method, asked.steps) == ("paper", 4)
    assert EpisodeIn.model_validate({"scene": "s", "goal": "g"}).chosen().method == "ours"


def test_steps_of_a_method_that_looks_at_images_alone_know_no_distances():
    step = {"step": 0, "seconds": {}, "image_cost": 0.1, "to_goal_mm": None, "to_goal_deg": None, "estimate_off_mm": {}}
    job = Job("a", "episode", {**PARAMS, "method": "paper"})
    out = EpisodeOut.of_job(job, "A", {"steps": [step]}, ())
    assert out.settings.method == "paper"
    assert (out.steps[0].to_goal_mm, out.steps[0].to_goal_deg) == (None, None)


def test_the_time_that_it_took_is_told_with_and_without_its_steps():
    job = Job("j", "episode", PARAMS, "done", result={"seconds": 31.25})
    assert told(job).seconds == told(job, {**REPORT, "seconds": 31.25}).seconds == 31.25
