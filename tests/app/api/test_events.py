import asyncio
import base64
import http.client
import io
import json
from collections.abc import AsyncIterator

import numpy as np
import pytest
from fastapi import FastAPI
from fastapi.sse import EventSourceResponse, ServerSentEvent
from PIL import Image

from app.api.events import DepartureMiddleware, Mailbox
from app.processes.messages.scene_messages import FramesTaken, SceneChanged
from app.services.driver import DriverChanged
from app.services.event_hub import CurrentScene, Notice
from app.services.goals import Draft, DraftChanged, GoalsChanged
from tests.app.api.test_jobs import TABLE
from tests.app.conftest import until
from tests.app.storage.test_database import record


class Stream:
    """A page's event stream."""

    def __init__(self, live, query="", last=None):
        self._connection = http.client.HTTPConnection("127.0.0.1", live.port, timeout=20)
        headers = {} if last is None else {"Last-Event-ID": str(last)}
        self._connection.request("GET", f"/api/events{query}", headers=headers)
        self.response = self._connection.getresponse()

    def __enter__(self):
        return self

    def __exit__(self, *_):
        self.response.close()
        self._connection.close()

    def next(self, *kinds):
        """The next event of one of these kinds: kind, number, data."""
        fields = {}
        while True:
            line = self.response.readline().decode().rstrip("\n")
            if line and not line.startswith(":"):
                key, _, value = line.partition(": ")
                fields[key] = value
            elif fields:
                if fields.get("event") in kinds:
                    return fields["event"], int(fields["id"]) if "id" in fields else None, json.loads(fields["data"])
                fields = {}


@pytest.fixture
def shown(live):
    _, scene = live.request("POST", "/api/scenes", {"seed": 1, "count": 1})
    yield scene
    live.request("DELETE", f"/api/scenes/{scene['id']}")


def test_the_current_scene_comes_first_and_with_each_change(live, shown):
    with Stream(live) as stream:
        assert stream.response.getheader("content-type").startswith("text/event-stream")
        assert stream.next("scene")[2] == shown
        live.request("POST", f"/api/scenes/{shown['id']}/actions", {"actions": [[0.1, 0, 0]]})
        assert stream.next("scene")[2]["revision"] > shown["revision"]


def test_jobs_are_told_with_numbers_and_replayed(live):
    with Stream(live) as stream:
        stream.next("scene")
        _, job = live.request("POST", "/api/jobs", TABLE)
        told = []
        while not told or told[-1][2]["state"] != "done":
            told.append(stream.next("job"))
    numbers = [number for _, number, _ in told]
    assert numbers == sorted(set(numbers))
    assert {data["id"] for _, _, data in told} == {job["id"]}
    with Stream(live, last=numbers[0]) as again:
        replayed = [again.next("job") for _ in told[1:]]
    assert [data["state"] for _, _, data in replayed] == [data["state"] for _, _, data in told[1:]]
    assert [number for _, number, _ in replayed] == numbers[1:]


def test_pages_are_told_what_was_removed_for_good_also_when_they_come_back(live):
    with Stream(live) as stream:
        stream.next("scene")
        _, job = live.request("POST", "/api/jobs", TABLE)
        state = before = None
        while state != "done":
            _, before, told = stream.next("job")
            state = told["state"]
        live.request("DELETE", f"/api/jobs/{job['id']}?forget=true")
        kind, number, data = stream.next("forgotten")
        assert (kind, data) == ("forgotten", {"job": job["id"]})
    with Stream(live, last=before) as again:
        assert again.next("job", "forgotten") == ("forgotten", number, {"job": job["id"]})


@pytest.mark.parametrize("last", ["", "x", "-1", "9" * 40, "\u00b2"])
def test_nonsense_as_last_number_is_no_matter(live, last):
    with Stream(live, last=last.encode("latin-1").decode("latin-1")) as stream:
        assert stream.response.status == 200
        stream.next("scene")


def test_live_images_come_only_where_asked_for(live, shown, monkeypatch):
    runner, changes = live.services.runner, []
    watch_frames = runner.scenes.watch_frames
    monkeypatch.setattr(runner.scenes, "watch_frames", lambda change: (changes.append(change), watch_frames(change)))
    with Stream(live, "?frames=1") as stream:
        _, _, frame = stream.next("frame")
        assert frame["scene"] == shown["id"]
        assert set(frame["cameras"]) == {"0", "1", "2", "3"}
        data = base64.b64decode(frame["cameras"]["0"].removeprefix("data:image/jpeg;base64,"))
        assert Image.open(io.BytesIO(data)).size == (128, 128)
        live.request("PATCH", f"/api/scenes/{shown['id']}", {"light": {"position": [0, 0, 1]}})
        while frame["revision"] <= shown["revision"]:
            frame = stream.next("frame")[2]
    until(lambda: changes == [1, -1])


def test_streams_that_left_are_forgotten(live):
    before = live.services.runner.hub.subscribers
    for _ in range(20):
        with Stream(live) as stream:
            stream.next("scene")
    until(lambda: live.services.runner.hub.subscribers == before)


