import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st

from osfcore.errors import InvalidInput
from osfcore.geometry.light import SpotLamp
from tests.support.errors import about

POINTS = np.random.default_rng(0).uniform(-0.3, 0.3, (200, 3))


def lamp(position=(0.3, -0.2, 0.6), aim=(0.05, 0.02, 0.0), inner_deg=15.0, outer_deg=30.0) -> SpotLamp:
    return SpotLamp(np.array(position), np.array(aim), inner_deg, outer_deg)


def angles_deg(of: SpotLamp, points: np.ndarray) -> np.ndarray:
    """Between the lamp's axis and the way to points, by the cross product."""
    way = points - of.position
    axis = of.aim - of.position
    return np.rad2deg(np.arctan2(np.linalg.norm(np.cross(way, axis), axis=-1), way @ axis))


@given(scale=st.floats(0.3, 3.0))
def test_light_falls_off_with_the_square_of_the_distance(scale):
    one = lamp(aim=(0, 0, 0))
    along = one.position - scale * one.distance * one.toward(np.zeros(3))
    assert one.falloff(along) == pytest.approx(scale**-2)
    assert one.falloff(np.zeros(3)) == pytest.approx(1)


def test_a_lamp_far_away_is_a_distant_light():
    near = lamp(inner_deg=20, outer_deg=40)
    far = SpotLamp(near.direction * 1000, np.zeros(3), 20, 40)
    assert far.distance == pytest.approx(1000)
    np.testing.assert_allclose(far.distant.direction, near.direction, atol=1e-12)
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
    sharp = lamp(inner_deg=20, outer_deg=20).spot_factor(POINTS)
    np.testing.assert_array_equal(sharp[np.abs(angle - 20) > 1e-3], (angle < 20)[np.abs(angle - 20) > 1e-3])


@pytest.mark.parametrize(
    ("what", "changes"),
    [
        ("distance of the lamp", [{"position": (0, 0, 0.1)}]),
        ("elevation of the lamp", [{"position": (0.5, 0, -0.3)}, {"position": (0.5, 0, 0)}]),
        ("position of the lamp", [{"position": (0.5, 0, np.nan)}]),
        ("point that the lamp looks at", [{"aim": (0, np.inf, 0)}, {"aim": (0.3, -0.2, 0.6)}]),
        ("cone", [{"inner_deg": 0.0}, {"inner_deg": 31.0}, {"outer_deg": 91.0}, {"outer_deg": float("nan")}]),
    ],
)
def test_lamps_that_make_no_sense_are_refused(what, changes):
    for change in changes:
        with pytest.raises(InvalidInput, check=about(what)):
            lamp(**change)
