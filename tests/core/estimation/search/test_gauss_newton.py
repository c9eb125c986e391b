from dataclasses import replace

import numpy as np
import pytest

from osfcore.estimation.objective import LIGHT, POSE, QUALITY, photometric_loss, residuals
from osfcore.estimation.search import PLANAR_PARAMETERS, GaussNewtonState, difference_steps, gauss_newton
from osfcore.geometry.cameras import default_cameras
from tests.core.estimation.scenes import apart, own_views, params_of

SHIFT = np.array([0.006, -0.004, 0.003, 0.05, -0.04, 0.08])


@pytest.fixture(scope="module")
def views(models, truth):
    return own_views(models, params_of(truth), default_cameras(64)[:3], replace(QUALITY, samples_per_side=2))


def changed(truth, first=(0,) * 6, second=(0,) * 6, light=(0, 0)):
    return params_of(truth).updated(np.array([*first, *second, *light], float))


def loss(models, views, params) -> float:
    return float(photometric_loss(residuals(models, views, params.perturbed(np.zeros((1, params.size)))))[0])


def ended(models, views, params, **how) -> GaussNewtonState:
    return list(gauss_newton(models, views, GaussNewtonState.at(params), **how))[-1]


@pytest.mark.parametrize("sign", [-1, 1])
def test_shifted_objects_move_back(models, truth, views, sign):
    start = changed(truth, sign * SHIFT, -sign * SHIFT)
    end = ended(models, views, start, iterations=6).params
    for before, after, bound in zip(apart(start, truth)[:2], apart(end, truth)[:2], (5e-4, 0.01), strict=True):
        assert np.all(after < before / 10)
        assert np.all(after < bound)
    assert loss(models, views, end) < loss(models, views, start) / 100


def test_the_light_moves_back(models, truth, views):
    start = changed(truth, light=(0.15, -0.1))
    end = ended(models, views, start, iterations=4, objects=(), light=views).params
    assert apart(end, truth)[2] < apart(start, truth)[2] / 10
    assert apart(end, truth)[2] < 0.01
    np.testing.assert_array_equal(end.positions, start.positions)


def test_objects_and_light_move_back_together(models, truth, views):
    start = changed(truth, SHIFT, -SHIFT, (0.1, 0.05))
    end = ended(models, views, start, iterations=6, light=views).params
    shift, turn, light = apart(end, truth)
    assert shift.max() < 6e-4
    assert turn.max() < 0.01
    assert light < 0.01


def test_only_the_objects_asked_for_move(models, truth, views):
    start = changed(truth, SHIFT, SHIFT, (0.1, 0.0))
    at = ended(models, views, start, iterations=2, objects=(1,))
    assert not np.array_equal(at.params.positions[1], start.positions[1])
    np.testing.assert_array_equal(at.params.positions[0], start.positions[0])
    np.testing.assert_allclose(at.params.light, start.light, atol=1e-12)
    assert [bool(normal.any()) for normal in at.normals] == [False, True, False]
    assert np.isfinite(at.losses).tolist() == [False, True, False]


def test_planar_objects_stay_flat_on_the_table(models, truth, views):
    start = changed(truth, SHIFT * np.isin(range(6), PLANAR_PARAMETERS))
    at = ended(models, views, start, iterations=5, numbers=PLANAR_PARAMETERS, objects=(0,))
    assert apart(at.params, truth)[0][0] < 1e-3
    np.testing.assert_array_equal(at.params.positions[:, 2], start.positions[:, 2])
    others = np.setdiff1d(range(6), PLANAR_PARAMETERS)
    assert not at.normals[0][others].any()
    assert not at.normals[0][:, others].any()
    assert at.normals[0][np.ix_(PLANAR_PARAMETERS, PLANAR_PARAMETERS)].all()


def test_each_sweep_is_told_and_none_makes_it_worse(models, truth, views):
    start = changed(truth, SHIFT, -SHIFT, (0.1, 0))
    steps = list(gauss_newton(models, views, GaussNewtonState.at(start), iterations=4, light=views))
    assert len(steps) == 4
    losses = [step.losses[-1] for step in steps]
    assert np.all(np.diff(losses) <= 0)
    assert losses[-1] == pytest.approx(loss(models, views, steps[-1].params), rel=1e-3)
    for normal, size in zip(steps[-1].normals, (POSE, POSE, LIGHT), strict=True):
        assert normal.shape == (size, size)
        np.testing.assert_allclose(normal, normal.T, rtol=1e-4, atol=1e-4 * normal.max())
        assert np.linalg.eigvalsh((normal + normal.T) / 2).min() > 0


def test_at_the_truth_nothing_moves(models, truth, views):
    """Whose images are explained to the last bit."""
    end = ended(models, views, params_of(truth), iterations=2, light=views)
    np.testing.assert_allclose(end.params.positions, truth.poses.position, atol=1e-5)
    assert end.losses.max() < 1e-9


def test_an_object_out_of_sight_stays_where_it_is(models, truth, views):
    params = params_of(truth)
    away = replace(params, positions=params.positions + [[0, 0, 0], [0, 0, -1.0]])
    at = ended(models, views, away, iterations=2, objects=(1,))
    np.testing.assert_array_equal(at.params.positions, away.positions)
    assert not at.normals[1].any()


def test_no_iterations_are_none(models, truth, views):
    assert list(gauss_newton(models, views, GaussNewtonState.at(params_of(truth)), iterations=0)) == []


def test_half_widths_are_of_each_number():
    assert difference_steps(0).shape == (LIGHT,)
    widths = difference_steps(2)
    assert widths.shape == (2 * POSE + LIGHT,)
    np.testing.assert_array_equal(widths[:POSE], widths[POSE : 2 * POSE])
    assert np.all(widths > 0)