def test_notices_reach_the_page(live):
    with Stream(live) as stream:
        stream.next("scene")
        live.services.runner.hub.publish(Notice("warning", "Mind the\nstep."))
        assert stream.next("notice")[2] == {"level": "warning", "text": "Mind the\nstep."}


def test_a_push_is_told_to_every_page_and_to_those_that_come_later(live, shown):
    with Stream(live) as stream:
        live.request("PUT", "/api/push", {})
        told = stream.next("push")[2]
        assert (told["scene"], told["revision"]) == (shown["id"], shown["revision"])
        with Stream(live) as later:
            assert later.next("push")[2]["actions"] == told["actions"]
        live.request("DELETE", "/api/push")
        while told is not None:
            told = stream.next("push")[2]


def test_a_draft_is_told_to_every_page_and_to_those_that_come_later(live, shown):
    (thing,) = shown["objects"]
    with Stream(live) as stream:
        stream.next("scene")
        begun = live.request("POST", "/api/goals/draft", {})[1]
        assert stream.next("draft")[2] == begun
        aside = {"name": thing["name"], "position": [0.1, 0.1, 0.2], "quaternion": thing["quaternion"]}
        moved = live.request("PATCH", "/api/goals/draft", {"objects": [aside]})[1]
        assert stream.next("draft")[2] == moved
        with Stream(live) as later:
            assert later.next("draft")[2] == moved
        live.request("DELETE", "/api/goals/draft")
        assert stream.next("draft")[2] is None
    with Stream(live) as later:
        live.services.runner.hub.publish(Notice("info", "Hello."))
        assert later.next("draft", "notice")[0] == "notice"


def test_pages_are_told_that_the_list_of_goals_has_changed(live, shown):
    with Stream(live) as stream:
        stream.next("scene")
        goal = live.request("POST", "/api/goals", {"random": {"seed": 1}})[1]
        assert stream.next("goals") == ("goals", None, None)
        live.request("DELETE", f"/api/goals/{goal['id']}")
        assert stream.next("goals") == ("goals", None, None)


def test_pages_that_say_who_they_are_are_told_who_drives(live):
    with Stream(live, "?visitor=first") as first:
        assert first.next("driver")[2] == {"driver": "first", "visitors": 1}
        live.request("POST", "/api/driver", {"visitor": "other"})
        assert first.next("driver")[2]["driver"] == "other"
    until(lambda: live.services.driver.now().visitors == 0)


def test_a_mailbox_keeps_only_the_latest_draft_but_every_letter_about_goals_and_drivers():
    async def fill():
        mailbox = Mailbox(None)
        drafts = [DraftChanged(Draft("s", (), revision=number)) for number in (1, 2)]
        for event in (drafts[0], GoalsChanged(), DriverChanged("a", 1), drafts[1], DriverChanged("b", 2)):
            mailbox.put(event)
        await asyncio.sleep(0)
        assert mailbox.draft is drafts[1]
        assert list(mailbox.letters) == [GoalsChanged(), DriverChanged("a", 1), DriverChanged("b", 2)]
        assert mailbox.arrived.is_set()

    asyncio.run(fill())


def test_a_mailbox_keeps_only_the_latest_scene_and_images():
    async def fill():
        mailbox = Mailbox("a")
        mailbox.is_scene_new = False
        nothing = np.zeros((0, 1, 1, 3), np.uint8)
        for event in (SceneChanged(record("b")), FramesTaken("b", 1, (), nothing, ())):
            mailbox.put(event)
        await asyncio.sleep(0)
        assert (mailbox.is_scene_new, mailbox.frames) == (False, None)
        for revision in (1, 2):
            mailbox.put(SceneChanged(record("a")))
            mailbox.put(FramesTaken("a", revision, (), nothing, ()))
        await asyncio.sleep(0)
        assert mailbox.is_scene_new
        assert mailbox.frames is not None
        assert mailbox.frames.revision == 2
        mailbox.put(CurrentScene(record("b")))
        await asyncio.sleep(0)
        assert (mailbox.is_scene_new, mailbox.frames) == (True, None)

    asyncio.run(fill())


def test_a_client_that_leaves_a_stream_is_no_error():
    """It leaves while it does not read, so that the stream has more to say than it may."""

    async def leave():
        is_full, never = asyncio.Event(), asyncio.Event()
        requests = [{"type": "http.request", "body": b"", "more_body": False}]

        async def receive():
            if requests:
                return requests.pop()
            await is_full.wait()
            for _ in range(50):  # the stream gets as far as it can
                await asyncio.sleep(0)
            return {"type": "http.disconnect"}

        async def send(message):
            if message["type"] == "http.response.body":
                is_full.set()
                await never.wait()

        app = FastAPI()

        @app.get("/events", response_class=EventSourceResponse)
        async def stream() -> AsyncIterator[ServerSentEvent]:
            for number in range(100):
                yield ServerSentEvent(data=number)

        asgi = {"version": "3.0", "spec_version": "2.3"}
        scope = {"type": "http", "asgi": asgi, "method": "GET", "path": "/events", "query_string": b"", "headers": []}
        await DepartureMiddleware(app)(scope, receive, send)

    asyncio.run(leave())
