import numpy as np
import pytest

from osfcore.estimation.objective import views_of
from osfcore.estimation.search import light_loss_ratio, search_light
from osfcore.geometry.cameras import default_cameras
from osfcore.geometry.light import Light
from tests.core.estimation.scenes import BOTTLE, BOX, angle, lying, observe, params_of, scene


def found(models, state, params):
    seen = observe(models, state, default_cameras(96)[:2], masks=False)
    return search_light(models, views_of(seen, 32), views_of(seen, 64), params)


@pytest.mark.parametrize(("azimuth_deg", "elevation_deg"), [(30, 15), (-120, 25), (140, 45), (-100, 70), (0, 89)])
def test_the_light_of_a_scene_is_found(models, azimuth_deg, elevation_deg):
    light = Light.from_angles(*np.deg2rad([azimuth_deg, elevation_deg])).direction
    state = scene({BOX: lying(models, BOX, 30, 0.05, -0.08), BOTTLE: lying(models, BOTTLE, 50, -0.06, 0.09)}, light)
    assert np.rad2deg(angle(found(models, state, params_of(state)), light)) < 2


@pytest.mark.parametrize("azimuth_deg", range(0, 360, 30))
@pytest.mark.parametrize("elevation_deg", [7, 13])
def test_a_light_near_the_horizon_is_found_with_one_object(models, azimuth_deg, elevation_deg):
    """Shading changes by half from one direction of a grid to the next, and the table's alone tells no azimuth."""
    light = Light.from_angles(*np.deg2rad([azimuth_deg, elevation_deg])).direction
    state = scene({BOX: lying(models, BOX, 30, 0.03, -0.05)}, light)
    assert np.rad2deg(angle(found(models, state, params_of(state)), light)) < 2


def test_poses_need_not_be_right_to_the_degree(models, truth):
    params = params_of(truth)
    change = np.array([0.008, -0.005, 0.002, 0.05, 0, 0.1, -0.006, 0.007, 0, 0, 0.05, -0.12, 0, 0])
    wrong = params.updated(change)
    assert np.rad2deg(angle(found(models, truth, wrong), truth.light.direction)) < 6


def test_where_the_guess_has_its_light_plays_no_part(models, truth):
    params = params_of(truth)
    other = params.updated(np.array([0] * 12 + [0.6, -0.4]))
    a, b = found(models, truth, params), found(models, truth, other)
    np.testing.assert_array_equal(a, b)
    np.testing.assert_allclose(np.linalg.norm(a), 1, atol=1e-12)


def test_the_right_light_is_hardly_beaten_and_a_wrong_one_clearly(models, truth):
    seen = observe(models, truth, default_cameras(96)[:2], masks=False)
    params = params_of(truth)
    wrong = params.updated(np.array([0] * 12 + [0.6, -0.4]))
    assert light_loss_ratio(models, views_of(seen, 32), params) > 1
    assert light_loss_ratio(models, views_of(seen, 32), wrong) < 0.5
