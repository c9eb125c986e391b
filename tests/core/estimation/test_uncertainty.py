from dataclasses import replace

import numpy as np
import pytest

from osfcore.estimation.objective import LIGHT, POSE, QUALITY, SceneParameters, views_of
from osfcore.estimation.search import GaussNewtonState, gauss_newton
from osfcore.estimation.uncertainty import (
    FitQuality,
    allowed_residuals,
    estimate_with_uncertainty,
    evaluate_fit,
    goal_allowance,
    misfits,
    object_residuals,
    relative_residuals,
)
from osfcore.geometry.cameras import default_cameras
from tests.support.posed_scenes import BOX, own_views, params_of

FINE = replace(QUALITY, samples_per_side=2)


@pytest.fixture(scope="module")
def views(models, truth, seen):
    """With the masks of an observation: a pixel is the object's or not."""
    return views_of(seen, 96, samples=2)


@pytest.fixture(scope="module")
def end(models, truth, views):
    return list(gauss_newton(models, views, GaussNewtonState.at(params_of(truth)), iterations=1, light=views))[-1]


def fit_of(count=1, **change) -> FitQuality:
    residuals, pixels, each = np.full((2, count), 0.01), np.full((2, count), 50.0), np.ones(count)
    return replace(FitQuality(residuals, pixels, 0.1 * each, 0.3 * each, each, 0.01, 1e-5), **change)


def params(count=1) -> SceneParameters:
    light = np.array([0, 0, 1.0])
    names = tuple(f"object{n}" for n in range(count))
    return SceneParameters(names, np.zeros((count, 3)), np.tile([1.0, 0, 0, 0], (count, 1)), light, None)


def normals(count=1, scale=1e6):
    return [scale * np.eye(POSE)] * count + [scale * np.eye(LIGHT)]


def test_a_right_guess_is_trusted(models, views, end):
    fit = evaluate_fit(models, views, end.params)
    estimate = estimate_with_uncertainty(end.params, end.normals, fit, {0: 3.0, 1: 2.0})
    assert estimate.trusted
    assert estimate.position_std.max() < 0.003
    assert estimate.rotation_std.max() < np.deg2rad(2)
    assert 0 < estimate.light_std < np.deg2rad(3)
    np.testing.assert_allclose(estimate.state.poses.position, end.params.positions, atol=1e-12)


def test_a_wrong_guess_is_doubted(models, views, end):
    for number, change in ((0, 0.06), (2, -1.0), (2, 40.0), (3, np.pi), (5, np.pi)):
        wrong = end.params.updated(change * np.eye(end.params.size)[number])
        estimate = estimate_with_uncertainty(wrong, end.normals, evaluate_fit(models, views, wrong), {})
        assert BOX in estimate.doubted
        assert estimate.reason.startswith(f"{BOX}: ")
    dark = end.params.updated(np.array([*[0.0] * (2 * POSE), 1.5, 0.8]))
    assert not estimate_with_uncertainty(dark, end.normals, evaluate_fit(models, views, dark), {}).trusted


def test_fit_of_the_truth_is_perfect_and_evidence_is_of_each_objects_pixels(models, truth):
    own = own_views(models, params_of(truth), default_cameras(48)[:2], FINE)
    fit = evaluate_fit(models, own, params_of(truth))
    np.testing.assert_array_equal(fit.residuals, 0)
    np.testing.assert_allclose(fit.overlap, 1, atol=1e-12)
    np.testing.assert_allclose(fit.pixels, own.masks.sum(axis=(2, 3)), rtol=1e-5)
    assert fit.surroundings == fit.spread == 0
    assert evaluate_fit(models, replace(own, masks=None), params_of(truth)).overlap.tolist() == [1, 1]
    masks, unmasked = own.masks.copy(), np.zeros(own.masks.shape[:2], bool)
    masks[0, 1], unmasked[0, 1] = 0, True
    hidden, undrawn = replace(own, masks=masks), replace(own, masks=masks, unmasked=unmasked)
    assert evaluate_fit(models, hidden, params_of(truth)).overlap[1] < 0.95
    np.testing.assert_allclose(evaluate_fit(models, undrawn, params_of(truth)).overlap, 1, atol=1e-12)
    darker = own.images.copy()
    darker[1][own.masks[1, 0] > 0] -= np.float32(0.2)  # the box, in one view
    fit = evaluate_fit(models, replace(own, images=darker), params_of(truth))
    assert fit.residuals[1, 0] == pytest.approx(0.2, rel=1e-3)
    np.testing.assert_allclose(fit.residuals[0], 0, atol=1e-6)
    assert fit.residuals[1, 1] < 0.03  # which it touches in the image at most
    share = fit.pixels[1, 0] / fit.pixels[:, 0].sum()
    assert object_residuals(fit)[0] == pytest.approx(0.2 * np.sqrt(share), rel=1e-3)
    assert fit.surroundings < 0.05


def doubted(fit, rivals=None, scale=1e6, **more) -> bool:
    """Whether an object, alone in the scene, is doubted."""
    return not estimate_with_uncertainty(params(), normals(1, scale), fit, rivals or {}, **more).trusted


def test_every_reason_to_doubt_is_enough_and_is_written_down():
    assert not doubted(fit_of())
    assert doubted(fit_of(pixels=np.full((2, 1), 3.0)))
    assert doubted(fit_of(overlap=np.array([0.6])))
    assert doubted(fit_of(residuals=np.full((2, 1), 0.1)))
    assert doubted(fit_of(), {0: 1.01})  # another orientation is as good
    assert doubted(fit_of(), scale=1.0)  # its pose is hardly known
    for height, is_doubted in ((0.001, False), (0.02, True), (-0.01, True)):
        assert doubted(fit_of(), lowest=np.array([height])) == is_doubted
    fit = fit_of(residuals=np.full((2, 1), 0.06))
    for allowed, is_doubted in ((None, True), (np.array([0.05]), True), (np.array([0.07]), False)):
        assert doubted(fit, allowed=allowed) == is_doubted
    three = estimate_with_uncertainty(params(3), normals(3), fit_of(3, overlap=np.array([0.1, 1.0, 0.2])), {1: 9.0})
    assert three.reason == f"object0: {three.doubts[0]}; object2: {three.doubts[2]}"


