import asyncio

import pytest
from fastapi import HTTPException
from fastapi.exceptions import RequestValidationError
from starlette.requests import ClientDisconnect, Request

from app.api.bodies import kind_of, parsed, whole_body
from app.api.schemas.goals import GoalIn


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
