from dataclasses import replace

import numpy as np
import pytest

from osfcore.errors import InvalidInput, UnknownName
from osfcore.estimation.camera_response import ImageModel, srgb_of_linear
from osfcore.estimation.first_frame import FirstFrameConfig, estimate_first, estimate_first_calibrated
from osfcore.estimation.objective import views_of
from osfcore.estimation.photometry import adapted, check_table
from osfcore.geometry.cameras import default_cameras
from osfcore.geometry.light import Light
from tests.support.errors import about
from tests.support.posed_scenes import BOTTLE, BOX, NAMES, angle, apart, lying, observe, scene, shipped_models

QUICK = FirstFrameConfig(2, 6, 2, 8, 2, 3, 2)
LEAST = replace(QUICK, starts=1, coarse_iterations=1, fine_iterations=1)
STAGES = ("orientations", "light", "orientations", "objects", "together", "polish", "done")
OTHER = ImageModel(np.full(3, 0.75), 1.8, np.array([0.5, 0.7, 0.9]))


def steps_of(models, seen, effort=QUICK, estimate=estimate_first_calibrated):
    steps = list(estimate(models, seen, np.random.default_rng(0), effort))
    done = [step.progress.done for step in steps]
    assert np.all(np.diff(done) > 0)
    assert {step.progress.total for step in steps} == {done[-1]}
    assert [step.estimate is None for step in steps] == [True] * (len(steps) - 1) + [False]
    return steps


@pytest.fixture(scope="module")
def small(models, truth):
    return observe(models, truth, default_cameras(64)[:2])


def check_found(estimate, truth):
    shift, turn, light = apart(estimate.state, truth)
    assert shift.max() < 0.005
    assert np.rad2deg(turn).max() < 5
    assert np.rad2deg(light) < 5
    assert estimate.trusted, estimate.reason


def test_poses_and_light_are_found_in_the_stages_of_the_method(models, seen, truth):
    steps = steps_of(models, seen)
    check_found(steps[-1].estimate, truth)
    stages = [step.stage for step in steps]
    assert tuple(s for k, s in enumerate(stages) if k == 0 or stages[k - 1] != s) == STAGES
    objects = next(step for step in steps if step.stage == "objects")
    assert objects.candidates.position.shape == (12, 2, 3)
    together = next(step for step in steps if step.stage == "together")
    assert together.candidates.quaternion.shape == (9, 2, 4)
    assert together.lights.shape == (9, 3)
    assert np.isfinite(together.loss)


def test_the_same_seed_gives_the_same_estimate_and_leaves_numpys_global_generator_alone(models, truth):
    seen = observe(models, scene({BOX: truth.pose(BOX)}), default_cameras(48)[:1])
    before = np.random.get_state()[1].copy()  # noqa: NPY002
    steps, again = steps_of(models, seen, LEAST), steps_of(models, seen, LEAST)
    for a, b in zip(steps, again, strict=True):
        np.testing.assert_array_equal(a.state.poses.position, b.state.poses.position)
        np.testing.assert_array_equal(a.state.light.direction, b.state.light.direction)
    np.testing.assert_array_equal(again[-1].estimate.position_std, steps[-1].estimate.position_std)
    np.testing.assert_array_equal(np.random.get_state()[1], before)  # noqa: NPY002


@pytest.mark.slow
def test_one_view_and_the_pusher_in_it(models):
    state = scene({BOX: lying(models, BOX, 30, 0.0, -0.03)}, (-0.4, 0.2, 0.8), np.array([0.0, 0.12, 0.062]))
    last = steps_of(models, observe(models, state, default_cameras(96)[:1]))[-1]
    shift, turn, light = apart(last.estimate.state, state)
    assert shift[0] < 0.01
    assert np.rad2deg(turn[0]) < 5
    assert np.rad2deg(light) < 5
    np.testing.assert_array_equal(last.estimate.state.pusher, state.pusher)


@pytest.mark.slow
def test_a_light_held_overhead_stays_there(models):
    state = scene({BOX: lying(models, BOX, 30, 0.0, -0.03)}, (0, 0, 1.0))
    seen = observe(models, state, default_cameras(64)[:2])
    steps = steps_of(models, seen, replace(QUICK, held_light=(0.0, 0.0, 1.0)))
    for step in steps:
        np.testing.assert_allclose(step.state.light.direction, [0, 0, 1], atol=1e-12)
    assert steps[-1].estimate.light_std == 0
    assert apart(steps[-1].estimate.state, state)[0][0] < 0.005