@pytest.mark.parametrize(
    ("rival", "residual", "is_doubted"),
    [(20.0, 0.08, False), (20.0, 0.1, True), (5.0, 0.08, True), (np.inf, 0.08, True), (20.0, 0.03, False)],
)
def test_a_field_that_errs_is_no_doubt_where_every_other_orientation_is_far_worse(rival, residual, is_doubted):
    """At a level of 0.3 a residual up to 0.09 is forgiven; without other orientations nothing speaks for this one."""
    assert doubted(fit_of(residuals=np.full((2, 1), residual)), {0: rival}) == is_doubted


def test_deviations_are_those_of_least_squares():
    """They grow with the error of a pixel, and shrink with the root of the curvature."""
    first = estimate_with_uncertainty(params(), normals(), fit_of(), {})
    noisier = estimate_with_uncertainty(params(), normals(), fit_of(spread=4e-5), {})
    sharper = estimate_with_uncertainty(params(), normals(1, 1e8), fit_of(), {})
    for name in ("position_std", "rotation_std", "light_std"):
        here = getattr(first, name)
        np.testing.assert_allclose(getattr(noisier, name), 2 * here, rtol=1e-3)
        np.testing.assert_allclose(getattr(sharper, name), here / 10, rtol=1e-3)
    assert first.position_std[0] == pytest.approx(15 * 1e-3 * 1e-5**0.5, rel=1e-2)


def test_a_grainy_table_says_little_of_how_well_an_object_is_known():
    """Up to a share of the object's own squared residual its surroundings count, beyond that no more."""
    own = object_residuals(fit_of())[0] ** 2
    every = [
        estimate_with_uncertainty(params(), normals(), fit_of(spread=share * own), {}) for share in (0.1, 0.5, 5, 50)
    ]
    deviations = np.array([(e.position_std[0], e.rotation_std[0]) for e in every])
    np.testing.assert_allclose(deviations[0], np.sqrt(0.1 / 0.5) * deviations[1], atol=1e-12)
    np.testing.assert_allclose(deviations[2:], deviations[[1, 1]], atol=1e-12)
    np.testing.assert_allclose([e.light_std for e in every], every[0].light_std * np.sqrt([1, 5, 50, 500]))


def test_what_nothing_constrains_is_not_known():
    nothing = [np.zeros((POSE, POSE)), np.zeros((LIGHT, LIGHT))]
    estimate = estimate_with_uncertainty(params(), nothing, fit_of(), {})
    assert estimate.position_std[0] > 0.1
    assert not estimate.trusted
    assert estimate.light_std > 0.1
    assert estimate_with_uncertainty(params(), nothing, fit_of(), {}, light_held=True).light_std == 0
    flat = np.diag([1e6, 1e6, 0, 0, 0, 1e6])  # an object that was slid over the table only
    partly = estimate_with_uncertainty(params(), [flat, nothing[1]], fit_of(), {})
    assert np.isfinite(partly.position_std[0])
    assert partly.position_std[0] > estimate_with_uncertainty(params(), normals(), fit_of(), {}).position_std[0]


def test_contrast_and_level_are_of_what_an_object_shows(models, views, truth):
    """Twice the radiance has twice of both; more light everywhere leaves the contrast; grey has none."""
    plain, twice, shifted, grey = (
        evaluate_fit(models, replace(views, images=images), params_of(truth))
        for images in (views.images, 2 * views.images, views.images + np.float32(0.1), np.full_like(views.images, 0.3))
    )
    np.testing.assert_allclose(twice.contrast, 2 * plain.contrast, rtol=1e-4)
    np.testing.assert_allclose(twice.level, 2 * plain.level, rtol=1e-5)
    np.testing.assert_allclose(shifted.contrast, plain.contrast, rtol=1e-3)
    np.testing.assert_allclose(grey.level, 0.3, rtol=1e-5)
    np.testing.assert_allclose(grey.contrast, 0, atol=1e-3)


def test_what_is_usual_is_allowed_up_to_a_bound():
    """Fields err a little everywhere; but nothing is believed where everything is off."""
    allowed = allowed_residuals(np.array([0.0, 0.04, 0.1, 0.5]))
    np.testing.assert_allclose(allowed, [0.0, 0.05, 0.125, 0.125], atol=1e-12)
    goal = goal_allowance(fit_of(4, level=np.array([0.5, 0.1, 0.3, 0.3])), np.array([0.0, 0.0, 2.0, np.nan]))
    np.testing.assert_allclose(goal, [0.04, 0.02, 0.18, 0.04], atol=1e-12)


def test_a_goal_may_be_brighter_or_dimmer_than_the_scene():
    """What is off by the same share in another light is nothing new, however much that is in radiance."""
    usual = relative_residuals(fit_of(residuals=np.full((2, 1), 0.03)))
    np.testing.assert_allclose(usual, 0.1, atol=1e-12)
    for brighter in (0.5, 1.0, 3.0):
        for times, is_misfit in ((1.9, False), (2.1, True)):
            fit = fit_of(residuals=np.full((2, 1), 0.03 * brighter * times), level=np.array([0.3 * brighter]))
            assert misfits(fit, goal_allowance(fit, usual)) == [0] * is_misfit
