import numpy as np
import pytest

from app.jobs.job import JobChanged, JobSeen
from app.viewer.nodes.scene_nodes import VIEW_FROM
from app.viewer.viewer import LoopbackViser
from osfcore.geometry.poses import Pose
from osfcore.geometry.workspace import PUSHER_HEIGHT_M
from tests.app.conftest import until
from tests.app.viewer.conftest import BOTTLE, BOX, agrees
from tests.app.viewer.panels.test_episode_panel import found, job, sketch, stepped


def test_a_dropped_object_falls_and_one_in_another_goes_back(live, drawing, shown):
    viewer = live.services.viewer
    up = Pose(np.array([0.0, 0.0, 0.4]), np.array([1.0, 0, 0, 0]))
    viewer._move_object(BOX, up, None)

    def has_fallen():
        scene = live.request("GET", f"/api/scenes/{shown['id']}")[1]
        height = scene["objects"][0]["position"][2]
        moved = scene["revision"] > shown["revision"] + 1  # the jump, and the way down
        return scene if moved and height < 0.35 and agrees(drawing, scene) else None

    fallen = until(has_fallen)
    bottle = fallen["objects"][1]
    into = Pose(np.array(bottle["position"]), np.array(bottle["quaternion"]))
    drawing._follow(BOX, into)  # as the hand had moved it
    viewer._move_object(BOX, into, None)
    until(lambda: agrees(drawing, fallen))
    assert live.request("GET", f"/api/scenes/{shown['id']}")[1]["objects"] == fallen["objects"]


def test_handles_show_only_when_wanted(live, drawing, shown):
    viewer = live.services.viewer
    assert not any(gizmo.visible for gizmo in drawing._gizmos.values())
    viewer._wants_gizmos.value = True
    until(lambda: all(gizmo.visible for gizmo in drawing._gizmos.values()))
    viewer._wants_gizmos.value = False
    until(lambda: not any(gizmo.visible for gizmo in drawing._gizmos.values()))


def test_a_goal_is_composed_with_handles_of_its_own(live, drawing, shown):
    viewer = live.services.viewer
    view = viewer._goal_view
    viewer._wants_gizmos.value = True
    until(lambda: all(gizmo.visible for gizmo in drawing._gizmos.values()))
    live.request("POST", "/api/goals/draft", {"scene": None})
    until(lambda: set(view._copies) == {BOX, BOTTLE})
    until(lambda: not any(gizmo.visible for gizmo in drawing._gizmos.values()))
    until(lambda: view._image.visible)
    before = np.array(view._copies[BOX]._gizmo.position)
    aside = Pose(before + [0.03, 0, 0], dict(view._draft.poses)[BOX].quaternion)
    view._let_go(view._copies[BOX], 0, aside, None)
    until(lambda: np.allclose(view._copies[BOX]._gizmo.position, aside.position, atol=2e-3))
    assert live.request("GET", f"/api/scenes/{shown['id']}")[1]["objects"] == shown["objects"]  # only the copy moves
    live.request("DELETE", "/api/goals/draft")
    until(lambda: view._copies == {})
    until(lambda: all(gizmo.visible for gizmo in drawing._gizmos.values()))
    viewer._wants_gizmos.value = False


def test_an_episode_on_the_table_is_drawn_in_place_of_an_estimate(live, drawing, shown):
    viewer, hub = live.services.viewer, live.services.runner.hub
    mine = job(scene=shown["id"])
    for seen in (found(), sketch(), stepped()):
        hub.publish(JobSeen(mine, seen))
    shows = viewer._episode_view._drawing
    until(lambda: shows._ways.visible and shows.shows_light)
    until(lambda: not drawing._cube.visible)
    assert viewer._estimate_view._job is None
    viewer._estimate_view.visited()  # another view that draws guesses has its say, and nothing against it
    until(lambda: viewer._estimate_view._thread.is_idle)
    assert not drawing._cube.visible
    hub.publish(JobChanged(1, job("done", scene=shown["id"])))
    live.request("POST", f"/api/scenes/{shown['id']}/reset")
    until(lambda: drawing._cube.visible)


def test_pushes_from_the_panel_move_the_pusher(live, drawing, shown):
    viewer = live.services.viewer
    viewer._push("+x", None)
    viewer._push("sideways", None)
    after = live.request("GET", f"/api/scenes/{shown['id']}")[1]
    assert after["time_s"] == pytest.approx(0.4)
    assert after["pusher"]["position"][0] > shown["pusher"]["position"][0]
    assert after["pusher"]["position"][2] > PUSHER_HEIGHT_M / 2


def test_nobody_can_open_a_tunnel(live):
    server = live.services.viewer.server
    assert isinstance(server, LoopbackViser)
    assert server.request_share_url() is None
    assert server.get_host() == "127.0.0.1"
    assert tuple(server.initial_camera.position) == VIEW_FROM
