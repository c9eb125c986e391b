import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st

from osfcore.estimation.camera_response import linear_from_encoded, linear_of_srgb, srgb_of_linear


def test_srgb_has_its_well_known_values():
    linear = np.array([0, 0.002, 0.18, 0.5, 1])
    np.testing.assert_allclose(srgb_of_linear(linear), [0, 0.02584, 0.46136, 0.73536, 1], atol=1e-5)


@given(value=st.floats(0, 1))
def test_each_curve_is_the_inverse_of_the_other(value):
    values = np.array([value])
    np.testing.assert_allclose(linear_of_srgb(srgb_of_linear(values)), values, atol=1e-7)
    np.testing.assert_allclose(srgb_of_linear(linear_of_srgb(values)), values, atol=1e-7)


@pytest.mark.parametrize("curve", [srgb_of_linear, linear_of_srgb])
def test_the_curves_rise_without_a_step(curve):
    steps = np.diff(curve(np.linspace(0, 1, 100_001)))
    assert np.all(steps > 0)
    assert steps.max() < 2e-4


@pytest.mark.parametrize("dtype", [np.float32, np.float64])
def test_types_of_numbers_are_kept(dtype):
    values = np.linspace(0, 1, 7, dtype=dtype)
    assert linear_from_encoded(values, "srgb").dtype == dtype
    assert srgb_of_linear(values).dtype == dtype
    np.testing.assert_array_equal(linear_from_encoded(values, "linear"), values)
