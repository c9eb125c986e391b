from dataclasses import replace

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st

from osfcore.estimation.objective import (
    QUALITY,
    ObservedViews,
    crop_camera,
    crop_to_masks,
    crop_to_object,
    crop_to_silhouette,
    residuals,
    views_of,
)
from osfcore.geometry.cameras import default_cameras
from osfcore.geometry.light import Light
from osfcore.geometry.states import Observation
from osfcore.render.types import OUTPUTS, SceneBatch
from tests.core.estimation.scenes import own_views, params_of
from tests.core.render.scenes import state, view

ROUNDING = 1e-4  # of a ray's direction, when a camera's corner is moved
CAMERAS = default_cameras(64)[:2]


@pytest.fixture(scope="module")
def params():
    """Above the table, which hides what of a field is below it."""
    return params_of(state({"block": (0.05, 0.03, 0.06), "ball": (-0.07, -0.03, 0.06)}))


@pytest.fixture(scope="module")
def views(plain, params):
    return own_views(plain, params, CAMERAS)


def observation(width=96, height=64, masks=True) -> Observation:
    rng = np.random.default_rng(0)
    cameras = tuple(camera.resized(width, height) for camera in default_cameras()[:2])
    images = rng.uniform(size=(2, height, width, 3))
    chosen = rng.uniform(size=(2, 3, height, width)) < 0.3 if masks else None
    return Observation(cameras, images, ("a", "b", "c"), chosen, np.array([0.1, 0, 0.062]), 0.0)


@given(seed=st.integers(0, 10**6), width=st.integers(16, 200), height=st.integers(16, 200), side=st.integers(16, 200))
def test_a_world_point_projects_to_the_scaled_pixel(seed, width, height, side):
    camera = view().resized(width, height)
    seen = Observation((camera,), np.zeros((1, height, width, 3)), (), None, None, 0.0)
    views = views_of(seen, side)
    small = views.cameras[0]
    assert views.images.shape == (1, small.height, small.width, 3)
    assert max(small.width, small.height) <= max(side, 16)
    point = 0.2 * np.random.default_rng(seed).normal(size=(5, 3))
    scale = small.width / width, small.height / height
    np.testing.assert_allclose(small.project(point), camera.project(point) * scale, rtol=1e-9, atol=1e-9)


def test_images_and_masks_are_means_over_pixels():
    seen = observation()
    views = views_of(seen, 48)
    assert views.images.shape == (2, 32, 48, 3)
    np.testing.assert_allclose(views.images, seen.images.reshape(2, 32, 2, 48, 2, 3).mean(axis=(2, 4)), atol=1e-6)
    np.testing.assert_allclose(views.masks, seen.masks.reshape(2, 3, 32, 2, 48, 2).mean(axis=(3, 5)), atol=1e-6)
    assert views.images.dtype == views.masks.dtype == np.float32


def test_images_are_never_enlarged():
    seen = observation()
    views = views_of(seen, 500)
    np.testing.assert_array_equal(views.images, seen.images.astype(np.float32))
    np.testing.assert_array_equal(views.masks, seen.masks)
    assert [(c.width, c.height) for c in views.cameras] == [(96, 64)] * 2


def test_what_else_was_observed_stays():
    views = views_of(observation(masks=False), 48, samples=2)
    assert views.masks is views.only is None
    np.testing.assert_array_equal(views.pusher, [0.1, 0, 0.062])
    assert views.quality == replace(QUALITY, samples_per_side=2)
    assert views_of(observation(), 48).quality == QUALITY
    flat = views_of(observation(200, 16), 32)  # no side may become shorter than a camera's shortest
    assert flat.images.shape == (2, 16, 32, 3)


def test_no_objects_have_no_masks():
    seen = replace(observation(), names=(), masks=np.zeros((2, 0, 64, 96), bool))
    assert views_of(seen, 48).masks.shape == (2, 0, 32, 48)


