"""Views of single pages, with browsers that speak viser's protocol through the relay."""

import contextlib
import gc
import threading
import time
import weakref
from types import SimpleNamespace

import msgspec
import numpy as np
import pytest
import viser
import zstandard
from websockets.sync.client import connect

from app.episodes.trajectory import ReplayClock, read_trajectory
from app.services.examples import Stories
from app.viewer.page_views import PageViews, Replay, Wish
from app.viewer.private_server import SECRET_HEADER
from osfcore.geometry.cameras import Camera
from tests.app.conftest import until
from tests.app.viewer.conftest import BOX, CAMERA

STORY = "first"


@pytest.fixture(scope="module")
def course():
    return read_trajectory(Stories().trajectory(STORY))


class Page:
    """A page whose view is open."""

    def __init__(self, server, address, headers=()):
        self._clients, before = server.get_clients, set(server.get_clients())
        self._socket = connect(
            address,
            subprotocols=[f"viser-v{viser.__version__}"],
            additional_headers=dict(headers),
            compression=None,
            max_size=None,
            proxy=None,
        )
        self._socket.send(msgspec.msgpack.encode(CAMERA))
        until(lambda: set(self._clients()) - before)
        (self._number,) = set(self._clients()) - before

    def __enter__(self):
        return self

    def __exit__(self, *_):
        self._socket.close()
        until(lambda: self._number not in self._clients())

    def send(self, frame):
        self._socket.send(frame)

    def look(self, eye, at):
        """Look from one place to another."""
        view = Camera.look_at("view", eye, at).T_world_camera
        seen = {"position": eye.tolist(), "look_at": at.tolist(), "wxyz": view.quaternion.tolist()}
        self.send(msgspec.msgpack.encode({**CAMERA, **seen}))

    def told_about(self, path):
        """Kinds of messages about a node that have come since this was asked for last."""
        kinds = set()
        with contextlib.suppress(TimeoutError):
            while True:
                frame = self._socket.recv(timeout=0.3)
                packed = frame[16 : 16 + int.from_bytes(frame[8:16], "little")]
                content = msgspec.msgpack.decode(zstandard.ZstdDecompressor().decompress(packed))
                kinds |= {message["type"] for message in content["messages"] if message.get("name") == path}
        return kinds

    @property
    def client(self):
        return self._clients()[self._number]

    @property
    def camera(self):
        return self.client.camera

    def own(self, path):
        """A node that this browser alone sees; None if there is none."""
        return self.client.scene.get_handle_by_name(path)

    def hides(self, path):
        node = self.own(path)
        return node is not None and not node.visible


def opened(live, name):
    """A page of a running service."""
    return Page(live.services.viewer.server, f"ws://127.0.0.1:{live.port}/viewer/{name}")


def ask(live, page, replay=None, **more):
    status, answer = live.request("PUT", f"/api/views/{page}", {"replay": replay, **more})
    assert status == 200, answer
    return answer["is_open"]


def test_a_page_sees_an_episode_in_place_of_the_live_table_and_other_pages_do_not(live, shown, course):
    with opened(live, "one") as one, opened(live, "two") as two:
        assert ask(live, "one", {"story": STORY, "at_s": 0.0})
        until(lambda: one.own(f"/replay/objects/{course.names[0]}"))
        assert one.hides("/objects")
        until(lambda: np.allclose(one.own("/lamp").position, course.states[0].light.position, atol=1e-5))
        assert not one.hides("/lamp")
        assert two.own("/replay") is two.own("/objects") is two.own("/lamp") is None
        ask(live, "one")
        until(lambda: one.own("/replay") is one.own("/objects") is one.own("/lamp") is None)


@pytest.mark.parametrize("step", [0, 3, -1])
def test_everything_is_where_it_was_after_a_step(live, course, step):
    at_s, action = ReplayClock(course).step_s[step], course.rounds[step].action
    with opened(live, "page") as page:
        ask(live, "page", {"story": STORY, "at_s": at_s})
        body = until(lambda: page.own(f"/replay/objects/{course.names[0]}"))
        until(lambda: np.allclose(body.position, course.states[action].poses.position[0], atol=1e-5))
        until(lambda: np.allclose(page.own("/replay/pusher").position, course.states[action].pusher, atol=1e-5))
        until(lambda: page.own(f"/replay/episode/goal/where/{course.names[0]}"))
        ask(live, "page")


def test_a_page_has_handles_only_if_it_wants_them(live, shown):
    with opened(live, "one") as one, opened(live, "two") as two:
        ask(live, "one")
        ask(live, "two", handles=True)
        until(lambda: one.hides("/handles") and two.own("/handles") is None)
        ask(live, "one", handles=True)
        until(lambda: one.own("/handles") is None)
        ask(live, "two", handles=True, shows="beliefs")
        until(lambda: two.hides("/handles") and two.hides("/objects") and two.hides("/light"))


