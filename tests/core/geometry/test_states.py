import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from osfcore.errors import InvalidInput, UnknownName
from osfcore.geometry.cameras import CAMERA_POSITIONS, SCENE_CENTRE, Camera, default_cameras, goal_camera
from osfcore.geometry.light import Light
from osfcore.geometry.poses import Pose
from osfcore.geometry.states import EstimatedState, SceneState
from osfcore.geometry.workspace import check_action
from tests.support.errors import about

OVERHEAD = Light(np.array([0.0, 0, 1]))


def test_default_cameras_are_where_the_conventions_put_them():
    for camera, position in zip(default_cameras(), CAMERA_POSITIONS, strict=True):
        np.testing.assert_allclose(camera.T_world_camera.position, position, atol=1e-12)
        np.testing.assert_allclose(camera.project(np.array(SCENE_CENTRE)), [64, 64], atol=1e-12)
        assert np.rad2deg(camera.fov_y_rad) == pytest.approx(45)
        assert (camera.width, camera.height) == (128, 128)
        assert camera.T_world_camera.inverse().apply(np.array(SCENE_CENTRE))[2] > 0
        assert camera.project(np.array([0, 0, 0.14]))[1] < 64  # up is up
    assert default_cameras()[0].project(np.array([0.0, 0.1, 0.04]))[0] > 64  # seen from +x, +y is on the right
    np.testing.assert_allclose(goal_camera().T_world_camera.position, (0, -0.45, 0.8), atol=1e-12)


@given(x=st.floats(-0.4, 0.4), y=st.floats(-0.4, 0.4), z=st.floats(0, 0.2))
@settings(max_examples=40)
def test_rays_go_back_through_projected_points(x, y, z):
    point = np.array([x, y, z])
    for camera in (*default_cameras(), goal_camera()):
        direction = camera.ray_directions(camera.project(point))
        expected = point - camera.T_world_camera.position
        np.testing.assert_allclose(direction, expected / np.linalg.norm(expected), atol=1e-9)


def test_a_resized_camera_sees_the_same():
    point = np.array([0.1, -0.05, 0.1])
    small, large = goal_camera(64), goal_camera(64).resized(256, 256)
    np.testing.assert_allclose(4 * small.project(point), large.project(point), atol=1e-12)
    np.testing.assert_allclose(large.intrinsics, goal_camera(256).intrinsics, atol=1e-12)


@pytest.mark.parametrize("up", [(0, 0, 1), (0, 1, 0), (1, 0, 0), (0, 1, 1)])
@pytest.mark.parametrize("position", [(0, 1, 0), (0, -1, 0), (0, 0, 1), (1, 0, 0), (0, 1, 1), (0, 1, 1e-12)])
def test_cameras_look_along_any_direction(position, up):
    camera = Camera.look_at("any", position, (0, 0, 0), size=64, up=up)
    matrix = camera.T_world_camera.matrix()[:3, :3]
    np.testing.assert_allclose(matrix @ matrix.T, np.eye(3), atol=1e-9)
    np.testing.assert_allclose(camera.project(np.zeros(3)), [32, 32], atol=1e-12)


@given(azimuth=st.floats(-np.pi, np.pi), elevation=st.floats(np.deg2rad(5.001), np.pi / 2))
@settings(max_examples=40)
def test_lights_have_unit_length_and_the_angles_asked_for(azimuth, elevation):
    light = Light.from_angles(azimuth, elevation)
    assert np.linalg.norm(light.position) == pytest.approx(1)
    assert np.arcsin(light.direction[2]) == pytest.approx(elevation, abs=1e-6)
    np.testing.assert_allclose(Light(3 * light.position).position, light.position, atol=1e-12)


@pytest.mark.parametrize("position", [[1, 0, 0], [0, 1, -0.1], [1, 0, 0.08], [0, 0, 0], [np.nan, 0, 1], [0, 1], "up"])
def test_lights_at_or_below_the_table_are_refused(position):
    with pytest.raises(InvalidInput, check=about("light")):
        Light(position)


def test_random_lights_are_uniform_on_the_hemisphere_above_ten_degrees():
    rng = np.random.default_rng(0)
    heights = np.array([Light.random(rng).direction[2] for _ in range(4000)])
    low = np.sin(np.deg2rad(10))
    assert heights.min() >= low
    quarters = np.array([0.25, 0.5, 0.75])
    np.testing.assert_allclose(np.quantile(heights, quarters), low + (1 - low) * quarters, atol=0.02)


@pytest.mark.parametrize("action", [[0.301, 0, 0], [0, 0, 0.01], [np.inf, 0, 0], [0, 0], None, [[0, 0, 0]]])
def test_actions_beyond_are_refused(action):
    np.testing.assert_array_equal(check_action([0.3, -0.3, 0]), [0.3, -0.3, 0])
    with pytest.raises(InvalidInput, check=about("action")):
        check_action(action)


def state(names=("a",), positions=None, quaternions=None, pusher=None) -> SceneState:
    poses = Pose.identity(len(names))
    positions = poses.position if positions is None else np.array(positions)
    quaternions = poses.quaternion if quaternions is None else np.array(quaternions)
    return SceneState(tuple(names), Pose(positions, quaternions), OVERHEAD, pusher)


@pytest.mark.parametrize(
    ("bad", "what"),
    [
        ({"names": tuple("abcdefghi")}, "number of objects"),
        ({"names": ("a", "a")}, "list of objects"),
        ({"positions": [[np.nan, 0, 0]]}, "positions"),
        ({"positions": [[0.0, 0, 0], [0, 0, 0]]}, "positions"),
        ({"quaternions": [[1.0, 1, 0, 0]]}, "quaternions"),
        ({"pusher": [0, np.inf, 0]}, "pusher"),
    ],
)
def test_states_that_cannot_be_are_refused(bad, what):
    with pytest.raises(InvalidInput, check=about(what)):
        state(**bad)


def test_objects_are_put_in_another_order():
    both = state(("a", "b"), [[0.0, 0, 0], [0.1, 0.2, 0.3]])
    other = both.reordered(("b", "a"))
    assert other.names == ("b", "a")
    for name in both.names:
        np.testing.assert_array_equal(other.pose(name).position, both.pose(name).position)
    with pytest.raises(UnknownName, check=about("c")):
        both.reordered(("b", "c"))


GOOD = {"state": state("ab"), "position_std": np.array([0.001, np.inf]), "rotation_std": np.zeros(2), "light_std": 0.0,
        "doubts": ("", ""), "reason": ""}  # fmt: skip


@pytest.mark.parametrize(
    ("what", "values"),
    [
        ("position_std", [np.zeros(3), np.array([0.1, -0.1])]),
        ("rotation_std", [np.array([0.1, np.nan]), np.zeros((2, 1))]),
        ("light_std", [-1.0, np.nan]),
        ("doubts", [("",)]),
    ],
)
def test_uncertainties_that_make_no_sense_are_refused(what, values):
    assert EstimatedState(**GOOD).trusted
    for value in values:
        with pytest.raises(InvalidInput, check=about(what)):
            EstimatedState(**GOOD | {what: value})
