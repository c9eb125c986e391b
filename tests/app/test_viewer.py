import asyncio

import numpy as np
import pytest
import viser

from app.viewer import VIEW_FROM, LoopbackViser, light_toward
from osfcore.poses import Pose, quaternion_multiply
from osfcore.scene import MIN_LIGHT_ELEVATION_DEG, PUSHER_HEIGHT_M
from tests.app.conftest import until

BOX, BOTTLE = "003_cracker_box", "006_mustard_bottle"


@pytest.fixture
def drawing(live):
    return live.services.viewer._drawing


@pytest.fixture
def shown(live, drawing):
    _, scene = live.request("POST", "/api/scenes", {"seed": 1, "objects": [BOX, BOTTLE]})
    until(lambda: set(drawing._bodies) == {BOX, BOTTLE})
    yield scene
    live.request("DELETE", f"/api/scenes/{scene['id']}")


def agrees(drawing, scene):
    """Whether what is drawn is where the scene says."""
    bodies = drawing._bodies
    told = {o["name"]: o for o in scene["objects"]}
    return (
        set(told) == set(bodies)
        and all(np.allclose(bodies[n].position, o["position"], atol=1e-5) for n, o in told.items())
        and all(np.allclose(bodies[n].wxyz, o["quaternion"], atol=1e-5) for n, o in told.items())
        and np.allclose(drawing._pusher.position, scene["pusher"]["position"], atol=1e-5)
        and np.allclose(drawing._cube.position, scene["light"]["position"], atol=1e-5)
        and np.allclose(drawing._lamp.position, scene["light"]["position"], atol=1e-5)
    )


def test_what_is_drawn_is_where_the_scene_says(live, drawing, shown):
    until(lambda: agrees(drawing, shown))
    _, pushed = live.request("POST", f"/api/scenes/{shown['id']}/actions", {"actions": [[0.2, 0.1, 0]] * 3})
    until(lambda: agrees(drawing, pushed))
    _, lit = live.request("PATCH", f"/api/scenes/{shown['id']}", {"light": {"position": [0, -1, 1]}})
    until(lambda: agrees(drawing, lit))
    _, back = live.request("POST", f"/api/scenes/{shown['id']}/reset")
    until(lambda: agrees(drawing, back))


def test_meshes_are_sent_once(live, drawing, shown):
    before = dict(drawing._bodies)
    _, other = live.request("POST", "/api/scenes", {"seed": 2, "objects": [BOX, "009_gelatin_box"]})
    until(lambda: agrees(drawing, other))
    assert drawing._bodies[BOX] is before[BOX]
    assert before[BOTTLE]._impl.removed
    live.request("DELETE", f"/api/scenes/{other['id']}")


def test_an_empty_table_shows_no_pusher(live, drawing, shown):
    while (current := live.request("GET", "/api/scenes")[1]["current"]) is not None:
        live.request("DELETE", f"/api/scenes/{current}")
    until(lambda: not drawing._pusher.visible)
    assert drawing._bodies == {}


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


@pytest.mark.parametrize("position", [[0.3, 0.4, 5.0], [1, 0, -3], [0, 2, 0], [1e-3, 0, 0]])
def test_a_dragged_light_stays_on_the_hemisphere(position):
    light = light_toward(np.array(position))
    assert np.linalg.norm(light.position) == pytest.approx(1)
    assert light.position[2] >= np.sin(np.deg2rad(MIN_LIGHT_ELEVATION_DEG)) - 1e-9
    direction = np.array(position[:2]) / np.linalg.norm(position[:2])
    assert np.allclose(light.position[:2] / np.linalg.norm(light.position[:2]), direction)


@pytest.mark.parametrize("position", [[0, 0, 0], [np.nan, 0, 1], [np.inf, 0, 1]])
def test_no_light_comes_from_nowhere(position):
    assert light_toward(np.array(position)) is None


def drag(gizmo, phase, position, quaternion):
    """As a browser reports it."""
    gizmo.position, gizmo.wxyz = np.array(position), np.array(quaternion)
    (callback,) = gizmo._impl_aux.update_cb
    asyncio.run(callback(viser.TransformControlsEvent(client=None, client_id=None, target=gizmo, phase=phase)))


def test_dragged_objects_turn_about_the_axes_of_the_table(live, drawing, shown):
    until(lambda: agrees(drawing, shown))
    gizmo, body = drawing._gizmos[BOX], drawing._bodies[BOX]
    lying = np.array(body.wxyz)
    quarter = np.array([0.5**0.5, 0, 0, 0.5**0.5])
    drag(gizmo, "start", body.position, [1, 0, 0, 0])
    drag(gizmo, "update", [0, 0, 0.5], quarter)
    assert np.allclose(body.position, [0, 0, 0.5])
    assert np.allclose(body.wxyz, quaternion_multiply(quarter, lying))
    live.request("POST", f"/api/scenes/{shown['id']}/actions", {"actions": [[0, 0, 0]]})
    assert np.allclose(body.position, [0, 0, 0.5])  # the hand has it, not the scene
    drag(gizmo, "end", [0, 0, 0.5], quarter)
    until(lambda: body.position[2] < 0.3)
    until(lambda: np.allclose(gizmo.wxyz, [1, 0, 0, 0]) and np.allclose(gizmo.position, body.position))


def test_a_dragged_light_lights_the_scene_when_let_go(live, drawing, shown):
    until(lambda: agrees(drawing, shown))
    for phase in ("start", "update", "end"):
        drag(drawing._light_gizmo, phase, [0, 3, 4], [1, 0, 0, 0])
    assert np.allclose(drawing._lamp.position, [0, 0.6, 0.8])
    light = until(
        lambda: np.allclose(live.request("GET", f"/api/scenes/{shown['id']}")[1]["light"]["position"], [0, 0.6, 0.8])
    )
    assert light