def test_what_stands_in_the_middle_of_a_view_is_named(live, shown):
    at = np.array(shown["objects"][1]["position"])
    with opened(live, "page") as page:
        named = 200, {"name": shown["objects"][1]["name"]}

        def is_named():
            page.look(at + [0.0, -0.4, 0.4], at)  # again, should the service place the camera in between
            return live.request("GET", "/api/views/page/pointed?x=0.5&y=0.5") == named

        until(is_named)
    assert live.request("GET", "/api/views/nobody/pointed?x=0.5&y=0.5") == (200, {"name": None})


def test_it_plays_to_the_end_by_itself_faster_if_wanted(live, course):
    end_s = ReplayClock(course).length_s
    with opened(live, "page") as page:
        ask(live, "page", {"story": STORY, "at_s": end_s - 4.0, "plays": True, "speed": 16.0})
        pusher = until(lambda: page.own("/replay/pusher"))
        until(lambda: np.allclose(pusher.position, course.states[-1].pusher, atol=1e-5))
        ask(live, "page")


def test_a_replay_shows_beliefs_alone_and_goes_on_with_meshes(live, course):
    replay, name = {"story": STORY, "at_s": ReplayClock(course).step_s[0]}, f"/replay/objects/{course.names[0]}"
    with opened(live, "page") as page:
        ask(live, "page", replay)
        body = until(lambda: page.own(name))
        ask(live, "page", replay, shows="beliefs")
        until(lambda: page.hides("/replay/objects") and page.hides("/replay/shadows"))
        assert not page.hides("/replay/episode/estimate/tracked")
        ask(live, "page", {**replay, "at_s": ReplayClock(course).step_s[-1]}, shows="meshes")
        until(lambda: not page.hides("/replay/objects") and page.hides("/replay/episode/estimate/tracked"))
        assert page.own(name) is body  # the same node, which follows
        until(lambda: np.allclose(body.position, course.states[-1].poses.position[0], atol=1e-5))
        ask(live, "page")
        until(lambda: page.own("/objects") is None)


@pytest.mark.slow
def test_what_plays_goes_on_when_something_else_of_it_is_looked_at(live, course):
    end_s = ReplayClock(course).length_s
    replay = {"story": STORY, "at_s": end_s - 8.0, "plays": True, "speed": 4.0}
    with opened(live, "page") as page:
        ask(live, "page", replay)
        pusher = until(lambda: page.own("/replay/pusher"))
        deadline = time.monotonic() + 120.0
        while not np.allclose(pusher.position, course.states[-1].pusher, atol=1e-5):
            assert time.monotonic() < deadline  # begun anew each time it would never come to its end
            ask(live, "page", replay, shows="beliefs")
            ask(live, "page", replay)
            time.sleep(0.1)
        ask(live, "page")


def test_a_page_that_only_watches_moves_its_camera_and_nothing_else(live, browser, shown):
    driver, body = live.services.driver, until(lambda: browser.node(f"/objects/{BOX}"))
    turn = {"type": "TransformControlsUpdateMessage", "name": f"/handles/{BOX}", "wxyz": [1.0, 0, 0, 0], "owner": ""}
    lift = msgspec.msgpack.encode({**turn, "position": [0.0, 0.0, 0.7]})
    try:
        driver.arrive("drives")
        with opened(live, "watches") as page:
            page.send(lift)
            aside = msgspec.msgpack.encode(CAMERA | {"position": [2.0, 2.0, 2.0]})
            until(lambda: page.send(aside) or np.allclose(page.camera.position, 2.0))  # once the page has been framed
            assert body.position[2] < 0.5
            driver.take("watches")  # which puts back what the former driver held, a moment later
            until(lambda: page.send(lift) or np.isclose(body.position[2], 0.7))
    finally:
        driver.leave("drives")


@pytest.mark.parametrize("handles", [f"/handles/{BOX}", f"/goal/objects/{BOX}"])
def test_handles_that_a_watcher_moved_in_its_own_browser_go_back(live, shown, handles):
    end = msgspec.msgpack.encode({"type": "TransformControlsDragEndMessage", "name": handles, "owner": ""})
    driver, told = live.services.driver, set()
    live.request("POST", "/api/goals/draft", {"scene": None})
    until(lambda: live.services.viewer.server.scene.get_handle_by_name(handles))
    try:
        driver.arrive("drives")
        with opened(live, "watches") as page:
            until(lambda: "TransformControlsMessage" in page.told_about(handles))
            until(lambda: not page.told_about(handles))  # all that was there before has come
            page.send(end)
            until(
                lambda: told.update(page.told_about(handles)) or told >= {"SetPositionMessage", "SetOrientationMessage"}
            )
    finally:
        driver.leave("drives")
        live.request("DELETE", "/api/goals/draft")


