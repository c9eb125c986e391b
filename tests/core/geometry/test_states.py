"""States: states, estimated state."""

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st

from osfcore.errors import InvalidInput, UnknownName, check_seed
from osfcore.geometry.cameras import CAMERA_POSITIONS, SCENE_CENTRE, Camera, default_cameras, goal_camera
from osfcore.geometry.light import Light
from osfcore.geometry.poses import Pose
from osfcore.geometry.states import EstimatedState, SceneState
from osfcore.geometry.workspace import check_action

# States


OVERHEAD = Light(np.array([0.0, 0, 1]))


def test_default_cameras_are_where_the_conventions_say():
    for camera, position in zip(default_cameras(), CAMERA_POSITIONS, strict=True):
        np.testing.assert_allclose(camera.T_world_camera.position, position, atol=1e-12)
        np.testing.assert_allclose(camera.project(np.array(SCENE_CENTRE)), [64, 64], atol=1e-12)
        assert np.rad2deg(camera.fov_y_rad) == pytest.approx(45)
        assert (camera.width, camera.height) == (128, 128)
    np.testing.assert_allclose(goal_camera().T_world_camera.position, (0, -0.45, 0.8), atol=1e-12)


def test_camera_axes_are_opencv():
    camera = default_cameras()[0]  # at +x, looking toward -x: +y is on the right, up is up
    x, y = camera.project(np.array([[0.0, 0, 0.04], [0.0, 0.1, 0.04], [0.0, 0, 0.14]])).T
    assert x[1] > x[0]
    assert y[2] < y[0]
    assert camera.T_world_camera.inverse().apply(np.array(SCENE_CENTRE))[2] > 0


@given(x=st.floats(-0.4, 0.4), y=st.floats(-0.4, 0.4), z=st.floats(0, 0.2))
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


def test_a_camera_straight_above_has_an_upright_image():
    camera = Camera.look_at("above", (0, 0, 1), (0, 0, 0), size=64)
    matrix = camera.T_world_camera.matrix()[:3, :3]
    np.testing.assert_allclose(matrix @ matrix.T, np.eye(3), atol=1e-9)
    np.testing.assert_allclose(camera.project(np.zeros(3)), [32, 32], atol=1e-12)


@pytest.mark.parametrize("up", [(0, 0, 1), (0, 1, 0), (1, 0, 0), (0, 1, 1)])
@pytest.mark.parametrize("position", [(0, 1, 0), (0, -1, 0), (0, 0, 1), (1, 0, 0), (0, 1, 1), (0, 1, 1e-12)])
def test_cameras_look_along_any_direction(position, up):
    camera = Camera.look_at("any", position, (0, 0, 0), size=64, up=up)
    matrix = camera.T_world_camera.matrix()[:3, :3]
    np.testing.assert_allclose(matrix @ matrix.T, np.eye(3), atol=1e-9)
    np.testing.assert_allclose(camera.project(np.zeros(3)), [32, 32], atol=1e-12)


@given(azimuth=st.floats(-np.pi, np.pi), elevation=st.floats(np.deg2rad(5.001), np.pi / 2))
def test_lights_have_unit_length_and_the_angles_asked_for(azimuth, elevation):
    light = Light.from_angles(azimuth, elevation)
    assert np.linalg.norm(light.position) == pytest.approx(1)
    assert np.arcsin(light.direction[2]) == pytest.approx(elevation, abs=1e-6)
    np.testing.assert_allclose(Light(3 * light.position).position, light.position, atol=1e-12)


@pytest.mark.parametrize("position", [[1, 0, 0], [0, 1, -0.1], [1, 0, 0.08], [0, 0, 0], [np.nan, 0, 1], [0, 1], "up"])
def test_lights_at_or_below_the_table_are_refused(position):
    with pytest.raises(InvalidInput, match="light"):
        Light(position)


def test_random_lights_are_uniform_on_the_hemisphere_above_ten_degrees():
    rng = np.random.default_rng(0)
    heights = np.array([Light.random(rng).direction[2] for _ in range(4000)])
    low = np.sin(np.deg2rad(10))
    assert heights.min() >= low
    np.testing.assert_allclose(
        np.quantile(heights, [0.25, 0.5, 0.75]), low + (1 - low) * np.array([0.25, 0.5, 0.75]), atol=0.02
    )


def test_actions_within_limits_pass_unchanged():
    np.testing.assert_array_equal(check_action([0.3, -0.3, 0]), [0.3, -0.3, 0])


