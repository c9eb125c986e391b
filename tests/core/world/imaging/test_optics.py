import numpy as np
from hypothesis import given
from hypothesis import strategies as st

from osfcore.world.imaging.optics import Lamp, lambert

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
    np.testing.assert_allclose(shadowed, ALBEDO * Lamp().ambient)


def test_light_from_behind_adds_nothing():
    behind = lambert(ALBEDO, np.array([-0.5]), np.array([1.0]), Lamp())
    np.testing.assert_allclose(behind, ALBEDO * Lamp().ambient)


def test_white_under_full_light_is_one():
    np.testing.assert_allclose(lambert(np.ones((1, 3)), np.ones(1), np.ones(1), Lamp()), 1)
