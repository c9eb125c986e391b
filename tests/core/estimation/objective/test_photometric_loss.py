import numpy as np
from hypothesis import given
from hypothesis import strategies as st
from scipy.special import huber

from osfcore.estimation.objective import HUBER, ObservedViews, loss_of, photometric_loss, residuals
from osfcore.geometry.cameras import default_cameras
from tests.core.estimation.scenes import own_views, params_of
from tests.core.render.scenes import state, view


@given(seed=st.integers(0, 10**6), spread=st.sampled_from([1e-3, 0.1, 1.0]))
def test_the_loss_is_hubers(seed, spread):
    errors = spread * np.random.default_rng(seed).normal(size=(3, 2, 4, 5, 3))
    np.testing.assert_allclose(photometric_loss(errors), huber(HUBER, errors).mean(axis=(1, 2, 3, 4)), rtol=1e-12)


def test_small_errors_count_squared_and_large_ones_linearly():
    np.testing.assert_allclose(
        photometric_loss(np.array([[0.02], [-0.02], [1.0]])), [0.0002, 0.0002, 0.095], rtol=1e-12
    )


def test_a_scene_explains_its_own_images_and_no_others(plain):
    params = params_of(state({"block": (0.04, 0, 0.05), "ball": (-0.06, 0, 0.05)}))
    views = own_views(plain, params, [view(), view((0, 0.5, 0.4))])
    changes = np.zeros((3, params.size))
    changes[1, 0], changes[2, 0] = 0.005, 0.01
    errors = residuals(plain, views, params.perturbed(changes))
    assert errors.shape == (3, 2, 32, 32, 3)
    assert errors.dtype == np.float32
    assert not errors[0].any()
    losses = photometric_loss(errors)
    assert 0 == losses[0] < losses[1] < losses[2]


def test_residuals_are_rendered_minus_observed(plain):
    params = params_of(state({"ball": (0, 0, 0.05)}))
    views = own_views(plain, params, [view()])
    darker = ObservedViews(views.cameras, views.images - np.float32(0.25), None, None, views.quality)
    errors = residuals(plain, darker, params.perturbed(np.zeros((1, params.size))))
    np.testing.assert_allclose(errors, 0.25, atol=1e-6)


def test_the_loss_of_one_scene_is_that_of_a_batch_of_one(models, truth):
    params = params_of(truth)
    seen = own_views(models, params, default_cameras(32)[:1])
    moved = params.updated(np.array([0.01] * 12 + [0.0, 0.0]))
    assert loss_of(models, seen, params) == 0
    batch = moved.perturbed(np.zeros((1, moved.size)))
    assert loss_of(models, seen, moved) == photometric_loss(residuals(models, seen, batch))[0] > 0