@pytest.mark.parametrize("action", [[0.301, 0, 0], [0, 0, 0.01], [np.inf, 0, 0], [0, 0], None, [[0, 0, 0]]])
def test_actions_beyond_are_refused(action):
    with pytest.raises(InvalidInput, match="action"):
        check_action(action)


def state(names=("a",), positions=None, quaternions=None, pusher=None) -> SceneState:
    count = len(names)
    positions = np.zeros((count, 3)) if positions is None else np.array(positions)
    quaternions = np.tile([1.0, 0, 0, 0], (count, 1)) if quaternions is None else np.array(quaternions)
    return SceneState(tuple(names), Pose(positions, quaternions), OVERHEAD, pusher)


@pytest.mark.parametrize(
    ("bad", "words"),
    [
        ({"names": tuple("abcdefghi")}, "at most 8"),
        ({"names": ("a", "a")}, "repetition"),
        ({"positions": [[np.nan, 0, 0]]}, "finite"),
        ({"positions": [[0.0, 0, 0], [0, 0, 0]]}, "1 x 3"),
        ({"quaternions": [[1.0, 1, 0, 0]]}, "unit"),
        ({"pusher": [0, np.inf, 0]}, "pusher"),
    ],
)
def test_states_that_cannot_be_are_refused(bad, words):
    with pytest.raises(InvalidInput, match=words):
        state(**bad)


def test_pose_of_an_object_by_name():
    both = state(("a", "b"), [[0.0, 0, 0], [0.1, 0.2, 0.3]])
    np.testing.assert_array_equal(both.pose("b").position, [0.1, 0.2, 0.3])
    with pytest.raises(UnknownName, match="no object in the scene named 'c'; known: a, b"):
        both.pose("c")


def test_objects_are_put_in_another_order():
    both = state(("a", "b"), [[0.0, 0, 0], [0.1, 0.2, 0.3]])
    other = both.reordered(("b", "a"))
    assert other.names == ("b", "a")
    for name in both.names:
        np.testing.assert_array_equal(other.pose(name).position, both.pose(name).position)
    with pytest.raises(UnknownName, match="'c'"):
        both.reordered(("b", "c"))


def test_seeds_are_what_every_generator_takes():
    assert check_seed(0) == 0
    assert check_seed(2**63 - 1) == 2**63 - 1
    for seed in (-1, 2**63, 10**400):
        with pytest.raises(InvalidInput, match="but it must be between 0 and 9223372036854775807"):
            check_seed(seed)


def test_a_long_camera_name_makes_no_long_sentence():
    camera = goal_camera()
    with pytest.raises(InvalidInput, match="^K of camera xxx") as caught:
        Camera("x" * 5000, camera.T_world_camera, np.zeros((3, 3)), 32, 32)
    assert len(str(caught.value)) < 400


# Estimated state


STATE = SceneState(("a", "b"), Pose.identity(2), Light(np.array([0, 0, 1.0])), None)
GOOD = {"state": STATE, "position_std": np.array([0.001, np.inf]), "rotation_std": np.zeros(2), "light_std": 0.0,
        "doubts": ("", ""), "reason": ""}  # fmt: skip


def test_an_estimate_is_trusted_unless_there_is_a_reason():
    assert EstimatedState(**GOOD).trusted
    assert not EstimatedState(**GOOD | {"doubts": ("", "odd"), "reason": "b: odd"}).trusted


def test_no_objects_are_fine():
    nothing = SceneState((), Pose.identity(0), STATE.light, None)
    assert EstimatedState(nothing, np.zeros(0), np.zeros(0), 0.1, (), "").trusted


@pytest.mark.parametrize(
    ("change", "message"),
    [
        ({"position_std": np.zeros(3)}, "position_std is .* must be 2 numbers of at least 0"),
        ({"position_std": np.array([0.1, -0.1])}, "position_std"),
        ({"rotation_std": np.array([0.1, np.nan])}, "rotation_std"),
        ({"rotation_std": np.zeros((2, 1))}, "rotation_std"),
        ({"light_std": -1.0}, "light_std is -1"),
        ({"light_std": np.nan}, "light_std is nan"),
        ({"doubts": ("",)}, "doubts is 1, but it must be one for each of 2 objects"),
    ],
)
def test_numbers_that_make_no_sense_are_refused(change, message):
    with pytest.raises(InvalidInput, match=message):
        EstimatedState(**GOOD | change)
