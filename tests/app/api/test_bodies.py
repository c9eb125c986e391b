import asyncio
import contextlib
import gc
import os
import threading
from pathlib import Path

import pytest
from fastapi import FastAPI, HTTPException
from fastapi.exceptions import RequestValidationError
from starlette.requests import ClientDisconnect, Request
from starlette.testclient import TestClient

from app.api import problems
from app.api.bodies import OpenFile, kind_of, parsed, whole_body
from app.api.goals import GoalIn
from app.api.problems import NotFound
from app.services.service_settings import Settings
from osfcore.io.files import write_atomically
from tests.app.api.test_problems import is_problem


def request(chunks=(), headers=()):
    """A request whose body comes in pieces; the client leaves after the last one if that is None."""
    messages = [
        {"type": "http.disconnect"}
        if chunk is None
        else {"type": "http.request", "body": chunk, "more_body": number < len(chunks) - 1}
        for number, chunk in enumerate(chunks)
    ]

    async def receive():
        return messages.pop(0)

    return Request({"type": "http", "method": "POST", "headers": list(headers)}, receive), messages


@pytest.mark.parametrize(
    ("header", "kind"),
    [
        (b"image/png", "image/png"),
        (b"Application/JSON; charset=utf-8", "application/json"),
        (b" image/jpeg ;q=1", "image/jpeg"),
        (b";", ""),
        (None, ""),
    ],
)
def test_a_body_says_what_it_is(header, kind):
    assert kind_of(request(headers=[] if header is None else [(b"content-type", header)])[0]) == kind


@pytest.mark.parametrize("chunks", [[b""], [b"abc"], [b"a", b"", b"bc"]])
def test_a_body_is_put_together(chunks):
    assert asyncio.run(whole_body(request(chunks)[0], 3)) == b"".join(chunks)


def test_a_body_that_is_too_large_is_not_read_to_its_end():
    sent, messages = request([b"a" * 10] * 1000)
    with pytest.raises(HTTPException) as refusal:
        asyncio.run(whole_body(sent, 25))
    assert refusal.value.status_code == 413
    assert "25 bytes" in refusal.value.detail
    assert len(messages) == 997


def test_an_upload_that_breaks_off_is_told():
    with pytest.raises(ClientDisconnect):
        asyncio.run(whole_body(request([b"a", b"b", None])[0], 100))


def test_json_is_checked_as_everywhere_else():
    assert parsed(GoalIn, b'{"random": {"seed": 3}}').random.seed == 3
    for body, place in (
        (b'{"random": {"seed": -1}}', ("body", "random", "seed")),
        (b'{"random": {}, "extra": 1}', ("body", "extra")),
        (b"{}", ("body",)),
        (b"{", ("body",)),
        (b"", ("body",)),
        (b"\xff", ("body",)),
        (b'{"random": {}, "name": "\\ud800"}', ("body",)),
        (b"[" * 100_000, ("body",)),
    ):
        with pytest.raises(RequestValidationError) as refusal:
            parsed(GoalIn, body)
        assert refusal.value.errors()[0]["loc"][: len(place)] == place


@pytest.mark.parametrize("path", ["/api/scenes", "/api/goals", "/api/predictions", "/api/jobs", "/api/driver"])
@pytest.mark.parametrize("nested", [False, True])
def test_objects_with_very_many_members_are_refused_at_once(service, path, nested):
    members = {f"k{n}": n for n in range(3000)}
    answer = service.post(path, json={"light": members} if nested else members)
    assert answer.status_code == 422
    assert "3000 members" in answer.json()["detail"]


def test_of_many_mistakes_the_first_few_are_told(service):
    answer = service.post("/api/scenes", json={f"k{n}": n for n in range(90)})
    assert answer.status_code == 422
    assert len(answer.json()["errors"]) == 20
    assert "89" in answer.json()["detail"]


def test_a_long_list_of_mistakes_ends_with_the_first(service):
    answer = service.post("/api/predictions", json={"actions": [["x"] * 10] * 900})
    assert answer.status_code == 422
    assert len(answer.text) < 5000


GONE = "It has been removed."


@pytest.fixture
def path(tmp_path):
    path = tmp_path / "file"
    path.write_bytes(b"0123456789")
    return path


@pytest.fixture
def client(path):
    app = FastAPI()
    app.state.settings = Settings(data_dir=path.parent)
    problems.install(app)

    @app.get("/file")
    def file() -> OpenFile:
        return OpenFile(path, GONE, media_type="text/plain", headers={"X-Own": "1"}, filename="ä.txt")

    with TestClient(app, raise_server_exceptions=False) as client:
        yield client


