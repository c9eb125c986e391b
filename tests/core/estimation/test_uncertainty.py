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
from tests.core.estimation.scenes import BOX, own_views, params_of

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
    estimate = estimate_with_uncertainty(
        end.params, end.normals, evaluate_fit(models, views, end.params), {0: 3.0, 1: 2.0}
    )
    assert estimate.trusted
    assert estimate.doubts == ("", "")
    assert estimate.position_std.max() < 0.003
    assert estimate.rotation_std.max() < np.deg2rad(2)
    assert 0 < estimate.light_std < np.deg2rad(3)
    np.testing.assert_allclose(estimate.state.poses.position, end.params.positions, atol=1e-12)


@pytest.mark.parametrize(
    ("change", "words"),
    [
        ([0.06, 0, 0, 0, 0, 0], "silhouette covers its masks"),
        ([0, 0, 0, 0, 0, np.pi], "differ from what was rendered"),
        ([0, 0, 0, np.pi, 0, 0], "differ from what was rendered"),
        ([0, 0, -1.0, 0, 0, 0], "hardly visible"),
        ([0, 0, 40.0, 0, 0, 0], "hardly visible"),
    ],
)
def test_a_wrong_guess_is_doubted(models, views, end, change, words):
    wrong = end.params.updated(np.array([*change, *[0.0] * (POSE + LIGHT)]))
    estimate = estimate_with_uncertainty(wrong, end.normals, evaluate_fit(models, views, wrong), {})
    assert words in estimate.doubts[0]
    assert not estimate.trusted
    assert estimate.reason.startswith(f"{BOX}: ")


def test_a_wrong_light_is_doubted(models, truth, views, end):
    wrong = end.params.updated(np.array([*[0.0] * (2 * POSE), 1.5, 0.8]))
    assert not estimate_with_uncertainty(wrong, end.normals, evaluate_fit(models, views, wrong), {}).trusted


def test_fit_of_the_truth_is_perfect(models, truth):
    own = own_views(models, params_of(truth), default_cameras(48)[:2], FINE)
    fit = evaluate_fit(models, own, params_of(truth))
    np.testing.assert_array_equal(fit.residuals, 0)
    np.testing.assert_allclose(fit.overlap, 1, atol=1e-12)
    np.testing.assert_allclose(fit.pixels, own.masks.sum(axis=(2, 3)), rtol=1e-5)
    assert fit.surroundings == fit.spread == 0
    assert evaluate_fit(models, replace(own, masks=None), params_of(truth)).overlap.tolist() == [1, 1]


def test_evidence_is_of_each_objects_pixels(models, truth):
    own = own_views(models, params_of(truth), default_cameras(48)[:2], FINE)
    darker = own.images.copy()
    darker[1][own.masks[1, 0] > 0] -= np.float32(0.2)  # the box, in one view
    fit = evaluate_fit(models, replace(own, images=darker), params_of(truth))
    assert fit.residuals[1, 0] == pytest.approx(0.2, rel=1e-3)
    np.testing.assert_allclose(fit.residuals[0], 0, atol=1e-6)
    assert fit.residuals[1, 1] < 0.03  # which it touches in the image at most
    share = fit.pixels[1, 0] / fit.pixels[:, 0].sum()
    assert object_residuals(fit)[0] == pytest.approx(0.2 * np.sqrt(share), rel=1e-3)
    assert fit.surroundings < 0.05


def test_an_empty_scene_has_fit_of_the_table_alone(models):
    nothing = params(0)
    own = own_views(models, nothing, default_cameras(48)[:1])
    fit = evaluate_fit(models, replace(own, images=own.images + np.float32(0.1)), nothing)
    assert fit.surroundings == pytest.approx(0.1, rel=1e-4)
    estimate = estimate_with_uncertainty(nothing, normals(0), fit, {})
    assert estimate.trusted
    assert estimate.position_std.shape == (0,)


def test_each_doubt_is_told():
    few = {"pixels": np.full((2, 1), 3.0)}
    cases = {
        "": ({}, {}, 1e6),
        "it is hardly visible": (few, {}, 1e6),
        "its silhouette covers its masks by 60% only": ({"overlap": np.array([0.6])}, {}, 1e6),
        "its images differ from what was rendered by 0.10": ({"residuals": np.full((2, 1), 0.1)}, {}, 1e6),
        "another orientation explains the images as well": ({}, {0: 1.01}, 1e6),
        "its pose is known to 47 mm and 2 deg only": ({}, {}, 1.0),
    }
    for words, (change, rivals, scale) in cases.items():
        estimate = estimate_with_uncertainty(params(), normals(1, scale), fit_of(**change), rivals)
        assert estimate.doubts == (words,)
        assert estimate.reason == (f"object0: {words}" if words else "")


def test_what_cannot_stand_there_is_doubted_where_that_matters():
    words = {0.001: "", 0.02: "it would float above the table by 20 mm", -0.01: "it would sink into the table by 10 mm"}
    for height, doubt in words.items():
        assert estimate_with_uncertainty(params(), normals(), fit_of(), {}, lowest=np.array([height])).doubts == (
            doubt,
        )
    assert estimate_with_uncertainty(params(), normals(), fit_of(), {}).trusted


