"""The table in the 3D view: what is drawn where, what hands move, its light and shadows."""

from dataclasses import replace

import numpy as np
import pytest
from hypothesis import assume, example, given
from hypothesis import strategies as st

from app.viewer.nodes.room import AT, CHARACTER, LINE, VIEW_AT, VIEW_FOV_RAD, VIEW_FROM, framing, separated
from app.viewer.nodes.scene_nodes import (
    LAMP_NAME,
    PUSHER_NAME,
    SceneNodes,
    clipped,
    dome_point,
    level_point,
    light_toward,
    pointed_at,
    shadow_colour,
    shadow_mesh,
)
from osfcore.errors import OsfError
from osfcore.geometry.cameras import Camera
from osfcore.geometry.light import AMBIENT, MIN_LIGHT_ELEVATION_DEG, Light
from osfcore.geometry.poses import Pose, quaternion_multiply
from osfcore.geometry.states import SceneState
from osfcore.geometry.workspace import TABLE_SIDE_M
from osfcore.world.imaging import TABLE_ALBEDO
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


BALL, ABOVE = "/light/ball", np.array([0.0, 0.0, 2.0])


def test_a_dragged_light_lights_the_scene_when_let_go(live, browser, shown):
    until(lambda: browser.table_agrees(shown))
    before, after = AT * np.array(shown["light"]["position"]), AT * np.array([0, 0.6, 0.8])
    browser.drag_body(BALL, ABOVE, before, after, "start", "update")
    assert np.allclose(browser.node("/lamp").position, [0, 0.6, 0.8])
    browser.drag_body(BALL, ABOVE, before, after, "end")
    until(lambda: np.allclose(live.request("GET", f"/api/scenes/{shown['id']}")[1]["light"]["position"], [0, 0.6, 0.8]))
    until(lambda: np.allclose(browser.node("/lamp").position, [0, 0.6, 0.8]))  # older changes may be drawn before


def test_a_light_that_may_not_be_moved_goes_back(live, browser, shown, monkeypatch):
    def refuse(*_, **__):
        raise OsfError("A job uses the table.")

    until(lambda: browser.table_agrees(shown))
    monkeypatch.setattr(live.services.runner.scenes, "edit", refuse)
    light = shown["light"]["position"]
    browser.drag_body(BALL, ABOVE, AT * np.array(light), AT * np.array([0, 0.6, 0.8]))
    until(lambda: np.allclose(browser.node("/lamp").position, light))


def test_a_light_that_somebody_holds_goes_back_when_another_takes_over(live, browser, shown):
    until(lambda: browser.table_agrees(shown))
    light = shown["light"]["position"]
    browser.drag_body(BALL, ABOVE, AT * np.array(light), AT * np.array([0, 0.6, 0.8]), "start", "update")
    assert not np.allclose(browser.node("/lamp").position, light)
    driver = live.services.driver
    try:
        driver.arrive("another")
        until(lambda: np.allclose(browser.node("/lamp").position, light))
    finally:
        driver.leave("another")


@pytest.fixture
def table(server, library):
    return SceneNodes(server, library, lambda *_: None, lambda *_: None)


CUBE = np.array([(x, y, z) for x in (-1, 1) for y in (-1, 1) for z in (0, 2)], float) * 0.05
HALF_M = TABLE_SIDE_M / 2


def area(mesh):
    vertices, faces = mesh
    a, b, c = (vertices[faces[:, k], :2] for k in range(3))
    return 0.5 * np.abs((b - a)[:, 0] * (c - a)[:, 1] - (b - a)[:, 1] * (c - a)[:, 0]).sum()


def test_under_a_light_straight_above_a_cube_covers_its_own_face():
    assert area(shadow_mesh([CUBE], np.array([0, 0, 1.0]))) == pytest.approx(0.1**2)


def test_a_cube_of_height_h_throws_a_shadow_of_h_over_tan_of_the_elevation():
    for elevation_deg in (15, 30, 45, 70):
        light = Light.from_angles(0.0, np.deg2rad(elevation_deg)).position
        vertices, _ = mesh = shadow_mesh([CUBE], light)
        reach_m = 0.1 / np.tan(np.deg2rad(elevation_deg))
        assert vertices[:, 0].min() == pytest.approx(-0.05 - reach_m, abs=1e-6)  # away from the light
        assert vertices[:, 0].max() == pytest.approx(0.05)
        assert area(mesh) == pytest.approx(0.1 * (0.1 + reach_m), rel=1e-5)


def test_shadows_end_where_the_table_does():
    light = Light.from_angles(0.4, np.deg2rad(5)).position
    vertices, _ = shadow_mesh([CUBE + (0.5, 0.5, 0), CUBE - (0.5, 0.5, 0)], light)
    assert np.abs(vertices[:, :2]).max() <= HALF_M + 1e-6
    assert area(shadow_mesh([CUBE + (5, 0, 0)], light)) == 0  # beside the table


