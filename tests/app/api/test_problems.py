import importlib
import pkgutil

import pytest

import app
import osfcore
from app.api.problems import STATUSES, NotFound, problem, status_of
from app.jobs.registry import QueueFull
from app.processes.client import ProcessHangs, ProcessUnavailable
from app.processes.server import InternalError, OutOfMemory
from app.storage.uploads import UploadNotStored, UploadRefused
from osfcore.errors import InvalidInput, MissingAssets, NotThere, OsfError, OverlappingObjects, WorkerDied

# What no request meets
OF_PROGRAMS = {"CannotListen", "DataDirectoryInUse", "LittleMemory", "NoEpisode", "NothingPushed", "ServiceError"}


def kinds_of(base):
    for kind in base.__subclasses__():
        yield kind
        yield from kinds_of(kind)


@pytest.mark.parametrize(
    ("error", "status"),
    [
        (OsfError("It cannot be."), 422),
        (InvalidInput("x", 1, "2"), 422),
        (NotThere("scene"), 422),
        (OverlappingObjects("a", "b", 0.01), 422),
        (MissingAssets(["025_mug"]), 409),
        (InternalError("simulation", ValueError()), 500),
        (ProcessUnavailable("simulation", "died"), 503),
        (ProcessHangs("simulation", 9.0), 503),
        (OutOfMemory("simulation"), 503),
        (WorkerDied("planner"), 503),
        (UploadRefused("it is no zip"), 422),
        (UploadNotStored("it is full"), 507),
        (QueueFull(20), 429),
        (NotFound("no"), 404),
    ],
    ids=lambda value: type(value).__name__,
)
def test_errors_have_the_status_that_says_the_same(error, status):
    assert status_of(error) == status


def test_every_error_of_the_program_has_its_status_on_purpose():
    for package in (app, osfcore):
        for info in pkgutil.walk_packages(package.__path__, package.__name__ + "."):
            if not info.name.endswith("__main__"):
                importlib.import_module(info.name)
    ours = [kind for kind in kinds_of(OsfError) if kind.__module__.startswith(("app.", "osfcore."))]
    assert {kind.__name__ for kind in ours if STATUSES.keys().isdisjoint(kind.__mro__)} == OF_PROGRAMS


def test_an_error_without_a_status_is_a_defect():
    assert status_of(type("Unheard", (OsfError,), {})("It cannot be.")) == 500


def test_text_that_is_not_unicode_goes_out_anyway():
    assert b'"detail":"a ? b"' in problem(422, "a \ud800 b").body


def is_problem(answer, status):
    assert answer.status_code == status
    assert answer.headers["content-type"] == "application/problem+json"
    body = answer.json()
    assert body["status"] == status
    assert body["detail"]
    assert "Traceback" not in answer.text
    return body


def test_nothing_there_and_wrong_methods_are_problems(service):
    assert "/api/nowhere" in is_problem(service.get("/api/nowhere"), 404)["detail"]
    assert "GET" in service.put("/api/health").headers["allow"]
    is_problem(service.put("/api/health"), 405)


def test_large_bodies_are_problems(service):
    is_problem(service.post("/api/scenes", content=b" " * (8 << 20), headers={"content-type": "application/json"}), 413)


@pytest.mark.parametrize(
    "body",
    [
        '{"light": {"position": [NaN, 0, 1]}}',
        '{"light": {"position": [Infinity, 0, 1]}}',
        '{"light": {"position": [1e999, 0, 1]}}',
        '{"seed": NaN}',
        '{"count": 1e400}',
        '{"seed": ' + "9" * 5000 + "}",
        '{"objects": ["\\ud800"]}',
        '{"\\ud800": 1}',
        "[" * 100_000,
        "{",
        '"\x00"',
    ],
    ids=lambda body: body[:24],
)
def test_hostile_json_is_never_a_defect(service, body):
    answer = service.post("/api/scenes", content=body.encode(), headers={"content-type": "application/json"})
    is_problem(answer, answer.status_code)
    assert answer.status_code in (400, 422)


@pytest.mark.parametrize(
    ("body", "words"),
    [
        ({"count": "three"}, "whole number"),
        ({"count": 99}, "99"),
        ({"seed": 1.5}, "whole number"),
        ({"poses": [{"name": "x", "quaternion": [1, 0, 0, 0]}]}, "missing"),
        ({"sed": 1}, "Sed is not known here."),
    ],
)
def test_what_is_wrong_with_a_request_is_a_sentence_of_no_terms(service, body, words):
    detail = is_problem(service.post("/api/scenes", json=body), 422)["detail"]
    assert words in detail
    assert not {"#", "/", "_"} & set(detail)
    assert detail[0].isupper()
    assert detail.endswith(".")


@pytest.mark.parametrize("noun", ["scenes", "jobs", "episodes", "estimates", "goals", "photos", "fields/sets"])
def test_what_is_not_there_is_told_without_its_identifier(service, noun):
    detail = is_problem(service.get(f"/api/{noun}/3f2a9c01beef"), 404)["detail"]
    assert "3f2a9c01beef" not in detail
    assert detail.startswith("There is no such ")


def test_pointers_name_what_is_wrong(service):
    body = {"count": 99, "poses": [{"name": "x", "position": [0, 0], "quaternion": [1, 0, 0, 0]}]}
    errors = is_problem(service.post("/api/scenes", json=body), 422)["errors"]
    assert [error["pointer"] for error in errors] == ["#/count", "#/poses/0/position"]
    job = {"kind": "collect_table", "params": {"seed": -1}}
    errors = is_problem(service.post("/api/jobs", json=job), 422)["errors"]
    assert [error["pointer"] for error in errors] == ["#/params/seed"]
    wrong = is_problem(service.get("/api/scenes/x/images/0.png?size=7"), 422)["errors"]
    assert wrong[0]["parameter"] == "size"


@pytest.mark.parametrize(
    ("path", "body"),
    [
        ("scenes", {"objects": ["025_mug"]}),
        ("jobs", {"kind": "collect_object", "params": {"name": "025_mug"}}),
        ("jobs", {"kind": "train_field", "params": {"name": "a", "source": {"mesh": "025_mug"}}}),
    ],
)
def test_an_object_that_was_not_fetched_is_a_conflict_in_words(service, path, body):
    before = service.get(f"/api/{path}").json()
    assert "osf assets fetch" in is_problem(service.post(f"/api/{path}", json=body), 409)["detail"]
    assert service.get(f"/api/{path}").json() == before
