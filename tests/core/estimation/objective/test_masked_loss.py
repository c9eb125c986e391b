from dataclasses import replace

import numpy as np
import pytest

from osfcore.estimation.objective import COLOUR_WEIGHT, QUALITY, ObjectView, RenderedObject, masked_loss, render_poses
from osfcore.geometry.cameras import default_cameras
from tests.core.estimation.scenes import BOX
from tests.core.render.scenes import UPRIGHT

LIGHT = np.array([0.48, 0.36, 0.8])
PLACE = np.array([0.02, -0.03, 0.12])
CAMERAS = default_cameras(48)[:2]


def part_that_shows(look, number=0) -> ObjectView:
    mask = look.opacity[number]
    area = mask.sum(axis=(1, 2))
    return ObjectView(CAMERAS, look.rgb[number], mask, np.ones(mask.shape, bool), area, QUALITY)


@pytest.fixture(scope="module")
def part(models):
    bare = ObjectView(CAMERAS, *[np.zeros(0)] * 4, QUALITY)
    return part_that_shows(render_poses(models, BOX, bare, PLACE[None], np.array([UPRIGHT]), LIGHT))


def loss_at(models, part, shifts, light=LIGHT, **how):
    positions = PLACE + np.asarray(shifts)
    look = render_poses(models, BOX, part, positions, np.tile(UPRIGHT, (len(positions), 1)), light)
    return masked_loss(look, part, **how)


def test_the_pose_that_made_the_images_has_no_loss(models, part):
    np.testing.assert_allclose(loss_at(models, part, [[0, 0, 0]]), 0, atol=1e-6)


@pytest.mark.parametrize("axis", range(3))
@pytest.mark.parametrize("sign", [-1, 1])
def test_the_loss_grows_with_displacement(models, part, axis, sign):
    shifts = np.zeros((6, 3))
    shifts[:, axis] = sign * np.array([0, 0.004, 0.01, 0.02, 0.03, 0.05])
    losses = loss_at(models, part, shifts)
    assert np.all(np.diff(losses) > 0)


def test_what_is_nowhere_to_be_seen_loses_the_silhouette(models, part):
    np.testing.assert_allclose(loss_at(models, part, [[0, 0, -5]]), 1, rtol=1e-5)


def test_what_another_object_hides_does_not_count(models, part):
    rgb, mask, valid = part.rgb.copy(), part.mask.copy(), part.valid.copy()
    rgb[:, :24], mask[:, :24], valid[:, :24] = 0, 0, False
    hidden = replace(part, rgb=rgb, mask=mask, valid=valid, area=np.maximum(mask.sum(axis=(1, 2)), 1))
    np.testing.assert_allclose(loss_at(models, hidden, [[0, 0, 0]]), 0, atol=1e-6)
    assert loss_at(models, replace(hidden, valid=part.valid), [[0, 0, 0]])[0] > 0.1


def test_any_brightness_is_up_to_a_factor(models, part):
    for gain in (0.4, 1.0, 2.5):
        brighter = replace(part, rgb=part.rgb * np.float32(gain))
        np.testing.assert_allclose(loss_at(models, brighter, [[0, 0, 0]], any_brightness=True), 0, atol=1e-5)
    assert loss_at(models, replace(part, rgb=part.rgb * np.float32(0.4)), [[0, 0, 0]])[0] > 0.1
    dark = replace(part, rgb=np.zeros_like(part.rgb))  # no factor below the least: black is not a dim box
    assert loss_at(models, dark, [[0, 0, 0]], any_brightness=True)[0] > 0.01


def test_the_loss_by_hand():
    """Two views of 1 x 2 pixels; the second view's mask is twice as large and counts twice."""
    mask = np.float32([[[1, 0]], [[1, 1]]])
    rgb = np.full((2, 1, 2, 3), 0.5, np.float32)
    part = ObjectView((), rgb, mask, np.ones(mask.shape, bool), mask.sum(axis=(1, 2)), QUALITY)
    shown = np.full((1, 2, 1, 2, 3), 0.5, np.float32)
    shown[0, 0, 0, 0] = 0.4, 0.5, 0.6  # 0.2 / 3 away
    shown[0, 1, 0, 1] = 2.0  # cut off at 0.3
    opacity = np.float32([[[[1, 0.25]], [[1, 1]]]])
    first = 0.25 + COLOUR_WEIGHT * 0.2 / 3
    second = COLOUR_WEIGHT * 0.3 / 2
    np.testing.assert_allclose(masked_loss(RenderedObject(shown, opacity), part), (first + 2 * second) / 3, rtol=1e-5)


def test_a_batch_is_its_poses_one_by_one(models, part):
    shifts = np.random.default_rng(0).normal(size=(4, 3)) * 0.02
    together = loss_at(models, part, shifts, any_brightness=True)
    apart = [loss_at(models, part, [shift], any_brightness=True)[0] for shift in shifts]
    np.testing.assert_allclose(together, apart, rtol=1e-6)
