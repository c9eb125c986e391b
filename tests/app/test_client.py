"""The client against a running service; requests and answers are checked by the OpenAPI schema."""

import json
import re
from typing import get_args

import httpx2
import numpy as np
import pytest
from jsonschema import Draft202012Validator

from app.api.app_factory import create_app
from app.jobs.job import FINISHED, State
from osfcore.contrib.client import Client, Connection, Episode, Estimate, Health, Mode, ServiceError
from osfcore.errors import InvalidInput
from osfcore.geometry.poses import Pose
from osfcore.io.image_file import encode_png, to_uint8
from osfcore.world.collect_images import CollectObservation, collect_observation
from tests.support.errors import about

BOX, BOTTLE = "003_cracker_box", "006_mustard_bottle"
TINY = {"steps": 1, "samples": 8, "horizon": 4}
SCHEMA = create_app().openapi()


def operation(request):
    """The schema of a request."""
    for path, methods in SCHEMA["paths"].items():
        pattern = re.sub(r"\\\{\w+\\\}", "[^/]+", re.escape(path))
        if re.fullmatch(pattern, request.url.path) and request.method.lower() in methods:
            return methods[request.method.lower()]
    pytest.fail(f"the schema knows no {request.method} {request.url.path}")


def check(schema, value):
    Draft202012Validator({**schema, "components": SCHEMA["components"]}).validate(value)


def judge_request(request):
    known = operation(request)
    parameters = {one["name"] for one in known.get("parameters", ()) if one["in"] == "query"}
    assert set(request.url.params) <= parameters
    kind = request.headers.get("content-type", "")
    if kind:
        allowed = known["requestBody"]["content"]
        assert kind in allowed or f"{kind.partition('/')[0]}/*" in allowed
    if kind == "application/json":
        check(known["requestBody"]["content"][kind]["schema"], json.loads(request.content))


def judge_answer(answer):
    kind = answer.headers.get("content-type", "")
    known = operation(answer.request)["responses"][str(answer.status_code)]["content"]
    assert kind.partition(";")[0] in known
    if "json" in kind:
        answer.read()
        check(known[kind]["schema"], answer.json())


def resolved(schema, root):
    """The schema that a reference points to, or itself."""
    if "$ref" in schema:
        _, *path = schema["$ref"].split("/")
        schema = root
        for part in path:
            schema = schema[part]
    return schema


def choices(schema, root):
    """The schemas one of which a value must fit."""
    schema = resolved(schema, root)
    return [one for option in schema["anyOf"] for one in choices(option, root)] if "anyOf" in schema else [schema]


def takes_all(ours, theirs, where):
    """That one schema allows every value that another one allows; both with what their references point into."""
    (our_schema, our_root), (their_schema, their_root) = ours, theirs
    our_choices = choices(our_schema, our_root)
    for given in choices(their_schema, their_root):
        kind = given.get("type")
        fitting = [one for one in our_choices if one.get("type") in (kind, "number" if kind == "integer" else kind)]
        assert fitting, f"{where} may be {given}, which is not known here"
        (known,) = fitting
        if "enum" in known or "const" in known:
            values = set(given.get("enum", [given.get("const")]))
            assert values <= set(known.get("enum", [known.get("const")])), where
        for part in ("items", "additionalProperties"):
            if isinstance(known.get(part), dict):
                takes_all((known[part], our_root), (given[part], their_root), f"{where}, each")
        assert set(known.get("required", ())) <= set(given.get("required", ())), where
        for name, member in known.get("properties", {}).items():
            takes_all((member, our_root), (given["properties"][name], their_root), f"{where}, {name}")


@pytest.mark.parametrize(
    ("kind", "path"),
    [(Health, "/api/health"), (Episode, "/api/episodes/{episode}"), (Estimate, "/api/estimates/{estimate}")],
)
def test_every_answer_that_the_schema_allows_is_understood(kind, path):
    ours = kind.model_json_schema()
    theirs = SCHEMA["paths"][path]["get"]["responses"]["200"]["content"]["application/json"]["schema"]
    takes_all((ours, ours), (theirs, SCHEMA), kind.__name__)