@given(st.integers(3, 9), st.floats(0.05, 3), st.floats(-2, 2), st.floats(-2, 2))
def test_what_is_clipped_lies_in_the_square_and_in_the_polygon(corners, radius, x, y):
    angles = np.linspace(0, 2 * np.pi, corners, endpoint=False)
    polygon = np.column_stack([x + radius * np.cos(angles), y + radius * np.sin(angles)])
    kept = clipped(polygon, HALF_M)
    assert np.all(np.abs(kept) <= HALF_M + 1e-9)
    assert np.all(np.hypot(*(kept - (x, y)).T) <= radius + 1e-9)
    if np.all(np.abs(polygon) < HALF_M):
        np.testing.assert_array_equal(kept, polygon)


@pytest.mark.parametrize("cosine", [0.1, 0.5, 1.0])
def test_lit_like_the_table_a_shadow_is_what_the_ambient_light_leaves(cosine):
    linear = [(channel / 255) ** 2.2 for channel in shadow_colour(cosine)]
    lit = np.array(linear) * (AMBIENT + (1 - AMBIENT) * cosine)
    np.testing.assert_allclose(lit, np.array(TABLE_ALBEDO) ** 2.2 * AMBIENT, rtol=0.03)


@given(
    st.lists(st.tuples(*[st.floats(-0.4, 0.4)] * 3), min_size=2, max_size=8), st.floats(0.4, 1.2), st.floats(0.4, 2.5)
)
@example([(0, 0.4, 0), (0, -0.4, 0.4), (-0.4, 0.4, -0.4)], 0.943, 1.595)  # one point bounds both sides
def test_a_framed_view_holds_all_points_and_not_much_more(points, fov_rad, aspect):
    points = np.array(points)
    position, look_at = framing(points, fov_rad, aspect)
    view = Camera.look_at("view", position, look_at, size=100, fov_y_deg=float(np.rad2deg(fov_rad)))
    x, y = (2 * view.project(points) / 100 - 1).T
    x = x / aspect
    assert np.abs(x).max() < 1
    assert np.abs(y).max() < 1
    spans = np.ptp(x), np.ptp(y)
    forward = (look_at - position) / np.linalg.norm(look_at - position)
    is_near = np.linalg.norm(position - look_at) < 0.61 or ((points - position) @ forward).min() < 0.11
    assert is_near or max(spans) > 0.8  # of 2, from edge to edge


def test_a_hand_that_points_at_a_level_meets_it_there_and_the_sky_nowhere():
    eye, point = np.array([0.0, -1.0, 1.0]), np.array([0.1, 0.2, 0.05])
    assert level_point(eye, eye + 0.3 * (point - eye), 0.05) == pytest.approx(point)
    assert level_point(eye, eye + [0.0, 1.0, 0.1], 0.05) is None
    assert level_point(eye, np.array([0.0, 3.0, 0.5]), 0.0) is None  # beyond the table


def test_a_ray_meets_what_is_nearest(library):
    poses = Pose(np.array([[0.0, 0.0, 0.1], [0.0, 0.3, 0.1]]), np.tile([1.0, 0, 0, 0], (2, 1)))
    scene = SceneState((BOX, BOTTLE), poses, Light(np.array([0.8, 0.0, 0.6])), np.array([0.0, -0.3, 0.06]))
    eye = np.array([0.0, -2.0, 0.1])

    def meets(*to):
        return pointed_at(scene, library, eye, np.array(to) - eye)

    assert meets(0.0, 0.3, 0.1) == PUSHER_NAME  # before both objects
    assert meets(0.0, 0.0, 0.18) == BOX  # over the pusher, at its top
    assert meets(0.8 * AT, 0.0, 0.6 * AT) == LAMP_NAME
    assert meets(0.3, 0.0, 0.1) is None
    assert pointed_at(scene, library, eye, np.array([0.0, -1.0, 0.0])) is None  # all is behind
    assert pointed_at(scene, library, np.array([0.0, 2.0, 0.1]), np.array([0.0, -1.0, 0.0])) == BOTTLE


on_dome = st.builds(Light.from_angles, st.floats(-np.pi, np.pi), st.floats(0.0873, 1.57)).map(
    lambda light: AT * light.position
)
eyes = st.tuples(st.floats(-1, 1), st.floats(-2, -0.8), st.floats(0.2, 2)).map(np.array)


