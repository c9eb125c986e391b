"""First frames of pictures whose exposure, response, ambient light and table nobody tells."""

from dataclasses import replace

import numpy as np
import pytest

from osfcore.control.first_frame import estimate_first
from osfcore.errors import InvalidInput
from osfcore.estimation.camera_response import ImageModel, srgb_of_linear
from osfcore.estimation.first_frame import FirstFrameConfig
from osfcore.estimation.first_frame import estimate_first as estimate_usual
from osfcore.estimation.objective import views_of
from osfcore.estimation.photometry import adapted
from osfcore.estimation.search import check_table
from osfcore.geometry.cameras import default_cameras
from osfcore.geometry.light import Light
from tests.core.estimation.scenes import BOTTLE, BOX, NAMES, apart, lying, observe, scene, shipped_models

BRICK = "061_foam_brick"
QUICK = FirstFrameConfig(2, 6, 2, 8, 2, 3, 2)
OTHER = ImageModel(np.array([0.75, 0.75, 0.75]), 1.8, np.array([0.5, 0.7, 0.9]))


@pytest.fixture(scope="module")
def models():
    return shipped_models()


@pytest.fixture(scope="module")
def truth(models):
    return scene({BOX: lying(models, BOX, 30, 0.05, -0.08), BOTTLE: lying(models, BOTTLE, 50, -0.06, 0.09)})


def steps_of(estimate, models, seen, config=QUICK):
    return list(estimate(models, seen, np.random.default_rng(0), config))


@pytest.mark.slow
def test_usual_pictures_are_estimated_as_ever_to_the_last_bit(models, truth):
    seen = observe(models, truth, default_cameras(48)[2:])
    ours, usual = (steps_of(estimate, models, seen)[-1].estimate for estimate in (estimate_first, estimate_usual))
    np.testing.assert_array_equal(ours.state.poses.position, usual.state.poses.position)
    np.testing.assert_array_equal(ours.state.light.direction, usual.state.light.direction)
    np.testing.assert_array_equal(ours.position_std, usual.position_std)


@pytest.mark.slow
def test_usual_pictures_have_no_image_model_of_their_own(models, truth):
    assert steps_of(estimate_first, models, observe(models, truth, default_cameras(48)[2:]))[-1].image_model is None


@pytest.mark.slow
def test_usual_pictures_of_one_plain_object_under_a_high_lamp_are_taken_for_usual():
    """No full shadow is seen, and a fit of exposure, ambient light and table explains the lamp in another way."""
    light, models = Light.from_angles(*np.deg2rad([-60, 72])).direction, shipped_models((BRICK,))
    alone = scene({BRICK: lying(models, BRICK, 30, 0.05, -0.08)}, light)
    seen = observe(models, alone, default_cameras(128))
    assert check_table(models, views_of(seen, 128)).verdict == "unclear"
    last = steps_of(estimate_first, models, seen, FirstFrameConfig())[-1]
    assert last.image_model is None
    assert np.rad2deg(last.estimate.state.light.angle_to(alone.light)) < 4
    assert last.estimate.trusted


@pytest.mark.slow
def test_poses_and_light_of_an_srgb_picture_of_another_table_at_another_exposure(models, truth):
    shown = observe(adapted(models, NAMES, OTHER), truth, default_cameras(96)[1:])
    linear = np.clip(shown.images * (OTHER.gain / OTHER.scale), 0, 1)
    steps = steps_of(estimate_first, models, replace(shown, images=srgb_of_linear(linear)))
    estimate = steps[-1].estimate
    shift, turn, light = apart(estimate.state, truth)
    assert shift.max() < 0.005
    assert np.rad2deg(turn).max() < 5
    assert np.rad2deg(light) < 5
    assert estimate.trusted, estimate.reason
    found = steps[-1].image_model
    assert found.encoding == "srgb"
    np.testing.assert_allclose([*found.gain, found.ambient], [*OTHER.gain, OTHER.ambient], rtol=0.15)
    done = [step.progress.done for step in steps]
    assert done == sorted(set(done))
    assert {step.progress.total for step in steps} == {done[-1]}
    assert [step.estimate is None for step in steps] == [True] * (len(steps) - 1) + [False]


@pytest.mark.slow
@pytest.mark.parametrize("wall", [0.05, 0.25, 0.6])
def test_half_of_the_light_is_no_srgb_whatever_lies_beyond_the_table(models, truth, wall):
    dim = ImageModel(np.full(3, 0.5), 1.0, np.ones(3), surroundings=np.full(3, wall))
    shown = observe(adapted(models, NAMES, dim), truth, default_cameras(96)[1:])
    last = steps_of(estimate_first, models, replace(shown, images=shown.images * 0.5))[-1]
    assert last.image_model.encoding == "linear"
    np.testing.assert_allclose(last.image_model.gain, 0.5, rtol=0.1)
    assert np.rad2deg(apart(last.estimate.state, truth)[2]) < 2


@pytest.mark.slow
def test_black_pictures_are_not_trusted(models, truth):
    seen = observe(models, truth, default_cameras(48)[2:])
    last = steps_of(estimate_first, models, replace(seen, images=np.zeros_like(seen.images)))[-1]
    assert not last.estimate.trusted


def test_masks_are_needed(models, truth):
    seen = observe(models, truth, default_cameras(48)[:1], masks=False)
    with pytest.raises(InvalidInput, match="masks of the first frame"):
        next(estimate_first(models, seen, np.random.default_rng(0)))
