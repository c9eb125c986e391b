import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st

from osfcore.errors import InvalidInput
from osfcore.geometry.workspace import TABLE_SIDE_M
from osfcore.world.imaging import TABLE_ALBEDO, Lamp, TableSurface, lambert

ALBEDO = np.array([[0.2, 0.5, 0.8]])
shares = st.floats(0, 1)


@given(ambient=shares, diffuse=shares, cosine=st.floats(-1, 1), visible=st.sampled_from([0.0, 1.0]))
def test_radiance_is_linear_in_ambient_and_diffuse(ambient, diffuse, cosine, visible):
    args = (ALBEDO, np.array([cosine]), np.array([visible]))
    whole = lambert(*args, Lamp(ambient, diffuse))
    parts = ambient * lambert(*args, Lamp(1, 0)) + diffuse * lambert(*args, Lamp(0, 1))
    np.testing.assert_allclose(whole, parts, atol=1e-12)


def test_shadow_removes_the_whole_diffuse_term():
    shadowed = lambert(ALBEDO, np.array([1.0]), np.array([0.0]), Lamp())
    np.testing.assert_allclose(shadowed, ALBEDO * Lamp().ambient, atol=1e-12)


def test_light_from_behind_adds_nothing():
    behind = lambert(ALBEDO, np.array([-0.5]), np.array([1.0]), Lamp())
    np.testing.assert_allclose(behind, ALBEDO * Lamp().ambient, atol=1e-12)


def test_white_under_full_light_is_one():
    np.testing.assert_allclose(lambert(np.ones((1, 3)), np.ones(1), np.ones(1), Lamp()), 1, atol=1e-12)


@given(intensity=st.floats(0, 3), cosine=st.floats(-1, 1), visible=st.sampled_from([0.0, 1.0]))
def test_intensity_and_colour_are_factors_on_the_whole_radiance(intensity, cosine, visible):
    args = (ALBEDO, np.array([cosine]), np.array([visible]))
    colour = (1.0, 0.5, 0.25)
    lit = lambert(*args, Lamp(intensity=intensity, colour=colour))
    np.testing.assert_allclose(lit, intensity * np.array(colour) * lambert(*args, Lamp()), atol=1e-12)


def test_albedo_keeps_its_precision_under_any_lamp():
    args = (ALBEDO.astype(np.float32), np.ones(1, np.float32), np.ones(1, np.float32))
    assert lambert(*args, Lamp(0.1, 0.9, 0.7, (1.0, 0.9, 0.8))).dtype == np.float32


def test_a_table_without_texture_is_the_same_everywhere():
    points = np.array([[0.0, 0.0], [0.5, -0.59]], np.float32)
    np.testing.assert_array_equal(TableSurface().albedo_at(points, 0.01), np.float32([TABLE_ALBEDO] * 2))


def test_a_texture_lies_with_its_first_row_at_greatest_y_and_its_first_column_at_least_x():
    texture = np.zeros((4, 4, 3), np.float32)
    texture[..., 0] = np.linspace(0, 1, 4)  # red grows with x
    texture[..., 1] = np.linspace(0, 1, 4)[:, None]  # green grows toward -y
    at = TableSurface(texture=texture).albedo_at
    far = TABLE_SIDE_M / 2
    corners = np.array([[-far, far], [far, far], [-far, -far], [far, -far]], np.float32)
    np.testing.assert_allclose(at(corners)[:, :2], [[0, 0], [1, 0], [0, 1], [1, 1]], atol=1e-6)
    np.testing.assert_allclose(at(np.zeros((1, 2), np.float32)), [[0.5, 0.5, 0]], atol=1e-2)


def test_texels_smaller_than_the_footprint_are_averaged():
    texture = np.indices((64, 64)).sum(axis=0)[..., None] % 2 * np.ones(3, np.float32)
    points = np.random.default_rng(0).uniform(-0.5, 0.5, (700, 2)).astype(np.float32)
    surface = TableSurface(texture=texture)
    np.testing.assert_allclose(surface.albedo_at(points, 2 * TABLE_SIDE_M / 64), 0.5, atol=1e-6)
    assert surface.albedo_at(points).std() > 0.15
    assert surface.albedo_at(points[:0]).shape == (0, 3)


@pytest.mark.parametrize("texture", [np.full((4, 4, 3), 1.5), np.full((4, 4, 3), np.nan), np.ones((4, 4))])
@pytest.mark.wrong_arrays
def test_a_texture_that_is_no_albedo_is_refused(texture):
    with pytest.raises(InvalidInput, match="texture"):
        TableSurface(texture=texture)