def test_modes_and_finished_states_are_those_of_the_service():
    known = resolved(SCHEMA["components"]["schemas"]["EstimateIn"]["properties"]["mode"], SCHEMA)
    assert set(known["enum"]) == set(get_args(Mode))
    fields = {"id": "e1", "stage": None, "done": 0, "total": 0, "note": "", "eta_s": None, "error": None}
    over = {state for state in get_args(State) if Estimate(**fields, status=state, estimate=None).is_over}
    assert over == set(FINISHED)


@pytest.fixture
def osf(live):
    hooks = {"request": [judge_request], "response": [judge_answer]}
    with Client(connection=Connection(httpx2.Client(base_url=live.url, event_hooks=hooks, timeout=60))) as client:
        yield client


@pytest.fixture
def table(osf, live):
    scene = osf.new_scene([BOX, BOTTLE], seed=1)
    yield scene
    live.request("DELETE", f"/api/scenes/{scene.id}")


def test_a_table_is_made_pushed_and_seen(osf, table):
    assert osf.health().status in ("ok", "degraded")
    assert {BOX, BOTTLE} <= set(osf.objects())
    assert table.state.names == (BOX, BOTTLE)
    assert table.id in [one.id for one in osf.scenes()]
    assert [camera.name for camera in table.cameras] == ["0", "1", "2", "3", "goal"]
    velocity = -table.state.pusher / np.abs(table.state.pusher).max() * [0.2, 0.2, 0]
    moved = osf.act(np.tile(velocity, (2, 1)))
    np.testing.assert_allclose(moved.state.pusher - table.state.pusher, 0.4 * velocity, atol=2e-3)
    assert moved.time_s == pytest.approx(0.4)
    np.testing.assert_array_equal(osf.scene().state.poses.position, moved.state.poses.position)
    image = osf.image(size=64, pusher=False)
    assert image.shape == (64, 64, 3)
    assert 0.05 < image.mean() < 0.95
    assert np.abs(osf.image("2", size=64) - image).max() > 0.1


@pytest.mark.slow
def test_goals_are_sent_and_made(osf, table, tmp_path):
    drawn = osf.random_goal(1, moved=1)
    assert set(drawn.names) == {BOX, BOTTLE}
    image = osf.goal_image(osf.goal(drawn.id))
    assert image.shape == (drawn.camera.height, drawn.camera.width, 3)
    sent = osf.upload_goal(image, name="As drawn")
    assert (sent.name, sent.names) == ("As drawn", ())
    np.testing.assert_allclose(osf.goal_image(sent), image, atol=2 / 255)
    assert osf.goal_problem(drawn) == ""
    (tmp_path / "table.png").write_bytes(encode_png(to_uint8(image)))
    assert osf.upload_goal(tmp_path / "table.png").name == "table"
    pose = table.state.pose(BOX)
    made = osf.goal_of({BOX: Pose(pose.position + [0.0, 0.05, 0.0], pose.quaternion)}, light=table.state.light)
    assert np.abs(osf.goal_image(made) - image).max() > 0.1
    (tmp_path / "goal.txt").write_text("a table")
    for path in (tmp_path / "goal.txt", tmp_path / "none.png"):
        with pytest.raises(InvalidInput, check=about("photo")):
            osf.upload_goal(path)


@pytest.mark.slow
def test_predictions_are_futures(osf, table):
    away = table.state.pusher / np.linalg.norm(table.state.pusher[:2]) * [0.2, 0.2, 0]
    rollouts = osf.predict(np.stack([np.tile(away, (3, 1)), np.zeros((3, 3))]))
    assert rollouts.names == table.state.names
    assert rollouts.positions.shape == (2, 4, 2, 3)
    np.testing.assert_allclose(rollouts.pusher[:, 0], np.tile(table.state.pusher, (2, 1)), atol=1e-6)
    again = osf.predict(np.zeros((1, 3, 3)), table.state)
    np.testing.assert_allclose(again.positions[0], rollouts.positions[1], atol=1e-6)
    with pytest.raises(InvalidInput, check=about("action 0 of sequence 0")):
        osf.predict(np.full((1, 1, 3), 9.0))


