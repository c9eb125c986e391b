import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st

from osfcore.estimation.objective import LIGHT, POSE, SceneParameters
from osfcore.geometry.light import MIN_LIGHT_ELEVATION_DEG, Light
from osfcore.geometry.poses import orthogonal_basis, quaternion_exp, quaternion_multiply, rotation_angle
from tests.core.estimation.scenes import angle

SEEDS = st.integers(0, 10**6)


def a_guess(rng, count=3, pusher=None) -> SceneParameters:
    quaternions = quaternion_exp(rng.normal(size=(count, 3)))
    names = tuple(f"object{n}" for n in range(count))
    light = Light.random(rng, min_elevation_deg=MIN_LIGHT_ELEVATION_DEG).direction
    return SceneParameters(names, rng.normal(size=(count, 3)), quaternions, light, pusher)


@given(seed=SEEDS, count=st.integers(0, 4))
def test_no_change_is_the_identity(seed, count):
    params = a_guess(np.random.default_rng(seed), count)
    assert params.size == POSE * count + LIGHT
    batch = params.perturbed(np.zeros((2, params.size)))
    assert batch.names == params.names
    for row in range(2):
        np.testing.assert_array_equal(batch.positions[row], params.positions)
        np.testing.assert_allclose(batch.quaternions[row], params.quaternions, atol=1e-15)
        np.testing.assert_allclose(batch.lights[row], params.light, atol=2e-5)  # which may stand at the very lowest


@given(seed=SEEDS, size=st.floats(1e-3, 3))
def test_whatever_the_change_it_leads_to_a_scene(seed, size):
    """Quaternions stay unit and the light stays over the table: a state refuses anything else."""
    rng = np.random.default_rng(seed)
    params = a_guess(rng)
    batch = params.perturbed(size * rng.normal(size=(8, params.size)))
    np.testing.assert_allclose(np.linalg.norm(batch.quaternions, axis=-1), 1, atol=1e-12)
    np.testing.assert_allclose(np.linalg.norm(batch.lights, axis=-1), 1, atol=1e-12)
    for light in batch.lights:
        Light(light)
    params.updated(size * rng.normal(size=params.size)).state()


@pytest.mark.parametrize("elevation_deg", [5.0, 5.5, 20.0])
@pytest.mark.parametrize("push", [-1.0, -0.1, -0.01, 0.01, 0.1, 1.0])
def test_the_light_is_held_above_the_lowest_elevation(elevation_deg, push):
    light = Light.from_angles(0.4, np.deg2rad(elevation_deg)).direction
    params = SceneParameters((), np.zeros((0, 3)), np.zeros((0, 4)), light, None)
    lights = params.perturbed(push * np.array([[1.0, 0], [0, 1], [1, 1], [1, -1]])).lights
    assert np.rad2deg(np.arcsin(lights[:, 2])).min() >= MIN_LIGHT_ELEVATION_DEG


@given(seed=SEEDS)
def test_translations_add_and_rotations_are_about_the_worlds_axes(seed):
    rng = np.random.default_rng(seed)
    params = a_guess(rng, 2)
    change = np.zeros(params.size)
    change[POSE : POSE + 3], change[POSE + 3 : 2 * POSE] = shift, turn = 0.1 * rng.normal(size=(2, 3))
    moved = params.updated(change)
    np.testing.assert_array_equal(moved.positions[0], params.positions[0])
    np.testing.assert_allclose(moved.positions[1], params.positions[1] + shift, atol=1e-12)
    np.testing.assert_allclose(moved.quaternions[0], params.quaternions[0], atol=1e-15)
    wanted = quaternion_multiply(quaternion_exp(turn), params.quaternions[1])
    np.testing.assert_allclose(rotation_angle(moved.quaternions[1], wanted), 0, atol=1e-7)
    np.testing.assert_allclose(
        rotation_angle(moved.quaternions[1], params.quaternions[1]), np.linalg.norm(turn), atol=1e-7
    )


@given(seed=SEEDS)
def test_small_changes_of_the_light_are_angles(seed):
    rng = np.random.default_rng(seed)
    light = Light.random(rng, min_elevation_deg=20).direction
    params = SceneParameters((), np.zeros((0, 3)), np.zeros((0, 4)), light, None)
    change = 0.02 * rng.normal(size=2)
    assert angle(params.updated(change).light, light) == pytest.approx(np.linalg.norm(change), rel=5e-3)


@given(seed=SEEDS)
def test_directions_across_stand_on_each_other(seed):
    direction = np.random.default_rng(seed).normal(size=3)
    direction /= np.linalg.norm(direction)
    axes = np.stack([direction, *orthogonal_basis(direction)])
    np.testing.assert_allclose(axes @ axes.T, np.eye(3), atol=1e-12)


def test_directions_across_the_axes_too():
    for direction in (*np.eye(3), *-np.eye(3)):
        axes = np.stack([direction, *orthogonal_basis(direction)])
        np.testing.assert_allclose(axes @ axes.T, np.eye(3), atol=1e-12)


def test_a_guess_is_its_state():
    params = a_guess(np.random.default_rng(0), pusher=np.array([0.1, 0.2, 0.06]))
    again = SceneParameters.of(params.state(), params.pusher)
    for name in ("positions", "quaternions", "light", "pusher"):
        np.testing.assert_allclose(getattr(again, name), getattr(params, name), atol=1e-15)
    assert again.names == params.names
    np.testing.assert_array_equal(again.perturbed(np.zeros((3, again.size))).pusher, np.tile(params.pusher, (3, 1)))
    assert a_guess(np.random.default_rng(0)).perturbed(np.zeros((3, again.size))).pusher is None
