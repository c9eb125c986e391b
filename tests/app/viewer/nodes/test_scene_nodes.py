import asyncio

import numpy as np
import pytest
import viser

from app.viewer.nodes.scene_nodes import light_toward
from osfcore.geometry.light import MIN_LIGHT_ELEVATION_DEG
from osfcore.geometry.poses import quaternion_multiply
from tests.app.conftest import until
from tests.app.viewer.conftest import BOTTLE, BOX, agrees


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


def test_the_lamp_can_be_hidden_or_named_and_still_follows(live, drawing, shown):
    until(lambda: agrees(drawing, shown))
    own = tuple(drawing._cube.color)
    drawing.show_lamp(is_on=False)
    assert not drawing._cube.visible
    assert not drawing._ray.visible
    assert not drawing._light_gizmo.visible
    _, lit = live.request("PATCH", f"/api/scenes/{shown['id']}", {"light": {"position": [0, -1, 1]}})
    until(lambda: agrees(drawing, lit))
    drawing.show_lamp(is_on=True, name="true light")
    assert drawing._cube.visible
    assert tuple(drawing._cube.color) != own
    assert drawing._lamp_name.text == "true light"
    np.testing.assert_allclose(drawing._lamp_name.position, lit["light"]["position"], atol=1e-5)
    drawing.show_lamp(is_on=True)
    assert tuple(drawing._cube.color) == own
    assert not drawing._lamp_name.visible


def test_the_lamp_is_as_usual_once_no_view_wants_it_otherwise(drawing):
    drawing.show_lamp(is_on=False, name="true light", by="one")
    drawing.show_lamp(is_on=True, by="two")
    assert not drawing._cube.visible
    drawing.show_lamp(is_on=True, name="true light", by="two")
    assert drawing._cube.visible
    assert drawing._lamp_name.text == "true light"
    drawing.show_lamp(is_on=True, by="two")
    drawing.show_lamp(is_on=True, by="one")
    assert drawing._cube.visible
    assert not drawing._lamp_name.visible