@pytest.mark.slow
def test_cma_alone_moves_the_light(models, small, truth):
    steps = steps_of(models, small, replace(LEAST, light="cma", joint_generations=4))
    assert "light" not in [step.stage for step in steps]
    before = angle(np.array([0, 0, 1.0]), truth.light.direction)
    assert angle(steps[-1].estimate.state.light.direction, truth.light.direction) < before


def test_an_empty_scene_has_only_its_light(models):
    state = scene({}, (0.5, 0.3, 0.8))
    last = steps_of(models, observe(models, state, default_cameras(48)[:1]))[-1]
    assert last.estimate.trusted
    assert last.estimate.state.names == ()
    found = last.estimate.state.light.direction  # of which the table shows the elevation alone
    assert abs(found[2] - state.light.direction[2]) < 0.05


@pytest.mark.parametrize("estimate", [estimate_first, estimate_first_calibrated])
def test_an_observation_that_does_not_show_where_each_known_object_is_is_refused(models, seen, estimate):
    hidden = seen.masks.copy()
    hidden[:, 1] = False
    for wrong, kind, subject in (
        (replace(seen, masks=None), InvalidInput, "masks"),
        (replace(seen, masks=hidden), InvalidInput, BOTTLE),
        (replace(seen, names=(BOX, "025_mug")), UnknownName, "025_mug"),
    ):
        with pytest.raises(kind, check=about(subject)):
            next(estimate(models, wrong, np.random.default_rng(0)))


@pytest.mark.slow
def test_a_mask_of_one_pixel_is_an_estimate_not_to_be_trusted(models, small):
    masks = small.masks.copy()
    row, column = np.argwhere(masks[0, 1])[0]
    masks[:, 1] = False
    masks[0, 1, row, column] = True
    assert not steps_of(models, replace(small, masks=masks), LEAST)[-1].estimate.trusted


# Pictures of unknown exposure, encoding, ambient light and table.


@pytest.mark.slow
def test_usual_pictures_are_estimated_as_ever_to_the_last_bit(models, truth):
    seen = observe(models, truth, default_cameras(48)[2:])
    ours, usual = (steps_of(models, seen, LEAST, how)[-1] for how in (estimate_first, estimate_first_calibrated))
    assert ours.image_model is None
    np.testing.assert_array_equal(ours.estimate.state.poses.position, usual.estimate.state.poses.position)
    np.testing.assert_array_equal(ours.estimate.state.light.direction, usual.estimate.state.light.direction)
    np.testing.assert_array_equal(ours.estimate.position_std, usual.estimate.position_std)


@pytest.mark.slow
def test_usual_pictures_of_one_plain_object_under_a_high_lamp_are_taken_for_usual():
    """No full shadow is seen, and a fit of exposure, ambient light and table explains the lamp in another way."""
    brick, light = "061_foam_brick", Light.from_angles(*np.deg2rad([-60, 72])).direction
    models = shipped_models((brick,))
    alone = scene({brick: lying(models, brick, 30, 0.05, -0.08)}, light)
    seen = observe(models, alone, default_cameras(128))
    assert check_table(models, views_of(seen, 128)) == "unclear"
    last = steps_of(models, seen, FirstFrameConfig(), estimate_first)[-1]
    assert last.image_model is None
    assert np.rad2deg(last.estimate.state.light.angle_to(alone.light)) < 4
    assert last.estimate.trusted


@pytest.mark.slow
def test_poses_and_light_of_an_srgb_picture_of_another_table_at_another_exposure(models, truth):
    shown = observe(adapted(models, NAMES, OTHER), truth, default_cameras(96)[1:])
    linear = np.clip(shown.images * (OTHER.gain / OTHER.scale), 0, 1)
    last = steps_of(models, replace(shown, images=srgb_of_linear(linear)), QUICK, estimate_first)[-1]
    check_found(last.estimate, truth)
    found = last.image_model
    assert found.encoding == "srgb"
    np.testing.assert_allclose([*found.gain, found.ambient], [*OTHER.gain, OTHER.ambient], rtol=0.15)


@pytest.mark.slow
@pytest.mark.parametrize("wall", [0.05, 0.6])
def test_half_of_the_light_is_no_srgb_whatever_lies_beyond_the_table(models, truth, wall):
    dim = ImageModel(np.full(3, 0.5), 1.0, np.ones(3), surroundings=np.full(3, wall))
    shown = observe(adapted(models, NAMES, dim), truth, default_cameras(96)[1:])
    last = list(estimate_first(models, replace(shown, images=shown.images * 0.5), np.random.default_rng(0), QUICK))[-1]
    assert last.image_model.encoding == "linear"
    np.testing.assert_allclose(last.image_model.gain, 0.5, rtol=0.1)
    assert np.rad2deg(apart(last.estimate.state, truth)[2]) < 2
