import numpy as np
import pytest

from osfcore.photo.camera_response import encoded_from_linear, linear_from_encoded


def test_encoding_and_decoding_undo_each_other():
    values = np.linspace(0, 1, 1001)
    np.testing.assert_allclose(encoded_from_linear(linear_from_encoded(values)), values, atol=1e-6)


@pytest.mark.parametrize(("encoded", "linear"), [(0.0, 0.0), (1.0, 1.0), (0.5, 0.2140411), (0.04, 0.04 / 12.92)])
def test_values_of_the_standard(encoded, linear):
    assert linear_from_encoded(np.array([encoded]))[0] == pytest.approx(linear, abs=1e-6)


def test_linear_files_stay_as_they_are():
    values = np.linspace(0, 1, 7)
    np.testing.assert_allclose(linear_from_encoded(values, "linear"), values, atol=1e-7)