@given(on_dome, eyes, st.floats(0.1, 3))
def test_a_hand_that_points_at_the_dome_meets_it_there(mark, eye, share):
    through = eye + share * (mark - eye)
    point, is_beside = dome_point(eye, through, is_far=bool(mark @ (mark - eye) > 0))
    np.testing.assert_allclose(point, mark, atol=1e-4)  # where it only touches the dome, both points are one
    assert not is_beside or abs(mark @ (mark - eye)) < 1e-3


@given(eyes, st.tuples(*[st.floats(-1, 1)] * 3).map(np.array), st.booleans())
def test_wherever_a_hand_points_the_mark_stays_on_the_dome(eye, through, is_far):
    assume(np.linalg.norm(through - eye) > 1e-3)
    point, is_beside = dome_point(eye, through, is_far=is_far)
    assert np.linalg.norm(point) == pytest.approx(AT)
    way = (through - eye) / np.linalg.norm(through - eye)
    from_ray = np.linalg.norm(np.cross(point - eye, way))
    from_centre = np.linalg.norm(np.cross(eye, way))
    assert from_ray == pytest.approx(max(from_centre - AT, 0.0), abs=1e-6)  # no point of the dome is nearer
    assert is_beside == (from_ray > 1e-9) or from_ray < 1e-6


def test_led_over_the_edge_of_the_dome_a_light_goes_behind_it(table, driver):
    front, behind = AT * np.array([0.0, -0.6, 0.8]), AT * np.array([0.0, 0.8, 0.6])
    table.show(replace(record().state, light=Light(front)))
    eye, lamp = np.array(VIEW_FROM), driver.node("/lamp")
    driver.drag_body(BALL, eye, front, behind, "start", "update")
    assert lamp.position[1] < 0.5  # that spot is before the dome, too
    driver.drag_body(BALL, eye, front, behind + [0.0, 0.5, 1.0], "update")
    driver.drag_body(BALL, eye, front, behind, "update", "end")
    np.testing.assert_allclose(lamp.position, behind / AT, atol=1e-6)


def test_an_object_is_dragged_over_the_table_until_a_goal_is_composed(live, browser, shown):
    until(lambda: browser.table_agrees(shown))
    body = until(lambda: browser.node(f"/objects/{BOX}"))
    before = np.array(body.position)
    eye, grip = before + [0.0, -1.0, 1.0], before + [0.0, 0.0, 0.02]
    browser.drag_body(f"/objects/{BOX}", eye, grip, grip + [0.1, 0.05, 0.0])

    def went():
        after = live.request("GET", f"/api/scenes/{shown['id']}")[1]["objects"][0]["position"]
        return np.allclose(np.array(after[:2]) - before[:2], [0.1, 0.05], atol=5e-3)

    until(went)
    live.request("POST", "/api/goals/draft", {"scene": None})
    until(lambda: not browser.is_draggable(f"/objects/{BOX}"))
    live.request("DELETE", "/api/goals/draft")
    until(lambda: browser.is_draggable(f"/objects/{BOX}"))


VIEW = Camera.look_at("view", VIEW_FROM, VIEW_AT, fov_y_deg=float(np.rad2deg(VIEW_FOV_RAD)))
on_table = st.tuples(st.floats(-0.3, 0.3), st.floats(-0.3, 0.3), st.floats(0.02, 0.25))


@given(anchors=st.lists(on_table, min_size=1, max_size=5))
def test_no_label_covers_another_and_none_leaves_its_object_sideways(anchors):
    anchors = np.array(anchors)
    texts = [("Mug", "Cracker box", "Potted meat can", "Bowl", "Tuna fish can")[i] for i in range(len(anchors))]
    raised = separated(anchors, texts)
    np.testing.assert_array_equal(raised[:, :2], anchors[:, :2])
    assert np.all(raised[:, 2] >= anchors[:, 2] - 1e-9)
    place = VIEW.project(raised) / VIEW.height
    for i, j in zip(*np.triu_indices(len(texts), 1), strict=True):
        apart = np.abs(place[i] - place[j])
        assert apart[1] > 0.8 * LINE or apart[0] > 0.9 * CHARACTER * (len(texts[i]) + len(texts[j])) / 2


def test_labels_that_are_clear_of_each_other_stay():
    anchors = np.array([[-0.2, 0.0, 0.1], [0.2, 0.0, 0.1], [0.0, 0.25, 0.2]])
    np.testing.assert_allclose(separated(anchors, ["Mug", "Bowl", "Cracker box"]), anchors, atol=1e-12)
    assert separated(np.zeros((0, 3)), []).shape == (0, 3)


def test_the_higher_of_two_is_raised():
    anchors = np.array([[0.0, 0.0, 0.1], [0.01, 0.02, 0.1]])
    raised = separated(anchors, ["Mug", "Bowl"])
    assert raised[0, 2] == pytest.approx(0.1)
    assert raised[1, 2] > 0.11