@pytest.mark.parametrize("samples", [1, 2])
def test_a_window_shows_the_pixels_of_the_whole(plain, params, samples):
    quality = replace(QUALITY, samples_per_side=samples)
    batch = SceneBatch.of(params.state())
    x, y, width, height = 13, 9, 30, 24
    whole = plain.together.render(batch, CAMERAS, quality=quality, outputs=OUTPUTS)
    windows = [crop_camera(camera, x, y, width, height) for camera in CAMERAS]
    part = plain.together.render(batch, windows, quality=quality, outputs=OUTPUTS)
    for name in ("rgb", "opacity", "depth"):
        cut = getattr(whole, name)
        cut = cut[:, :, y : y + height, x : x + width] if name != "opacity" else cut[..., y : y + height, x : x + width]
        np.testing.assert_allclose(getattr(part, name), cut, atol=ROUNDING)


@given(x=st.integers(-50, 50), y=st.integers(-50, 50))
def test_a_window_moves_pixels_by_its_corner(x, y):
    points = np.array([[0, 0, 0.04], [0.1, -0.2, 0.0]])
    moved = crop_camera(CAMERAS[0], x, y, 20, 30)
    assert (moved.width, moved.height) == (20, 30)
    np.testing.assert_allclose(moved.project(points) + [x, y], CAMERAS[0].project(points), atol=1e-9)


def test_a_part_is_the_object_and_its_surroundings_by_its_masks(plain, params, views):
    for number, name in enumerate(params.names):
        part = crop_to_masks(views, number, margin=4)
        height, width = part.mask.shape[1:]
        assert len({part.rgb.shape[1:3], part.valid.shape[1:], (height, width)}) == 1
        np.testing.assert_allclose(part.mask.sum(axis=(1, 2)), views.masks[:, number].sum(axis=(1, 2)), rtol=1e-3)
        assert max(height, width) < 32 < 64
        own = SceneBatch((name,), params.positions[None, [number]], params.quaternions[None, [number]],
                         params.light[None], None)  # fmt: skip
        look = plain.alone.render(own, part.cameras, quality=part.quality, outputs={"opacity"}).opacity[0, :, 0]
        for v, camera in enumerate(part.cameras):
            x, y = np.round(views.cameras[v].intrinsics[:2, 2] - camera.intrinsics[:2, 2]).astype(int)
            cut = np.s_[v, y : y + height, x : x + width]
            mask = views.masks[:, number][cut]
            np.testing.assert_array_equal(part.mask[v], mask)
            np.testing.assert_array_equal(part.rgb[v], views.images[cut] * mask[..., None])
            other = views.masks[:, 1 - number][cut]
            np.testing.assert_array_equal(part.valid[v], other < 0.3)
            np.testing.assert_allclose(look[v][other == 0], mask[other == 0], atol=ROUNDING)
        np.testing.assert_allclose(part.area, (part.mask * part.valid).sum(axis=(1, 2)), rtol=1e-6)


def test_a_part_leaves_out_views_that_do_not_show_the_object(views):
    masks = views.masks.copy()
    masks[0, 0] = 0
    part = crop_to_masks(replace(views, masks=masks), 0)
    assert len(part.cameras) == len(part.rgb) == len(part.area) == 1
    assert part.cameras[0].T_world_camera is views.cameras[1].T_world_camera


def test_what_others_cover_is_not_valid(views):
    masks = views.masks.copy()
    masks[:, 1] = 1 - masks[:, 0]
    part = crop_to_masks(replace(views, masks=masks), 0)
    np.testing.assert_array_equal(part.valid, 1 - part.mask < 0.3)
    alone = crop_to_masks(replace(views, masks=masks[:, :1]), 0)
    assert alone.valid.all()