def descriptors(path):
    """How many descriptors of a file are open, under this name or replaced, without those left to the collector."""
    gc.collect()
    targets = []
    for link in Path("/proc/self/fd").iterdir():
        with contextlib.suppress(OSError):  # closed meanwhile, by another thread
            targets.append(os.readlink(link))
    return sum(target.startswith(str(path)) for target in targets)


def version(number):
    """A text of its own length, of which each line tells the number."""
    return f"{number:09d}\n".encode() * (20_000 + 1000 * (number % 7))


def test_a_file_is_sent_with_its_facts(client):
    answer = client.get("/file")
    assert (answer.status_code, answer.content) == (200, b"0123456789")
    assert answer.headers["content-type"].startswith("text/plain")
    assert (answer.headers["content-length"], answer.headers["x-own"]) == ("10", "1")
    assert answer.headers["content-disposition"] == "attachment; filename*=utf-8''%C3%A4.txt"


def test_ranges_of_the_same_version_continue_a_download(client, path):
    first = client.get("/file", headers={"Range": "bytes=0-3"})
    assert (first.status_code, first.content, first.headers["content-range"]) == (206, b"0123", "bytes 0-3/10")
    rest = {"Range": "bytes=4-", "If-Range": first.headers["etag"]}
    assert client.get("/file", headers=rest).content == b"456789"
    assert b"89" in client.get("/file", headers={"Range": "bytes=0-1,8-9"}).content
    assert client.get("/file", headers={"Range": "bytes=99-"}).status_code == 416
    write_atomically(path, b"another version")
    again = client.get("/file", headers=rest)
    assert (again.status_code, again.content) == (200, b"another version")


def test_a_file_that_is_known_is_not_sent_again_until_it_changes(client, path):
    tag = client.get("/file").headers["etag"]
    for known in (tag, f"W/{tag}", f'"another", {tag}'):
        again = client.get("/file", headers={"If-None-Match": known})
        assert (again.status_code, again.content, again.headers["etag"]) == (304, b"", tag)
    write_atomically(path, b"another version")
    assert client.get("/file", headers={"If-None-Match": tag}).content == b"another version"
    assert descriptors(path) == 0


@pytest.mark.parametrize("change", [lambda path: path.unlink(), lambda path: (path.unlink(), path.mkdir())])
def test_a_file_that_is_gone_is_not_found(client, path, change):
    change(path)
    assert is_problem(client.get("/file"), 404)["detail"] == GONE


def test_what_was_opened_is_sent_though_it_is_replaced_or_deleted(path):
    for change in (lambda: write_atomically(path, b"new"), path.unlink):
        content = path.read_bytes()
        response = OpenFile(path, GONE, media_type="text/plain")
        change()
        assert asyncio.run(sent(response)) == content
    with pytest.raises(NotFound):
        OpenFile(path, GONE, media_type="text/plain")


async def sent(response):
    body = b""

    async def receive():
        await asyncio.sleep(60)

    async def send(message):
        nonlocal body
        body += message.get("body", b"")

    await response({"type": "http", "method": "GET", "headers": []}, receive, send)
    return body


@pytest.mark.slow
def test_downloads_are_whole_while_the_file_is_replaced_and_deleted(client, path):
    over = threading.Event()

    def disturb():
        number = 0
        while not over.is_set():
            number += 1
            write_atomically(path, version(number))
            if number % 5 == 0:
                path.unlink()

    path.write_bytes(version(0))
    thread = threading.Thread(target=disturb)
    thread.start()
    whole, others = [], []
    try:
        while len(whole) < 100 and len(others) < 10_000:  # how often it is there is a matter of chance
            ranged = {"Range": "bytes=0-"} if len(whole) % 3 == 0 else {}
            answer = client.get("/file", headers=ranged)
            (whole if answer.status_code in (200, 206) else others).append(answer)
    finally:
        over.set()
        thread.join()
    assert len(whole) == 100
    for answer in whole:
        assert answer.content == version(int(answer.content[:9]))
        assert int(answer.headers["content-length"]) == len(answer.content)
    assert all(is_problem(answer, 404)["detail"] == GONE for answer in others)
    assert descriptors(path) == 0


@pytest.mark.slow
@pytest.mark.parametrize("spec", ["2.3", "2.4"])
def test_a_file_is_closed_when_whoever_asked_has_gone(path, spec):
    path.write_bytes(version(1))

    async def leave():
        return {"type": "http.disconnect"}

    async def refuse(message):
        if message["type"] == "http.response.body":
            raise OSError("gone")

    scope = {"type": "http", "method": "GET", "headers": [], "asgi": {"spec_version": spec}}
    for _ in range(5):
        with contextlib.suppress(OSError):
            asyncio.run(OpenFile(path, GONE, media_type="text/plain")(scope, leave, refuse))
    assert descriptors(path) == 0