def test_what_the_service_refuses_is_one_sentence(osf, live):
    with pytest.raises(ServiceError, match="'teapot'") as refused:
        osf.new_scene(["teapot"])
    assert refused.value.status == 422
    with pytest.raises(ServiceError) as unknown:
        osf.image(scene="none")
    assert unknown.value.status == 404
    with Client(live.url) as plain, pytest.raises(ServiceError):
        plain.episode({BOX: Pose(np.zeros(3), np.array([1.0, 0, 0, 0]))}, steps=0)


def talking_to(answer):
    """A client of something that is played."""
    return Client(connection=Connection(httpx2.Client(base_url="http://desk", transport=httpx2.MockTransport(answer))))


def test_no_service_or_another_one_is_told_by_its_status():
    page = talking_to(lambda request: httpx2.Response(404, text="<html>nothing here"))
    for client, status in ((Client("http://127.0.0.1:9"), 0), (page, 404)):
        with client as osf, pytest.raises(ServiceError) as caught:
            osf.health()
        assert caught.value.status == status


def test_a_download_that_breaks_off_leaves_the_older_file(tmp_path):
    def half():
        yield b"half"
        raise httpx2.ReadError("cut")

    known = {"id": "e1", "stage": None, "done": 1, "total": 1, "note": "", "eta_s": None, "error": None}
    facts = {"name": "e", "scene": "s", "outcome": None, "text": None, "steps": [], "files": ["video.mp4"]}
    episode = Episode(**known, **facts, status="done")
    (tmp_path / "video.mp4").write_bytes(b"older")
    with talking_to(lambda _: httpx2.Response(200, content=half())) as osf, pytest.raises(ServiceError):
        osf.download(episode, "video.mp4", tmp_path)
    assert {path.name: path.read_bytes() for path in tmp_path.iterdir()} == {"video.mp4": b"older"}


def test_an_episode_is_followed_over_a_broken_network(table, osf):
    waiting = osf.episode({name: table.state.pose(name) for name in table.state.names})
    known = {**json.loads(next(waiting).model_dump_json()), "id": "e1"}
    osf.cancel(osf.episodes()[0])
    streams = []

    def answer(request):
        if not request.url.path.endswith("/events"):
            return httpx2.Response(200, json={**known, "status": "done" if len(streams) == 3 else "running"})
        streams.append(request)
        if len(streams) < 3:
            raise httpx2.ReadError("cut", request=request)
        return httpx2.Response(200, headers={"Content-Type": "text/event-stream"}, text="event: job\ndata: {}\n\n")

    with talking_to(answer) as far:
        assert [one.status for one in far.episode({})] == ["running", "done"]
    assert len(streams) == 3


@pytest.mark.slow
def test_an_observation_is_estimated(osf, library, tmp_path):
    folder = tmp_path / "seen"
    collect_observation(CollectObservation(folder, (BOTTLE,), size=64), library)
    with pytest.raises(InvalidInput):
        osf.estimate(observation=tmp_path)
    *before, last = osf.estimate(observation=folder)
    assert {one.status for one in before} <= {"queued", "running", "done"}
    assert last.status == "done"
    assert last.is_over
    assert last.estimated.state.names == (BOTTLE,)
    assert last.estimated.trusted


@pytest.mark.slow
def test_an_episode_from_photo_to_files(osf, table, tmp_path):
    poses = {name: table.state.pose(name) for name in table.state.names}
    *before, last = osf.episode(poses, **TINY)
    assert all(one.status in ("queued", "running", "done") for one in before)
    assert (last.status, last.outcome, last.scene) == ("done", "reached", table.id)
    assert max(last.steps[-1].to_goal_mm.values()) < 10
    assert last.id in [one.id for one in osf.episodes()]
    assert osf.latest(last.id) == last
    assert osf.frame(last, 0).shape[2] == 3
    report = osf.download(last, "report.json", tmp_path)
    assert json.loads(report.read_text())["steps"]
    with pytest.raises(ServiceError):
        osf.download(last, "none.json", tmp_path)