def test_all_doubts_make_the_reason():
    estimate = estimate_with_uncertainty(params(3), normals(3), fit_of(3, overlap=np.array([0.1, 1.0, 0.2])), {1: 9.0})
    assert estimate.doubts[1] == ""
    assert estimate.reason == f"object0: {estimate.doubts[0]}; object2: {estimate.doubts[2]}"


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
    told = [
        estimate_with_uncertainty(params(), normals(), fit_of(spread=share * own), {}) for share in (0.1, 0.5, 5, 50)
    ]
    deviations = np.array([(e.position_std[0], e.rotation_std[0]) for e in told])
    np.testing.assert_allclose(deviations[0], np.sqrt(0.1 / 0.5) * deviations[1], atol=1e-12)
    np.testing.assert_allclose(deviations[2:], deviations[[1, 1]], atol=1e-12)
    np.testing.assert_allclose([e.light_std for e in told], told[0].light_std * np.sqrt([1, 5, 50, 500]))


def test_what_nothing_tells_about_is_not_known():
    nothing = [np.zeros((POSE, POSE)), np.zeros((LIGHT, LIGHT))]
    estimate = estimate_with_uncertainty(params(), nothing, fit_of(), {})
    assert estimate.position_std[0] > 0.1
    assert "its pose is known to" in estimate.doubts[0]
    assert estimate.light_std > 0.1
    assert estimate_with_uncertainty(params(), nothing, fit_of(), {}, light_held=True).light_std == 0
    flat = np.diag([1e6, 1e6, 0, 0, 0, 1e6])  # an object that was slid over the table only
    partly = estimate_with_uncertainty(params(), [flat, nothing[1]], fit_of(), {})
    assert np.isfinite(partly.position_std[0])
    assert partly.position_std[0] > estimate_with_uncertainty(params(), normals(), fit_of(), {}).position_std[0]


def test_contrast_is_the_spread_of_what_an_object_shows(models, views, truth):
    """Twice the radiance has twice of it; more light everywhere leaves it as it is."""
    plain, twice, shifted = (
        evaluate_fit(models, replace(views, images=images), params_of(truth)).contrast
        for images in (views.images, 2 * views.images, views.images + np.float32(0.1))
    )
    np.testing.assert_allclose(twice, 2 * plain, rtol=1e-4)
    np.testing.assert_allclose(shifted, plain, rtol=1e-3)


@pytest.mark.parametrize(("allowed", "is_doubted"), [(None, True), (np.array([0.05]), True), (np.array([0.07]), False)])
def test_residuals_that_are_allowed_are_not_doubted(allowed, is_doubted):
    fit = fit_of(residuals=np.full((2, 1), 0.06))
    estimate = estimate_with_uncertainty(params(), normals(), fit, {}, allowed=allowed)
    assert bool(estimate.doubted) == is_doubted


def test_what_is_usual_is_allowed_up_to_a_bound():
    np.testing.assert_allclose(
        allowed_residuals(np.array([0.0, 0.04, 0.1, 0.5])), [0.0, 0.05, 0.125, 0.125], atol=1e-12
    )


def test_the_level_is_of_what_an_object_shows(models, views, truth):
    plain, twice = (
        evaluate_fit(models, replace(views, images=images), params_of(truth)).level
        for images in (views.images, 2 * views.images)
    )
    np.testing.assert_allclose(twice, 2 * plain, rtol=1e-5)
    grey = evaluate_fit(models, replace(views, images=np.full_like(views.images, 0.3)), params_of(truth))
    np.testing.assert_allclose(grey.level, 0.3, rtol=1e-5)
    np.testing.assert_allclose(grey.contrast, 0, atol=1e-3)


def test_a_goal_may_be_brighter_or_dimmer_than_the_scene():
    """What is off by the same share in another light is nothing new, however much that is in radiance."""
    usual = relative_residuals(fit_of(residuals=np.full((2, 1), 0.03)))
    np.testing.assert_allclose(usual, 0.1, atol=1e-12)
    for brighter in (0.5, 1.0, 3.0):
        for times, is_misfit in ((1.9, False), (2.1, True)):
            fit = fit_of(residuals=np.full((2, 1), 0.03 * brighter * times), level=np.array([0.3 * brighter]))
            assert misfits(fit, goal_allowance(fit, usual)) == [0] * is_misfit


def test_a_goal_is_not_doubted_for_what_all_fields_err_by_nor_believed_where_everything_is_off():
    fit = fit_of(4, level=np.array([0.5, 0.1, 0.3, 0.3]))
    np.testing.assert_allclose(
        goal_allowance(fit, np.array([0.0, 0.0, 2.0, np.nan])), [0.04, 0.02, 0.18, 0.04], atol=1e-12
    )


@pytest.mark.parametrize(
    ("rival", "residual", "is_doubted"),
    [(20.0, 0.08, False), (20.0, 0.1, True), (5.0, 0.08, True), (np.inf, 0.08, True), (20.0, 0.03, False)],
)
def test_a_field_that_errs_is_no_doubt_where_every_other_orientation_is_far_worse(rival, residual, is_doubted):
    """At a level of 0.3 a residual up to 0.09 is forgiven; without other orientations nothing speaks for this one."""
    fit = fit_of(residuals=np.full((2, 1), residual))
    assert bool(estimate_with_uncertainty(params(), normals(), fit, {0: rival}).doubted) == is_doubted
