from dataclasses import replace

import numpy as np
import pytest

from app.viewer.nodes.light_marker import AT
from app.viewer.nodes.scene_nodes import SceneNodes, light_toward
from osfcore.geometry.light import MIN_LIGHT_ELEVATION_DEG, Light
from osfcore.geometry.poses import quaternion_multiply
from tests.app.conftest import until
from tests.app.storage.test_database import record
from tests.app.viewer.conftest import BOTTLE, BOX


def test_what_is_drawn_is_where_the_scene_says(live, browser, shown):
    until(lambda: browser.table_agrees(shown))
    _, pushed = live.request("POST", f"/api/scenes/{shown['id']}/actions", {"actions": [[0.2, 0.1, 0]] * 3})
    until(lambda: browser.table_agrees(pushed))
    _, lit = live.request("PATCH", f"/api/scenes/{shown['id']}", {"light": {"position": [0, -1, 1]}})
    until(lambda: browser.table_agrees(lit))
    _, back = live.request("POST", f"/api/scenes/{shown['id']}/reset")
    until(lambda: browser.table_agrees(back))


def test_meshes_are_sent_once(live, browser, shown):
    before = browser.node(f"/objects/{BOX}")
    _, other = live.request("POST", "/api/scenes", {"seed": 2, "objects": [BOX, "009_gelatin_box"]})
    until(lambda: browser.table_agrees(other))
    assert browser.node(f"/objects/{BOX}") is before
    assert browser.node(f"/objects/{BOTTLE}") is None
    live.request("DELETE", f"/api/scenes/{other['id']}")


def test_an_empty_table_shows_no_pusher(live, browser, shown):
    while (current := live.request("GET", "/api/scenes")[1]["current"]) is not None:
        live.request("DELETE", f"/api/scenes/{current}")
    until(lambda: not browser.shows("/pusher") and browser.below("/objects") == set())


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


def test_dragged_objects_turn_about_the_axes_of_the_table(live, browser, shown):
    until(lambda: browser.table_agrees(shown))
    handles = f"/handles/{BOX}"
    gizmo, body = browser.node(handles), browser.node(f"/objects/{BOX}")
    lying = np.array(body.wxyz)
    quarter = np.array([0.5**0.5, 0, 0, 0.5**0.5])
    browser.drag(handles, body.position, [1, 0, 0, 0], "start")
    browser.drag(handles, [0, 0, 0.5], quarter, "update")
    assert np.allclose(body.position, [0, 0, 0.5])
    assert np.allclose(body.wxyz, quaternion_multiply(quarter, lying))
    live.request("POST", f"/api/scenes/{shown['id']}/actions", {"actions": [[0, 0, 0]]})
    assert np.allclose(body.position, [0, 0, 0.5])  # the hand has it, not the scene
    browser.drag(handles, [0, 0, 0.5], quarter, "end")
    until(lambda: body.position[2] < 0.3)
    until(lambda: np.allclose(gizmo.wxyz, [1, 0, 0, 0]) and np.allclose(gizmo.position, body.position))


def test_a_dragged_light_lights_the_scene_when_let_go(live, browser, shown):
    until(lambda: browser.table_agrees(shown))
    browser.drag("/light_handle", [0, 3, 4])
    assert np.allclose(browser.node("/lamp").position, [0, 0.6, 0.8])
    light = until(
        lambda: np.allclose(live.request("GET", f"/api/scenes/{shown['id']}")[1]["light"]["position"], [0, 0.6, 0.8])
    )
    assert light


@pytest.fixture
def table(server, library):
    return SceneNodes(server, library, lambda *_: None, lambda *_: None)


def test_the_lamp_can_be_hidden_or_named_and_still_follows(table, driver):
    table.show(record())
    own = tuple(driver.node("/light").colors)
    table.show_lamp(is_on=False)
    assert not any(driver.shows(path) for path in ("/light", "/light_ray", "/light_handle"))
    light = Light(np.array([0.0, -0.6, 0.8]))
    table.place(replace(record().state, light=light))
    np.testing.assert_allclose(driver.node("/light").position, AT * light.position, atol=1e-12)
    table.show_lamp(is_on=True, name="true light")
    assert driver.shows("/light")
    assert driver.shows("/light_ray")
    assert tuple(driver.node("/light").colors) != own
    assert driver.node("/light_name").text == "true light"
    np.testing.assert_allclose(driver.node("/light_name").position, AT * light.position, atol=1e-12)
    table.show_lamp(is_on=True)
    assert tuple(driver.node("/light").colors) == own
    assert not driver.shows("/light_name")


def test_the_lamp_is_as_usual_once_no_view_wants_it_otherwise(table, driver):
    table.show_lamp(is_on=False, name="true light", by="one")
    table.show_lamp(is_on=True, by="two")
    assert not driver.shows("/light")
    table.show_lamp(is_on=True, name="true light", by="two")
    assert driver.shows("/light")
    assert driver.node("/light_name").text == "true light"
    table.show_lamp(is_on=True, by="two")
    table.show_lamp(is_on=True, by="one")
    assert driver.shows("/light")
    assert not driver.shows("/light_name")
