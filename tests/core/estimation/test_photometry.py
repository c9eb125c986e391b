"""Pictures whose making is known: rendered by models that were changed by an image model."""

from dataclasses import replace

import numpy as np
import pytest

from osfcore.estimation.camera_response import ImageModel
from osfcore.estimation.objective import views_of
from osfcore.estimation.photometry import Calibrator, adapted, check_table
from osfcore.geometry.cameras import default_cameras
from tests.support.posed_scenes import BOTTLE, BOX, NAMES, lying, observe, params_of, scene

CAMERAS = default_cameras(64)[2:]  # on the other side than the lamp: they see shadows
MODEL = ImageModel(np.array([0.7, 0.75, 0.8]), 2.0, np.array([0.5, 0.7, 0.9]))


@pytest.fixture(scope="module")
def truth(models):
    """Under a low lamp, so that shadows are long."""
    poses = {BOX: lying(models, BOX, 30, 0.05, -0.08), BOTTLE: lying(models, BOTTLE, 50, -0.06, 0.09)}
    return scene(poses, (0.6, 0.5, 0.45))


def taken(models, state, model):
    """What cameras see under an image model: `normalized` undone on what `adapted` models show."""
    shown = observe(adapted(models, NAMES, model), state, CAMERAS)
    return replace(shown, images=shown.images * (model.gain / model.scale))


@pytest.fixture(scope="module")
def pictures(models, truth):
    return taken(models, truth, MODEL)


def test_image_model_and_lamp_are_found_from_the_poses(models, truth, pictures):
    elsewhere = params_of(scene({name: truth.pose(name) for name in NAMES}, (-0.7, 0.1, 0.7)))
    found = Calibrator(models, NAMES).search(views_of(pictures, 32), views_of(pictures, 64), elsewhere)
    assert np.rad2deg(np.arccos(found.light @ truth.light.direction)) < 5
    np.testing.assert_allclose(found.model.gain, MODEL.gain, rtol=0.2)
    np.testing.assert_allclose(found.model.table, MODEL.table, rtol=0.1)
    assert found.model.ambient == pytest.approx(MODEL.ambient, rel=0.2)


def test_refining_with_the_light_held_leaves_it_and_comes_nearer(models, truth, pictures):
    found = Calibrator(models, NAMES).refine(views_of(pictures, 64, samples=2), params_of(truth), 1.7, hold_light=True)
    np.testing.assert_array_equal(found.light, truth.light.direction)
    assert found.model.ambient == pytest.approx(MODEL.ambient, rel=0.06)
    np.testing.assert_allclose(found.model.gain, MODEL.gain, rtol=0.06)
    assert found.unexplained < 0.1
    shifted = replace(params_of(truth), positions=params_of(truth).positions + [0.05, 0.0, 0.0])
    wrong = Calibrator(models, NAMES).refine(views_of(pictures, 64, samples=2), shifted, 1.7, hold_light=True)
    assert wrong.unexplained > 1.5 * found.unexplained


def test_what_lies_beyond_the_table_is_measured_and_changes_nothing_else(models, truth, pictures):
    """No lamp lights it: a wall that stays as bright in half the light says nothing of the exposure."""
    wall = np.array([0.1, 0.3, 0.2])
    beside_a_wall = taken(models, truth, replace(MODEL, surroundings=wall))
    calibrator = Calibrator(models, NAMES)
    plain, walled = (
        calibrator.refine(views_of(seen, 64), params_of(truth), MODEL.ambient, hold_light=True)
        for seen in (pictures, beside_a_wall)
    )
    np.testing.assert_allclose(walled.model.surroundings, wall, rtol=1e-4)
    np.testing.assert_allclose(walled.model.gain, plain.model.gain, rtol=1e-3)
    assert walled.model.ambient == plain.model.ambient


def test_a_lit_table_that_is_brighter_than_all_else_is_not_taken_for_saturated(models, truth):
    bright = ImageModel(np.full(3, 0.3), 1.0, np.full(3, 2.0))
    high = scene({name: truth.pose(name) for name in NAMES}, (0.3, 0.3, 0.9))
    views = views_of(taken(models, high, bright), 64, samples=2)
    right = params_of(high)
    near = replace(right, positions=right.positions + [0.004, -0.004, 0.0])
    found = Calibrator(models, NAMES).refine(views, near, 1.0, hold_light=True)
    np.testing.assert_allclose(found.model.table, bright.table, rtol=0.05)
    assert found.model.ambient == pytest.approx(bright.ambient, rel=0.1)


@pytest.mark.parametrize("change", [*({"gain": np.full(3, g)} for g in (0.7, 1.4)), {"ambient": 0.4}, {"ambient": 3.0},
                                    *({"table": np.array(t)} for t in ((0.5, 0.7, 1), (0.3, 0.3, 0.3)))])  # fmt: skip
def test_pictures_of_another_exposure_ambient_light_or_table_are_noticed(models, truth, change):
    model = replace(ImageModel(np.ones(3), 1.0, np.ones(3)), **change)
    assert check_table(models, views_of(taken(models, truth, model), 64)) != "usual"


def test_usual_pictures_are_usual_in_spite_of_noise_and_without_a_shadow_only_colours_count(models, truth):
    usual, empty = observe(models, truth, CAMERAS), observe(models, scene({}), CAMERAS)
    noise = 0.02 * np.random.default_rng(0).standard_normal(usual.images.shape)
    for shown, change, verdict in (
        (usual, lambda images: images, "usual"),
        (usual, lambda images: np.clip(images + noise, 0, 1), "usual"),
        (empty, lambda images: images, "unclear"),
        (empty, lambda images: 0.8 * images, "unclear"),
        (empty, lambda images: images * [1.0, 0.8, 0.7], "other"),
    ):
        changed = replace(shown, images=change(shown.images))
        assert check_table(models, views_of(changed, 64)) == verdict
