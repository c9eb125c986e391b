from dataclasses import replace

import numpy as np
import pytest

from osfcore.errors import InvalidInput, UnknownName
from osfcore.estimation.first_frame import FirstFrameConfig, estimate_first
from osfcore.geometry.cameras import default_cameras
from tests.core.estimation.scenes import BOTTLE, BOX, angle, apart, lying, observe, scene

QUICK = FirstFrameConfig(
    starts=2,
    population=6,
    generations=2,
    joint_population=8,
    joint_generations=2,
    coarse_iterations=3,
    fine_iterations=2,
)
LEAST = replace(QUICK, starts=1, coarse_iterations=1, fine_iterations=1)
STAGES = ("orientations", "light", "orientations", "objects", "together", "polish", "done")


def steps_of(models, seen, effort=QUICK, seed=0):
    return list(estimate_first(models, seen, np.random.default_rng(seed), effort))


@pytest.fixture(scope="module")
def steps(models, seen):
    return steps_of(models, seen)


@pytest.fixture(scope="module")
def small(models, truth):
    return observe(models, truth, default_cameras(64)[:2])


def test_poses_and_light_are_found(steps, truth):
    estimate = steps[-1].estimate
    shift, turn, light = apart(estimate.state, truth)
    assert shift.max() < 0.005
    assert np.rad2deg(turn).max() < 5
    assert np.rad2deg(light) < 5
    assert estimate.trusted, estimate.reason
    assert estimate.state.names == truth.names


def test_progress_goes_on_to_its_end(steps):
    done = [step.progress.done for step in steps]
    assert done == list(range(1, len(steps) + 1))
    assert {step.progress.total for step in steps} == {len(steps)}
    assert all(step.progress.note for step in steps)
    assert [step.estimate is None for step in steps] == [True] * (len(steps) - 1) + [False]


def test_the_stages_are_those_of_the_method(steps):
    stages = [step.stage for step in steps]
    assert tuple(s for k, s in enumerate(stages) if k == 0 or stages[k - 1] != s) == STAGES
    for step in steps:
        assert step.state.names == (BOX, BOTTLE)
        assert len(step.losses) in (0, 1, 2)
    objects = next(step for step in steps if step.stage == "objects")
    assert objects.candidates.position.shape == (12, 2, 3)
    assert objects.candidates.quaternion.shape == (12, 2, 4)
    together = next(step for step in steps if step.stage == "together")
    assert together.candidates.position.shape == (9, 2, 3)
    assert together.lights.shape == (9, 3)
    assert np.isfinite(together.loss)


def test_the_same_seed_gives_the_same_estimate(models, truth):
    seen = observe(models, scene({BOX: truth.pose(BOX)}), default_cameras(48)[:1])
    before = np.random.get_state()[1].copy()  # noqa: NPY002
    steps, again = steps_of(models, seen, LEAST), steps_of(models, seen, LEAST)
    assert len(again) == len(steps)
    for a, b in zip(steps, again, strict=True):
        np.testing.assert_array_equal(a.state.poses.position, b.state.poses.position)
        np.testing.assert_array_equal(a.state.poses.quaternion, b.state.poses.quaternion)
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
    steps = steps_of(
        models, observe(models, state, default_cameras(64)[:2]), replace(QUICK, held_light=(0.0, 0.0, 1.0))
    )
    for step in steps:
        np.testing.assert_allclose(step.state.light.direction, [0, 0, 1], atol=1e-12)
    estimate = steps[-1].estimate
    assert estimate.light_std == 0
    assert apart(estimate.state, state)[0][0] < 0.005
    done = [step.progress.done for step in steps]
    assert np.all(np.diff(done) > 0)
    assert done[-1] == steps[-1].progress.total


@pytest.mark.slow
def test_cma_alone_moves_the_light(models, small, truth):
    steps = steps_of(models, small, replace(LEAST, light="cma", joint_generations=4))
    assert "light" not in [step.stage for step in steps]
    before = angle(np.array([0, 0, 1.0]), truth.light.direction)
    assert angle(steps[-1].estimate.state.light.direction, truth.light.direction) < before
    assert steps[-1].progress.done == steps[-1].progress.total


def test_an_empty_scene_has_only_its_light(models):
    state = scene({}, (0.5, 0.3, 0.8))
    seen = observe(models, state, default_cameras(64)[:2])
    steps = steps_of(models, seen)
    assert steps[-1].estimate.trusted
    assert steps[-1].estimate.state.names == ()
    assert (
        abs(steps[-1].estimate.state.light.direction[2] - state.light.direction[2]) < 0.05
    )  # all that the table tells
    assert steps[-1].progress.done == steps[-1].progress.total


def test_the_first_frame_needs_masks(models, seen):
    with pytest.raises(InvalidInput, match="masks of the first frame is missing"):
        next(estimate_first(models, replace(seen, masks=None), np.random.default_rng(0)))


def test_masks_that_are_empty_in_every_view_are_refused(models, seen):
    masks = seen.masks.copy()
    masks[:, 1] = False
    with pytest.raises(InvalidInput, match=f"mask of {BOTTLE} is empty in every view"):
        next(estimate_first(models, replace(seen, masks=masks), np.random.default_rng(0)))


@pytest.mark.slow
def test_a_mask_of_one_pixel_is_an_estimate_not_to_be_trusted(models, small):
    masks = small.masks.copy()
    row, column = np.argwhere(masks[0, 1])[0]
    masks[:, 1] = False
    masks[0, 1, row, column] = True
    assert not steps_of(models, replace(small, masks=masks), LEAST)[-1].estimate.trusted


def test_an_object_without_a_field_is_refused(models, seen):
    with pytest.raises(UnknownName, match="no field named '025_mug'"):
        next(estimate_first(models, replace(seen, names=(BOX, "025_mug")), np.random.default_rng(0)))
