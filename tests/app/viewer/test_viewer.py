import numpy as np
import pytest

from app.jobs.job import JobChanged, JobView
from app.viewer.nodes.room import VIEW_FROM
from app.viewer.private_server import PrivateViser
from tests.app.conftest import until
from tests.app.viewer.conftest import BOTTLE, BOX
from tests.app.viewer.test_episodes import found, job, sketch, stepped


def test_a_dropped_object_falls_and_one_in_another_goes_back(live, browser, shown):
    browser.drag(f"/handles/{BOX}", (0.0, 0.0, 0.4))

    def has_fallen():
        scene = live.request("GET", f"/api/scenes/{shown['id']}")[1]
        height = scene["objects"][0]["position"][2]
        moved = scene["revision"] > shown["revision"] + 1  # the jump, and the way down
        return scene if moved and height < 0.35 and browser.table_agrees(scene) else None

    fallen = until(has_fallen)
    browser.drag(f"/handles/{BOX}", fallen["objects"][1]["position"])
    until(lambda: browser.table_agrees(fallen))
    after = live.request("GET", f"/api/scenes/{shown['id']}")[1]
    for put_back, lying in zip(after["objects"], fallen["objects"], strict=True):
        assert put_back["position"] == pytest.approx(lying["position"], abs=1e-4)  # may still have been coming to rest
        assert put_back["quaternion"] == pytest.approx(lying["quaternion"], abs=1e-3)


def test_a_goal_is_composed_with_copies_of_its_own(live, browser, shown):
    until(lambda: all(browser.shows(f"/handles/{name}") for name in (BOX, BOTTLE)))
    live.request("POST", "/api/goals/draft", {"scene": None})
    until(lambda: browser.below("/goal/objects") == {BOX, BOTTLE})
    until(lambda: not any(browser.shows(f"/handles/{name}") for name in (BOX, BOTTLE)))
    copy = f"/goal/objects/{BOX}"
    at = np.array(browser.node(copy).position)
    aside = at + [0.03, 0, 0]
    browser.drag_body(f"{copy}/shape", at + [0, 0, 1], at, aside)
    until(lambda: np.allclose(browser.node(copy).position, aside, atol=2e-3))
    assert live.request("GET", f"/api/scenes/{shown['id']}")[1]["objects"] == shown["objects"]  # only the copy moves
    live.request("DELETE", "/api/goals/draft")
    until(lambda: browser.below("/goal/objects") == set())
    until(lambda: all(browser.shows(f"/handles/{name}") for name in (BOX, BOTTLE)))


def test_an_episode_on_the_table_is_drawn_in_place_of_an_estimate(live, browser, shown):
    hub = live.services.runner.hub
    mine = job(scene=shown["id"])
    for seen in (found(), sketch(), stepped()):
        hub.publish(JobView(mine, seen))
    until(lambda: browser.shows("/episode/plan/ways") and browser.shows("/episode/estimate/tracked/light"))
    assert browser.below("/estimate/guess") == set()
    hub.publish(JobChanged(1, job("done", scene=shown["id"])))
    live.request("POST", f"/api/scenes/{shown['id']}/reset")
    until(lambda: browser.node("/episode/estimate/tracked/light") is None)


def test_nobody_can_open_a_tunnel(live):
    server = live.services.viewer.server
    assert isinstance(server, PrivateViser)
    assert server.request_share_url() is None
    assert server.get_host() == "127.0.0.1"
    assert tuple(server.initial_camera.position) == VIEW_FROM
