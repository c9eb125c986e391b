import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st

from app.viewer.nodes.shadow_nodes import clipped, shadow_colour, shadow_mesh
from osfcore.geometry.light import AMBIENT, Light
from osfcore.geometry.workspace import TABLE_SIDE_M
from osfcore.world.imaging import TABLE_ALBEDO

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
