import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st

from osfcore.errors import InvalidInput
from osfcore.geometry.light import SpotLamp

POINTS = np.random.default_rng(0).uniform(-0.3, 0.3, (200, 3))


def lamp(position=(0.3, -0.2, 0.6), aim=(0.05, 0.02, 0.0), inner_deg=15.0, outer_deg=30.0) -> SpotLamp:
    return SpotLamp(np.array(position), np.array(aim), inner_deg, outer_deg)


def angles_deg(of: SpotLamp, points: np.ndarray) -> np.ndarray:
    """Between the lamp's axis and the way to points, by the cross product."""
    way = points - of.position
    axis = of.aim - of.position
    return np.rad2deg(np.arctan2(np.linalg.norm(np.cross(way, axis), axis=-1), way @ axis))


def test_direction_and_distance_are_those_of_its_position():
    one = lamp((0.0, 0.3, 0.4))
    np.testing.assert_allclose(one.direction, [0, 0.6, 0.8], atol=1e-12)
    assert one.distance == pytest.approx(0.5)
    np.testing.assert_allclose(one.distant.direction, one.direction, atol=1e-12)


@given(scale=st.floats(0.3, 3.0))
def test_light_falls_off_with_the_square_of_the_distance(scale):
    one = lamp(aim=(0, 0, 0))
    along = one.position - scale * one.distance * one.toward(np.zeros(3))
    assert one.falloff(along) == pytest.approx(scale**-2)


def test_the_centre_of_the_table_is_as_bright_as_under_a_distant_light():
    assert lamp().falloff(np.zeros(3)) == pytest.approx(1)


def test_a_lamp_far_away_is_a_distant_light():
    near = lamp(inner_deg=20, outer_deg=40)
    far = SpotLamp(near.direction * 1000, np.zeros(3), 20, 40)
    np.testing.assert_allclose(far.falloff(POINTS), 1, atol=2e-3)
    np.testing.assert_array_equal(far.spot_factor(POINTS), 1)
    np.testing.assert_allclose(far.toward(POINTS), np.broadcast_to(far.direction, POINTS.shape), atol=1e-3)


def test_the_cone_is_full_inside_dark_outside_and_half_in_the_middle_of_its_penumbra():
    one = lamp()
    factor, angle = one.spot_factor(POINTS), angles_deg(one, POINTS)
    np.testing.assert_array_equal(factor[angle < 15 - 1e-6], 1)
    np.testing.assert_array_equal(factor[angle > 30 + 1e-6], 0)
    within = (angle > 15) & (angle < 30)
    s = (30 - angle[within]) / 15
    assert within.sum() > 20
    np.testing.assert_allclose(factor[within], s * s * (3 - 2 * s), atol=1e-9)
    assert SpotLamp(np.array([0, 0, 1.0]), np.zeros(3), 10, 35).spot_factor(
        np.array([np.tan(np.deg2rad(22.5)), 0, 0])
    ) == pytest.approx(0.5)


def test_a_cone_without_penumbra_has_a_sharp_edge():
    one = lamp(inner_deg=20, outer_deg=20)
    factor, angle = one.spot_factor(POINTS), angles_deg(one, POINTS)
    np.testing.assert_array_equal(factor[np.abs(angle - 20) > 1e-3], (angle < 20)[np.abs(angle - 20) > 1e-3])


def test_points_may_have_any_leading_shape():
    one, grid = lamp(), POINTS.reshape(10, 20, 3)
    for closed_form in (one.falloff, one.spot_factor, one.toward):
        np.testing.assert_array_equal(closed_form(grid).reshape(200, -1), closed_form(POINTS).reshape(200, -1))


@pytest.mark.parametrize(
    ("change", "message"),
    [
        ({"position": (0, 0, 0.1)}, r"distance of the lamp from the table's centre \[m\] is 0.100, .* at least 0.15"),
        ({"position": (0.5, 0, -0.3)}, r"elevation of the lamp above the table.* is -31.0, .* at least 5"),
        ({"position": (0.5, 0, 0)}, "elevation of the lamp above the table"),
        ({"position": (0.5, 0, np.nan)}, "position of the lamp .* 3 finite numbers"),
        ({"aim": (0, np.inf, 0)}, "point that the lamp looks at .* 3 finite numbers"),
        ({"aim": (0.3, -0.2, 0.6)}, "point that the lamp looks at .* away from the lamp itself"),
        ({"inner_deg": 0.0}, r"cone \[deg\] is 0 and 30, but it must be 0 < inner <= outer <= 90"),
        ({"inner_deg": 31.0}, "cone .* is 31 and 30"),
        ({"outer_deg": 91.0}, "cone .* is 15 and 91"),
        ({"outer_deg": float("nan")}, "cone .* is 15 and nan"),
    ],
)
def test_lamps_that_make_no_sense_are_told(change, message):
    with pytest.raises(InvalidInput, match=message):
        lamp(**change)