def test_a_chosen_goal_is_golden_on_the_live_table_alone(live, shown):
    poses = [{"name": o["name"], "position": o["position"], "quaternion": o["quaternion"]} for o in shown["objects"]]
    poses[0]["position"][0] += 0.05
    status, goal = live.request("POST", "/api/goals", {"scene": shown["id"], "objects": poses, "name": "Aside"})
    assert status == 201, goal
    name = goal["objects"][0]["name"]
    with opened(live, "page") as page:
        ask(live, "page", goal=goal["id"])
        node = until(lambda: page.own(f"/chosen/{name}"))
        until(lambda: np.allclose(node.position, goal["objects"][0]["position"], atol=1e-6))
        ask(live, "page", {"story": STORY, "at_s": 0.0}, goal=goal["id"])
        until(lambda: page.own(f"/chosen/{name}") is None)
        ask(live, "page")
    assert live.request("PUT", "/api/views/page", {"goal": "no such goal"})[0] == 404


def test_the_camera_frames_another_table_a_replay_and_on_request_what_is_there(live, shown):
    with opened(live, "page") as page:
        until(lambda: not np.allclose(page.camera.position, CAMERA["position"]))  # framed as it opened
        first = np.array(page.camera.position)
        page.send(msgspec.msgpack.encode(CAMERA))
        until(lambda: np.allclose(page.camera.position, CAMERA["position"]))
        assert live.request("POST", "/api/views/page/camera")[0] == 204
        until(lambda: np.allclose(page.camera.position, first))
        ask(live, "page", {"story": STORY, "at_s": 0.0})
        until(lambda: not np.allclose(page.camera.position, first))
        ask(live, "page")
        until(lambda: np.allclose(page.camera.position, first))
        _, other = live.request("POST", "/api/scenes", {"seed": 9, "objects": ["009_gelatin_box"]})
        until(lambda: not np.allclose(page.camera.position, first))
        live.request("DELETE", f"/api/scenes/{other['id']}")
    assert live.request("POST", "/api/views/closed/camera")[0] == 204  # there is nothing to do


def test_what_was_asked_for_is_shown_once_the_view_opens_and_again_after_a_reload(live, course):
    assert not ask(live, "late", {"story": STORY, "at_s": 0.0})
    for _ in range(2):
        with opened(live, "late") as page:
            until(lambda page=page: page.own(f"/replay/objects/{course.names[0]}"))
    ask(live, "late")


class SlowLibrary:
    """A library whose meshes come when they are released."""

    def __init__(self, library):
        self._library, self.is_asked, self.release = library, threading.Event(), threading.Event()

    def viewer_glb(self, name):
        self.is_asked.set()
        self.release.wait(60)
        return self._library.viewer_glb(name)

    def __getattr__(self, name):
        return getattr(self._library, name)


def test_a_page_that_is_reloaded_while_a_replay_opens_shows_it_in_its_new_view(server, library, course):
    address, headers = f"ws://127.0.0.1:{server.get_port()}", {SECRET_HEADER: server.secret}
    slow = SlowLibrary(library)
    views = PageViews(slow, lambda _: "page", lambda: None, SimpleNamespace(is_warm=True), set)
    views.start(None)
    views.ask("page", Wish(Replay(Stories().trajectory(STORY))))  # paused: nothing but the reload draws it anew
    try:
        with Page(server, address, headers) as page, Page(server, address, headers) as again:
            views.add_client(page.client)
            assert slow.is_asked.wait(60)
            views.add_client(again.client)
            slow.release.set()
            until(lambda: again.own(f"/replay/objects/{course.names[0]}"))
            until(lambda: np.allclose(again.own("/lamp").position, course.states[0].light.position, atol=1e-5))
    finally:
        slow.release.set()
        views.close()


def test_what_a_browser_that_has_left_occupied_is_freed_without_waiting_for_python(live):
    gc.disable()  # which would free it some day, too
    try:
        with opened(live, "page") as page:
            left = weakref.ref(page.client)
        until(lambda: left() is None)
    finally:
        gc.enable()


def test_a_page_chooses_between_meshes_and_beliefs(live, shown):
    with opened(live, "page") as page:
        until(lambda: page.hides("/episode/estimate/tracked"))
        ask(live, "page", shows="beliefs")
        until(lambda: page.hides("/objects") and page.hides("/shadows"))
        assert page.own("/episode/estimate/tracked") is None
        ask(live, "page", shows="meshes")
        until(lambda: page.own("/objects") is None)


@pytest.mark.parametrize(
    ("replay", "status", "words"),
    [
        ({"at_s": 0.0}, 422, "an episode or a story"),
        ({"episode": "a", "story": "b"}, 422, "an episode or a story"),
        ({"story": "../presets"}, 404, "story"),
        ({"episode": "nobody"}, 404, "no such episode"),
        ({"story": STORY, "at_s": -1.0}, 422, "greater than or equal to 0"),
        ({"story": STORY, "speed": 0.0}, 422, "greater than or equal to 0.1"),
    ],
)
def test_what_cannot_be_shown_is_told(live, replay, status, words):
    answer = live.request("PUT", "/api/views/page", {"replay": replay})
    assert answer[0] == status
    assert words in str(answer[1])


def test_a_view_is_of_a_page_with_a_plain_name(live):
    assert live.request("PUT", "/api/views/a%20b", {"replay": None})[0] == 422