@pytest.mark.parametrize("corner", [(0, 0), (63, 0), (0, 63), (63, 63)])
def test_a_part_at_the_border_stays_in_the_image(views, corner):
    masks = np.zeros_like(views.masks)
    masks[:, 0, corner[1], corner[0]] = 1
    part = crop_to_masks(replace(views, masks=masks), 0)
    assert part.mask.shape == (2, 16, 16)
    assert part.area.tolist() == [1, 1]


def test_around_are_windows_that_hold_the_object(plain, params, views):
    for number in range(2):
        own = crop_to_object(views, plain, params, number)
        assert own.masks is own.only is None
        assert own.images.shape[1] == own.images.shape[2] < 64
        batch = params.perturbed(np.zeros((1, params.size)))
        np.testing.assert_allclose(residuals(plain, own, batch), 0, atol=ROUNDING)
        shown = plain.together.render(batch, own.cameras, quality=QUALITY, outputs={"opacity"}).opacity[0, :, number]
        np.testing.assert_allclose(shown.sum(axis=(1, 2)), views.masks[:, number].sum(axis=(1, 2)), rtol=1e-3)


def test_around_keeps_which_pixels_count(plain, params, views):
    bright = views.images.sum(axis=-1) > 0.2
    own = crop_to_object(replace(views, only=bright), plain, params, 0)
    np.testing.assert_array_equal(own.only, own.images.sum(axis=-1) > 0.2)


def test_around_leaves_out_cameras_that_look_elsewhere(plain, params):
    away = view((0.5, 0, 0.4), (1.0, 0, 0.5), 64)
    both = own_views(plain, params, [CAMERAS[0], away])
    assert len(crop_to_object(both, plain, params, 0).cameras) == 1
    nowhere = own_views(plain, params, [away])
    own = crop_to_object(nowhere, plain, params, 0)
    np.testing.assert_array_equal(own.images, nowhere.images)
    assert own.masks is None
    assert crop_to_silhouette(nowhere, plain, params, 0).only is None


def test_near_is_the_whole_image_inside_and_black_outside(plain, params, views):
    for number in range(2):
        own, wide = crop_to_silhouette(views, plain, params, number), crop_to_object(views, plain, params, number)
        np.testing.assert_array_equal(own.images, wide.images * own.only[..., None])
        batch = SceneBatch.of(params.state())
        some = plain.together.render(batch, own.cameras, quality=own.quality, only=own.only).rgb[0]
        everything = plain.together.render(batch, own.cameras, quality=own.quality).rgb[0]
        np.testing.assert_array_equal(some[own.only], everything[own.only])
        assert not some[~own.only].any()
        assert 0.1 < own.only.mean() < 0.9
        np.testing.assert_allclose(residuals(plain, own, batch), 0, atol=ROUNDING)


def test_near_is_the_silhouette_and_three_pixels_beside_it(plain, params, views):
    own = crop_to_silhouette(views, plain, params, 1)
    batch = params.perturbed(np.zeros((1, params.size)))
    alone = SceneBatch(("ball",), batch.positions[:, [1]], batch.quaternions[:, [1]], batch.lights, None)
    silhouette = plain.alone.render(alone, own.cameras, quality=QUALITY, outputs={"opacity"}).opacity[0, :, 0] > 0
    for only, shown in zip(own.only, silhouette, strict=True):
        rows, columns = np.nonzero(shown)
        for row, column in zip(*np.nonzero(only), strict=True):
            assert np.maximum(abs(rows - row), abs(columns - column)).min() <= 3
        assert only[shown].all()
        assert only[max(rows.min() - 3, 0) : rows.max() + 4].any(axis=1).all()


def test_the_light_does_not_choose_the_pixels(plain, params, views):
    lit = replace(params, light=Light.from_angles(1.0, 0.3).direction)
    np.testing.assert_array_equal(
        crop_to_silhouette(views, plain, params, 0).only, crop_to_silhouette(views, plain, lit, 0).only
    )


def test_views_are_made_of_what_is_given(views):
    assert ObservedViews(views.cameras, views.images, None, None).quality == QUALITY
